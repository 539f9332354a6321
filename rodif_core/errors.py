"""The error tree of RoDiF Studio.

    RodifError
    ├── UnknownNameError        a name (task, method, mode …) that does not exist
    ├── ValueOutOfRangeError    a number or text outside its legal range
    ├── TrajectoryFileError     an episode file that is missing, truncated or inconsistent
    ├── CheckpointFileError     a checkpoint file that is missing, truncated or inconsistent
    ├── DemonstrationFileError  a file of demonstrations that cannot be read or trained on
    ├── SimulationDivergedError the physics of one simulation blew up
    ├── GraphicsError           this machine cannot draw pictures off screen
    └── LearningError           fine-tuning or pretraining cannot go on (no labels …)

Every message names the offending value and the legal ones.
"""

from __future__ import annotations

from collections.abc import Iterable


class RodifError(Exception):
    """Base of all errors that a user of RoDiF Studio can cause or fix."""


class UnknownNameError(RodifError):
    """A name that does not exist; the message lists the names that do."""

    def __init__(self, kind: str, name: object, legal: Iterable[object]) -> None:
        self.kind, self.name, self.legal = kind, name, tuple(legal)
        choices = ", ".join(repr(str(item)) for item in self.legal)
        super().__init__(f"unknown {kind} {str(name)!r}; legal values are {choices}")


class ValueOutOfRangeError(RodifError):
    """A value outside its legal range; the message names the range."""

    def __init__(self, name: str, value: object, legal: str) -> None:
        self.name, self.value, self.legal = name, value, legal
        super().__init__(f"{name} is {value!r}, but must be {legal}")


class TrajectoryFileError(RodifError):
    """An episode file that cannot be read back as a trajectory."""


class CheckpointFileError(RodifError):
    """A checkpoint file that cannot be read back as a policy."""


class SimulationDivergedError(RodifError):
    """The physics of at least one simulation produced non-finite values."""


class DemonstrationFileError(RodifError):
    """A file of demonstrations that is damaged, of another task, failed, or not plain data."""


class GraphicsError(RodifError):
    """Pictures cannot be drawn on this machine; the message says what to install."""


class LearningError(RodifError):
    """Pretraining or fine-tuning cannot go on; the message says why and what to do."""
