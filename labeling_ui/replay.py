"""Two episodes as one 3-D recording: A on the left, B on the right, one camera, one timeline.

The recording is a `.viser` file, played by viser's own browser client. Equal inputs give equal
bytes, so it can be stored by its hash. It says nothing about where the episodes come from: an
annotator who opens the file finds "A", "B" and bodies, but no checkpoint and no mode.

viser is imported when a replay is made, never before: it must not exist in a process that forks.
"""

from __future__ import annotations

import contextlib
import io
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from labeling_ui.scene import (
    Poses,
    SceneModel,
    Shape,
    body_poses,
    hit_geom,
    relative,
    scene_model,
    smooth,
)
from labeling_ui.thumbnail import make_thumbnail
from rodif_core.errors import ValueOutOfRangeError
from rodif_core.tasks.base import Task
from rodif_core.trajectory import Trajectory

if TYPE_CHECKING:
    import viser

__all__ = ["make_replay", "make_thumbnail"]

SIDE_OFFSET = 0.48  # m; A's robot stands this far to the left of the middle, B's to the right
MIDDLE_X = 0.38  # m in the robot's frame; what lies between the base and the far end of the reach
LEAST_RATE = 30.0  # drawn frames per second, because the client does not interpolate
TRAIL_PIECES = 250  # that appear one by one, at most; each is a thing to draw
HOLD = 1.2  # s; the last frame stays this long before the client starts again

# Sky blue and orange stay apart for every common kind of colour blindness (Okabe & Ito 2008).
SIDE_COLOURS = {"A": (0, 114, 178), "B": (213, 94, 0)}
PALE = 0.5  # how far the trail that is still to come is mixed with white
MAT_PALE = 0.7
TABLE_COLOUR = (226, 224, 219)
HIT_COLOUR = (255, 196, 0)
BACKGROUND = ((236, 240, 244), (206, 213, 221))  # top, bottom

CAMERA_POSITION = (0.0, -1.72, 1.42)
CAMERA_LOOK_AT = (0.0, 0.02, 0.18)
CAMERA_FOV = 0.72  # rad, vertical


@dataclass(frozen=True, eq=False)
class _Side:
    """What one half of the picture shows."""

    name: str
    origin: tuple[float, float, float]  # of the robot's frame, m
    poses: Poses  # seen from each body's parent
    path: NDArray[np.float32]  # (N + 1, 3), m
    kept: int | None  # control steps that its trail stays in view; None: for good
    hit: int | None  # geom that ended the episode


def make_replay(task: Task, left: Trajectory, right: Trajectory) -> bytes:
    """A `.viser` recording of two episodes of `task`, `left` as A and `right` as B.

    Both start together; the shorter one waits in its last pose. Raises ValueOutOfRangeError when an
    episode's physics positions do not fit the task.
    """
    import viser

    model = scene_model(task).model
    for side, trajectory in (("left", left), ("right", right)):
        if trajectory.qpos.shape[1] != model.nq:
            raise ValueOutOfRangeError(
                f"qpos width of the {side} episode",
                trajectory.qpos.shape[1],
                f"{model.nq}, the positions of task {str(task.name)!r}",
            )
    sides = (
        _side("A", -SIDE_OFFSET - MIDDLE_X, task, left),
        _side("B", SIDE_OFFSET - MIDDLE_X, task, right),
    )
    # viser prints a banner whatever its settings say; a worker's log is no place for it.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            with server.atomic():  # nobody listens: do not wake the network thread per message
                return _record(server, task, sides)
        finally:
            server.stop()


def subframes(task: Task) -> int:
    """Drawn frames per control step: as few as give `LEAST_RATE`."""
    return math.ceil(LEAST_RATE * task.control_dt)


def _side(name: str, x: float, task: Task, trajectory: Trajectory) -> _Side:
    model = scene_model(task).model
    poses = relative(body_poses(model, trajectory.qpos), model.body_parentid)
    poses = smooth(poses, subframes(task))
    kept = None if task.trail_seconds is None else round(task.trail_seconds / task.control_dt)
    hit = hit_geom(task, trajectory)
    return _Side(name, (x, 0.0, 0.0), poses, trajectory.paths, kept, hit)


