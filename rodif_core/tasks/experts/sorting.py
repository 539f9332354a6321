"""A scripted demonstrator for Sorting: reacts to the observation alone, given its mode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import UnknownNameError
from rodif_core.tasks.base import Array
from rodif_core.tasks.experts.push import HAND_TREMBLE, steer
from rodif_core.tasks.sorting import BIN_Y, SortingTask, edge_point

OVER_THE_EDGE = BIN_Y[0] + 0.012  # m; a cube whose centre is there falls
NOWHERE = (9.0, 9.0)  # m; where a cube that lies in its bin is for the rod above it


@dataclass(frozen=True)
class SortingExpert:
    """Pushes one cube over the edge into its bin and then the other.

    Raises UnknownNameError for a mode that the task has not.
    """

    mode: str
    tremble: ClassVar[float] = HAND_TREMBLE

    def __post_init__(self) -> None:
        if self.mode not in SortingTask.modes:
            raise UnknownNameError("mode", self.mode, SortingTask.modes)

    def act(self, observation: NDArray[np.float32]) -> Array:
        """The steady hand's action (2,) in metres for an observation (16,)."""
        values = [float(value) for value in observation[:12]]
        rod = values[2], values[3]
        cubes = [(values[4], values[5]), (values[8], values[9])]
        cube = SortingTask.modes.index(self.mode)
        if cubes[cube][1] > OVER_THE_EDGE:
            cube = 1 - cube
        other = cubes[1 - cube]
        if other[1] > OVER_THE_EDGE:
            other = NOWHERE
        x, y = edge_point(np.array([cubes]), cube)[0]
        return np.array(steer(rod, cubes[cube], (float(x), float(y)), other))

    def to_json(self) -> dict[str, Any]:
        """The parameters, for the record of a demonstration."""
        return {"mode": self.mode, "tremble": self.tremble}
