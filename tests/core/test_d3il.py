"""D3IL's files become demonstrations of ours: our observations, actions, positions and modes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rodif_core.d3il import FORMATS, REFUSED_START, episode_files, read_episode, replay
from rodif_core.demonstrations import make_demonstrations
from rodif_core.errors import DemonstrationFileError, UnknownNameError
from rodif_core.spec import TaskName
from rodif_core.tasks import TASKS, get_task
from rodif_core.trajectory import Trajectory
from tests.core.d3il_files import d3il_record, write_record
from tests.core.test_plain_pickle import Calls


@pytest.fixture(scope="module")
def shown() -> list[Trajectory]:
    """Demonstrations of Avoid, left and right."""
    return make_demonstrations(get_task("avoid"), episodes=3, seed=5, preferred_share=0.4)


def imported(
    name: str, folder: Path, records: list[Any]
) -> tuple[list[Trajectory], list[tuple[str, str]]]:
    files = [write_record(folder / f"env_{i}.pkl", record) for i, record in enumerate(records)]
    episodes = [read_episode(TaskName(name), file) for file in files]
    made, rejected = replay(get_task(name), episodes)
    return made, [(Path(one.name).name, one.reason) for one in rejected]


def test_set_points_become_the_actions_that_follow_them(shown: list[Trajectory], tmp_path: Path):
    task = get_task("avoid")
    made, rejected = imported("avoid", tmp_path, [d3il_record(task, one) for one in shown])
    assert rejected == []
    for one, original in zip(made, shown, strict=True):
        assert one.context["start"] == pytest.approx(original.context["start"])
        assert np.allclose(one.actions, original.actions, atol=1e-7)
        assert np.allclose(one.qpos, original.qpos, atol=1e-5)
        assert np.allclose(one.observations, original.observations, atol=1e-5)
        assert one.outcome == original.outcome
        assert one.info["source"] == "d3il" and one.info["task"] == "avoid"
        assert one.info["file"].startswith("env_") and one.info["mode"] == one.outcome["mode"]


@pytest.mark.parametrize("name", [name for name in FORMATS if name is not TaskName.AVOID])
def test_every_task_reads_its_own_files(name: TaskName, tmp_path: Path):
    task = get_task(name)
    shown = make_demonstrations(task, episodes=1, seed=1)
    made, rejected = imported(name, tmp_path, [d3il_record(task, shown[0])])
    assert rejected == []
    assert made[0].outcome["mode"] == shown[0].outcome["mode"]
    assert made[0].qpos.shape[1] == shown[0].qpos.shape[1]


def test_a_task_that_d3il_has_not_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert set(FORMATS) <= set(TASKS)
    monkeypatch.delitem(FORMATS, TaskName.AVOID)
    with pytest.raises(UnknownNameError, match="task with D3IL files 'avoid'.*'pushing'"):
        read_episode(TaskName.AVOID, write_record(tmp_path / "x.pkl", {}))


def test_steps_that_are_too_long_are_clipped_and_made_up_for(
    shown: list[Trajectory], tmp_path: Path
):
    task = get_task("avoid")
    record = d3il_record(task, shown[0])
    # Three rows are missing: a step of four, which no action may take at once.
    record["robot"]["des_c_pos"] = np.delete(record["robot"]["des_c_pos"], slice(20, 23), axis=0)
    episode = read_episode(TaskName.AVOID, write_record(tmp_path / "quick.pkl", record))
    assert np.abs(np.diff(episode.setpoints, axis=0)).max() > 2 * task.action_limit
    ((one,), rejected) = replay(task, [episode])
    assert rejected == []
    assert np.abs(one.actions).max() == np.float32(task.action_limit)
    last = len(one.actions)
    assert np.allclose(one.observations[last, :2], episode.setpoints[last], atol=1e-6)


def test_failed_replays_and_foreign_starts_are_told_with_their_files(
    shown: list[Trajectory], tmp_path: Path
):
    task = get_task("avoid")
    good, astray, afar, still = (d3il_record(task, shown[0]) for _ in range(4))
    astray["robot"]["des_c_pos"][:, 0] = 0.5  # straight through the first cylinder
    afar["robot"]["des_c_pos"] = afar["robot"]["des_c_pos"] + 1.0
    still["robot"]["des_c_pos"] = still["robot"]["des_c_pos"][:20]  # ends on the way
    made, rejected = imported("avoid", tmp_path, [good, astray, afar, still])
    assert [one.info["file"] for one in made] == ["env_0.pkl"]
    assert sorted(rejected) == [
        ("env_1.pkl", "collision"),
        ("env_2.pkl", REFUSED_START),
        ("env_3.pkl", "time_limit"),
    ]


def test_batches_do_not_change_the_result(
    shown: list[Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    task = get_task("avoid")
    records = [d3il_record(task, one) for one in shown]
    together, _ = imported("avoid", tmp_path, records)
    monkeypatch.setattr("rodif_core.d3il.PARALLEL", 1)
    alone, _ = imported("avoid", tmp_path, records)
    assert [one.to_bytes() for one in together] == [one.to_bytes() for one in alone]


def test_a_malicious_file_is_refused_and_not_run(tmp_path: Path):
    trace = tmp_path / "was-here"
    file = write_record(tmp_path / "evil.pkl", {"robot": Calls(os.system, f"touch {trace}")})
    with pytest.raises(DemonstrationFileError, match=r"evil\.pkl.*asks for posix\.system"):
        read_episode(TaskName.AVOID, file)
    assert not trace.exists()


def broken(record: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {"robot": record["robot"] | changes}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"des_c_pos": np.zeros((1, 3))}, r"shape \(1, 3\), but must have 2 or more rows"),
        ({"des_c_pos": np.zeros((9, 1))}, r"2 or more numbers"),
        ({"des_c_pos": np.full((9, 3), np.nan)}, "not finite"),
        ({"des_c_pos": "none"}, "no array 'des_c_pos' of 'robot'"),
    ],
)
def test_an_episode_that_does_not_hold_together_is_refused(
    change: dict[str, Any], message: str, shown: list[Trajectory], tmp_path: Path
):
    record = broken(d3il_record(get_task("avoid"), shown[0]), **change)
    with pytest.raises(DemonstrationFileError, match=message):
        read_episode(TaskName.AVOID, write_record(tmp_path / "x.pkl", record))


def test_a_gripper_that_was_recorded_for_fewer_rows_than_the_joints_is_refused(tmp_path: Path):
    robot = {"des_c_pos": np.zeros((3, 3)), "des_j_pos": np.zeros((3, 7))}
    robot["gripper_width"] = np.zeros(2)
    pose = {"pos": np.zeros((3, 3)), "quat": np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))}
    record = {"robot": robot} | dict.fromkeys(FORMATS[TaskName.STACKING].places.values(), pose)
    with pytest.raises(DemonstrationFileError, match="has 2 rows, but must have 3, as 'des_j_pos"):
        read_episode(TaskName.STACKING, write_record(tmp_path / "x.pkl", record))


def test_a_file_of_another_task_is_refused(shown: list[Trajectory], tmp_path: Path):
    file = write_record(tmp_path / "x.pkl", d3il_record(get_task("avoid"), shown[0]))
    with pytest.raises(DemonstrationFileError, match="no array 'pos' of 'red-box'; it is no epis"):
        read_episode(TaskName.PUSHING, file)
    with pytest.raises(DemonstrationFileError, match="no array"):
        read_episode(TaskName.AVOID, write_record(tmp_path / "y.pkl", ["env_0.pkl"]))


def test_folders_are_searched_in_the_order_of_names(tmp_path: Path):
    files = [write_record(tmp_path / name, {}) for name in ("b/2.pkl", "a/1.pkl", "c.pkl")]
    (tmp_path / "a" / "picture.png").write_bytes(b"")
    assert episode_files([tmp_path]) == [files[1], files[0], files[2]]
    assert episode_files([files[2], tmp_path / "a"]) == [files[2], files[1]]
    (tmp_path / "empty").mkdir()
    for path, message in (("nowhere", "does not exist"), ("empty", "has no .pkl files")):
        with pytest.raises(DemonstrationFileError, match=message):
            episode_files([tmp_path / path])
