"""Pretrained checkpoints that are part of the package. Read as bytes: no torch here."""

from __future__ import annotations

from importlib import resources
from importlib.resources.abc import Traversable

from rodif_core.errors import CheckpointFileError
from rodif_core.spec import TaskName


def shipped_tasks() -> list[TaskName]:
    """Tasks with a shipped checkpoint."""
    return [task for task in TaskName if _file(task).is_file()]


def shipped_checkpoint(task: TaskName) -> bytes:
    """The pretrained checkpoint of a task; raises CheckpointFileError when none is shipped."""
    if not _file(task).is_file():
        others = ", ".join(repr(other.value) for other in shipped_tasks())
        raise CheckpointFileError(
            f"no checkpoint is shipped for task {task.value!r}; tasks that have one: "
            f"{others or 'none (install the project again)'}. "
            f"`rodif pretrain {task.value} --out FILE` makes one"
        )
    return _file(task).read_bytes()


def _file(task: TaskName) -> Traversable:
    return resources.files("rodif_core") / "checkpoints" / f"{task.value}.safetensors"
