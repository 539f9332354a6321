"""Stacking: build a tower of two cubes and a cuboid with the gripper, in any of six orders.

Blocks, start ranges, pad, time limit, control rate and actions (changes of the seven joints'
set-points, and the gripper) are those of D3IL's "Stacking" (Jia et al., ICLR 2024). Different from
D3IL, on purpose: success needs a real tower that stands by itself (D3IL asks neither for a release
nor for standstill, and its heights need only differ by 3 cm); a mode is the order of the placements
in that tower, not of the first visits to the pad; the gripper's axis is the change of its opening,
as on all other axes, instead of an absolute width; yaws are given as sines and cosines instead of
tangents; observations add what an approach and a placement depend on, and they show the state after
the step; blocks do not start so near to each other that the fingers find no room.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

import rodif_core.tasks.blocks as blocks
from rodif_core.errors import UnknownNameError
from rodif_core.spec import TaskName
from rodif_core.tasks.base import FINISHED, REASONS, Array, Context, Task, View
from rodif_core.tasks.control import Control, GripperControl
from rodif_core.tasks.panda import (
    ARM_JOINTS,
    FINGER_JOINTS,
    FRONT_CAMERA,
    HAND_CAMERA,
    JOINT_HIGH,
    JOINT_LOW,
    MAX_OPENING,
    PHYSICS_DT,
    TABLE_GEOM,
    Mesh,
    add_block,
    gripper_scene,
)

NAMES = ("red", "green", "blue")
RGB = {"red": (0.84, 0.15, 0.16), "green": (0.17, 0.63, 0.28), "blue": (0.12, 0.38, 0.78)}
HALVES = {  # m; red and green are cubes, blue is a cuboid that is long along its own y
    "red": (0.03, 0.03, 0.03),
    "green": (0.03, 0.03, 0.03),
    "blue": (0.03, 0.05, 0.03),
}
RANGES = {  # m; starts in x and y
    "red": ((0.35, 0.45), (-0.25, -0.15)),
    "green": ((0.35, 0.45), (-0.10, 0.0)),
    "blue": ((0.55, 0.60), (-0.20, 0.0)),
}
# Turns that leave a block as it was: a quarter for a cube, a half for the cuboid.
SYMMETRY = np.array([4.0, 4.0, 2.0])
# rad; how far the gripper is turned from a block that it grasps: the cuboid only fits across.
GRASP_TURN = np.array([0.0, 0.0, np.pi / 2])

APART = 0.12  # m between centres at the start: the open fingers have room beside any block
FRICTION = 0.5  # of blocks on the table and on each other

START = (0.525, 0.0)  # m
START_HEIGHT = 0.30  # m

PAD = (0.5, 0.2)  # m; where the tower is to stand
PAD_HALF = 0.05  # m, drawn only
ON_PAD = 0.06  # m between the centres of block and pad, seen from above, as D3IL
LEVELS = np.array([0.03, 0.09, 0.15])  # m; heights of the centres in a tower
LEVEL_SLACK = 0.01  # m
RELEASED = 0.05  # m between the middle of the jaws and a block's centre; they hold it nearer
AT_REST = 0.0005  # m per control step (17 mm/s)

# The middle of the jaws leaves the workspace where arm or table end.
WORKSPACE = ((0.20, 0.80), (-0.50, 0.50), (0.005, 0.55))  # m; x, y, z
# The part of the table that maps show: all starts, the pad, and some room.
DRAWN = {"x0": 0.28, "y0": -0.33, "x1": 0.70, "y1": 0.28}  # m
FALLEN = 0.0  # m; a block whose centre is lower has left the table

JOINT_LIMIT = 0.06  # rad per control step
GRIPPER_LIMIT = 0.008  # m per control step: open to closed in ten

OFFSET_SCALE = 0.06  # m; scale on which tanh features tell places near a goal apart


class StackingStateTask(Task):
    """Stacking seen through the true poses of the blocks.

    The six modes are named by the order of the placements: "red-blue-green" is red on the pad,
    blue on it, green on top. Every mode is its own group; a failure's group is settled as soon as
    two blocks have been stacked.
    """

    name: ClassVar[TaskName] = TaskName.STACKING_STATE
    observation_dim: ClassVar[int] = 59
    action_dim: ClassVar[int] = ARM_JOINTS + 1  # changes of the joints' set-points and the opening
    action_limit: ClassVar[float | tuple[float, ...]] = (*[JOINT_LIMIT] * ARM_JOINTS, GRIPPER_LIMIT)
    control_dt: ClassVar[float] = 12 * PHYSICS_DT  # 30 ms = 33.3 Hz, as D3IL
    max_steps: ClassVar[int] = 1000
    robot_joints: ClassVar[int] = ARM_JOINTS + FINGER_JOINTS
    objects: ClassVar[tuple[str, ...]] = NAMES
    contact_ends: ClassVar[bool] = False
    modes: ClassVar[tuple[str, ...]] = tuple("-".join(order) for order in permutations(NAMES))
    groups: ClassVar[tuple[str, ...]] = modes
    preferred_group: ClassVar[str] = "red-blue-green"
    preferred_share: ClassVar[float] = 0.26
    trail_seconds: ClassVar[float | None] = 1.0  # more of it hides the tower
    criterion: ClassVar[str] = (
        "The robot should build the tower from the red block at the bottom, the blue one on it and "
        "the green one on top."
    )

    def build_model(self, mesh: Mesh = "col") -> mujoco.MjModel:
        spec = gripper_scene(mesh)
        spec.geom(TABLE_GEOM).friction[0] = FRICTION
        spec.worldbody.add_geom(
            name="pad",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[*PAD, 0.001],
            size=[PAD_HALF, PAD_HALF, 0.001],
            rgba=[0.93, 0.56, 0.15, 0.6],
            contype=0,
            conaffinity=0,
        )
        for name in NAMES:
            add_block(
                spec,
                name,
                halves=HALVES[name],
                mass=blocks.MASS,
                friction=FRICTION,
                rgba=[*RGB[name], 1.0],
            )
        return spec.compile()

    def control(self, count: int, threads: int = 1) -> Control:
        return GripperControl(count, threads)

    def sample_context(self, rng: np.random.Generator) -> dict[str, Any]:
        """{"start": [x, y], "red": [x, y, yaw], "green": …, "blue": …}: D3IL's ranges, blocks
        apart from each other; the gripper's start varies by 4 mm."""
        context: dict[str, Any] = {"start": blocks.draw_start(rng, START)}
        places = blocks.draw_cubes(rng, list(RANGES.values()), APART)
        return context | dict(zip(NAMES, places, strict=True))

    def start_point(self, context: Context) -> Array:
        return blocks.read_start(context, START_HEIGHT, START)

    def start_objects(self, context: Context) -> Array:
        return blocks.read_cubes(context, RANGES, blocks.HALF, APART)

    def group_of(self, mode: str) -> str:
        if mode not in self.modes:
            raise UnknownNameError("mode", mode, self.modes)
        return mode

    def move(self, setpoints: Array, actions: Array) -> Array:
        return np.clip(setpoints + actions, (*JOINT_LOW, 0.0), (*JOINT_HIGH, MAX_OPENING))

    def observe(self, view: View) -> Array:
        """Proprioception (14), then of every block: x, y, z, sin and cos of its yaw times its
        symmetry (15); its offset from the jaws and sin and cos of the turn that a grasp still
        lacks (15); its offset from the next place of the tower (9). Then the offset of that place
        from the jaws (3), and which blocks are in the tower (3). Offsets are
        tanh(metres / OFFSET_SCALE).
        """
        levels = placed_levels(view.objects, view.ends)
        place = next_place(view.objects, levels)
        yaws = blocks.yaws(view.objects)
        turns = SYMMETRY * yaws
        lacking = SYMMETRY * (yaws + GRASP_TURN - tool_yaws(view.rotations)[:, None])
        places = view.objects[:, :, :3]
        own = np.concatenate([places, sin_cos(turns)], axis=2)
        seen = np.concatenate([near(places - view.ends[:, None]), sin_cos(lacking)], axis=2)
        rows = len(view.ends)
        return np.concatenate(
            [
                proprioception(view),
                own.reshape(rows, -1),
                seen.reshape(rows, -1),
                near(places - place[:, None]).reshape(rows, -1),
                near(place - view.ends),
                (levels >= 0).astype(np.float64),
            ],
            axis=1,
        )

    def finished(self, view: View) -> NDArray[np.bool_]:
        stacked = tower_height(placed_levels(view.objects, view.ends)) == len(NAMES)
        return np.asarray(stacked & at_rest(view.objects, view.objects_before))

    def inside(self, view: View) -> NDArray[np.bool_]:
        low, high = np.array(WORKSPACE).T
        within = ((view.ends >= low) & (view.ends <= high)).all(axis=1)
        return np.asarray(within & (view.objects[:, :, 2] > FALLEN).all(axis=1))

    def outcome(
        self,
        path: NDArray[np.floating[Any]],
        objects: NDArray[np.floating[Any]],
        reason: str,
    ) -> dict[str, Any]:
        if reason not in REASONS:
            raise UnknownNameError("reason", reason, REASONS)
        poses = np.asarray(objects, dtype=np.float64)
        success = reason == FINISHED
        mode = order_of(poses[-1]) if success else None
        group = mode or first_pair(poses, np.asarray(path, dtype=np.float64))
        return {"success": success, "mode": mode, "group": group, "reason": reason}

    def scene_shapes(self) -> list[dict[str, Any]]:
        """Pad and blocks as `blocks` describes them, the workspace box {type, x0, y0, x1, y1}
        and the start {type, x, y}; metres."""
        colours = blocks.colours(RGB)
        return [
            blocks.target_shape("pad", PAD, (PAD_HALF, PAD_HALF), "#ed8f26"),
            *(
                blocks.cube_shape(
                    index, name, (sum(x) / 2, sum(y) / 2), colours[name], HALVES[name]
                )
                for index, (name, (x, y)) in enumerate(RANGES.items())
            ),
            {"type": "workspace", **DRAWN},
            {"type": "start", "x": START[0], "y": START[1]},
        ]


