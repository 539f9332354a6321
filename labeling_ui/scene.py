"""What a compiled task scene looks like, free of any renderer: shapes on bodies, and body poses.

Replays and thumbnails draw from here. Positions are in metres, quaternions are (w, x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from rodif_core.tasks.base import COLLISION, Task
from rodif_core.tasks.panda import ROD_GEOM, TABLE_GEOM
from rodif_core.trajectory import Trajectory

Array = NDArray[np.float64]

MESH_CELL = 0.008  # m; vertices of the arm's drawing that are nearer than this are merged
POSE_GRID = 2.0**-14  # m and quaternion units; rounding poses makes a replay 30 % smaller
VISUAL_GROUP = 2  # geoms of higher groups are collision hulls and helpers
ROBOT_COLOUR = (224, 228, 234)  # its files tint it green


@dataclass(frozen=True, eq=False)
class Shape:
    """One drawable part, placed on a body.

    kind      "box": size = half lengths (3,); "sphere": (radius,); "cylinder": (radius, half
              height); "mesh": size is empty, vertices (V, 3) float32 and faces (F, 3) int32 are set
    position  (3,) and wxyz (4,) in the body's frame
    colour    (r, g, b) in 0 … 255, and opacity in 0 … 1
    geom      index of the geom in the model
    """

    geom: int
    body: int
    kind: Literal["box", "sphere", "cylinder", "mesh"]
    size: tuple[float, ...]
    position: Array
    wxyz: Array
    colour: tuple[int, int, int]
    opacity: float
    vertices: NDArray[np.float32] | None = None
    faces: NDArray[np.int32] | None = None


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of all bodies over F frames, in the world's frame or in that of the body's parent:
    positions (F, B, 3), wxyz (F, B, 4)."""

    positions: Array
    wxyz: Array

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, eq=False)
class SceneModel:
    """A task's drawing: the compiled model and its shapes."""

    model: mujoco.MjModel
    shapes: tuple[Shape, ...]


@lru_cache(maxsize=8)
def scene_model(task: Task) -> SceneModel:
    """Compile a task's detailed scene and list its shapes, the table left out; kept per process."""
    model = task.build_model("viz")
    shapes = [_shape(model, geom) for geom in range(model.ngeom) if _is_drawn(model, geom)]
    return SceneModel(model, tuple(shapes))


def body_poses(model: mujoco.MjModel, qpos: NDArray[np.float32]) -> Poses:
    """World poses of all bodies for physics positions `qpos` (F, Q)."""
    data = mujoco.MjData(model)
    positions = np.zeros((len(qpos), model.nbody, 3))
    wxyz = np.zeros((len(qpos), model.nbody, 4))
    for frame, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        positions[frame], wxyz[frame] = data.xpos, data.xquat
    return Poses(positions, wxyz)


def relative(poses: Poses, parents: NDArray[np.int32]) -> Poses:
    """World poses as poses in the frame of each body's parent; `parents` (B,), the world's is 0.

    Most of an arm's parts turn about a joint that stays where it is in the parent: seen from there
    their positions never change.
    """
    back = poses.wxyz[:, parents] * np.array([1.0, -1.0, -1.0, -1.0])
    offsets = poses.positions - poses.positions[:, parents]
    pure = np.concatenate([np.zeros_like(offsets[..., :1]), offsets], axis=2)
    seen = _product(_product(back, pure), poses.wxyz[:, parents])
    return Poses(seen[..., 1:], _product(back, poses.wxyz))


def _product(first: Array, second: Array) -> Array:
    """Hamilton product of quaternions (…, 4)."""
    w, v = first[..., :1], first[..., 1:]
    w2, v2 = second[..., :1], second[..., 1:]
    scalar = w * w2 - (v * v2).sum(axis=-1, keepdims=True)
    return np.concatenate([scalar, w * v2 + w2 * v + np.cross(v, v2)], axis=-1)


def smooth(poses: Poses, subframes: int) -> Poses:
    """`subframes` frames for each step between two frames: (F - 1) * subframes + 1 in all.

    Positions are interpolated linearly, rotations by normalised linear interpolation: steps between
    control frames are small. The result is rounded to POSE_GRID.
    """
    last = len(poses) - 1
    at = np.arange(last * subframes + 1) / subframes
    low = np.minimum(at.astype(int), max(last - 1, 0))
    high = np.minimum(low + 1, last)
    share = (at - low)[:, None, None]
    positions = (1 - share) * poses.positions[low] + share * poses.positions[high]
    first, second = poses.wxyz[low], poses.wxyz[high]
    # q and -q are the same rotation; go the short way.
    sign = np.where((first * second).sum(axis=2, keepdims=True) < 0, -1.0, 1.0)
    wxyz = (1 - share) * first + share * sign * second
    wxyz /= np.linalg.norm(wxyz, axis=2, keepdims=True)
    return Poses(_round(positions), _round(wxyz))


