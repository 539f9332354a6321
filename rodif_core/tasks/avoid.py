"""Avoid: cross a field of six cylinders with a rod, without touching any.

Geometry, observation, success and modes are those of D3IL's "Avoiding" (Jia et al., ICLR 2024).
Different from D3IL, on purpose: observations show the state after the step, contact is looked at in
every physics step, leaving the workspace is a failure, and the start varies by a few millimetres.
"""

from __future__ import annotations

from itertools import product
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.spec import TaskName
from rodif_core.tasks.base import FINISHED, REASONS, Array, Context, Task, View, read_numbers
from rodif_core.tasks.panda import CONTROL_DT, OBJECT_BIT, TOOL_BIT, Mesh, rod_scene

# Rows of cylinders in the order of travel: (x, y, radius) in metres, left (small x) to right.
ROWS = (
    ((0.5, -0.10, 0.03),),
    ((0.425, 0.08, 0.025), (0.575, 0.08, 0.025)),
    ((0.35, 0.26, 0.025), (0.5, 0.26, 0.025), (0.65, 0.26, 0.025)),
)
HEIGHTS = (0.07, 0.10, 0.10)  # m above the table, a row each
FINISH_Y = 0.35  # m
START = (0.525, -0.28)  # m
START_JITTER = 0.004  # m; starts are uniform in START +- this, on both axes
ROD_HEIGHT = 0.03  # m; the rod's tip stays at this height

# Limits of the workspace. Left and right leave 4.5 cm beside the outer cylinders' contact, so that
# all 24 modes can be had; they lie symmetrically about the field's middle, x = 0.5. Nearer than
# MIN_REACH and farther than MAX_REACH from the base the arm cannot hold the rod upright.
MIN_X, MAX_X = 0.27, 0.73  # m
MIN_Y = -0.36  # m
MIN_REACH, MAX_REACH = 0.32, 0.80  # m from the base
REACH_MARGIN = 0.01  # m; set-points may go this far beyond, so that ends can cross the limits

# A row's gap is read when the path is first this close to the row (m); the last row's at y >= 0.26.
ROW_BAND = 0.03

_COLOUR = (0.80, 0.22, 0.18, 1.0)


