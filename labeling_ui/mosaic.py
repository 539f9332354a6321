"""The frames of a film of many rollouts side by side, each with its trail and how it ends."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from labeling_ui.mode_plot import colours_of_groups, kind_of
from rodif_core.tasks.base import FINISHED, Task
from rodif_core.tasks.camera import Camera, Trail
from rodif_core.tasks.panda import Mesh
from rodif_core.trajectory import Trajectory

MOST_TILES = 12
WIDTH = 1280  # px of the film, less for one rollout
ONE_WIDTH = 800  # px of the film of one rollout
GAP = 6  # px between tiles
HEADER = 62  # px: what is shown, and the legend
CAPTION = 26  # px under each picture
PROGRESS = 3  # px, the bar that fills while the rollout runs

PAPER = (13, 16, 21)
BAR = (27, 32, 40)
INK = (232, 235, 240)
FAINT = (150, 158, 170)
GOOD = (46, 160, 98)
BAD = (196, 62, 56)
TRAIL_OF_FAILURE = (0.27, 0.30, 0.34)
TRAIL_POINTS = 160  # of a whole episode; more cost time and look the same

# Where the camera of the film stands: in front of the robot, a little to its left, so that all of
# the table's working area can be seen and the arm hides little of it.
LOOK_AT = (0.42, 0.03, 0.06)  # m
DISTANCE = 1.04  # m
AZIMUTH, ELEVATION = 162.0, -50.0  # degrees


class Mosaic:
    """Films up to MOST_TILES episodes of one task in a grid, all started together.

    The header tells of all `episodes`; the first ones are shown. An episode that has ended stays
    with its last picture until the longest one has ended.

    stride  control steps from one frame to the next: 1 is real time
    mesh    "col" the low-poly arm, "viz" the detailed one, which takes several times as long
    """

    def __init__(
        self,
        task: Task,
        title: str,
        episodes: Sequence[Trajectory],
        *,
        stride: int = 1,
        mesh: Mesh = "col",
    ) -> None:
        shown = episodes[:MOST_TILES]
        self._columns = columns_of(len(shown))
        rows = -(-len(shown) // self._columns)
        width = WIDTH if self._columns > 1 else ONE_WIDTH
        tile = (width - GAP * (self._columns + 1)) // self._columns
        self._picture = (tile, 3 * tile // 4)
        self._colours = colours_of_groups(task)
        self._tiles = [_Tile(task, one, self._picture, self._colours) for one in shown]
        self._task, self._mesh, self._stride = task, mesh, stride
        self._longest = max(len(one.actions) for one in shown)
        height = HEADER + rows * (self._picture[1] + CAPTION + GAP)
        # Video codecs halve the resolution of colour, so both must be even.
        self._size = (width + width % 2, height + height % 2)
        self._page = Image.new("RGB", self._size, PAPER)
        self._draw_header(title, episodes)

    @property
    def frame_count(self) -> int:
        """Frames that `frames` makes."""
        return len(self._steps())

    @property
    def frame_ms(self) -> int:
        """Milliseconds that a frame lasts."""
        return round(1000 * self._task.control_dt)

    def frames(self) -> Iterator[NDArray[np.uint8]]:
        """Frames (height, width, 3) uint8, height and width even; raises GraphicsError."""
        page = self._page.copy()
        view = free_camera()
        with Camera(self._task, *self._picture, mesh=self._mesh, samples=4) as camera:
            for step in self._steps():
                for index, tile in enumerate(self._tiles):
                    row, column = divmod(index, self._columns)
                    x = GAP + column * (self._picture[0] + GAP)
                    y = HEADER + row * (self._picture[1] + CAPTION + GAP)
                    if tile.changes(step, self._stride):
                        page.paste(tile.draw(camera, view, step), (x, y))
                yield np.array(page)

    def _steps(self) -> list[int]:
        """The control steps that are shown, the last one always."""
        return [*range(0, self._longest, self._stride), self._longest]

    def _draw_header(self, title: str, episodes: Sequence[Trajectory]) -> None:
        draw = ImageDraw.Draw(self._page)
        middle = HEADER // 2
        draw.text((2 * GAP, middle - 13), title, fill=INK, font=_font(18), anchor="lm")
        counts = Counter(kind_of(one) for one in episodes)
        x = 2 * GAP
        for name, colour in self._colours.items():
            if not counts[name]:
                continue
            draw.rounded_rectangle((x, middle + 9, x + 14, middle + 19), 3, fill=colour)
            text = f"{name} {counts[name]}"
            draw.text((x + 20, middle + 14), text, fill=INK, font=_font(14), anchor="lm")
            x += 20 + round(draw.textlength(text, font=_font(14))) + 18


def columns_of(tiles: int) -> int:
    """Columns of a grid of 1 … MOST_TILES tiles."""
    return next(columns for most, columns in ((1, 1), (4, 2), (9, 3), (12, 4)) if tiles <= most)


def free_camera() -> mujoco.MjvCamera:
    """From where the film looks."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = LOOK_AT
    camera.distance, camera.azimuth, camera.elevation = DISTANCE, AZIMUTH, ELEVATION
    return camera


