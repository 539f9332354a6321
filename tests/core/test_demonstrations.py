"""Scripted demonstrations: what the expert can do, and what a set of them is."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from rodif_core import demonstrations
from rodif_core.demonstrations import (
    assign_modes,
    load_demonstrations,
    make_demonstrations,
    mode_shares,
    save_demonstrations,
)
from rodif_core.errors import (
    LearningError,
    TrajectoryFileError,
    UnknownNameError,
    ValueOutOfRangeError,
)
from rodif_core.spec import TaskName
from rodif_core.tasks import get_task
from rodif_core.tasks.avoid import START, AvoidTask
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.experts import EXPERTS
from rodif_core.tasks.experts.avoid import MIN_CLEARANCE, AvoidExpert
from rodif_core.trajectory import Trajectory

TASK = AvoidTask()


@pytest.fixture(scope="module")
def balanced() -> list[Trajectory]:
    """120 demonstrations, five of each mode."""
    return make_demonstrations(TASK, episodes=120, seed=3, preferred_share=0.5)


def same(first: Trajectory, second: Trajectory) -> bool:
    return first.to_bytes() == second.to_bytes()


def test_every_mode_is_reached_by_the_expert(balanced: list[Trajectory]) -> None:
    assert Counter(one.outcome["mode"] for one in balanced) == dict.fromkeys(TASK.modes, 5)


def test_at_least_95_percent_of_first_draws_succeed_on_both_sides(
    balanced: list[Trajectory],
) -> None:
    for group in TASK.groups:
        attempts = [one.info["attempt"] for one in balanced if one.outcome["group"] == group]
        assert len(attempts) == 60
        assert attempts.count(0) / len(attempts) >= 0.95


@pytest.mark.parametrize("share", [0.0, 0.26, 1.0])
@pytest.mark.parametrize("name", ["avoid", "stacking-state"])
def test_mode_shares_are_those_of_many_assignments(name: str, share: float) -> None:
    task = get_task(name)
    counts = Counter(assign_modes(task, 10_000, share))
    counted = [counts[mode] / 10_000 for mode in task.modes]
    assert mode_shares(task, share) == pytest.approx(counted, abs=1e-3)


def test_a_demonstration_is_a_success_with_its_provenance(balanced: list[Trajectory]) -> None:
    for index, one in enumerate(balanced):
        assert one.success and one.outcome["reason"] == "finished"
        assert one.info["task"] == "avoid"
        assert one.info["seed"] == 3 and one.info["index"] == index
        assert one.info["mode"] == one.info["expert"]["mode"] == one.outcome["mode"]
        assert one.info["mujoco_version"] == mujoco.__version__
        assert one.info["control_dt"] == TASK.control_dt


def test_a_demonstration_has_no_decisions_but_arrays_of_the_right_ranks(
    balanced: list[Trajectory],
) -> None:
    one = balanced[0]
    assert one.histories.shape == (0, 1, 4)
    assert one.chains.shape == (0, 1, 1, 2)
    assert one.decision_steps.shape == (0,)
    assert one.qpos.shape == (len(one.actions) + 1, 7)


def test_lengths_are_like_those_of_people(balanced: list[Trajectory]) -> None:
    """D3IL's 96 human demonstrations: 76 +- 12 control steps, 60 to 106."""
    lengths = np.array([len(one.actions) for one in balanced])
    assert 70 < lengths.mean() < 84
    assert lengths.min() >= 55 and lengths.max() <= 120


def test_actions_played_again_give_the_same_bits(balanced: list[Trajectory]) -> None:
    one = balanced[7]
    env = BatchEnv(TASK, 1)
    observations = [env.reset([one.context])]
    observations += [env.step(action[None]) for action in one.actions]
    assert np.concatenate(observations).tobytes() == one.observations.tobytes()
    assert env.outcomes() == [one.outcome]


def test_actions_are_within_the_limit_and_move_the_set_point_as_written(
    balanced: list[Trajectory],
) -> None:
    for one in balanced[:24]:
        assert np.abs(one.actions).max() <= np.float32(TASK.action_limit)
        assert np.allclose(np.diff(one.observations[:, :2], axis=0), one.actions, atol=1e-6)


