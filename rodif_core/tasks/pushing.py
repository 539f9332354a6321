"""Pushing: move a red and a green cube onto two targets with the tip of the rod.

Cubes, targets, start ranges, success and the order of visits are those of D3IL's "Pushing" (Jia et
al., ICLR 2024). Different from D3IL, on purpose: the rod is thicker (see `blocks`), yaw
is given as sine and cosine of four times the angle instead of its tangent, observations add the
rod's place in the frame of each of the four possible pushes, they show the state after the step,
and set-points stay within the arm's reach.
"""

from __future__ import annotations

from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

import rodif_core.tasks.blocks as blocks
from rodif_core.errors import UnknownNameError
from rodif_core.spec import TaskName
from rodif_core.tasks.base import FINISHED, REASONS, Array, Context, Task, View
from rodif_core.tasks.panda import CONTROL_DT, Mesh, add_cube

TARGETS = ((0.42, 0.30), (0.63, 0.30))  # m; red target, green target
TARGET_HALF = 0.05  # m, drawn only
REACHED = 0.05  # m between the centres of cube and target, seen from above
START = (0.525, -0.28)  # m
ROD_HEIGHT = 0.01  # m; the rod's tip stays at this height

CUBE_X = ((0.40, 0.50), (0.55, 0.65))  # m; starts of the red and of the green cube
CUBE_Y = (-0.15, 0.0)  # m
FALLEN = 0.0  # m; a cube whose centre is lower has left the table

RGB = {"red": (0.84, 0.15, 0.16), "green": (0.17, 0.63, 0.28)}

# The visits of D3IL: cube, then target. A mode is the order of the two visits of a success.
VISITS = ("red-to-red", "red-to-green", "green-to-red", "green-to-green")
MODES = {  # name: ((cube, target) of the first push, of the second)
    "rr-gg": ((0, 0), (1, 1)),
    "rg-gr": ((0, 1), (1, 0)),
    "gr-rg": ((1, 0), (0, 1)),
    "gg-rr": ((1, 1), (0, 0)),
}


