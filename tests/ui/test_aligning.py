"""Recordings of Aligning: a hollow box that moves, and its target that stays."""

from __future__ import annotations

import functools
import io

import numpy as np
import pytest
from PIL import Image, ImageColor

from labeling_ui.replay import make_replay
from labeling_ui.scene import scene_model
from labeling_ui.thumbnail import HEADER, PANEL, make_thumbnail
from labeling_ui.top_down import Map
from rodif_core.demonstrations import make_demonstrations
from rodif_core.spec import TaskName
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory
from tests.ui.test_replay import messages

TASK = get_task(TaskName.ALIGNING_STATE)


@functools.cache
def pair() -> tuple[Trajectory, Trajectory]:
    """One episode from the inside, one from the outside."""
    inside, outside = make_demonstrations(TASK, episodes=2, seed=4, preferred_share=0.5)
    return inside, outside


def test_recording_shows_the_walls_of_box_and_target_and_moves_the_box_alone() -> None:
    inside, outside = pair()
    recording = make_replay(TASK, inside, outside)
    moved = messages(recording, "SetPositionMessage")
    for side, trajectory in (("A", inside), ("B", outside)):
        objects = TASK.object_poses(trajectory.qpos)
        bodies = [scene_model(TASK).model.body(name).id for name in TASK.objects]
        box, target = (
            [m["position"] for _, m in moved if m["name"] == f"/{side}/b{body}"] for body in bodies
        )
        assert len(box) > 20
        np.testing.assert_allclose(box[-1], objects[-1, 0, :3], atol=1e-4)
        assert len(target) == 1
        np.testing.assert_allclose(target[0], objects[0, 1, :3], atol=1e-4)


def test_box_and_target_have_the_same_four_colours_and_the_target_is_seen_through() -> None:
    model, shapes = scene_model(TASK).model, scene_model(TASK).shapes
    walls = {
        name: [
            shape
            for shape in shapes
            if shape.body == model.body(name).id and "wall" in model.geom(shape.geom).name
        ]
        for name in TASK.objects
    }
    assert [wall.colour for wall in walls["box"]] == [wall.colour for wall in walls["target"]]
    assert len({wall.colour for wall in walls["box"]}) == 4
    assert {wall.opacity for wall in walls["box"]} == {1.0}
    assert all(wall.opacity < 0.5 for wall in walls["target"])


def seen(frame: np.ndarray, name: str) -> list[int]:
    """Pixels of a frame of the thumbnail in the colour of an object, on the left and the right."""
    shape = next(one for one in TASK.scene_shapes() if one.get("name") == name)
    near = np.abs(frame[HEADER:] - np.array(ImageColor.getrgb(shape["colour"]))).sum(axis=2) < 30
    half = frame.shape[1] // 2
    return [int(near[:, :half].sum()), int(near[:, half:].sum())]


def test_thumbnail_shows_the_box_as_large_as_it_is_and_at_last_over_its_target() -> None:
    frames = []
    with Image.open(io.BytesIO(make_thumbnail(TASK, *pair()))) as film:
        for number in (0, film.n_frames - 1):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
    first, last = frames
    edge = 0.1 * Map.fit(TASK.scene_shapes(), PANEL, 0).scale  # px; 10 cm
    for name in TASK.objects:
        # Without its outline, which is a pixel wide.
        assert seen(first, name) == pytest.approx([(edge - 1) ** 2] * 2, rel=0.15)
    for box, target in zip(seen(last, "box"), seen(last, "target"), strict=True):
        assert box > 2 * target