def hit_geom(task: Task, trajectory: Trajectory) -> int | None:
    """The object that ended an episode by a collision: the one nearest to the rod at the end.

    None when the episode ended otherwise, or when the scene has no rod.
    """
    model = scene_model(task).model
    rod = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, ROD_GEOM)
    if trajectory.outcome.get("reason") != COLLISION or rod < 0:
        return None
    data = mujoco.MjData(model)
    data.qpos[:] = trajectory.qpos[-1]
    mujoco.mj_kinematics(model, data)
    others = [
        geom
        for geom in range(model.ngeom)
        if geom != rod and model.geom_contype[geom] and model.geom(geom).name != TABLE_GEOM
    ]
    if not others:
        return None
    reach = 1.0  # m; farther objects all count as this far
    return min(
        others, key=lambda g: float(mujoco.mj_geomDistance(model, data, rod, g, reach, None))
    )


def _round(values: Array) -> Array:
    return np.asarray(np.round(values / POSE_GRID) * POSE_GRID)


def _is_drawn(model: mujoco.MjModel, geom: int) -> bool:
    return bool(
        model.geom_group[geom] <= VISUAL_GROUP
        and model.geom_rgba[geom, 3] > 0
        and model.geom(geom).name != TABLE_GEOM
    )


def _shape(model: mujoco.MjModel, geom: int) -> Shape:
    kinds = mujoco.mjtGeom
    kind = kinds(model.geom_type[geom])
    size = [float(value) for value in model.geom_size[geom]]
    rgba = model.geom_rgba[geom]
    vertices = faces = None
    colour = (round(rgba[0] * 255), round(rgba[1] * 255), round(rgba[2] * 255))
    name: Literal["box", "sphere", "cylinder", "mesh"] = "mesh"
    if kind == kinds.mjGEOM_BOX:
        name, used = "box", tuple(size)
    elif kind == kinds.mjGEOM_SPHERE:
        name, used = "sphere", (size[0],)
    elif kind == kinds.mjGEOM_CYLINDER:
        name, used = "cylinder", (size[0], size[1])
    elif kind == kinds.mjGEOM_CAPSULE:
        capsule = trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=[12, 12])
        used, vertices, faces = (), np.array(capsule.vertices), np.array(capsule.faces)
    elif kind == kinds.mjGEOM_MESH:
        used, colour = (), ROBOT_COLOUR
        vertices, faces = merge_vertices(*_mesh(model, int(model.geom_dataid[geom])), MESH_CELL)
    else:
        raise ValueError(
            f"geom {geom} is a {kind.name}, which replays cannot draw; "
            "legal are box, sphere, cylinder, capsule and mesh"
        )
    return Shape(
        geom=geom,
        body=int(model.geom_bodyid[geom]),
        kind=name,
        size=used,
        position=model.geom_pos[geom].copy(),
        wxyz=model.geom_quat[geom].copy(),
        colour=colour,
        opacity=float(rgba[3]),
        vertices=None if vertices is None else vertices.astype(np.float32),
        faces=None if faces is None else faces.astype(np.int32),
    )


def _mesh(model: mujoco.MjModel, mesh: int) -> tuple[Array, NDArray[np.int64]]:
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return (
        model.mesh_vert[start : start + count].astype(np.float64),
        model.mesh_face[face : face + faces].astype(np.int64),
    )


def merge_vertices(
    vertices: Array, faces: NDArray[np.int64], cell: float
) -> tuple[Array, NDArray[np.int64]]:
    """A coarser mesh: all vertices within one cell of a grid become their mean.

    Faces that collapse are dropped, doubled ones kept once (Rossignac & Borrel 1993).
    """
    keys = np.floor((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    _, cluster, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    cluster = cluster.reshape(-1)
    merged = np.zeros((len(counts), 3))
    np.add.at(merged, cluster, vertices)
    merged /= counts[:, None]
    corners = cluster[faces]
    alive = (
        (corners[:, 0] != corners[:, 1])
        & (corners[:, 1] != corners[:, 2])
        & (corners[:, 0] != corners[:, 2])
    )
    corners = corners[alive]
    _, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    return merged, corners[np.sort(first)]