def _record(server: viser.ViserServer, task: Task, sides: tuple[_Side, _Side]) -> bytes:
    scene = server.scene
    _set_stage(server)
    tracks = [_Track(scene, side, scene_model(task), subframes(task)) for side in sides]
    for track in tracks:
        track.show(0)
    recording = server.get_scene_serializer()
    step = task.control_dt / subframes(task)
    for frame in range(1, max(len(side.poses) for side in sides)):
        recording.insert_sleep(step)
        for track in tracks:
            track.show(frame)
    recording.insert_sleep(HOLD)
    return bytes(recording.serialize())


def _set_stage(server: viser.ViserServer) -> None:
    """Camera, light, background and the common table top."""
    camera = server.initial_camera
    camera.position, camera.look_at, camera.fov = CAMERA_POSITION, CAMERA_LOOK_AT, CAMERA_FOV
    scene = server.scene
    scene.set_up_direction("+z")
    # Without the built-in environment map the picture is there ten times sooner on slow machines.
    scene.configure_environment_map(None)
    scene.configure_default_lights(True, cast_shadow=False)
    scene.add_light_hemisphere("/light", intensity=2.0)
    top, bottom = (np.array(colour, dtype=np.float64) for colour in BACKGROUND)
    share = np.linspace(0.0, 1.0, 64)[:, None, None]
    gradient = np.round((1 - share) * top + share * bottom).astype(np.uint8)
    scene.set_background_image(np.repeat(gradient, 4, axis=1), format="png")
    width = 4 * SIDE_OFFSET + 0.1
    scene.add_box(
        "/table",
        color=TABLE_COLOUR,
        dimensions=(width, 1.16, 0.04),
        position=(0.0, 0.02, -0.022),
        cast_shadow=False,
    )