class StackingTask(StackingStateTask):
    """The same, for policies that see pictures instead of poses."""

    name: ClassVar[TaskName] = TaskName.STACKING
    cameras: ClassVar[tuple[str, ...]] = (FRONT_CAMERA, HAND_CAMERA)
    proprioception_dim: ClassVar[int] = 14


def proprioception(view: View) -> Array:
    """What the robot knows about itself (m, 14): the joints' set-points and that of the opening,
    the middle of the jaws x, y, z, sin and cos of twice the gripper's yaw, the measured opening."""
    opening = view.joints[:, ARM_JOINTS:].sum(axis=1, keepdims=True)
    turn = sin_cos(2 * tool_yaws(view.rotations))
    return np.concatenate([view.setpoints, view.ends, turn, opening], axis=1)


def tool_yaws(rotations: Array) -> Array:
    """Yaw (m,) in rad of grippers (m, 3, 3); 0: the fingers close along the world's y."""
    return np.asarray(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))


def sin_cos(angles: Array) -> Array:
    """(…, 2) of angles (…,) in rad."""
    return np.stack([np.sin(angles), np.cos(angles)], axis=-1)


def near(offsets: Array) -> Array:
    """Offsets in metres to (-1, 1): fine near 0, coarse elsewhere."""
    return np.asarray(np.tanh(offsets / OFFSET_SCALE))


