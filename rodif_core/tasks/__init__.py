"""Robot tasks: the scene, the control, and the scripted experts."""

from __future__ import annotations

from rodif_core.errors import UnknownNameError
from rodif_core.spec import TaskName
from rodif_core.tasks.aligning import AligningStateTask, AligningTask
from rodif_core.tasks.avoid import AvoidTask
from rodif_core.tasks.base import Task
from rodif_core.tasks.pushing import PushingTask
from rodif_core.tasks.sorting import SortingTask
from rodif_core.tasks.stacking import StackingStateTask, StackingTask

TASKS: dict[TaskName, Task] = {
    TaskName.AVOID: AvoidTask(),
    TaskName.PUSHING: PushingTask(),
    TaskName.SORTING: SortingTask(),
    TaskName.ALIGNING: AligningTask(),
    TaskName.STACKING: StackingTask(),
    TaskName.ALIGNING_STATE: AligningStateTask(),
    TaskName.STACKING_STATE: StackingStateTask(),
}


def get_task(name: str) -> Task:
    """The task of that name; raises UnknownNameError listing the legal names."""
    for legal, task in TASKS.items():
        if legal == name:
            return task
    raise UnknownNameError("task", name, [legal.value for legal in TASKS])


__all__ = ["TASKS", "Task", "get_task"]
