"""End-effector paths over a task's scene, coloured by how they went: the paper's mode figures."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Sequence

from PIL import Image, ImageDraw, ImageFont

from labeling_ui.top_down import DETAIL, INK, Map, draw_scene, pale
from rodif_core.tasks.base import Task
from rodif_core.trajectory import Trajectory

MAP = (420, 520)  # px
LINE = 20  # px, height of a line of the legend
FAILED = "failed"
FAILED_COLOUR = (150, 156, 165)
# The preferred group first; colours that stay apart for all common kinds of colour blindness
# (Okabe & Ito 2008).
GROUP_COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0))


def mode_plot(task: Task, title: str, trajectories: Sequence[Trajectory]) -> bytes:
    """A PNG of all paths from above with a legend that counts the groups; equal inputs give equal
    bytes. Failures are grey and lie below."""
    names = [task.preferred_group, *(g for g in task.groups if g != task.preferred_group)]
    colours = dict(zip(names, GROUP_COLOURS, strict=False)) | {FAILED: FAILED_COLOUR}
    names.append(FAILED)
    kinds = [str(t.outcome["group"]) if t.success else FAILED for t in trajectories]
    counts = Counter(kinds)
    top = LINE * (len(names) + 2)
    size = (MAP[0] * DETAIL, (MAP[1] + top) * DETAIL)
    picture = Image.new("RGB", size, (255, 255, 255))
    draw = ImageDraw.Draw(picture)
    shapes = task.scene_shapes()
    place = Map.fit(shapes, (size[0], MAP[1] * DETAIL), top * DETAIL)
    draw_scene(draw, place, shapes)
    for name in reversed(names):
        for kind, trajectory in zip(kinds, trajectories, strict=True):
            if kind == name:
                path = [place.point(float(x), float(y)) for x, y in trajectory.paths[:, :2]]
                draw.line(path, fill=pale(colours[name], 0.3), width=DETAIL, joint="curve")
    font = ImageFont.load_default(size=13 * DETAIL)
    x, y = LINE * DETAIL, LINE * DETAIL
    draw.text((x, y), title, fill=INK, font=font, anchor="lm")
    for name in names:
        y += LINE * DETAIL
        draw.line((x, y, x + LINE * DETAIL, y), fill=colours[name], width=4 * DETAIL)
        liked = ", preferred" if name == task.preferred_group else ""
        text = f"{name}{liked}: {counts[name]}"
        draw.text((x + 1.5 * LINE * DETAIL, y), text, fill=INK, font=font, anchor="lm")
    buffer = io.BytesIO()
    picture.reduce(DETAIL).save(buffer, format="PNG")
    return buffer.getvalue()
