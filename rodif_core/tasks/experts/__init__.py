"""Scripted demonstrators. Each is drawn for one episode and then reacts to observations alone."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

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


def draw_expert(task: TaskName, mode: str, context: Context, rng: np.random.Generator) -> Expert:
    """An expert for one episode; raises UnknownNameError for a mode that the task has not."""
    if task is TaskName.AVOID:
        return AvoidExpert.draw(mode, context, rng)
    if task is TaskName.PUSHING:
        return PushingExpert(mode)
    if task in (TaskName.ALIGNING, TaskName.ALIGNING_STATE):
        return AligningExpert(mode)
    if task in (TaskName.STACKING, TaskName.STACKING_STATE):
        return StackingExpert(mode)
    return SortingExpert(mode)


__all__ = ["Expert", "draw_expert"]
