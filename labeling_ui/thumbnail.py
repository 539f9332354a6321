"""A small moving picture of a pair, for lists and for browsers without WebGL.

It is a top-down drawing of both paths, made by Pillow from the task's scene facts: the same bytes
on every machine, no graphics driver, and nothing that could hang in a forked worker. A rendered
arm would hide the very path that the picture is for.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import imageio.v3 as imageio
import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from rodif_core.tasks.base import COLLISION, Task
from rodif_core.trajectory import Trajectory

PANEL = (140, 184)  # px of each side
HEADER = 24  # px above the drawing, for the letter
GAP = 6  # px between the sides
FRAMES = 18  # moving frames; one more is held at the end
FRAME_MS = 110
HOLD_MS = 1400
TIP = 5  # px, radius of the dot that moves
DETAIL = 3  # drawn this many times larger, then scaled down for smooth edges

INK = (38, 45, 56)
PAPER = (246, 247, 249)
HIT_COLOUR = (255, 196, 0)
SIDE_COLOURS = {"A": (0, 114, 178), "B": (213, 94, 0)}
MARGIN = 0.03  # m around the work space
GROUND = ("workspace", "platform", "target")  # shapes that lie below all others


@dataclass(frozen=True)
class _Map:
    """From metres to pixels: x to the right, y up."""

    scale: float
    left: float  # px of x = 0
    bottom: float  # px of y = 0

    def point(self, x: float, y: float) -> tuple[float, float]:
        return self.left + self.scale * x, self.bottom - self.scale * y

    def disc(self, x: float, y: float, radius: float) -> tuple[float, float, float, float]:
        """Bounding box of a disc of `radius` metres."""
        (u, v), r = self.point(x, y), self.scale * radius
        return u - r, v - r, u + r, v + r

    def corners(self, pose: NDArray[np.float64], half: float) -> list[tuple[float, float]]:
        """Corners of the upper face of a cube with pose (7,) and half edge `half` (m)."""
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, pose[3:])
        axes = rotation.reshape(3, 3).T
        # Whichever face looks up now: a cube may have rolled.
        up = int(np.argmax(np.abs(axes[:, 2])))
        u, v = (half * axes[i] for i in range(3) if i != up)
        signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
        return [self.point(*(pose[:2] + a * u[:2] + b * v[:2])) for a, b in signs]


def make_thumbnail(task: Task, left: Trajectory, right: Trajectory) -> bytes:
    """Animated webp (286 x 208 px) of both paths and of the cubes seen from above, `left` as A,
    `right` as B. Both run at the same speed; the last frame, with both whole paths, is held.
    """
    longest = max(len(left.paths), len(right.paths))
    ends = np.unique(np.linspace(1, longest, FRAMES).astype(int))
    panels = (_Panel("A", task, left), _Panel("B", task, right))
    frames = [_frame(panels, int(end)) for end in ends]
    durations = [FRAME_MS] * (len(frames) - 1) + [HOLD_MS]
    buffer = io.BytesIO()
    imageio.imwrite(
        buffer,
        np.stack(frames),
        extension=".webp",
        plugin="pillow",
        duration=durations,
        loop=0,
        quality=70,
        method=4,
    )
    return buffer.getvalue()


class _Panel:
    """One side: what does not move is drawn once, the path on a copy of it for every frame."""

    def __init__(self, name: str, task: Task, trajectory: Trajectory) -> None:
        self._colour = SIDE_COLOURS[name]
        self._hit = trajectory.outcome.get("reason") == COLLISION
        shapes = task.scene_shapes()
        place = self._place = _fit(shapes)
        self._cubes = [shape for shape in shapes if shape["type"] == "cube"]
        self._objects = task.object_poses(trajectory.qpos).astype(np.float64)
        self._path = [place.point(float(x), float(y)) for x, y in trajectory.paths[:, :2]]
        size = (PANEL[0] * DETAIL, (PANEL[1] + HEADER) * DETAIL)
        self._still = Image.new("RGB", size, (255, 255, 255))
        draw = ImageDraw.Draw(self._still)
        for shape in sorted(shapes, key=lambda shape: shape["type"] not in GROUND):
            _draw_shape(draw, place, shape)
        draw.line(self._path, fill=_pale(self._colour), width=DETAIL, joint="curve")
        draw.rectangle((0, 0, size[0], (HEADER - 2) * DETAIL), fill=self._colour)
        font = ImageFont.load_default(size=15 * DETAIL)
        centre = (size[0] / 2, (HEADER - 2) * DETAIL / 2)
        draw.text(centre, name, fill=(255, 255, 255), font=font, anchor="mm")

    def picture(self, end: int) -> Image.Image:
        """The path up to row `end`, where it stands, and the cubes there."""
        large = self._still.copy()
        draw = ImageDraw.Draw(large)
        poses = self._objects[min(end, len(self._objects)) - 1]
        for cube in self._cubes:
            corners = self._place.corners(poses[cube["object"]], cube["half"])
            draw.polygon(corners, fill=cube["colour"], outline=INK, width=DETAIL)
        done = self._path[:end]
        if len(done) > 1:
            draw.line(done, fill=self._colour, width=3 * DETAIL, joint="curve")
        (x, y), r = done[-1], TIP * DETAIL
        tip = HIT_COLOUR if self._hit and end >= len(self._path) else INK
        draw.ellipse((x - r, y - r, x + r, y + r), fill=tip, outline=INK, width=DETAIL)
        return large.reduce(DETAIL)


def _frame(panels: tuple[_Panel, _Panel], end: int) -> NDArray[np.uint8]:
    """(208, 286, 3) uint8: both paths up to row `end`."""
    picture = Image.new("RGB", (2 * PANEL[0] + GAP, PANEL[1] + HEADER), PAPER)
    for panel, x in zip(panels, (0, PANEL[0] + GAP), strict=True):
        picture.paste(panel.picture(end), (x, 0))
    return np.asarray(picture)


def _fit(shapes: Sequence[Mapping[str, Any]]) -> _Map:
    """The largest map that shows the whole work space below the header."""
    box = next(shape for shape in shapes if shape["type"] == "workspace")
    x0, x1 = box["x0"] - MARGIN, box["x1"] + MARGIN
    y0, y1 = box["y0"] - MARGIN, box["y1"] + 3 * MARGIN  # paths end a little behind the finish
    width, height = PANEL[0] * DETAIL, PANEL[1] * DETAIL
    scale = min(width / (x1 - x0), height / (y1 - y0))
    left = width / 2 - scale * (x0 + x1) / 2
    bottom = HEADER * DETAIL + height / 2 + scale * (y0 + y1) / 2
    return _Map(scale, left, bottom)


def _draw_shape(draw: ImageDraw.ImageDraw, place: _Map, shape: Mapping[str, Any]) -> None:
    kind = shape["type"]
    if kind == "cylinder":
        draw.ellipse(place.disc(shape["x"], shape["y"], shape["radius"]), fill=shape["colour"])
    elif kind == "finish":
        line = [place.point(shape["x0"], shape["y"]), place.point(shape["x1"], shape["y"])]
        draw.line(line, fill=shape["colour"], width=3 * DETAIL)
    elif kind == "workspace":
        corner, other = place.point(shape["x0"], shape["y1"]), place.point(shape["x1"], shape["y0"])
        draw.rectangle((*corner, *other), outline=(222, 226, 231), width=DETAIL)
    elif kind == "start":
        draw.ellipse(place.disc(shape["x"], shape["y"], 0.010), outline=INK, width=DETAIL)
    elif kind == "platform":
        corner, other = place.point(shape["x0"], shape["y1"]), place.point(shape["x1"], shape["y0"])
        draw.rectangle((*corner, *other), fill=(232, 234, 237))
    elif kind == "target":
        x, y, a, b = shape["x"], shape["y"], shape["half_x"], shape["half_y"]
        box = (*place.point(x - a, y + b), *place.point(x + a, y - b))
        colour = ImageColor.getrgb(shape["colour"])
        draw.rectangle(box, fill=_pale(colour[:3], 0.75), outline=colour, width=DETAIL)
    elif kind != "cube":  # cubes move, they are drawn in every frame
        raise ValueError(
            f"scene shape of type {kind!r}; legal are cylinder, finish, workspace, start, "
            "platform, target and cube"
        )


def _pale(colour: tuple[int, ...], white: float = 0.6) -> tuple[int, int, int]:
    red, green, blue = (round(value + (255 - value) * white) for value in colour)
    return red, green, blue
