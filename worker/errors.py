"""Errors of starting and running the process tree, told so that one knows what to do."""

from __future__ import annotations

from pathlib import Path

from rodif_core.errors import RodifError


class SystemStartError(RodifError):
    """The process tree cannot start or cannot go on; the message says what to do."""


class StateInUseError(SystemStartError):
    """Another process already runs the system of this state folder."""

    def __init__(self, state_dir: Path, pid: str) -> None:
        super().__init__(
            f"the state folder {str(state_dir)!r} is in use by process {pid or 'unknown'};"
            " stop that one, or choose another folder with --state"
        )


class ServiceCrashedError(SystemStartError):
    """A process of the tree died again and again; the message shows the end of its log."""

    def __init__(self, name: str, times: int, seconds: float, log: Path, tail: str) -> None:
        self.name, self.log = name, log
        super().__init__(
            f"{name} crashed {times} times in {seconds:.0f} seconds, so everything was stopped;"
            f" the end of {log}:\n{tail}"
        )