class _Tile:
    """One episode: its picture, and the caption under it."""

    def __init__(
        self,
        task: Task,
        trajectory: Trajectory,
        size: tuple[int, int],
        colours: dict[str, tuple[int, int, int]],
    ) -> None:
        self._trajectory, self._size = trajectory, size
        self._dt = task.control_dt
        self._last = len(trajectory.actions)
        self._colour = colours[kind_of(trajectory)]
        rgb = [part / 255 for part in self._colour] if trajectory.success else TRAIL_OF_FAILURE
        self._rgba = (rgb[0], rgb[1], rgb[2], 1.0)
        self._thin = max(1, self._last // TRAIL_POINTS)

    def changes(self, step: int, stride: int) -> bool:
        """Whether the picture at this control step differs from that of the frame before."""
        return step - stride < self._last

    def draw(self, camera: Camera, view: mujoco.MjvCamera, step: int) -> Image.Image:
        """Picture and caption at a control step, the last one's after the end."""
        row = min(step, self._last)
        points = self._trajectory.paths[: row + 1]
        kept = np.concatenate([points[:: self._thin], points[-1:]])
        width, height = self._size
        trail = Trail(kept, self._rgba, max(3.0, width / 120))
        pixels = camera.picture(self._trajectory.qpos[row], view, [trail])
        tile = Image.new("RGB", (width, height + CAPTION), BAR)
        tile.paste(Image.fromarray(pixels), (0, 0))
        self._caption(ImageDraw.Draw(tile), row)
        return tile

    def _caption(self, draw: ImageDraw.ImageDraw, row: int) -> None:
        width, height = self._size
        middle = height + CAPTION // 2 + 1
        ended = row == self._last
        outcome = self._trajectory.outcome
        tone = GOOD if outcome["success"] else BAD
        part = width * row // max(self._last, 1)
        draw.rectangle((0, height, part, height + PROGRESS - 1), fill=self._colour)
        draw.rectangle((6, middle - 5, 16, middle + 5), fill=self._colour)
        name = str(outcome["mode"] or outcome["group"] or "no mode")
        draw.text((23, middle), name, fill=INK, font=_font(14), anchor="lm")
        start = 23 + draw.textlength(name, font=_font(14)) + 10
        seed = self._trajectory.info.get("seed")
        if seed is not None:
            draw.text((start, middle), f"seed {seed}", fill=FAINT, font=_font(12), anchor="lm")
        time = f"{row * self._dt:.1f} s"
        if not ended:
            draw.text((width - 8, middle), time, fill=FAINT, font=_font(12), anchor="rm")
            return
        text = f"{_ending(outcome)}, {time}"
        box = draw.textbbox((width - 10, middle), text, font=_font(13), anchor="rm")
        draw.rounded_rectangle((box[0] - 6, middle - 9, width - 4, middle + 10), 4, fill=tone)
        draw.text((width - 10, middle), text, fill=(255, 255, 255), font=_font(13), anchor="rm")


def _ending(outcome: dict[str, Any]) -> str:
    reason = str(outcome["reason"])
    return "success" if reason == FINISHED else reason.replace("_", " ")


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size)
