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
# (Okabe & Ito 2008). Stacking has as many groups as there are colours here.
GROUP_COLOURS = (
    (0, 114, 178),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (230, 159, 0),
    (86, 180, 233),
)


def mode_plot(task: Task, title: str, trajectories: Sequence[Trajectory]) -> bytes:
    """A PNG of all paths from above with a legend that counts the groups; equal inputs give equal
    bytes. Failures are grey and lie below."""
    colours = colours_of_groups(task)
    kinds = [kind_of(trajectory) for trajectory in trajectories]
    counts = Counter(kinds)
    top = LINE * (len(colours) + 2)
    size = (MAP[0] * DETAIL, (MAP[1] + top) * DETAIL)
    picture = Image.new("RGB", size, (255, 255, 255))
    draw = ImageDraw.Draw(picture)
    shapes = task.scene_shapes()
    place = Map.fit(shapes, (size[0], MAP[1] * DETAIL), top * DETAIL)
    draw_scene(draw, place, shapes)
    for name in reversed(colours):
        for kind, trajectory in zip(kinds, trajectories, strict=True):
            if kind == name:
                path = [place.point(float(x), float(y)) for x, y in trajectory.paths[:, :2]]
                draw.line(path, fill=pale(colours[name], 0.3), width=DETAIL, joint="curve")
    font = ImageFont.load_default(size=13 * DETAIL)
    x, y = LINE * DETAIL, LINE * DETAIL
    draw.text((x, y), title, fill=INK, font=font, anchor="lm")
    for name, colour in colours.items():
        y += LINE * DETAIL
        draw.line((x, y, x + LINE * DETAIL, y), fill=colour, width=4 * DETAIL)
        liked = ", preferred" if name == task.preferred_group else ""
        text = f"{name}{liked}: {counts[name]}"
        draw.text((x + 1.5 * LINE * DETAIL, y), text, fill=INK, font=font, anchor="lm")
    buffer = io.BytesIO()
    picture.reduce(DETAIL).save(buffer, format="PNG")
    return buffer.getvalue()


def colours_of_groups(task: Task) -> dict[str, tuple[int, int, int]]:
    """The colour of each group, the preferred one first, and of failures."""
    names = [task.preferred_group, *(g for g in task.groups if g != task.preferred_group)]
    own = dict(zip(names, GROUP_COLOURS[: len(names)], strict=True))
    return own | {FAILED: FAILED_COLOUR}


def kind_of(trajectory: Trajectory) -> str:
    """The group of a success, FAILED for any other episode."""
    return str(trajectory.outcome["group"]) if trajectory.success else FAILED
