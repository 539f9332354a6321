"""Takeovers by the expert from a policy."""

from __future__ import annotations

import functools
from collections import Counter

import numpy as np
import pytest

from rodif_core import recoveries
from rodif_core.demonstrations import make_demonstrations, mode_shares
from rodif_core.policies.checkpoint import Checkpoint, load_checkpoint
from rodif_core.policies.unet import UnetSize
from rodif_core.presets import PretrainConfig
from rodif_core.pretrain import pretrain
from rodif_core.recoveries import make_recoveries
from rodif_core.rollout import rollout
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import RolloutConfig, TaskName
from rodif_core.tasks import get_task
from rodif_core.tasks.experts.pushing import PushingExpert
from rodif_core.trajectory import Trajectory


@functools.cache
def beginner() -> Checkpoint:
    """A policy for Pushing that has hardly learnt."""
    config = PretrainConfig(size=UnetSize(channels=(8, 16)), updates=3, batch_size=8)
    demonstrations = make_demonstrations(get_task("pushing"), episodes=4, seed=0)
    return pretrain(TaskName.PUSHING, demonstrations, config)


def taken_over(checkpoint: Checkpoint, *, episodes: int, seed: int) -> list[Trajectory]:
    driven = rollout(checkpoint, RolloutConfig(episodes=episodes, seed=seed))
    return make_recoveries(get_task(checkpoint.task), driven)


@functools.cache
def recovered() -> list[Trajectory]:
    return taken_over(beginner(), episodes=6, seed=5)


def test_a_recovery_begins_where_the_expert_took_over_and_succeeds() -> None:
    task = get_task("pushing")
    assert len(recovered()) >= 3
    for one in recovered():
        assert one.success and one.outcome["mode"] in task.modes
        assert 1 <= one.info["taken_over_at"] < recoveries.LATEST * task.max_steps
        assert one.info["taken_over_at"] + len(one.actions) <= task.max_steps
        assert one.info["checkpoint"] == beginner().digest
        assert len(one.decision_steps) == 0


def test_the_actions_of_a_recovery_are_the_experts() -> None:
    for one in recovered():
        expert = PushingExpert(one.info["expert"]["mode"])
        for seen, done in zip(one.observations[:-1], one.actions, strict=True):
            np.testing.assert_allclose(done, expert.act(seen), atol=1e-6)


def test_a_recovery_depends_on_its_seed_alone() -> None:
    again = taken_over(beginner(), episodes=6, seed=5)
    assert [one.to_bytes() for one in again] == [one.to_bytes() for one in recovered()]
    other = taken_over(beginner(), episodes=4, seed=7)
    contexts = {one.info["seed"]: one.context for one in recovered()}
    shared = [one for one in other if one.info["seed"] in contexts]
    assert shared and len(contexts) == len(recovered())
    assert [one.context for one in shared] == [contexts[one.info["seed"]] for one in shared]


def test_a_recovery_goes_on_from_where_the_policy_had_driven() -> None:
    """Takeovers are drawn from the steps that the policy lasted, so none comes after its end."""
    driven = rollout(beginner(), RolloutConfig(episodes=6, seed=5))
    for one in recovered():
        drive = driven[one.info["seed"] - 5]
        step = one.info["taken_over_at"]
        assert one.context == drive.context and step < len(drive.actions)
        np.testing.assert_array_equal(one.observations[0], drive.observations[step])
        np.testing.assert_array_equal(one.qpos[0], drive.qpos[step])
        np.testing.assert_array_equal(one.paths[0], drive.paths[step])


def test_takeovers_asked_for_by_number_come_evenly_from_failures_and_groups() -> None:
    """A good policy fails seldom and goes left seldom; both get as many as what it mostly does."""
    checkpoint = load_checkpoint(shipped_checkpoint(TaskName.AVOID))
    driven = rollout(checkpoint, RolloutConfig(episodes=40, seed=1))
    kinds = {one.info["seed"]: one.outcome["group"] if one.success else None for one in driven}
    rarest = min(Counter(kinds.values()).values())
    assert len(set(kinds.values())) == 3 and rarest < 5
    chosen = recoveries._spread(driven, 15)
    assert Counter(kinds[one.info["seed"]] for one, _ in chosen) == dict.fromkeys(
        ("left", "right", None), 5
    )
    # As often as needed the few are chosen again, all of them before any a third time.
    of_rarest = [(one.info["seed"], again) for one, again in recoveries._spread(driven, 3 * 40)]
    assert len(set(of_rarest)) == 120
    again_of = Counter(kinds[seed] for seed, again in of_rarest if again == 0)
    assert again_of == {k: min(40, n) for k, n in Counter(kinds.values()).items()}


def test_a_rollout_is_taken_over_at_another_step_when_it_is_chosen_again() -> None:
    driven = rollout(beginner(), RolloutConfig(episodes=2, seed=5))
    assert not any(one.success for one in driven)
    made = make_recoveries(get_task("pushing"), driven, count=8)
    steps = {(one.info["seed"], one.info["taken_over_at"]) for one in made}
    assert len(steps) == len(made) > len(driven)
    once = make_recoveries(get_task("pushing"), driven)
    assert [one.to_bytes() for one in once] == [
        one.to_bytes() for one in make_recoveries(get_task("pushing"), driven, count=2)
    ]


def test_the_expert_goes_on_in_the_mode_that_the_policy_was_after() -> None:
    """A policy that is good at Avoid is taken over after it has chosen a side."""
    made = taken_over(load_checkpoint(shipped_checkpoint(TaskName.AVOID)), episodes=30, seed=1)
    late = [one for one in made if one.paths[0, 1] > 0.0]
    assert len(late) >= 3
    for one in late:
        assert one.outcome["mode"][2:] == one.info["expert"]["mode"][2:]


def test_where_modes_have_not_parted_they_are_drawn_by_their_shares() -> None:
    """All orders that begin with the same block look alike until it stands on the pad."""
    task = get_task("stacking-state")
    [driven] = make_demonstrations(task, episodes=1, seed=0, preferred_share=1.0)
    shares = mode_shares(task, 0.75)
    drawn = Counter(
        recoveries._likeliest_expert(
            task, driven, 5, shares, np.random.default_rng(seed)
        ).to_json()["mode"]
        for seed in range(200)
    )
    # red-blue-green has 0.75, red-green-blue 0.05: 15 of 16 draws, 187.5 of 200, sd 3.4.
    assert set(drawn) == {"red-blue-green", "red-green-blue"}
    assert 175 <= drawn["red-blue-green"] <= 198


def test_recoveries_do_not_depend_on_how_many_run_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recoveries, "PARALLEL", 2)
    again = taken_over(beginner(), episodes=3, seed=5)
    both = [one for one in recovered() if one.info["seed"] < 5 + 3]
    assert [one.context for one in again] == [one.context for one in both]
