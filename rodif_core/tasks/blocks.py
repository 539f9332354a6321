"""What the tasks with cubes share: the reach of the rod, contexts with cubes, features of a push.

Legend: m simulations, B cubes; positions in metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.tasks.base import Array, Context, read_numbers
from rodif_core.tasks.panda import ROD_GEOM, TABLE_GEOM, Mesh, rod_scene

Range = tuple[float, float]

HALF = 0.03  # m, half edge of every cube, as D3IL
MASS = 0.05  # kg, as D3IL
FRICTION = 0.5  # of cubes on what they stand on
# Ours; D3IL's rod has 1 cm. Measured with the experts: a rod that grips (friction 1) drags a cube's
# face along when it should slide to the middle, so pushes miss by centimetres.
PUSHER_RADIUS = 0.02  # m
PUSHER_FRICTION = 0.4

# Set-points stay where the arm can hold the rod upright (measured: beyond 0.80 m it cannot).
MIN_X, MAX_X = 0.30, 0.72  # m
MAX_Y = 0.45  # m, on both sides
MAX_REACH = 0.78  # m from the base

START_JITTER = 0.004  # m; rods start uniformly within +- this of the task's start, on both axes
START_REACH = 0.05  # m; a context's start may be this far off on either axis
MAX_YAW = np.pi / 2  # rad; cubes start turned by up to this, either way

APART = 0.09  # m between the centres of two cubes at the start: their diagonals are 8.5 cm

OFFSET_SCALE = 0.06  # m; scale on which `push_frame` tells places beside a cube apart


def pusher_scene(mesh: Mesh) -> mujoco.MjSpec:
    """The arm with a rod for pushing, on a table."""
    spec = rod_scene(mesh, rod_radius=PUSHER_RADIUS)
    rod = spec.geom(ROD_GEOM)
    rod.friction[0] = PUSHER_FRICTION
    rod.priority = 1  # else the cube's larger friction counts
    rod.condim = 4
    spec.geom(TABLE_GEOM).friction[0] = FRICTION
    return spec


def clamp_reach(points: Array) -> Array:
    """Points (m, 3) moved to where the arm can follow: into the box first, then within reach."""
    moved = points.copy()
    moved[:, 0] = np.clip(moved[:, 0], MIN_X, MAX_X)
    moved[:, 1] = np.clip(moved[:, 1], -MAX_Y, MAX_Y)
    reach = np.sqrt(moved[:, 0] ** 2 + moved[:, 1] ** 2)
    moved[:, :2] *= np.minimum(1.0, MAX_REACH / reach)[:, None]
    return moved


def draw_start(rng: np.random.Generator, start: tuple[float, float]) -> list[float]:
    """The rod's start [x, y], up to START_JITTER off on either axis."""
    point = np.array(start) + rng.uniform(-START_JITTER, START_JITTER, 2)
    return [float(point[0]), float(point[1])]


def draw_cubes(
    rng: np.random.Generator, ranges: Sequence[tuple[Range, Range]], apart: float = APART
) -> list[list[float]]:
    """Starts [x, y, yaw in rad] of cubes, uniform in their ranges of x and y and in +- MAX_YAW;
    drawn again until their centres are `apart` (m) or more (D3IL lets them overlap, and the solver
    throws them)."""
    while True:
        places = [
            [float(rng.uniform(*x)), float(rng.uniform(*y)), float(rng.uniform(-MAX_YAW, MAX_YAW))]
            for x, y in ranges
        ]
        if _apart(places, apart):
            return places


def _apart(places: Sequence[Sequence[float]], distance: float) -> bool:
    return all(
        np.hypot(one[0] - other[0], one[1] - other[1]) >= distance
        for one, other in combinations(places, 2)
    )


def read_start(context: Context, height: float, start: tuple[float, float]) -> Array:
    """The rod's first set-point (3,) from context["start"]: within START_REACH of the task's
    `start`, where no cube can stand. Raises ValueOutOfRangeError."""
    (x, y), r = start, START_REACH
    legal = (
        f"[x, y] in metres with x in [{x - r:.3f}, {x + r:.3f}], y in [{y - r:.3f}, {y + r:.3f}]"
    )
    point = read_numbers(context, "start", 2, legal)
    if np.abs(point - start).max() > r:
        raise ValueOutOfRangeError("start", context["start"], legal)
    return np.append(point, height)


