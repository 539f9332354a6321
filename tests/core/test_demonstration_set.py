"""What of a demonstration set is looked at before anybody trains on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rodif_core.demonstration_set import read_set
from rodif_core.demonstrations import make_demonstrations, save_demonstrations
from rodif_core.errors import DemonstrationFileError, TrajectoryFileError
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory

TASK = get_task("avoid")


@pytest.fixture(scope="module")
def shown() -> list[Trajectory]:
    return make_demonstrations(TASK, episodes=2, seed=4)


def kept(tmp_path: Path, episodes: list[Trajectory]) -> Path:
    file = tmp_path / "set.npz"
    save_demonstrations(file, episodes)
    return file


def test_card_tells_who_made_the_episodes(shown: list[Trajectory], tmp_path: Path):
    facts = {name: value for name, value in shown[0].info.items() if name != "expert"}
    imported = replace(shown[0], info=facts | {"source": "d3il", "file": "env_0.pkl"})
    driven = replace(shown[1], info=facts | {"checkpoint": "c" * 64, "seed": 9})
    taken_over = replace(driven, info=driven.info | {"taken_over_at": 7})
    made, told = read_set(TASK, kept(tmp_path, [*shown, imported, driven, taken_over]))
    assert len(made) == told["episodes"] == 5
    assert told["sources"] == {"d3il": 1, "policy": 1, "scripted": 2, "takeover": 1}
    assert told["seeds"] == [4]  # of the scripted ones alone
    assert told["checkpoints"] == ["c" * 64]


def test_set_of_another_task_is_refused(shown: list[Trajectory], tmp_path: Path):
    with pytest.raises(DemonstrationFileError, match="of task 'avoid', but must be of 'pushing'"):
        read_set(get_task("pushing"), kept(tmp_path, shown))


def test_failed_episode_is_refused(shown: list[Trajectory], tmp_path: Path):
    failed = replace(shown[1], outcome={"success": False, "mode": None, "reason": "collision"})
    with pytest.raises(DemonstrationFileError, match=r"episode 1 failed \('collision'\)"):
        read_set(TASK, kept(tmp_path, [shown[0], failed]))


@pytest.mark.parametrize(("name", "legal"), [("observations", 4), ("actions", 2), ("qpos", 7)])
def test_arrays_of_another_width_are_refused(
    name: str, legal: int, shown: list[Trajectory], tmp_path: Path
):
    narrow = [replace(one, **{name: getattr(one, name)[:, :-1]}) for one in shown]
    message = f"{name} of {legal - 1} numbers, but task 'avoid' has {legal}"
    with pytest.raises(DemonstrationFileError, match=message):
        read_set(TASK, kept(tmp_path, narrow))


def test_file_that_is_no_set_is_refused(tmp_path: Path):
    with pytest.raises(TrajectoryFileError, match="none.npz is not readable"):
        read_set(TASK, tmp_path / "none.npz")
    file = tmp_path / "text.npz"
    file.write_text("not a set")
    with pytest.raises(TrajectoryFileError, match="text.npz is not readable"):
        read_set(TASK, file)