def test_modes_can_be_read_again_from_what_was_stored(balanced: list[Trajectory]) -> None:
    for one in balanced:
        assert TASK.outcome(one.paths, TASK.object_poses(one.qpos), "finished") == one.outcome


def test_mirrored_actions_drive_through_the_mirrored_mode(balanced: list[Trajectory]) -> None:
    chosen = [one for one in balanced if one.info["mode"] in ("L-22", "L-13", "R-11", "R-34")]
    env = BatchEnv(TASK, len(chosen))
    starts = [one.context["start"] for one in chosen]
    env.reset([{"start": [1.0 - x, y]} for x, y in starts])
    for step in range(TASK.max_steps):
        rows = [one.actions[min(step, len(one.actions) - 1)] for one in chosen]
        env.step(np.array(rows) * [-1, 1])
    for one, outcome in zip(chosen, env.outcomes(), strict=True):
        side, second, third = (one.info["mode"][i] for i in (0, 2, 3))
        mirrored = f"{'R' if side == 'L' else 'L'}-{4 - int(second)}{5 - int(third)}"
        assert (outcome["success"], outcome["mode"]) == (True, mirrored)


def test_the_same_seed_gives_the_same_set_whatever_runs_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = make_demonstrations(TASK, episodes=10, seed=5)
    monkeypatch.setattr(demonstrations, "PARALLEL", 3)
    second = make_demonstrations(TASK, episodes=10, seed=5)
    assert all(same(a, b) for a, b in zip(first, second, strict=True))


def test_another_seed_gives_other_episodes() -> None:
    first = make_demonstrations(TASK, episodes=1, seed=5)[0]
    second = make_demonstrations(TASK, episodes=1, seed=6)[0]
    assert first.context != second.context


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 1.0])
def test_modes_are_balanced_on_each_side(share: float) -> None:
    modes = assign_modes(TASK, 240, share)
    counts = Counter(modes)
    assert sum(mode.startswith("L") for mode in modes) == round(share * 240)
    for side in "LR":
        here = [counts[mode] for mode in TASK.modes if mode.startswith(side)]
        assert max(here) - min(here) <= 1


def test_the_preferred_share_holds_in_every_part_of_a_set() -> None:
    modes = assign_modes(TASK, 100, 0.2)
    for first in range(0, 100, 10):
        assert sum(mode.startswith("L") for mode in modes[first : first + 10]) == 2


def test_a_demonstration_that_fails_is_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AvoidExpert, "tremble", 0.0035)
    made = make_demonstrations(TASK, episodes=24, seed=0, preferred_share=0.5)
    assert len(made) == 24 and all(one.success for one in made)
    assert any(one.info["attempt"] > 0 for one in made)


def test_an_expert_that_keeps_failing_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AvoidExpert, "tremble", 0.2)
    monkeypatch.setattr(demonstrations, "MAX_ATTEMPTS", 2)
    with pytest.raises(
        LearningError, match="failed 2 times in mode .L-11.; the failures of all modes"
    ):
        make_demonstrations(TASK, episodes=1, seed=0, preferred_share=1.0)


def test_progress_ends_at_the_whole() -> None:
    seen: list[tuple[int, int]] = []
    make_demonstrations(TASK, episodes=3, seed=0, progress=lambda a, b: seen.append((a, b)))
    assert seen[-1] == (3, 3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"episodes": 0}, "episodes is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"preferred_share": 1.5}, r"preferred_share is 1.5, but must be in \[0, 1\]"),
    ],
)
def test_values_out_of_range_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueOutOfRangeError, match=message):
        make_demonstrations(TASK, **{"episodes": 1, "seed": 0, **values})


@pytest.mark.parametrize("mode", TASK.modes)
def test_an_experts_path_keeps_clear_and_runs_in_its_mode(mode: str) -> None:
    for seed in range(5):
        expert = AvoidExpert.draw(mode, {"start": START}, np.random.default_rng(seed))
        y = np.linspace(START[1], 0.36, 200)
        path = np.stack([expert.x(y), y], axis=1)
        assert path[0] == pytest.approx(START)
        assert np.abs(np.diff(path[:, 0])).max() < 0.02  # no jumps
        assert expert.clearance() >= MIN_CLEARANCE
        assert TASK.outcome(path, np.zeros((len(path), 0, 7)), "finished")["mode"] == mode