class _Track:
    """The nodes of one side, and what must be sent to show a frame."""

    def __init__(self, scene: Any, side: _Side, drawn: SceneModel, subframes: int) -> None:
        self._side = side
        self._subframes = subframes
        root = f"/{side.name}"
        scene.add_frame(root, show_axes=False, position=side.origin)
        self._names = _body_names(root, drawn.model.body_parentid)
        self._bodies = [scene.add_frame(name, show_axes=False) for name in self._names]
        for shape in drawn.shapes:
            _add_shape(scene, f"{self._names[shape.body]}/g{shape.geom}", shape)
        self._add_surroundings(scene, root)
        self._trail = self._add_trail(scene, root)
        self._hit = self._add_hit(scene, drawn.shapes)
        # viser compares at some cost; what stays as it was is not even offered to it.
        self._moved = _changes(side.poses.positions)
        self._turned = _changes(side.poses.wxyz)

    def _add_surroundings(self, scene: Any, root: str) -> None:
        """A tinted mat under the work space and the side's letter in front of it."""
        colour = SIDE_COLOURS[self._side.name]
        scene.add_box(
            f"{root}/mat",
            color=_mix(colour, MAT_PALE),
            dimensions=(0.56, 0.86, 0.003),
            position=(0.5, 0.0, -0.0008),
            cast_shadow=False,
            receive_shadow=False,
        )
        scene.add_label(
            f"{root}/label", self._side.name, position=(0.5, -0.49, 0.03), font_screen_scale=2.2
        )

    def _add_trail(self, scene: Any, root: str) -> list[Any]:
        """Strong pieces that appear as the end effector moves, and a pale line over the whole path
        where they stay."""
        colour = SIDE_COLOURS[self._side.name]
        points = np.asarray(self._side.path, dtype=np.float32)
        pieces = np.stack([points[:-1], points[1:]], axis=1)
        below = pieces - np.array([0.0, 0.0, 0.004], dtype=np.float32)  # else the two lines mix
        if self._side.kept is None:
            scene.add_line_segments(
                f"{root}/path", below, _mix(colour, PALE), thickness=2.0, thickness_units="screen"
            )
        self._hidden = 0  # pieces that were in view and are no longer
        self._stride = max(1, math.ceil(len(pieces) / TRAIL_PIECES))  # control steps a piece
        return [
            scene.add_line_segments(
                f"{root}/trail/{first}",
                pieces[first : first + self._stride],
                colour,
                thickness=5.0,
                thickness_units="screen",
                visible=False,
            )
            for first in range(0, len(pieces), self._stride)
        ]

    def _add_hit(self, scene: Any, shapes: tuple[Shape, ...]) -> list[Any]:
        """What appears when the rod has touched an object: the object in another colour."""
        for shape in shapes:
            if shape.geom == self._side.hit:
                name = f"{self._names[shape.body]}/touched"
                body = _add_shape(scene, name, shape, colour=HIT_COLOUR, grown=1.02, visible=False)
                above = shape.position + np.array([0.0, 0.0, shape.size[-1] + 0.06])
                label = scene.add_label(
                    f"{name}_label", "touched", position=above, font_screen_scale=1.1, visible=False
                )
                return [body, label]
        return []

    def show(self, frame: int) -> None:
        """Send what changes at `frame`; frames after the last one change nothing."""
        poses = self._side.poses
        if frame >= len(poses):
            return
        for body in np.flatnonzero(self._moved[frame]):
            self._bodies[body].position = poses.positions[frame, body]
        for body in np.flatnonzero(self._turned[frame]):
            self._bodies[body].wxyz = poses.wxyz[frame, body]
        last = frame == len(poses) - 1
        step, between = divmod(frame, self._subframes)
        if frame and not between and (step % self._stride == 0 or last):
            self._trail[(step - 1) // self._stride].visible = True
            self._hide_trail(step, last)
        if last:
            for handle in self._hit:
                handle.visible = True

    def _hide_trail(self, step: int, last: bool) -> None:
        """What is too old goes piece by piece; when all is over, the rest."""
        if self._side.kept is None:
            return
        old = len(self._trail) if last else max(0, (step - self._side.kept) // self._stride)
        for piece in self._trail[self._hidden : old]:
            piece.visible = False
        self._hidden = old


def _body_names(root: str, parents: NDArray[np.int32]) -> list[str]:
    """The node of each body, under that of its parent; what hangs on the world is under `root`."""
    names = [f"{root}/b0"]
    for body, parent in enumerate(parents[1:], start=1):
        names.append(f"{names[parent] if parent else root}/b{body}")
    return names


def _changes(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which bodies' rows of (F, B, D) differ from the frame before (F, B); the first all do."""
    changes = np.ones(values.shape[:2], dtype=bool)
    changes[1:] = (values[1:] != values[:-1]).any(axis=2)
    return changes


def _add_shape(
    scene: Any,
    name: str,
    shape: Shape,
    *,
    colour: tuple[int, int, int] | None = None,
    grown: float = 1.0,
    visible: bool = True,
) -> Any:
    """Draw a shape; `colour` and `grown` (a scale factor) replace its own look."""
    place: dict[str, Any] = {
        "color": colour or shape.colour,
        "position": shape.position,
        "wxyz": shape.wxyz,
        "opacity": None if shape.opacity >= 1 else shape.opacity,
        "cast_shadow": False,
        "receive_shadow": False,
        "visible": visible,
    }
    if shape.kind == "box":
        size = tuple(2 * grown * half for half in shape.size)
        return scene.add_box(name, dimensions=size, **place)
    if shape.kind == "sphere":
        return scene.add_icosphere(name, radius=grown * shape.size[0], subdivisions=3, **place)
    if shape.kind == "cylinder":
        radius, half = shape.size
        return scene.add_cylinder(
            name, radius=grown * radius, height=2 * grown * half, radial_segments=40, **place
        )
    return scene.add_mesh_simple(name, shape.vertices, shape.faces, scale=grown, **place)


def _mix(colour: tuple[int, int, int], white: float) -> tuple[int, int, int]:
    red, green, blue = (round(value + (255 - value) * white) for value in colour)
    return red, green, blue
