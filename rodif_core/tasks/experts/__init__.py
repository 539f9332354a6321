"""Scripted demonstrators. Each is drawn for one episode and then reacts to observations alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import UnknownNameError
from rodif_core.spec import TaskName
from rodif_core.tasks.base import Array, Context
from rodif_core.tasks.experts.aligning import AligningExpert
from rodif_core.tasks.experts.avoid import AvoidExpert
from rodif_core.tasks.experts.pushing import PushingExpert
from rodif_core.tasks.experts.sorting import SortingExpert
from rodif_core.tasks.experts.stacking import StackingExpert


class Expert(Protocol):
    """One demonstrator in one mode.

    Nothing hidden (no clock, no phase) decides what it does, so it can also take over or label a
    policy's own rollouts.
    """

    @property
    def mode(self) -> str:
        """The mode that it drives for."""

    @property
    def tremble(self) -> float | Array:
        """Standard deviation of the hand's noise in task units per control step: of every axis, or
        (A,) axis by axis."""

    def act(self, observation: NDArray[np.float32]) -> Array:
        """The steady hand's action (A,) in task units for an observation (O,)."""

    def to_json(self) -> dict[str, Any]:
        """The parameters, for the record of a demonstration."""


Draw = Callable[[str, Context, np.random.Generator], Expert]


def _same_everywhere(expert: Callable[[str], Expert]) -> Draw:
    """Of an expert that differs by its mode only."""
    return lambda mode, _context, _rng: expert(mode)


EXPERTS: dict[TaskName, Draw] = {
    TaskName.AVOID: AvoidExpert.draw,
    TaskName.PUSHING: _same_everywhere(PushingExpert),
    TaskName.SORTING: _same_everywhere(SortingExpert),
    TaskName.ALIGNING: _same_everywhere(AligningExpert),
    TaskName.STACKING: _same_everywhere(StackingExpert),
    TaskName.ALIGNING_STATE: _same_everywhere(AligningExpert),
    TaskName.STACKING_STATE: _same_everywhere(StackingExpert),
}


def draw_expert(task: TaskName, mode: str, context: Context, rng: np.random.Generator) -> Expert:
    """An expert for one episode; raises UnknownNameError for a task without one, and for a mode
    that the task has not."""
    if task not in EXPERTS:
        raise UnknownNameError("task with an expert", task.value, EXPERTS)
    return EXPERTS[task](mode, context, rng)


__all__ = ["EXPERTS", "Expert", "draw_expert"]
