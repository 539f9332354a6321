"""A scripted demonstrator for Avoid: follows a smooth path through one gap of each row.

Given its path the expert is a function of the observation alone: it looks a little ahead on the
path and goes there at its own speed, so it steers back whenever its hand trembles. Nothing hidden
(no clock, no phase) decides what it does, which makes it easy to imitate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import LearningError, UnknownNameError
from rodif_core.tasks.avoid import FINISH_Y, ROWS, START, AvoidTask
from rodif_core.tasks.base import Context
from rodif_core.tasks.panda import ROD_RADIUS

Array = NDArray[np.float64]

# Where paths cross each row: middle and half-width (m) of a uniform draw, gaps from the left.
CROSSINGS = (
    ((0.425, 0.012), (0.575, 0.012)),
    ((0.350, 0.010), (0.500, 0.012), (0.650, 0.010)),
    ((0.295, 0.005), (0.425, 0.012), (0.575, 0.012), (0.705, 0.005)),
)
EXIT_Y = 0.42  # m; the path's last point, past the finish line
EXIT_PULL = 0.15  # share of the way back to the middle, x = 0.5, between the last row and EXIT_Y
OUTER_EARLY = 0.02  # m of y: paths around the last row get out that much before it
SLOPE = 0.4  # of the slope between the neighbours: how early a path turns to its next gap
MIN_CLEARANCE = 0.008  # m between rod and cylinder, everywhere on the path
MAX_DRAWS = 200  # of one path; measured: the hardest modes need about 1
LOOK_AHEAD = 0.03  # m along the path
SPEEDS = (0.0088, 0.0116)  # m per control step, a draw per episode; D3IL's stick was at 0.0125


@dataclass(frozen=True)
class AvoidExpert:
    """One way through the field: x as a piecewise cubic function of y, and a speed."""

    mode: str
    knots_x: tuple[float, ...]  # m; start, three crossings, exit
    knots_y: tuple[float, ...]  # m
    speed: float  # m per control step
    tremble: ClassVar[float] = 0.0008  # m per control step: standard deviation of the hand's noise

    @classmethod
    def draw(cls, mode: str, context: Context, rng: np.random.Generator) -> AvoidExpert:
        """Draw a path of that mode from the context's start which is clear of all cylinders.

        Raises UnknownNameError for a mode that is not one of the task's 24.
        """
        if mode not in AvoidTask.modes:
            raise UnknownNameError("mode", mode, AvoidTask.modes)
        start = context["start"]
        gaps = ("LR".index(mode[0]), int(mode[2]) - 1, int(mode[3]) - 1)
        rows_y = [row[0][1] for row in ROWS]
        if gaps[2] in (0, 3):
            rows_y[2] -= OUTER_EARLY
        speed = float(rng.uniform(*SPEEDS))
        for _ in range(MAX_DRAWS):
            crossings = [
                float(rng.uniform(middle - width, middle + width))
                for middle, width in (CROSSINGS[i][gap] for i, gap in enumerate(gaps))
            ]
            exit_x = crossings[-1] + EXIT_PULL * (0.5 - crossings[-1])
            expert = cls(
                mode=mode,
                knots_x=(float(start[0]), *crossings, exit_x),
                knots_y=(float(start[1]), *rows_y, EXIT_Y),
                speed=speed,
            )
            if expert.clearance() >= MIN_CLEARANCE:
                return expert
        raise LearningError(
            f"no clear path of mode {mode} from {start} in {MAX_DRAWS} draws; "
            f"starts belong around {START}"
        )

    def x(self, y: Array | float) -> Array:
        """The path's x (m) at y (m): cubic Hermite between the knots."""
        xs, ys = np.array(self.knots_x), np.array(self.knots_y)
        slopes = np.zeros(len(xs))
        slopes[1:-1] = SLOPE * (xs[2:] - xs[:-2]) / (ys[2:] - ys[:-2])
        # Free ends: no curvature at the start, so that left and right part at once.
        slopes[0] = 1.5 * (xs[1] - xs[0]) / (ys[1] - ys[0]) - 0.5 * slopes[1]
        y = np.clip(np.asarray(y, dtype=np.float64), ys[0], ys[-1])
        i = np.clip(np.searchsorted(ys, y, side="right") - 1, 0, len(ys) - 2)
        width = ys[i + 1] - ys[i]
        t = (y - ys[i]) / width
        return np.asarray(
            (1 + 2 * t) * (1 - t) ** 2 * xs[i]
            + t * (1 - t) ** 2 * width * slopes[i]
            + t**2 * (3 - 2 * t) * xs[i + 1]
            + t**2 * (t - 1) * width * slopes[i + 1]
        )

    def clearance(self) -> float:
        """Least distance (m) between rod and cylinders on the path; negative: they would touch."""
        y = np.linspace(self.knots_y[0], FINISH_Y, 400)
        x = self.x(y)
        return min(
            float(np.min(np.hypot(x - cx, y - cy))) - radius - ROD_RADIUS
            for row in ROWS
            for cx, cy, radius in row
        )

    def act(self, observation: NDArray[np.float32]) -> Array:
        """The steady hand's action (2,) in metres for an observation (4,)."""
        setpoint = np.asarray(observation[:2], dtype=np.float64)
        below, above = self.x(np.array([setpoint[1] - 1e-3, setpoint[1] + 1e-3]))
        slope = (above - below) / 2e-3
        # Measured along the path: a look-ahead in y alone would cut the corners of steep paths.
        rise = LOOK_AHEAD / np.sqrt(1.0 + slope**2)
        direction = np.array([float(self.x(setpoint[1] + rise)) - setpoint[0], rise])
        return np.asarray(self.speed * direction / np.hypot(*direction))

    def to_json(self) -> dict[str, Any]:
        """The parameters, for the record of a demonstration."""
        return {
            "mode": self.mode,
            "knots_x": list(self.knots_x),
            "knots_y": list(self.knots_y),
            "speed": self.speed,
            "tremble": self.tremble,
        }
