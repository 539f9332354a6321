"""Drawing a task's scene from above with Pillow: where things are, and what does not move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor, ImageDraw

DETAIL = 3  # drawn this many times larger, then scaled down for smooth edges
INK = (38, 45, 56)
MARGIN = 0.03  # m around the work space
GROUND = ("workspace", "platform", "target")  # shapes that lie below all others


@dataclass(frozen=True)
class Map:
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

    def corners(
        self, pose: NDArray[np.float64], halves: tuple[float, float, float]
    ) -> list[tuple[float, float]]:
        """Corners of the upper face of a block with pose (7,) and half lengths `halves` (m)."""
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, pose[3:])
        axes = rotation.reshape(3, 3).T
        # Whichever face looks up now: a block may have rolled.
        up = int(np.argmax(np.abs(axes[:, 2])))
        u, v = (halves[i] * axes[i] for i in range(3) if i != up)
        signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
        return [self.point(*(pose[:2] + a * u[:2] + b * v[:2])) for a, b in signs]

    @classmethod
    def fit(cls, shapes: Sequence[Mapping[str, Any]], size: tuple[int, int], top: int) -> Map:
        """The largest map of `size` px, `top` px below the upper edge, with the whole work space.

        All pixels are those of the large drawing.
        """
        box = next(shape for shape in shapes if shape["type"] == "workspace")
        x0, x1 = box["x0"] - MARGIN, box["x1"] + MARGIN
        y0, y1 = box["y0"] - MARGIN, box["y1"] + 3 * MARGIN  # paths end a little behind the finish
        scale = min(size[0] / (x1 - x0), size[1] / (y1 - y0))
        left = size[0] / 2 - scale * (x0 + x1) / 2
        return cls(scale, left, top + size[1] / 2 + scale * (y0 + y1) / 2)


def draw_scene(draw: ImageDraw.ImageDraw, place: Map, shapes: Sequence[Mapping[str, Any]]) -> None:
    """Everything that does not move: all shapes but cubes. Raises ValueError for a foreign type."""
    for shape in sorted(shapes, key=lambda shape: shape["type"] not in GROUND):
        _draw_shape(draw, place, shape)


def _draw_shape(draw: ImageDraw.ImageDraw, place: Map, shape: Mapping[str, Any]) -> None:
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
        draw.rectangle(box, fill=pale(colour[:3], 0.75), outline=colour, width=DETAIL)
    elif kind != "cube":  # cubes move, they are drawn in every frame
        raise ValueError(
            f"scene shape of type {kind!r}; legal are cylinder, finish, workspace, start, "
            "platform, target and cube"
        )


def pale(colour: tuple[int, ...], white: float = 0.6) -> tuple[int, int, int]:
    """A colour mixed with white."""
    red, green, blue = (round(value + (255 - value) * white) for value in colour)
    return red, green, blue
