"""Recordings and thumbnails of pairs."""

from __future__ import annotations

import io
import subprocess
import sys
from dataclasses import replace
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest
import zstandard
from PIL import Image

from labeling_ui.replay import (
    HOLD,
    SIDE_COLOURS,
    TRAIL_PIECES,
    make_replay,
    make_thumbnail,
    subframes,
)
from labeling_ui.scene import (
    Poses,
    body_poses,
    hit_geom,
    merge_vertices,
    relative,
    scene_model,
    smooth,
)
from rodif_core.errors import ValueOutOfRangeError
from rodif_core.spec import TaskName
from rodif_core.tasks import get_task
from tests.ui.studio import TASK, episodes, replay_of

TASK_OBJECT = get_task(TASK)
LEFT, RIGHT, COLLIDING = 0, 1, 2


def decode(recording: bytes) -> dict[str, Any]:
    """The messages of a `.viser` file: size, then zstandard of (size, MessagePack, buffers)."""
    size = int.from_bytes(recording[:8], "little")
    raw = zstandard.ZstdDecompressor().decompress(recording[8:], max_output_size=size)
    length = int.from_bytes(raw[:8], "little")
    decoded: dict[str, Any] = msgspec.msgpack.decode(raw[8 : 8 + length])
    return decoded


def messages(recording: bytes, kind: str) -> list[tuple[float, dict[str, Any]]]:
    """(time in s, message) of one type."""
    return [(t, m) for t, m in decode(recording)["messages"] if m["type"] == kind]


def test_equal_episodes_give_equal_bytes_and_swapped_sides_give_others() -> None:
    left, right = episodes()[LEFT], episodes()[RIGHT]
    again = make_replay(TASK_OBJECT, left, right)
    assert again == replay_of(LEFT, RIGHT)[0]
    assert again != replay_of(RIGHT, LEFT)[0]


def test_recording_is_small_and_as_long_as_the_longer_episode() -> None:
    recording = replay_of(LEFT, COLLIDING)[0]
    steps = len(episodes()[LEFT].actions)
    assert len(recording) < 400_000
    seconds = steps * TASK_OBJECT.control_dt + HOLD
    assert decode(recording)["durationSeconds"] == pytest.approx(seconds)


def test_recording_tells_nothing_about_policies_modes_or_outcomes() -> None:
    recording = replay_of(LEFT, RIGHT)[0]
    names = {m["name"] for _, m in decode(recording)["messages"] if "name" in m}
    text = str(decode(recording)).lower()
    for word in ("success", "checkpoint", "collision", "l-11", "r-33", "avoid"):
        assert word not in text
    for word in ("left", "right"):  # viser itself says "top-left" of a label's anchor
        assert not any(word in name for name in names)
    labels = [m["props"]["text"] for _, m in messages(replay_of(LEFT, RIGHT)[0], "LabelMessage")]
    assert labels == ["A", "B"]


def test_nested_nodes_put_every_body_where_the_recorded_joint_positions_do() -> None:
    run = episodes()[LEFT]
    model = scene_model(TASK_OBJECT).model
    data = mujoco.MjData(model)
    step = 20
    data.qpos[:] = run.qpos[step]
    mujoco.mj_kinematics(model, data)
    hand = model.body("panda0_link7").id
    chain = [hand]
    while model.body_parentid[chain[0]]:
        chain.insert(0, int(model.body_parentid[chain[0]]))
    position, rotation = np.zeros(3), np.eye(3)
    for depth in range(len(chain)):
        name = "/A" + "".join(f"/b{body}" for body in chain[: depth + 1])
        offset = _latest("SetPositionMessage", name, "position", step * TASK_OBJECT.control_dt)
        wxyz = _latest("SetOrientationMessage", name, "wxyz", step * TASK_OBJECT.control_dt)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.array(wxyz) / np.linalg.norm(wxyz))
        position = position + rotation @ np.array(offset)
        rotation = rotation @ turn.reshape(3, 3)
    np.testing.assert_allclose(position, data.xpos[hand], atol=5e-4)


def _latest(kind: str, name: str, field: str, time: float) -> list[float]:
    """What a node was last told of that field, by that time; nothing is sent for no change."""
    told = [[0.0, 0.0, 0.0] if field == "position" else [1.0, 0.0, 0.0, 0.0]] + [
        m[field]
        for t, m in messages(replay_of(LEFT, RIGHT)[0], kind)
        if m["name"] == name and t <= time + 1e-6
    ]
    value: list[float] = told[-1]
    return value


def test_relative_poses_of_an_arm_turn_and_do_not_move() -> None:
    run = episodes()[LEFT]
    model = scene_model(TASK_OBJECT).model
    seen = smooth(relative(body_poses(model, run.qpos), model.body_parentid), 2)
    link = model.body("panda0_link7").id
    assert len(np.unique(seen.positions[:, link], axis=0)) == 1
    assert len(np.unique(seen.wxyz[:, link], axis=0)) > len(run.qpos) / 2


def test_drawn_frames_are_as_few_as_look_smooth() -> None:
    rates = {name: subframes(get_task(name)) / get_task(name).control_dt for name in TaskName}
    assert all(30 <= rate < 60 for rate in rates.values()), rates


def test_a_stands_left_of_b_and_both_show_the_same_scene() -> None:
    positions = {
        m["name"]: m["position"]
        for _, m in messages(replay_of(LEFT, RIGHT)[0], "SetPositionMessage")
    }
    assert positions["/A"][0] < positions["/B"][0]
    cylinders = [m["name"] for _, m in messages(replay_of(LEFT, RIGHT)[0], "CylinderMessage")]
    assert sorted(name[2:] for name in cylinders if name.startswith("/A")) == sorted(
        name[2:] for name in cylinders if name.startswith("/B")
    )


