"""A scripted demonstrator for Pushing: reacts to the observation alone, given its mode."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import UnknownNameError
from rodif_core.tasks.base import Array
from rodif_core.tasks.experts.push import HAND_TREMBLE, steer
from rodif_core.tasks.pushing import MODES, TARGETS

# m from its target at which a cube is left alone. At half of that three in four demonstrations went
# round the cube once more to correct a centimetre, which is long and hard to imitate.
PLACED = 0.035


@dataclass(frozen=True)
class PushingExpert:
    """Pushes one cube to one target and then the other cube to the other.

    Raises UnknownNameError for a mode that the task has not.
    """

    mode: str
    tremble: ClassVar[float] = HAND_TREMBLE

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise UnknownNameError("mode", self.mode, MODES)

    def act(self, observation: NDArray[np.float32]) -> Array:
        """The steady hand's action (2,) in metres for an observation (20,)."""
        values = [float(value) for value in observation[:12]]
        rod = values[2], values[3]
        cubes = (values[4], values[5]), (values[8], values[9])
        first, second = MODES[self.mode]
        cube, target = first
        if math.dist(cubes[cube], TARGETS[target]) < PLACED:
            cube, target = second
        return np.array(steer(rod, cubes[cube], TARGETS[target], cubes[1 - cube]))

    def to_json(self) -> dict[str, Any]:
        """The parameters, for the record of a demonstration."""
        return {"mode": self.mode, "tremble": self.tremble}
