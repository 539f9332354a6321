"""Sorting: push a red and a blue cube off a platform, each into the bin of its colour.

Platform, bins, start cells, success and the order of sorting are those of D3IL's "Sorting" with two
cubes (Jia et al., ICLR 2024). Different from D3IL, on purpose: the rod is thicker (see
`blocks`), a bin has three walls and begins at the platform's edge, yaw is given as sine and cosine
of four times the angle instead of its tangent, observations add the rod's place in the frame of
both pushes, they show the state after the step, set-points stay within the arm's reach, and a cube
that fell anywhere but into its bin ends the episode: nothing can bring it back.
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
from rodif_core.tasks.panda import (
    CONTROL_DT,
    OBJECT_BIT,
    TOOL_BIT,
    Mesh,
    add_cube,
)

PLATFORM_X = (0.2, 0.8)  # m
PLATFORM_Y = (-0.4, 0.2)  # m; cubes fall over the edge at y = 0.2
PLATFORM_TOP = 0.10  # m above the table
BIN_X = ((0.3, 0.5), (0.525, 0.725))  # m, inside; red bin, blue bin
BIN_Y = (PLATFORM_Y[1], 0.41)  # m; D3IL's begin 2 cm behind the edge
WALL = 0.08  # m, height of the bins' walls: lower than the platform, so that nothing stops at them
WALL_HALF = 0.005  # m
FALLEN = 0.09  # m; a cube whose centre is lower has left the platform
START = (0.525, -0.30)  # m
ROD_HEIGHT = PLATFORM_TOP + 0.01  # m; the rod's tip stays at this height

# The cubes start in two different ones of these six cells.
CELL_X = ((0.40, 0.50), (0.55, 0.65))  # m
CELL_Y = ((-0.15, -0.10), (-0.05, 0.0), (0.05, 0.10))  # m
START_X = (CELL_X[0][0], CELL_X[-1][1])
START_Y = (CELL_Y[0][0], CELL_Y[-1][1])

RGB = {"red": (0.84, 0.15, 0.16), "blue": (0.15, 0.35, 0.80)}
GREY = (0.62, 0.64, 0.67, 0.6)  # seen through, so that replays show the cubes behind its edge


class SortingTask(Task):
    """The two modes are the order of the cubes in their bins: "red-blue" sorted red first."""

    name: ClassVar[TaskName] = TaskName.SORTING
    # set-point x, y, end x, y; x, y, sin 4 yaw, cos 4 yaw of either cube; the end in the frame of
    # the push of either cube to its bin, along and across
    observation_dim: ClassVar[int] = 16
    action_dim: ClassVar[int] = 2  # change of the set-point in x, y
    action_limit: ClassVar[float] = 0.0125  # m per control step: 0.357 m/s
    control_dt: ClassVar[float] = CONTROL_DT
    max_steps: ClassVar[int] = 500
    objects: ClassVar[tuple[str, ...]] = ("red", "blue")
    contact_ends: ClassVar[bool] = False
    modes: ClassVar[tuple[str, ...]] = ("red-blue", "blue-red")
    groups: ClassVar[tuple[str, ...]] = ("red-first", "blue-first")
    preferred_group: ClassVar[str] = "red-first"
    preferred_share: ClassVar[float] = 0.25
    criterion: ClassVar[str] = (
        "The robot should sort the red block into the red bin first, and then the blue block into "
        "the blue one."
    )

    def build_model(self, mesh: Mesh = "col") -> mujoco.MjModel:
        spec = blocks.pusher_scene(mesh)
        _add_fixed(spec, "platform", PLATFORM_X, PLATFORM_Y, PLATFORM_TOP, GREY)
        for index, name in enumerate(self.objects):
            _add_bin(spec, name, BIN_X[index])
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
        """{"start": [x, y], "red": [x, y, yaw], "blue": [x, y, yaw]}: two of D3IL's six cells, the
        cubes apart from each other; the rod's start varies by 4 mm."""
        start = blocks.draw_start(rng, START)
        cells = [(x, y) for x in CELL_X for y in CELL_Y]
        chosen = rng.permutation(len(cells))[: len(self.objects)]
        cubes = blocks.draw_cubes(rng, [cells[i] for i in chosen])
        return {"start": start} | dict(zip(self.objects, cubes, strict=True))

    def start_point(self, context: Context) -> Array:
        return blocks.read_start(context, ROD_HEIGHT, START)

    def start_objects(self, context: Context) -> Array:
        ranges = dict.fromkeys(self.objects, (START_X, START_Y))
        return blocks.read_cubes(context, ranges, PLATFORM_TOP + blocks.HALF)

    def group_of(self, mode: str) -> str:
        if mode not in self.modes:
            raise UnknownNameError("mode", mode, self.modes)
        return self.groups[self.modes.index(mode)]

    def move(self, setpoints: Array, actions: Array) -> Array:
        moved = setpoints.copy()
        moved[:, :2] += actions
        return blocks.clamp_reach(moved)

    def observe(self, view: View) -> Array:
        ends = view.ends[:, :2]
        frames = [
            blocks.push_frame(ends, view.objects[:, cube, :2], edge_point(view.objects, cube))
            for cube in range(2)
        ]
        cubes = blocks.cube_features(view.objects)
        return np.concatenate([view.setpoints[:, :2], ends, cubes, *frames], axis=1)

    def finished(self, view: View) -> NDArray[np.bool_]:
        return np.asarray(sorted_cubes(view.objects).all(axis=1))

    def inside(self, view: View) -> NDArray[np.bool_]:
        """Set-points cannot leave; a cube that fell anywhere but into its bin has left."""
        lost = (view.objects[:, :, 2] < FALLEN) & ~sorted_cubes(view.objects)
        return np.asarray(~lost.any(axis=1))

    def outcome(
        self,
        path: NDArray[np.floating[Any]],  # noqa: ARG002 - only the cubes decide
        objects: NDArray[np.floating[Any]],
        reason: str,
    ) -> dict[str, Any]:
        if reason not in REASONS:
            raise UnknownNameError("reason", reason, REASONS)
        there = sorted_cubes(np.asarray(objects, dtype=np.float64))
        entries = [blocks.first_entry(there[:, cube]) for cube in range(2)]
        reached = [(step, cube) for cube, step in enumerate(entries) if step is not None]
        first = min(reached)[1] if reached else None  # both in the same step: red counts as first
        success = reason == FINISHED
        return {
            "success": success,
            "mode": self.modes[first] if success and first is not None else None,
            "group": None if first is None else self.groups[first],
            "reason": reason,
        }

    def scene_shapes(self) -> list[dict[str, Any]]:
        """Bins and cubes as `blocks` describes them, the platform {type, x0, y0, x1, y1}, the
        workspace box {type, x0, y0, x1, y1} and the start {type, x, y}; metres."""
        colours = blocks.colours(RGB)
        box = {"x0": PLATFORM_X[0], "y0": PLATFORM_Y[0], "x1": PLATFORM_X[1], "y1": PLATFORM_Y[1]}
        middles = [((x[0] + x[1]) / 2, (BIN_Y[0] + BIN_Y[1]) / 2) for x in BIN_X]
        halves = [((x[1] - x[0]) / 2, (BIN_Y[1] - BIN_Y[0]) / 2) for x in BIN_X]
        return [
            {"type": "platform", **box},
            *(
                blocks.target_shape(name, middle, half, colours[name])
                for name, middle, half in zip(self.objects, middles, halves, strict=True)
            ),
            *(
                blocks.cube_shape(index, name, (sum(x) / 2, sum(START_Y) / 2), colours[name])
                for index, (name, x) in enumerate(zip(self.objects, CELL_X, strict=True))
            ),
            {"type": "workspace", "x0": 0.28, "y0": -0.36, "x1": 0.74, "y1": BIN_Y[1] + 0.01},
            {"type": "start", "x": START[0], "y": START[1]},
        ]