def test_trail_appears_with_the_motion_and_the_shorter_run_waits() -> None:
    shown = [
        (t, m["name"])
        for t, m in messages(replay_of(LEFT, COLLIDING)[0], "SetSceneNodeVisibilityMessage")
        if m["visible"] and "/trail/" in m["name"]
    ]
    for side, which in (("A", LEFT), ("B", COLLIDING)):
        times = [t for t, name in shown if name.startswith(f"/{side}/")]
        steps = len(episodes()[which].actions)
        assert times == pytest.approx([(i + 1) * TASK_OBJECT.control_dt for i in range(steps)])


def test_hit_object_is_marked_only_where_a_collision_ended_the_run() -> None:
    assert hit_geom(TASK_OBJECT, episodes()[LEFT]) is None
    hit = hit_geom(TASK_OBJECT, episodes()[COLLIDING])
    assert hit is not None
    assert scene_model(TASK_OBJECT).model.geom(hit).name == "cylinder_0.5_-0.1"
    marks = [
        (t, m["name"])
        for t, m in messages(replay_of(LEFT, COLLIDING)[0], "SetSceneNodeVisibilityMessage")
        if m["visible"] and "touched" in m["name"]
    ]
    end = len(episodes()[COLLIDING].actions) * TASK_OBJECT.control_dt
    assert [name.split("/")[1] for _, name in marks] == ["B", "B"]
    assert all(t == pytest.approx(end) for t, _ in marks)


def test_trail_of_a_long_run_comes_in_few_pieces_and_is_whole_at_the_end() -> None:
    run = episodes()[LEFT]
    rows = np.repeat(np.arange(len(run.paths)), 8)
    columns = {name: getattr(run, name)[rows] for name in ("observations", "qpos", "paths")}
    many = replace(run, actions=run.actions[rows[1:] - 1], **columns)
    recording = make_replay(TASK_OBJECT, many, run)
    pieces = [
        (m["name"], m["props"]["points"])
        for _, m in messages(recording, "LineSegmentsMessage")
        if m["name"].startswith("/A/trail/")
    ]
    shown = {
        m["name"]
        for _, m in messages(recording, "SetSceneNodeVisibilityMessage")
        if m["visible"] and m["name"].startswith("/A/trail/")
    }
    assert TRAIL_PIECES / 2 < len(pieces) <= TRAIL_PIECES
    assert shown == {name for name, _ in pieces}


def test_episode_of_another_robot_is_refused_by_name() -> None:
    run = episodes()[LEFT]
    foreign = replace(run, qpos=np.zeros((len(run.qpos), 9), np.float32))
    with pytest.raises(ValueOutOfRangeError, match="right episode is 9, but must be 7"):
        make_replay(TASK_OBJECT, run, foreign)


def test_smooth_keeps_the_frames_and_goes_the_short_way_between_them() -> None:
    positions = np.array([[[0.0, 0.0, 0.0]], [[1.0, 2.0, 4.0]]])
    # The same rotation twice, once with the opposite sign: half way it must not be zero.
    wxyz = np.array([[[1.0, 0.0, 0.0, 0.0]], [[-1.0, 0.0, 0.0, 0.0]]])
    made = smooth(Poses(positions, wxyz), 2)
    np.testing.assert_array_equal(
        made.positions[:, 0], [[0.0, 0.0, 0.0], [0.5, 1.0, 2.0], [1.0, 2.0, 4.0]]
    )
    np.testing.assert_array_equal(np.abs(made.wxyz[:, 0, 0]), [1.0, 1.0, 1.0])


def test_smooth_of_a_single_frame_is_that_frame() -> None:
    made = smooth(Poses(np.ones((1, 1, 3)), np.array([[[1.0, 0.0, 0.0, 0.0]]])), 2)
    assert len(made) == 1
    np.testing.assert_array_equal(made.positions[0, 0], [1.0, 1.0, 1.0])


def test_merge_vertices_joins_what_lies_in_one_cell() -> None:
    vertices = np.array([[0.0, 0, 0], [0.2, 0, 0], [3.0, 0, 0], [0.0, 3, 0]])
    faces = np.array([[0, 2, 3], [1, 2, 3], [0, 1, 2]])
    merged, left = merge_vertices(vertices, faces, cell=1.0)
    # 0 and 1 become their mean; the first two faces are then one, the third collapses.
    np.testing.assert_allclose(sorted(merged.tolist()), [[0, 3, 0], [0.1, 0, 0], [3, 0, 0]])
    assert len(left) == 1


def test_thumbnail_is_a_small_looping_film_with_both_whole_paths_at_the_end() -> None:
    film = replay_of(LEFT, COLLIDING)[1]
    assert film == make_thumbnail(TASK_OBJECT, episodes()[LEFT], episodes()[COLLIDING])
    assert len(film) < 40_000
    with Image.open(io.BytesIO(film)) as picture:
        assert picture.format == "WEBP"
        assert picture.n_frames >= 10
        assert picture.info["loop"] == 0
        coloured = {side: [0, 0] for side in SIDE_COLOURS}
        for place, frame in enumerate((0, picture.n_frames - 1)):
            picture.seek(frame)
            pixels = np.asarray(picture.convert("RGB")).astype(int)[24:]
            for side, colour in SIDE_COLOURS.items():
                near = np.abs(pixels - np.array(colour)).sum(axis=2) < 60
                coloured[side][place] = int(near.sum())
    for first, last in coloured.values():
        assert last > first + 30


def test_viser_is_not_imported_before_a_replay_is_made() -> None:
    program = "import sys, labeling_ui.replay; sys.exit('viser' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
