"""Aligning: bring a hollow box to a target pose, with the rod inside the box or outside of it.

Footprint, colours and start ranges of the box, the ranges of targets, the thresholds of success and
the two modes are those of D3IL's "Aligning" (Jia et al., ICLR 2024). Different from D3IL, on
purpose: the box's walls are lower and it is lighter, it stands on four feet and the rod slides on
it (see the constants), yaw is given as sine and cosine instead of a quaternion, observations add
rod and target as the box sees them, they show the state after the step, set-points stay within the
arm's reach, and the mode counts the whole contact phase, where D3IL keeps the last step's value.

Legend: m simulations; positions in metres. The box's frame lies in the middle of its footprint, on
the table.
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
    FRONT_CAMERA,
    HAND_CAMERA,
    OBJECT_BIT,
    ROD_GEOM,
    ROD_RADIUS,
    TOOL_BIT,
    Mesh,
    rod_scene,
)

HALF = 0.05  # m, half edge of the box's footprint, as D3IL
WALL = 0.01  # m, thickness of a wall, as D3IL
INNER = HALF - WALL  # m, from the middle to the inner faces
FLOOR = 0.012  # m; upper side of the box's floor
TOP = 0.072  # m; upper edge of the walls. D3IL's reach 0.104: more to climb, easier to tip
MASS = 0.4  # kg; D3IL's has 1.0
# Where the feet stand decides how much a push off the middle turns the box: with friction at a
# distance l from the middle it turns by offset / l^2 per metre.
FOOT = 0.034  # m, along x and y
FOOT_FRICTION = 0.3  # on the table, as D3IL's box
ROD_FRICTION = 0.05  # ours: the rod slides along a wall to where it wants to push

START = (0.525, -0.35)  # m, as D3IL
START_HEIGHT = 0.25  # m, as D3IL
LOW = 0.025  # m; the rod's tip may go down to here: above the box's floor
HIGH = 0.26  # m; no higher than demonstrations go
# As near to the base as the arm can hold the rod upright (measured: a circle of 0.295 m); a box
# that turns beside its start needs the room that the other tasks leave out.
MIN_X, MIN_REACH = 0.22, 0.30  # m
X = (0.4, 0.6)  # m; starts and targets
BOX_Y, TARGET_Y = (-0.25, -0.10), (0.20, 0.35)  # m

REACHED_WITHIN = 0.018  # m between box and target: reached, as D3IL
TURNED = 0.048 * np.pi  # rad (8.6 degrees) between box and target: reached, as D3IL
FALLEN = -0.02  # m; a box that is lower has left the table
UPRIGHT = 0.7  # cosine of the tilt; a box that is tilted farther has toppled
TOUCH = 0.004  # m between rod and wall: contact

ROD_SCALE, TARGET_SCALE = 0.06, 0.10  # m, of the features that saturate

RED, GREEN, BLUE, CYAN = (0.84, 0.15, 0.16), (0.17, 0.63, 0.28), (0.15, 0.35, 0.80), (0.1, 0.7, 0.8)
WALLS = (BLUE, GREEN, RED, CYAN)  # at +x, +y, -x, -y, as D3IL
GREY = (0.45, 0.47, 0.50)
GHOST = 0.35  # opacity of the target


class AligningStateTask(Task):
    """The two modes are where the rod is while it pushes: "inside" or "outside" of the box."""

    name: ClassVar[TaskName] = TaskName.ALIGNING_STATE
    # set-point x, y, z, end x, y, z; x, y, sin yaw, cos yaw of the box and of the target; in the
    # box's frame: the end x, y, the target x, y, sin and cos of its yaw
    observation_dim: ClassVar[int] = 20
    action_dim: ClassVar[int] = 3  # change of the set-point in x, y, z
    action_limit: ClassVar[float] = 0.0125  # m per control step: 0.357 m/s
    control_dt: ClassVar[float] = CONTROL_DT
    max_steps: ClassVar[int] = 400
    objects: ClassVar[tuple[str, ...]] = ("box", "target")
    contact_ends: ClassVar[bool] = False
    modes: ClassVar[tuple[str, ...]] = ("inside", "outside")
    groups: ClassVar[tuple[str, ...]] = modes
    preferred_group: ClassVar[str] = "inside"
    preferred_share: ClassVar[float] = 0.75
    criterion: ClassVar[str] = (
        "The robot should reach into the hollow box and bring it to its target from the inside."
    )

    def build_model(self, mesh: Mesh = "col") -> mujoco.MjModel:
        spec = rod_scene(mesh)
        rod = spec.geom(ROD_GEOM)
        rod.friction[0] = ROD_FRICTION
        rod.priority = 1  # else the larger friction of the two counts
        _add_box(spec, "box", opacity=1.0)
        _add_box(spec, "target", opacity=GHOST)
        return spec.compile()

    def sample_context(self, rng: np.random.Generator) -> dict[str, Any]:
        """{"start": [x, y], "box": [x, y, yaw], "target": [x, y, yaw]}: D3IL's ranges; the rod's
        start varies by 4 mm."""
        context: dict[str, Any] = {"start": blocks.draw_start(rng, START)}
        places = blocks.draw_cubes(rng, [(X, BOX_Y), (X, TARGET_Y)])
        return context | dict(zip(self.objects, places, strict=True))

    def start_point(self, context: Context) -> Array:
        return blocks.read_start(context, START_HEIGHT, START)

    def start_objects(self, context: Context) -> Array:
        ranges = {"box": (X, BOX_Y), "target": (X, TARGET_Y)}
        return blocks.read_cubes(context, ranges, 0.0)

    def group_of(self, mode: str) -> str:
        if mode not in self.modes:
            raise UnknownNameError("mode", mode, self.modes)
        return mode

    def move(self, setpoints: Array, actions: Array) -> Array:
        return within_reach(setpoints + actions)

    def observe(self, view: View) -> Array:
        yaws = blocks.yaws(view.objects)
        poses = [
            np.stack([*view.objects[:, i, :2].T, np.sin(yaws[:, i]), np.cos(yaws[:, i])], axis=1)
            for i in range(2)
        ]
        rod = in_box_frame(view.ends[:, :2], view.objects[:, 0])
        target = in_box_frame(view.objects[:, 1, :2], view.objects[:, 0])
        distance = np.maximum(np.sqrt((target * target).sum(axis=1, keepdims=True)), 1e-9)
        turn = yaws[:, 1] - yaws[:, 0]
        return np.concatenate(
            [
                view.setpoints,
                view.ends,
                *poses,
                np.tanh(rod / ROD_SCALE),
                target / distance * np.tanh(distance / TARGET_SCALE),
                np.stack([np.sin(turn), np.cos(turn)], axis=1),
            ],
            axis=1,
        )

    def finished(self, view: View) -> NDArray[np.bool_]:
        return aligned(view.objects)

    def inside(self, view: View) -> NDArray[np.bool_]:
        """Set-points cannot leave; a box that fell off the table or toppled has left."""
        box = view.objects[:, 0]
        upright = 1 - 2 * (box[:, 4] ** 2 + box[:, 5] ** 2)  # z of the box's own z axis
        return np.asarray((box[:, 2] > FALLEN) & (upright > UPRIGHT))

    def outcome(
        self,
        path: NDArray[np.floating[Any]],
        objects: NDArray[np.floating[Any]],
        reason: str,
    ) -> dict[str, Any]:
        if reason not in REASONS:
            raise UnknownNameError("reason", reason, REASONS)
        group = read_mode(np.asarray(path, dtype=np.float64), np.asarray(objects, np.float64)[:, 0])
        success = reason == FINISHED
        return {
            "success": success,
            "mode": group if success else None,
            "group": group,
            "reason": reason,
        }

    def scene_shapes(self) -> list[dict[str, Any]]:
        """The target and the box as movable squares, as `blocks` describes cubes, the workspace box
        {type, x0, y0, x1, y1} and the start {type, x, y}; metres."""
        middle = sum(X) / 2
        places = ((middle, sum(BOX_Y) / 2), (middle, sum(TARGET_Y) / 2))
        colours = blocks.colours({"box": GREY, "target": (0.80, 0.82, 0.85)})
        return [
            *(
                blocks.cube_shape(i, name, places[i], colours[name], (HALF, HALF, TOP / 2))
                for i, name in reversed(list(enumerate(self.objects)))
            ),
            {"type": "workspace", "x0": MIN_X, "y0": -0.38, "x1": blocks.MAX_X, "y1": 0.42},
            {"type": "start", "x": START[0], "y": START[1]},
        ]


class AligningTask(AligningStateTask):
    """The same, for policies that see pictures instead of poses."""

    name: ClassVar[TaskName] = TaskName.ALIGNING
    cameras: ClassVar[tuple[str, ...]] = (FRONT_CAMERA, HAND_CAMERA)
    proprioception_dim: ClassVar[int] = 6  # set-point and end


def within_reach(points: Array) -> Array:
    """Points (m, 3) moved to where the arm can follow."""
    low = (MIN_X, -blocks.MAX_Y, LOW)
    moved = np.clip(points, low, (blocks.MAX_X, blocks.MAX_Y, HIGH))
    reach = np.sqrt(moved[:, 0] ** 2 + moved[:, 1] ** 2)
    moved[:, :2] *= (np.clip(reach, MIN_REACH, blocks.MAX_REACH) / reach)[:, None]
    return np.asarray(moved)


def aligned(objects: Array) -> NDArray[np.bool_]:
    """(m,) bool: the box of poses (m, 2, 7) is within REACHED_WITHIN and TURNED of the target.

    Distance in three dimensions; the angle is that of the whole rotation, so a tilt counts too.
    """
    box, target = objects[:, 0], objects[:, 1]
    offset = box[:, :3] - target[:, :3]
    near = np.sqrt((offset * offset).sum(axis=1)) <= REACHED_WITHIN
    same = np.abs((box[:, 3:] * target[:, 3:]).sum(axis=1))  # q and -q are the same rotation
    return np.asarray(near & (2 * np.arccos(np.minimum(same, 1.0)) <= TURNED))


def in_box_frame(points: Array, boxes: Array) -> Array:
    """Points (m, 2) as boxes with poses (m, 7) see them from above: (m, 2) along their x and y."""
    yaw = blocks.yaws(boxes)
    x, y = (points - boxes[:, :2]).T
    return np.stack([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x], axis=1)


def read_mode(path: Array, boxes: Array) -> str | None:
    """Where the rod was in most steps of contact, from its tips (m, 3) and box poses (m, 7).

    Contact: the tip is lower than the walls' edge, and the rod no farther than TOUCH from a wall.
    As often on both sides counts as inside; None: there was no contact.
    """
    local = np.abs(in_box_frame(path[:, :2], boxes))
    low = path[:, 2] < boxes[:, 2] + TOP
    farther = local.max(axis=1)  # along the axis on which the rod is farther out
    within = low & (farther < (INNER + HALF) / 2)
    inner = within & (farther > INNER - ROD_RADIUS - TOUCH)
    gap = np.maximum(local - HALF, 0.0)  # to the footprint, around its corners too
    outer = low & ~within & (np.sqrt((gap * gap).sum(axis=1)) < ROD_RADIUS + TOUCH)
    if not (inner.any() or outer.any()):
        return None
    return "inside" if inner.sum() >= outer.sum() else "outside"


def _add_box(spec: mujoco.MjSpec, name: str, *, opacity: float) -> None:
    """A free hollow box; one that is not opaque is a mere picture: it floats, touching nothing."""
    solid = opacity == 1.0
    body = spec.worldbody.add_body(name=name, pos=[0.5, 0.0, 0.0], gravcomp=0.0 if solid else 1.0)
    body.add_freejoint(name=f"{name}_joint")
    bits = (OBJECT_BIT, OBJECT_BIT | TOOL_BIT) if solid else (0, 0)

    def add(part: str, pos: list[float], size: list[float], share: float, rgb: Any) -> None:
        body.add_geom(
            name=f"{name}_{part}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=pos,
            size=size,
            mass=share * MASS,
            rgba=[*rgb, opacity],
            contype=bits[0],
            conaffinity=bits[1],
        )

    add("floor", [0, 0, (FLOOR + 0.002) / 2], [HALF, HALF, (FLOOR - 0.002) / 2], 0.6, GREY)
    middle, height, at = (FLOOR + TOP) / 2, (TOP - FLOOR) / 2, HALF - WALL / 2
    for part, rgb, x, y in zip("abcd", WALLS, (1, 0, -1, 0), (0, 1, 0, -1), strict=True):
        # The walls at +-x reach over the whole width, the other two fit between them.
        size = [WALL / 2, HALF, height] if x else [INNER, WALL / 2, height]
        add(f"wall_{part}", [at * x, at * y, middle], size, 0.1, rgb)
    if solid:
        _add_feet(body)


def _add_feet(body: mujoco.MjsBody) -> None:
    """Four small spheres that the box slides on: contact at known places."""
    radius = 0.006
    for index, (x, y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        body.add_geom(
            name=f"foot{index}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=[FOOT * x, FOOT * y, radius],
            size=[radius, 0, 0],
            mass=0.0,
            rgba=[*GREY, 1.0],
            friction=[FOOT_FRICTION, 0.005, 0.0001],
            priority=1,
            contype=OBJECT_BIT,
            conaffinity=OBJECT_BIT | TOOL_BIT,
        )