def sorted_cubes(objects: Array) -> NDArray[np.bool_]:
    """(m, 2) bool: cube i of poses (m, 2, 7) lies below the platform's top, in its bin."""
    low, high = np.array(BIN_X).T
    x, y, z = objects[..., 0], objects[..., 1], objects[..., 2]
    inside = (x > low) & (x < high) & (y > BIN_Y[0]) & (y < BIN_Y[1])
    return np.asarray(inside & (z < FALLEN))


def edge_point(objects: Array, cube: int) -> Array:
    """Where cube `cube` of poses (m, 2, 7) should be pushed to: (m, 2), over the edge in the middle
    of its bin. Beyond the edge it is farther out, so that the push never ends too early."""
    y = np.maximum(BIN_Y[0] + 0.015, objects[:, cube, 1] + 0.03)
    x = np.full_like(y, sum(BIN_X[cube]) / 2)
    return np.stack([x, y], axis=1)


def _add_bin(spec: mujoco.MjSpec, name: str, x: tuple[float, float]) -> None:
    """Floor and three walls; the platform is the fourth. The two inner walls meet."""
    rgba = (*RGB[name], 0.35)
    _add_fixed(spec, f"{name}_floor", x, BIN_Y, 0.001, rgba)
    back = (BIN_Y[1], BIN_Y[1] + 2 * WALL_HALF)
    _add_fixed(spec, f"{name}_back", x, back, WALL, rgba)
    gap = (BIN_X[1][0] - BIN_X[0][1]) / 2
    for side, inner, outer in (("left", x[0], x[0] - gap), ("right", x[1], x[1] + gap)):
        across = (min(inner, outer), max(inner, outer))
        _add_fixed(spec, f"{name}_{side}", across, BIN_Y, WALL, rgba)


def _add_fixed(
    spec: mujoco.MjSpec,
    name: str,
    x: tuple[float, float],
    y: tuple[float, float],
    height: float,
    rgba: tuple[float, ...],
) -> None:
    """A box on the table that cubes touch and the rod does not; all in metres."""
    spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[sum(x) / 2, sum(y) / 2, height / 2],
        size=[(x[1] - x[0]) / 2, (y[1] - y[0]) / 2, height / 2],
        rgba=list(rgba),
        friction=[blocks.FRICTION, 0.005, 0.0001],
        contype=TOOL_BIT,
        conaffinity=OBJECT_BIT,
    )