def test_an_expert_of_an_unknown_mode_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="'L-15'.*'L-11'.*'R-34'"):
        AvoidExpert.draw("L-15", {"start": START}, np.random.default_rng(0))


def test_an_expert_without_a_clear_path_is_reported() -> None:
    with pytest.raises(LearningError, match="no clear path of mode R-11"):
        AvoidExpert.draw("R-11", {"start": (0.5, -0.14)}, np.random.default_rng(0))


def test_a_saved_set_is_read_back_equal(tmp_path: Path, balanced: list[Trajectory]) -> None:
    save_demonstrations(tmp_path / "set.npz", balanced)
    again = load_demonstrations(tmp_path / "set.npz")
    assert len(again) == len(balanced)
    assert all(same(a, b) for a, b in zip(balanced, again, strict=True))
    save_demonstrations(tmp_path / "again.npz", again)
    assert (tmp_path / "set.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()


def test_a_missing_or_damaged_set_is_refused(tmp_path: Path, balanced: list[Trajectory]) -> None:
    path = tmp_path / "set.npz"
    with pytest.raises(TrajectoryFileError, match=r"set\.npz"):
        load_demonstrations(path)
    save_demonstrations(path, balanced[:3])
    whole = path.read_bytes()
    for damaged in (b"", b"text", whole[: len(whole) // 2], b"x" + whole[1:-200]):
        path.write_bytes(damaged)
        with pytest.raises(TrajectoryFileError, match="demonstration set .* is not readable"):
            load_demonstrations(path)


def test_a_set_whose_arrays_do_not_match_its_header_is_refused(
    tmp_path: Path, balanced: list[Trajectory]
) -> None:
    path = tmp_path / "set.npz"
    save_demonstrations(path, balanced[:2])
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **{**arrays, "actions": arrays["actions"][:-1]})
    with pytest.raises(TrajectoryFileError, match="actions has"):
        load_demonstrations(path)
    np.savez(path, **{**arrays, "header": np.frombuffer(b'{"format": 9}', np.uint8)})
    with pytest.raises(TrajectoryFileError, match="format 9; this version reads 1"):
        load_demonstrations(path)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (b"[1]", "a list as header"),
        (b'{"format": 1, "lengths": 3, "episodes": []}', "lengths in its header is 3"),
        (b'{"format": 1, "lengths": ["3"], "episodes": [{}]}', "not counts"),
        (b'{"format": 1, "lengths": [3], "episodes": [{"info": {}}]}', "without .*'context'"),
    ],
)
def test_a_set_with_a_foreign_header_says_what_is_wrong(
    tmp_path: Path, balanced: list[Trajectory], header: bytes, words: str
) -> None:
    path = tmp_path / "set.npz"
    save_demonstrations(path, balanced[:1])
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **{**arrays, "header": np.frombuffer(header, np.uint8)})
    with pytest.raises(TrajectoryFileError, match=words):
        load_demonstrations(path)


def test_an_empty_set_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueOutOfRangeError, match="demonstrations is 0"):
        save_demonstrations(tmp_path / "set.npz", [])


def test_an_expert_that_keeps_failing_is_told_with_how_its_episodes_ended(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(demonstrations, "MAX_ATTEMPTS", 2)
    # One that drives for another mode than it was asked for.
    monkeypatch.setitem(
        EXPERTS, TaskName.AVOID, lambda _mode, context, rng: AvoidExpert.draw("L-11", context, rng)
    )
    with pytest.raises(LearningError, match="failed 2 times in mode 'R-.*succeeded in mode 'L-11'"):
        make_demonstrations(get_task("avoid"), episodes=2, seed=3, preferred_share=0.0)


def test_a_task_without_an_expert_is_refused_by_its_name(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delitem(EXPERTS, TaskName.AVOID)
    with pytest.raises(UnknownNameError, match="unknown task with an expert 'avoid'.*'pushing'"):
        make_demonstrations(get_task("avoid"), episodes=1, seed=0)