class PushingTask(Task):
    """The four modes are named by their two pushes: "rg-gr" took red to green, then green to red.

    A success's group is its first push; a failure's is the first visit of a target.
    """

    name: ClassVar[TaskName] = TaskName.PUSHING
    # set-point x, y, end x, y; x, y, sin 4 yaw, cos 4 yaw of either cube; the end in the frame of
    # each push of VISITS, along and across
    observation_dim: ClassVar[int] = 20
    action_dim: ClassVar[int] = 2  # change of the set-point in x, y
    action_limit: ClassVar[float] = 0.0125  # m per control step: 0.357 m/s
    control_dt: ClassVar[float] = CONTROL_DT
    max_steps: ClassVar[int] = 400
    objects: ClassVar[tuple[str, ...]] = ("red", "green")
    contact_ends: ClassVar[bool] = False
    modes: ClassVar[tuple[str, ...]] = tuple(MODES)
    groups: ClassVar[tuple[str, ...]] = VISITS
    preferred_group: ClassVar[str] = "red-to-red"
    criterion: ClassVar[str] = (
        "The robot should first push the red block onto the red target, and then bring the green "
        "block to the green one."
    )

    def build_model(self, mesh: Mesh = "col") -> mujoco.MjModel:
        spec = blocks.pusher_scene(mesh)
        for index, name in enumerate(self.objects):
            spec.worldbody.add_geom(
                name=f"{name}_target",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[*TARGETS[index], 0.001],
                size=[TARGET_HALF, TARGET_HALF, 0.001],
                rgba=[*RGB[name], 0.45],
                contype=0,
                conaffinity=0,
            )
            add_cube(
                spec,
                name,
                half=blocks.HALF,
                mass=blocks.MASS,
                friction=blocks.FRICTION,
                rgba=[*RGB[name], 1.0],
            )
        return spec.compile()

    def sample_context(self, rng: np.random.Generator) -> dict[str, Any]:
        """{"start": [x, y], "red": [x, y, yaw], "green": [x, y, yaw]}: D3IL's ranges, cubes
        apart from each other; the rod's start varies by 4 mm."""
        context: dict[str, Any] = {"start": blocks.draw_start(rng, START)}
        ranges = [(x, CUBE_Y) for x in CUBE_X]
        cubes = blocks.draw_cubes(rng, ranges)
        return context | dict(zip(self.objects, cubes, strict=True))

    def start_point(self, context: Context) -> Array:
        return blocks.read_start(context, ROD_HEIGHT, START)

    def start_objects(self, context: Context) -> Array:
        ranges = {name: (x, CUBE_Y) for name, x in zip(self.objects, CUBE_X, strict=True)}
        return blocks.read_cubes(context, ranges, blocks.HALF)

    def group_of(self, mode: str) -> str:
        if mode not in MODES:
            raise UnknownNameError("mode", mode, MODES)
        cube, target = MODES[mode][0]
        return VISITS[2 * cube + target]

    def move(self, setpoints: Array, actions: Array) -> Array:
        moved = setpoints.copy()
        moved[:, :2] += actions
        return blocks.clamp_reach(moved)

    def observe(self, view: View) -> Array:
        ends = view.ends[:, :2]
        frames = [
            blocks.push_frame(ends, view.objects[:, cube, :2], np.array([target]))
            for cube in range(2)
            for target in TARGETS
        ]
        cubes = blocks.cube_features(view.objects)
        return np.concatenate([view.setpoints[:, :2], ends, cubes, *frames], axis=1)

    def finished(self, view: View) -> NDArray[np.bool_]:
        there = visited(view.objects)
        straight = there[:, 0, 0] & there[:, 1, 1]
        return np.asarray(straight | (there[:, 0, 1] & there[:, 1, 0]))

    def inside(self, view: View) -> NDArray[np.bool_]:
        """Set-points cannot leave; a cube that falls off the table has left."""
        return np.asarray((view.objects[:, :, 2] > FALLEN).all(axis=1))

    def outcome(
        self,
        path: NDArray[np.floating[Any]],  # noqa: ARG002 - only the cubes decide
        objects: NDArray[np.floating[Any]],
        reason: str,
    ) -> dict[str, Any]:
        if reason not in REASONS:
            raise UnknownNameError("reason", reason, REASONS)
        there = visited(np.asarray(objects, dtype=np.float64))
        mode = read_mode(there) if reason == FINISHED else None
        group = first_visit(there) if mode is None else self.group_of(mode)
        return {"success": reason == FINISHED, "mode": mode, "group": group, "reason": reason}

    def scene_shapes(self) -> list[dict[str, Any]]:
        """Targets and cubes as `blocks` describes them, the workspace box {type, x0, y0, x1, y1}
        and the start {type, x, y}; metres."""
        colours = blocks.colours(RGB)
        half = (TARGET_HALF, TARGET_HALF)
        middle = (sum(CUBE_Y)) / 2
        return [
            *(
                blocks.target_shape(name, target, half, colours[name])
                for name, target in zip(self.objects, TARGETS, strict=True)
            ),
            *(
                blocks.cube_shape(index, name, (sum(CUBE_X[index]) / 2, middle), colours[name])
                for index, name in enumerate(self.objects)
            ),
            {
                "type": "workspace",
                "x0": blocks.MIN_X,
                "y0": -0.34,
                "x1": blocks.MAX_X,
                "y1": 0.38,
            },
            {"type": "start", "x": START[0], "y": START[1]},
        ]


def visited(objects: Array) -> NDArray[np.bool_]:
    """(m, 2, 2) bool: cube i of poses (m, 2, 7) is within REACHED of target j, and on the table."""
    offsets = objects[:, :, None, :2] - np.array(TARGETS)
    near = np.sqrt((offsets * offsets).sum(axis=-1)) <= REACHED
    on_table = objects[:, :, 2] > FALLEN
    return np.asarray(near & on_table[:, :, None])


def read_mode(there: NDArray[np.bool_]) -> str:
    """Mode of a success with visits `there` (N + 1, 2, 2): which cube was first on the target that
    it ended on. Where both arrived in the same step, red counts as first."""
    straight = bool(there[-1, 0, 0] and there[-1, 1, 1])
    red = blocks.first_entry(there[:, 0, 0 if straight else 1])
    green = blocks.first_entry(there[:, 1, 1 if straight else 0])
    red_first = (red or 0) <= (green or 0)
    if straight:
        return "rr-gg" if red_first else "gg-rr"
    return "rg-gr" if red_first else "gr-rg"


def first_visit(there: NDArray[np.bool_]) -> str | None:
    """The first visit of any target by any cube; None: there was none."""
    entries = {
        VISITS[2 * cube + target]: blocks.first_entry(there[:, cube, target])
        for cube in range(2)
        for target in range(2)
    }
    reached = [(step, name) for name, step in entries.items() if step is not None]
    return min(reached)[1] if reached else None