class AvoidTask(Task):
    """The 24 modes are named side-gap-gap, counted from the left (small x).

    "L-12" passed the first cylinder on its left, row two through gap 1 of 3 and row three through
    gap 2 of 4; gaps 1 and 3 of row two, 1 and 4 of row three are the ways around the row.
    """

    name: ClassVar[TaskName] = TaskName.AVOID
    observation_dim: ClassVar[int] = 4  # set-point x, y, end x, y
    action_dim: ClassVar[int] = 2  # change of the set-point in x, y
    action_limit: ClassVar[float] = 0.0125  # m per control step: 0.357 m/s
    control_dt: ClassVar[float] = CONTROL_DT
    max_steps: ClassVar[int] = 150
    contact_ends: ClassVar[bool] = True
    groups: ClassVar[tuple[str, ...]] = ("left", "right")
    preferred_group: ClassVar[str] = "left"
    modes: ClassVar[tuple[str, ...]] = tuple(
        f"{side}-{second}{third}" for side, second, third in product("LR", "123", "1234")
    )
    criterion: ClassVar[str] = (
        "The rod should pass the first cylinder on the left (seen in the direction of travel: "
        "on the robot's side) and reach the finish line without touching any cylinder."
    )

    def build_model(self, mesh: Mesh = "col") -> mujoco.MjModel:
        spec = rod_scene(mesh)
        for row, height in zip(ROWS, HEIGHTS, strict=True):
            for x, y, radius in row:
                spec.worldbody.add_geom(
                    name=f"cylinder_{x:g}_{y:g}",
                    type=mujoco.mjtGeom.mjGEOM_CYLINDER,
                    pos=[x, y, height / 2],
                    size=[radius, height / 2, 0.0],
                    rgba=_COLOUR,
                    contype=OBJECT_BIT,
                    conaffinity=OBJECT_BIT | TOOL_BIT,
                )
        spec.worldbody.add_geom(
            name="finish_line",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[0.5, FINISH_Y, 0.001],
            size=[(MAX_X - MIN_X) / 2, 0.005, 0.001],
            rgba=[0.20, 0.62, 0.33, 1.0],
            contype=0,
            conaffinity=0,
        )
        return spec.compile()

    def sample_context(self, rng: np.random.Generator) -> dict[str, Any]:
        """{"start": [x, y]}: D3IL's start, up to 4 mm off on either axis."""
        start = np.array(START) + rng.uniform(-START_JITTER, START_JITTER, 2)
        return {"start": [float(start[0]), float(start[1])]}

    def start_point(self, context: Context) -> Array:
        legal = (
            f"[x, y] in metres with x in [{MIN_X}, {MAX_X}], y in [{MIN_Y}, -0.15] "
            f"and {MIN_REACH} to {MAX_REACH} from the robot's base"
        )
        point = np.append(read_numbers(context, "start", 2, legal), ROD_HEIGHT)
        if point[1] > -0.15 or not self._within(point[None])[0]:
            raise ValueOutOfRangeError("start", context["start"], legal)
        return point

    def group_of(self, mode: str) -> str:
        if mode not in self.modes:
            raise UnknownNameError("mode", mode, self.modes)
        return self.groups["LR".index(mode[0])]

    def move(self, setpoints: Array, actions: Array) -> Array:
        moved = setpoints.copy()
        moved[:, :2] += actions
        moved[:, 0] = np.clip(moved[:, 0], MIN_X - REACH_MARGIN, MAX_X + REACH_MARGIN)
        moved[:, 1] = np.clip(moved[:, 1], MIN_Y - REACH_MARGIN, FINISH_Y + 0.05)
        reach = np.sqrt(moved[:, 0] ** 2 + moved[:, 1] ** 2)
        legal = np.clip(reach, MIN_REACH - REACH_MARGIN, MAX_REACH + REACH_MARGIN)
        moved[:, :2] *= (legal / reach)[:, None]
        return moved

    def observe(self, view: View) -> Array:
        return np.concatenate([view.setpoints[:, :2], view.ends[:, :2]], axis=1)

    def finished(self, view: View) -> NDArray[np.bool_]:
        return np.asarray(view.ends[:, 1] > FINISH_Y)

    def inside(self, view: View) -> NDArray[np.bool_]:
        return self._within(view.ends)

    @staticmethod
    def _within(ends: Array) -> NDArray[np.bool_]:
        x, y = ends[:, 0], ends[:, 1]
        reach = np.sqrt(x**2 + y**2)
        return np.asarray(
            (x >= MIN_X) & (x <= MAX_X) & (y >= MIN_Y) & (reach >= MIN_REACH) & (reach <= MAX_REACH)
        )

    def outcome(
        self,
        path: NDArray[np.floating[Any]],
        objects: NDArray[np.floating[Any]],  # noqa: ARG002 - Avoid has none
        reason: str,
    ) -> dict[str, Any]:
        if reason not in REASONS:
            raise UnknownNameError("reason", reason, REASONS)
        gaps = passed_gaps(path)
        success = reason == FINISHED
        mode = None
        if success and None not in gaps:
            mode = f"{'LR'[(gaps[0] or 1) - 1]}-{gaps[1]}{gaps[2]}"
        group = None if gaps[0] is None else self.groups[gaps[0] - 1]
        return {"success": success, "mode": mode, "group": group, "reason": reason}

    def scene_shapes(self) -> list[dict[str, Any]]:
        """Cylinders {type, x, y, radius, colour}, the finish line {type, y, x0, x1, colour},
        the workspace box {type, x0, y0, x1, y1} and the start {type, x, y}; metres."""
        cylinders = [
            {"type": "cylinder", "x": x, "y": y, "radius": radius, "colour": "#cc382e"}
            for row in ROWS
            for x, y, radius in row
        ]
        return [
            *cylinders,
            {"type": "finish", "y": FINISH_Y, "x0": MIN_X, "x1": MAX_X, "colour": "#339e54"},
            {"type": "workspace", "x0": MIN_X, "y0": MIN_Y, "x1": MAX_X, "y1": FINISH_Y},
            {"type": "start", "x": START[0], "y": START[1]},
        ]


def passed_gaps(path: NDArray[np.floating[Any]]) -> tuple[int | None, int | None, int | None]:
    """Which gap of each row a path (N + 1, at least 2) took, from 1 at the left; None: not reached.

    D3IL's rule: the row's gap is given by x at the first control step with |y - row| <= 3 cm, in
    the last row at the first with y >= row.
    """
    x, y = np.asarray(path)[:, 0], np.asarray(path)[:, 1]
    gaps: list[int | None] = []
    for index, row in enumerate(ROWS):
        row_y = row[0][1]
        last = index == len(ROWS) - 1
        there = np.flatnonzero(y >= row_y if last else np.abs(y - row_y) <= ROW_BAND)
        if len(there) == 0:
            gaps.append(None)
        else:
            gaps.append(1 + int(np.sum(x[there[0]] >= np.array([centre[0] for centre in row]))))
    return gaps[0], gaps[1], gaps[2]