def placed_levels(objects: Array, ends: Array) -> NDArray[np.int64]:
    """Level (m, 3) of each block of poses (m, 3, 7) in the tower, 0 at the bottom; -1: not in it.

    In the tower is what stands over the pad at the height of a level, has a block of the tower
    below it, and is not held by the gripper at `ends` (m, 3).
    """
    offsets = objects[:, :, :2] - np.array(PAD)
    over = np.sqrt((offsets * offsets).sum(axis=2)) <= ON_PAD
    apart = objects[:, :, :3] - ends[:, None]
    free = np.sqrt((apart * apart).sum(axis=2)) >= RELEASED
    gaps = np.abs(objects[:, :, 2, None] - LEVELS)
    level = np.where(over & free & (gaps.min(axis=2) <= LEVEL_SLACK), gaps.argmin(axis=2), -1)
    supported = np.ones(len(objects), dtype=bool)
    for height in range(len(LEVELS)):
        here = level == height
        level[here & ~supported[:, None]] = -1
        supported &= here.any(axis=1)
    return np.asarray(level)


def tower_height(levels: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many levels (m,) of the tower there are."""
    return np.asarray(levels.max(axis=1) + 1)


def next_place(objects: Array, levels: NDArray[np.int64]) -> Array:
    """Where the next block's centre belongs (m, 3): on the tower's top, or on the pad."""
    height = tower_height(levels)
    rows = np.arange(len(objects))
    top = objects[rows, levels.argmax(axis=1), :2]
    place = np.where((height > 0)[:, None], top, np.array(PAD))
    level = LEVELS[np.minimum(height, len(LEVELS) - 1)]
    return np.concatenate([place, level[:, None]], axis=1)


def at_rest(objects: Array, before: Array) -> NDArray[np.bool_]:
    """Whether no block (m, 3, 7) has moved since the control step before."""
    moved = np.abs(objects[:, :, :3] - before[:, :, :3])
    return np.asarray((moved < AT_REST).all(axis=(1, 2)))


def order_of(poses: Array) -> str:
    """The mode of a finished tower of poses (3, 7): a block was placed after what it stands on."""
    return "-".join(NAMES[index] for index in np.argsort(poses[:, 2]))


def first_pair(objects: Array, path: Array) -> str | None:
    """The order that the first two stacked blocks of an episode settle; None: there were none."""
    before = np.concatenate([objects[:1], objects[:-1]])
    levels = placed_levels(objects, path)
    pairs = (tower_height(levels) >= 2) & at_rest(objects, before)
    step = blocks.first_entry(pairs)
    if step is None:
        return None
    first, second = (int(np.flatnonzero(levels[step] == level)[0]) for level in (0, 1))
    return "-".join(NAMES[index] for index in (first, second, 3 - first - second))
