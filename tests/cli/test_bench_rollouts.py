"""The benchmark of rollouts: real small measurements, what follows from them, and its judgement."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mujoco.batch
import numpy as np
import pytest
import torch

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.rollout import rollout
from rodif_core.spec import RolloutConfig, TaskName
from rodif_core.tasks import get_task
from tests.core.learning import tiny_checkpoint
from worker.cli.benchmarks import rollouts
from worker.cli.main import main
from worker.parallel import pool_of

ROW = rollouts.Row(
    task="avoid",
    policy="shipped",
    episodes=50,
    steps=4000,
    batch_s=2.0,
    steps_per_s={1: 2000.0, 2: 3800.0},
    plain_steps_per_s=100.0,
    physics_s=0.5,
    network_s=1.1,
)


def test_rates_follow_from_what_was_measured():
    assert ROW.episodes_per_s(1) == 25.0
    assert ROW.speedup(1) == 20.0 and ROW.speedup(2) == 38.0
    assert ROW.overhead == pytest.approx(1.25)
    plain = json.loads(json.dumps(ROW.to_json()))
    assert plain["steps_per_s"] == {"1": 2000.0, "2": 3800.0}
    assert plain["speedup"]["2"] == 38.0 and plain["overhead"] == pytest.approx(1.25)


def test_shortfalls_name_the_task_and_both_figures():
    assert rollouts.shortfalls([ROW]) == []
    slow = replace(ROW, plain_steps_per_s=380.0, physics_s=0.1, network_s=0.3)
    assert rollouts.shortfalls([ROW, slow]) == [
        "avoid: 10.0 times the plain loop on 2 cores, less than 20",
        "avoid: 5.00 times the sum of its parts, more than 2",
    ]


def test_raw_physics_gives_the_motion_of_the_episodes(monkeypatch: pytest.MonkeyPatch):
    """What is timed is the work of those episodes: with joint positions as targets the arm ends
    where it did."""
    task = get_task("avoid")
    episodes = rollout(tiny_checkpoint(), RolloutConfig(episodes=2, seed=3))
    made = []

    class Watched(mujoco.batch.Batch):
        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments)
            made.append(self)

    monkeypatch.setattr("mujoco.batch.Batch", Watched)
    assert rollouts.physics_seconds(task, episodes) > 0
    ends = made[0].bind("qpos")
    for end, episode in zip(ends, episodes, strict=True):
        assert np.abs(end - episode.qpos[-1]).max() < 0.05  # rad; servos lag


def test_raw_network_calls_the_policy_on_what_it_saw(monkeypatch: pytest.MonkeyPatch):
    checkpoint = tiny_checkpoint()
    episodes = rollout(checkpoint, RolloutConfig(episodes=3, seed=3))
    seen = []
    act = type(checkpoint.policy).act

    def watched(self: object, histories: torch.Tensor, noise: torch.Tensor) -> object:
        seen.append(histories.numpy())
        return act(self, histories, noise)  # type: ignore[arg-type]

    monkeypatch.setattr(type(checkpoint.policy), "act", watched)
    assert rollouts.network_seconds(checkpoint, episodes) > 0
    assert sum(len(rows) for rows in seen) == sum(len(one.histories) for one in episodes)
    assert np.array_equal(seen[0], np.stack([one.histories[0] for one in episodes]))


def test_the_plain_loop_does_whole_episodes():
    steps = rollouts.plain_loop(tiny_checkpoint(), 1)
    assert 1 < steps <= get_task("avoid").max_steps


def test_tasks_that_are_seen_through_cameras_are_not_timed(capsys: pytest.CaptureFixture[str]):
    assert rollouts.legal_tasks(["sorting", "avoid"]) == [TaskName.AVOID, TaskName.SORTING]
    assert not any(get_task(name).cameras for name in rollouts.legal_tasks(None))
    assert main(["bench", "rollouts", "--tasks", "aligning"]) == 1
    assert "unknown task without cameras 'aligning'; legal values" in capsys.readouterr().err


@pytest.mark.parametrize("task", rollouts.legal_tasks(None))
def test_every_task_has_a_policy_to_time(task: TaskName):
    checkpoint = rollouts.policy_of(task)
    assert checkpoint.task is task
    assert checkpoint.policy.config.action_dim == get_task(task).action_dim
    again = rollouts.policy_of(task)
    assert again.digest == checkpoint.digest


def test_too_few_episodes_are_refused():
    with pool_of(1) as pool, pytest.raises(ValueOutOfRangeError, match="episodes is 1"):
        rollouts.measure(TaskName.AVOID, 1, pool)


@pytest.mark.slow
def test_the_command_measures_prints_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "rates.json"
    wish = ["--tasks", "avoid", "--episodes", "4", "--json", str(file)]
    assert main(["bench", "rollouts", *wish]) in (0, 1)  # so few reach no target for sure
    shown = capsys.readouterr().out
    assert "per CPU second" in shown and "times the plain loop" in shown
    row = json.loads(file.read_text())[0]
    assert row["task"] == "avoid" and row["policy"] == "shipped" and row["episodes"] == 4
    assert all(row[name] > 0 for name in ("batch_s", "physics_s", "network_s", "steps"))
    assert row["steps_per_s"]["1"] == pytest.approx(row["steps"] / row["batch_s"])
    assert row["physics_s"] + row["network_s"] < row["batch_s"] * 1.5


def test_the_fine_tuners_benchmark_still_wants_a_file(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit, match="2"):
        main(["bench", "avoid"])
    assert "arguments are required: --json" in capsys.readouterr().err


@pytest.mark.parametrize("foreign", [["avoid", "--tasks", "avoid"], ["rollouts", "--seeds", "1"]])
def test_a_benchmark_refuses_the_options_of_the_other(
    foreign: list[str], capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit, match="2"):
        main(["bench", *foreign, "--json", "rows.json"])
    assert f"unrecognized arguments: {foreign[1]}" in capsys.readouterr().err
