"""Recordings and thumbnails of tasks with movable cubes."""

from __future__ import annotations

import functools
import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

from labeling_ui.replay import make_replay, make_thumbnail
from labeling_ui.scene import body_poses, scene_model
from rodif_core.demonstrations import make_demonstrations
from rodif_core.spec import TaskName
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory
from tests.ui.test_replay import messages

ROOT = Path(__file__).resolve().parents[2]
TASKS = [TaskName.PUSHING, TaskName.SORTING, TaskName.STACKING_STATE]


@functools.cache
def pair(name: TaskName) -> tuple[Trajectory, Trajectory]:
    """Two demonstrations, the first in the preferred group."""
    first, second = make_demonstrations(get_task(name), episodes=2, seed=4, preferred_share=0.5)
    return first, second


@functools.cache
def film(name: TaskName) -> tuple[np.ndarray, ...]:
    """Frames of the pair's thumbnail, RGB."""
    frames = []
    with Image.open(io.BytesIO(make_thumbnail(get_task(name), *pair(name)))) as picture:
        for index in range(picture.n_frames):
            picture.seek(index)
            frames.append(np.asarray(picture.convert("RGB")).astype(int))
    return tuple(frames)


@pytest.mark.parametrize("name", TASKS)
def test_recording_shows_the_cubes_where_they_were(name: TaskName) -> None:
    task = get_task(name)
    recording = make_replay(task, *pair(name))
    assert len(recording) < 800_000
    moved = messages(recording, "SetPositionMessage")
    for side, trajectory in zip("AB", pair(name), strict=True):
        objects = task.object_poses(trajectory.qpos)
        for index, cube in enumerate(task.objects):
            body = scene_model(task).model.body(cube).id
            places = [m["position"] for _, m in moved if m["name"] == f"/{side}/b{body}"]
            assert len(places) > 20
            np.testing.assert_allclose(places[0], objects[0, index, :3], atol=1e-4)
            np.testing.assert_allclose(places[-1], objects[-1, index, :3], atol=1e-4)


@pytest.mark.parametrize("name", TASKS)
def test_recording_tells_nothing_about_modes(name: TaskName) -> None:
    recording = make_replay(get_task(name), *pair(name))
    texts = [m["props"]["text"] for _, m in messages(recording, "LabelMessage")]
    assert texts == ["A", "B"]


@pytest.mark.parametrize("name", [TaskName.PUSHING, TaskName.SORTING])
def test_thumbnail_shows_every_cube_of_both_sides_move(name: TaskName) -> None:
    shapes = [s for s in get_task(name).scene_shapes() if s["type"] == "cube"]
    first, last = film(name)[0], film(name)[-1]
    half = first.shape[1] // 2
    for side in (slice(0, half), slice(half, None)):
        for shape in shapes:
            colour = np.array(ImageColor.getrgb(shape["colour"]))
            heights = []
            for frame in (first, last):
                near = np.abs(frame[24:, side] - colour).sum(axis=2) < 90
                assert near.sum() > 50
                heights.append(np.median(np.nonzero(near)[0]))
            assert heights[0] - heights[1] > 10  # px upwards: towards targets and bins


def test_thumbnail_shows_the_tower_from_above() -> None:
    """At first all blocks side by side, at last the top one on the others; blue is longer."""
    name = TaskName.STACKING_STATE
    colours = {
        shape["name"]: np.array(ImageColor.getrgb(shape["colour"]))
        for shape in get_task(name).scene_shapes()
        if shape["type"] == "cube"
    }

    def seen(frame: np.ndarray, side: slice, block: str) -> int:
        return int((np.abs(frame[24:, side] - colours[block]).sum(axis=2) < 90).sum())

    first, last = film(name)[0], film(name)[-1]
    half = first.shape[1] // 2
    for side, run in zip((slice(0, half), slice(half, None)), pair(name), strict=True):
        assert seen(first, side, "blue") > 1.3 * seen(first, side, "red") > 100
        bottom, _, top = run.outcome["mode"].split("-")
        assert seen(last, side, top) > seen(last, side, bottom) + 50


def test_recording_shows_the_fingers_close_and_open() -> None:
    task, name = get_task("stacking-state"), TaskName.STACKING_STATE
    model = scene_model(task).model
    bodies = [model.body(f"panda0_{side}finger").id for side in ("left", "right")]
    drawn = {shape.body for shape in scene_model(task).shapes}
    assert drawn >= set(bodies)
    for run in pair(name):
        fingers = body_poses(model, run.qpos).positions[:, bodies]
        gaps = np.linalg.norm(fingers[:, 0] - fingers[:, 1], axis=1)
        assert gaps.max() == pytest.approx(0.08, abs=1e-3)  # m; open
        assert gaps.min() == pytest.approx(0.06, abs=2e-3)  # around a block of 6 cm


@pytest.mark.parametrize("name", list(TaskName))
def test_every_shape_of_a_scene_is_known_to_thumbnails_and_maps(name: TaskName) -> None:
    script = (ROOT / "labeling_ui/site/static/behaviour.js").read_text()
    drawn = set(re.findall(r'shape\.type === "(\w+)"', script))
    task = get_task(name)
    assert {shape["type"] for shape in task.scene_shapes()} <= drawn
    run = make_demonstrations(task, episodes=1, seed=0)[0]
    assert make_thumbnail(task, run, run)


def test_trail_of_a_tower_being_built_is_short_and_does_not_hide_it() -> None:
    task = get_task(TaskName.STACKING_STATE)
    recording = make_replay(task, *pair(TaskName.STACKING_STATE))
    names = {m["name"] for _, m in messages(recording, "LineSegmentsMessage")}
    assert names and all("/trail/" in name for name in names)
    shown: dict[str, float] = {}
    told = messages(recording, "SetSceneNodeVisibilityMessage")
    for time, message in sorted(told, key=lambda one: one[0]):
        if message["visible"] and "/trail/" in message["name"]:
            shown[message["name"]] = time
        elif message["name"] in shown:
            seconds = time - shown.pop(message["name"])
            assert seconds <= task.trail_seconds + 4 * task.control_dt
    assert not shown
