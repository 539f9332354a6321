"""A small moving picture of a pair, for lists and for browsers without WebGL.

It is a top-down drawing of both paths, made by Pillow from the task's scene facts: the same bytes
on every machine, no graphics driver, and nothing that could hang in a forked worker. A rendered
arm would hide the very path that the picture is for.
"""

from __future__ import annotations

import io

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from labeling_ui.top_down import DETAIL, INK, Map, draw_scene, pale
from rodif_core.tasks.base import COLLISION, Task
from rodif_core.trajectory import Trajectory

PANEL = (140, 184)  # px of each side
HEADER = 24  # px above the drawing, for the letter
GAP = 6  # px between the sides
FRAMES = 18  # moving frames; one more is held at the end
FRAME_MS = 110
HOLD_MS = 1400
TIP = 5  # px, radius of the dot that moves

PAPER = (246, 247, 249)
HIT_COLOUR = (255, 196, 0)
SIDE_COLOURS = {"A": (0, 114, 178), "B": (213, 94, 0)}


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
        size = (PANEL[0] * DETAIL, PANEL[1] * DETAIL)
        place = self._place = Map.fit(shapes, size, HEADER * DETAIL)
        self._cubes = [shape for shape in shapes if shape["type"] == "cube"]
        self._objects = task.object_poses(trajectory.qpos).astype(np.float64)
        self._path = [place.point(float(x), float(y)) for x, y in trajectory.paths[:, :2]]
        size = (PANEL[0] * DETAIL, (PANEL[1] + HEADER) * DETAIL)
        self._still = Image.new("RGB", size, (255, 255, 255))
        draw = ImageDraw.Draw(self._still)
        draw_scene(draw, place, shapes)
        # Wide enough to be seen in the list, which shows the picture at half its size.
        draw.line(self._path, fill=pale(self._colour), width=2 * DETAIL, joint="curve")
        draw.rectangle((0, 0, size[0], (HEADER - 2) * DETAIL), fill=self._colour)
        font = ImageFont.load_default(size=15 * DETAIL)
        centre = (size[0] / 2, (HEADER - 2) * DETAIL / 2)
        draw.text(centre, name, fill=(255, 255, 255), font=font, anchor="mm")

    def picture(self, end: int) -> Image.Image:
        """The path up to row `end`, where it stands, and the cubes there."""
        large = self._still.copy()
        draw = ImageDraw.Draw(large)
        poses = self._objects[min(end, len(self._objects)) - 1]
        # From the lowest to the highest, as seen from above; within a centimetre as the scene lists
        # them, or the jitter of what rests on the table would decide.
        for cube in sorted(self._cubes, key=lambda cube: round(float(poses[cube["object"], 2]), 2)):
            halves = (cube["half_x"], cube["half_y"], cube["half_z"])
            corners = self._place.corners(poses[cube["object"]], halves)
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
