"""Pictures off screen: what they show, that they repeat, and what is said where there is no GL."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from rodif_core.errors import GraphicsError, UnknownNameError
from rodif_core.tasks import get_task
from rodif_core.tasks.camera import Camera, Trail
from rodif_core.tasks.env import BatchEnv

SIZE = (96, 72)


def start_of(name: str) -> Any:
    task = get_task(name)
    env = BatchEnv(task, 1)
    env.reset([task.sample_context(np.random.default_rng(0))])
    return env.qpos[0]


@pytest.fixture(scope="module")
def camera() -> Iterator[Camera]:
    with Camera(get_task("pushing"), *SIZE) as opened:
        yield opened


def test_the_same_positions_give_the_same_picture(camera: Camera):
    qpos = start_of("pushing")
    picture = camera.picture(qpos)
    assert picture.shape == (72, 96, 3) and picture.dtype == np.uint8
    moved = qpos.copy()
    moved[7] += 0.1  # the red cube
    other = camera.picture(moved)
    assert not np.array_equal(picture, other)
    assert np.array_equal(camera.picture(qpos), picture)
    with Camera(get_task("pushing"), *SIZE) as another:
        assert np.array_equal(another.picture(qpos), picture)


def test_a_cube_is_seen_where_it_is(camera: Camera):
    """Seen from the front, larger y is to the right and larger x is nearer: lower."""

    def centre_of_red(qpos: Any) -> Any:
        picture = camera.picture(qpos).astype(int)
        red = (picture[..., 0] > 100) & (picture[..., 1] < 60) & (picture[..., 2] < 60)
        assert red.any()
        rows, columns = np.nonzero(red)
        return rows.mean(), columns.mean()

    qpos = start_of("pushing")
    qpos[7:9] = (0.6, -0.3)
    row, column = centre_of_red(qpos)
    qpos[8] = -0.15
    assert centre_of_red(qpos)[1] > column + 5
    qpos[7:9] = (0.7, -0.3)
    assert centre_of_red(qpos)[0] > row + 5


def test_trails_are_drawn_in_their_colour(camera: Camera):
    qpos = start_of("pushing")
    points = np.array([[0.7, -0.3, 0.02], [0.7, 0.0, 0.02], [0.7, 0.3, 0.02]])
    plain = camera.picture(qpos)
    drawn = camera.picture(qpos, trails=[Trail(points, (0.0, 0.0, 1.0, 1.0))])
    changed = (plain != drawn).any(axis=-1)
    assert changed.sum() > 30
    assert (drawn[changed][:, 2].astype(int) > drawn[changed][:, 0]).mean() > 0.9
    assert np.array_equal(camera.picture(qpos), plain)  # the next picture is without it


def test_an_unknown_view_names_the_legal_ones(camera: Camera):
    with pytest.raises(UnknownNameError, match="unknown view 'moon'; legal values are 'front'"):
        camera.picture(start_of("pushing"), "moon")


def test_a_camera_can_be_closed_and_used_again():
    qpos = start_of("avoid")
    with Camera(get_task("avoid"), *SIZE) as camera:
        picture = camera.picture(qpos)
    assert np.array_equal(camera.picture(qpos), picture)
    camera.close()


def test_loading_the_module_needs_no_gl_and_no_torch():
    code = (
        "import sys; import rodif_core.tasks.camera;"
        "print(sorted({'torch', 'mujoco.egl', 'mujoco.osmesa'} & set(sys.modules)))"
    )
    env = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert done.stdout.strip() == "[]", done.stderr


def test_without_gl_libraries_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    def missing(name: str) -> Any:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(ctypes, "CDLL", missing)
    with (
        pytest.raises(GraphicsError, match=r"no libEGL.*apt-get install -y libegl1.*rodif doctor"),
        Camera(get_task("avoid"), *SIZE) as camera,
    ):
        camera.start()


def test_an_unknown_mujoco_gl_names_the_legal_ones(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with (
        pytest.raises(GraphicsError, match="'vulkan'; legal values are egl, osmesa"),
        Camera(get_task("avoid"), *SIZE) as camera,
    ):
        camera.start()


def _draw_in_child(answers: Any) -> None:
    try:
        with Camera(get_task("avoid"), *SIZE) as camera:
            camera.start()
    except GraphicsError as error:
        answers.put(str(error))
    else:
        answers.put("drawn")


@pytest.mark.parametrize(("method", "answer"), [("fork", "was forked from"), ("spawn", "drawn")])
def test_a_forked_child_of_a_process_that_drew_is_refused_instead_of_hanging(
    method: str, answer: str, camera: Camera
):
    camera.picture(start_of("pushing"))
    context = multiprocessing.get_context(method)
    answers = context.Queue()
    child = context.Process(target=_draw_in_child, args=(answers,))
    child.start()
    try:
        assert answer in answers.get(timeout=60)
    finally:
        child.kill()
        child.join()