def read_cubes(
    context: Context,
    ranges: Mapping[str, tuple[Range, Range]],
    height: float,
    apart: float = APART,
) -> Array:
    """Poses (B, 7) of cubes at `height` from context[name] = [x, y, yaw], in the order of `ranges`.

    Raises ValueOutOfRangeError for a place outside the ranges, a yaw outside +- MAX_YAW, or cubes
    that are too near to each other.
    """
    poses, places = [], []
    for name, (x, y) in ranges.items():
        legal = (
            f"[x, y, yaw] with x in {list(x)} m, y in {list(y)} m "
            f"and yaw in [-{MAX_YAW:.4f}, {MAX_YAW:.4f}] rad, {apart} m from any other cube"
        )
        place = read_numbers(context, name, 3, legal)
        limits = (x, y, (-MAX_YAW, MAX_YAW))
        places.append(place.tolist())
        within = all(a <= v <= b for v, (a, b) in zip(place, limits, strict=True))
        if not within or not _apart(places, apart):
            raise ValueOutOfRangeError(name, context[name], legal)
        half_yaw = place[2] / 2
        turned = (np.cos(half_yaw), 0.0, 0.0, np.sin(half_yaw))
        poses.append([place[0], place[1], height, *turned])
    return np.array(poses)


def yaws(objects: Array) -> Array:
    """Yaw (m, B) in rad of poses (m, B, 7)."""
    w, x, y, z = (objects[..., i] for i in range(3, 7))
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def cube_features(objects: Array) -> Array:
    """x, y and sin, cos of four times the yaw of every cube: (m, B * 4).

    A cube looks the same after a quarter turn. D3IL gives tan(yaw), which has no bound.
    """
    angle = 4 * yaws(objects)
    rows = np.stack([objects[..., 0], objects[..., 1], np.sin(angle), np.cos(angle)], axis=-1)
    return rows.reshape(len(objects), -1)


def push_frame(ends: Array, cubes: Array, targets: Array) -> Array:
    """Where the rod is as a push from cube to target sees it: (m, 2) in (-1, 1).

    ends, cubes, targets (m, 2). Along the push (negative behind the cube) and across it (positive
    on the left), each as tanh(metres / OFFSET_SCALE): fine beside the cube, coarse elsewhere.
    """
    way = targets - cubes
    way = way / np.maximum(np.sqrt((way * way).sum(axis=1, keepdims=True)), 1e-6)
    offset = ends - cubes
    along = (offset * way).sum(axis=1)
    across = way[:, 0] * offset[:, 1] - way[:, 1] * offset[:, 0]
    return np.asarray(np.tanh(np.stack([along, across], axis=1) / OFFSET_SCALE))


def target_shape(
    name: str, centre: tuple[float, float], half: tuple[float, float], colour: str
) -> dict[str, Any]:
    """A target for top-down plots: an outlined rectangle."""
    return {
        "type": "target",
        "name": name,
        "x": centre[0],
        "y": centre[1],
        "half_x": half[0],
        "half_y": half[1],
        "colour": colour,
    }


def cube_shape(
    index: int,
    name: str,
    place: tuple[float, float],
    colour: str,
    halves: tuple[float, float, float] = (HALF, HALF, HALF),
) -> dict[str, Any]:
    """A movable cube or cuboid of half lengths `halves` (m) for top-down plots, drawn at `place`
    where no episode is shown; `index` is its place in `Task.objects`."""
    return {
        "type": "cube",
        "object": index,
        "name": name,
        "x": place[0],
        "y": place[1],
        "half_x": halves[0],
        "half_y": halves[1],
        "half_z": halves[2],
        "colour": colour,
    }


def first_entry(inside: NDArray[np.bool_]) -> int | None:
    """First row where `inside` (N,) holds; None: never."""
    there = np.flatnonzero(inside)
    return int(there[0]) if len(there) else None


def colours(rgb: Mapping[str, tuple[float, float, float]]) -> dict[str, str]:
    """Colours in 0 … 1 as #rrggbb."""
    return {
        name: "#" + "".join(f"{round(255 * part):02x}" for part in value)
        for name, value in rgb.items()
    }
