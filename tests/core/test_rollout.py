"""Rolling out a policy in the real simulation, and summing it up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rodif_core.diffusion.chain import chain_means
from rodif_core.drift import (
    MAX_POINTS,
    fit_support,
    nearest_distance,
    off_support_share,
    spread_out,
    visited_states,
)
from rodif_core.errors import ValueOutOfRangeError
from rodif_core.evaluate import evaluate, thin_path
from rodif_core.gate import judge
from rodif_core.intervals import wilson_interval
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.rollout import rollout
from rodif_core.spec import Architecture, RolloutConfig
from rodif_core.trajectory import Trajectory
from tests.core.learning import tiny_checkpoint, tiny_policy


@pytest.fixture(scope="module")
def episodes() -> list[Trajectory]:
    return rollout(tiny_checkpoint(), RolloutConfig(episodes=5, seed=40))


def test_same_seeds_give_the_same_bits(episodes: list[Trajectory]) -> None:
    again = rollout(tiny_checkpoint(), RolloutConfig(episodes=5, seed=40))
    assert [t.to_bytes() for t in again] == [t.to_bytes() for t in episodes]


def test_episode_depends_on_its_own_seed_only(episodes: list[Trajectory]) -> None:
    other = rollout(tiny_checkpoint(), RolloutConfig(episodes=2, seed=43))
    for mine, same in zip(other, episodes[3:], strict=True):
        assert mine.context == same.context
        # The network's last bits may depend on how many rows it sees; behaviour must not.
        assert np.allclose(mine.chains[0], same.chains[0], atol=1e-4)


def test_different_seeds_give_different_noise(episodes: list[Trajectory]) -> None:
    assert not np.array_equal(episodes[0].chains[0, 0], episodes[1].chains[0, 0])


def test_rollout_without_noise_follows_the_means_from_the_same_beginnings(
    episodes: list[Trajectory],
) -> None:
    still = rollout(tiny_checkpoint(), RolloutConfig(episodes=1, seed=40), noise_scale=0.0)[0]
    assert np.array_equal(still.chains[0, 0], episodes[0].chains[0, 0])
    assert not np.array_equal(still.chains[0, 1], episodes[0].chains[0, 1])
    policy = tiny_checkpoint().policy
    history = policy.normaliser.observation(torch.from_numpy(still.histories[:1].copy()))
    chain = torch.from_numpy(still.chains[:1].copy())
    means = chain_means(policy.denoiser, policy.schedule, history, chain)
    assert torch.allclose(chain[:, 1 : means.shape[1] + 1], means, atol=1e-5)


def test_noise_scale_out_of_range_is_named() -> None:
    with pytest.raises(ValueOutOfRangeError, match=r"noise_scale.*1\.5.*\[0, 1\]"):
        rollout(tiny_checkpoint(), RolloutConfig(episodes=1), noise_scale=1.5)


def test_histories_are_the_observations_before_each_decision() -> None:
    blind = tiny_policy(architecture=Architecture.TRANSFORMER)
    # A history that is longer than what is executed reaches back to the first observation.
    config = replace(blind.config, observation_steps=5, executed_steps=2)
    torch.manual_seed(0)
    policy = DiffusionPolicy.build(config, blind.normaliser)
    made = rollout(replace(tiny_checkpoint(), policy=policy), RolloutConfig(episodes=2, seed=3))
    for episode in made:
        steps = episode.decision_steps[:, None] + np.arange(-4, 1)
        assert np.array_equal(episode.histories, episode.observations[steps.clip(min=0)])


def test_recorded_actions_are_the_executed_part_of_the_chains(
    episodes: list[Trajectory],
) -> None:
    policy = tiny_checkpoint().policy
    size = policy.config
    for episode in episodes:
        chunks = policy.normaliser.to_task_action(
            torch.tensor(episode.chains[:, -1, : size.executed_steps])
        )
        planned = chunks.reshape(-1, size.action_dim).numpy()[: len(episode.actions)]
        assert np.allclose(episode.actions, planned.clip(-0.0125, 0.0125), atol=1e-7)
        assert episode.chains.shape[1:] == (size.denoising_steps + 1, size.predicted_steps, 2)


def test_recorded_history_is_what_the_policy_saw(episodes: list[Trajectory]) -> None:
    for episode in episodes:
        for history, step in zip(episode.histories, episode.decision_steps, strict=True):
            assert np.array_equal(history[-1], episode.observations[step])
            assert np.array_equal(history[0], episode.observations[max(step - 1, 0)])


def test_evaluation_counts_every_episode_once() -> None:
    facts = evaluate(tiny_checkpoint(), RolloutConfig(episodes=6, seed=3)).to_json()
    assert facts["n"] == 6 == sum(facts["groups"].values()) == sum(facts["reasons"].values())
    assert 0 <= facts["alignment"] <= facts["success"] <= 1
    low, high = facts["intervals"]["success"]
    assert low <= facts["success"] <= high
    assert len(facts["paths"]) == len(facts["path_groups"]) == 6


def test_thin_path_keeps_both_ends(episodes: list[Trajectory]) -> None:
    points = thin_path(episodes[0], 8)
    assert len(points) == 8
    assert points[0] == pytest.approx(episodes[0].paths[0].tolist(), abs=1e-4)
    assert points[-1] == pytest.approx(episodes[0].paths[-1].tolist(), abs=1e-4)


@pytest.mark.parametrize(
    ("successes", "n", "expected"),
    # Wilson (1927) intervals, worked with z = 1.96: 8 of 10, 0 of 10, and nothing observed.
    [(8, 10, (0.4902, 0.9433)), (0, 10, (0.0, 0.2775)), (0, 0, (0.0, 1.0))],
)
def test_wilson_interval_matches_known_numbers(
    successes: int, n: int, expected: tuple[float, float]
) -> None:
    assert wilson_interval(successes, n) == pytest.approx(expected, abs=1e-4)


def test_support_keeps_rare_places_and_takes_the_99th_percentile() -> None:
    crowd, rare = torch.zeros(500, 2), torch.tensor([[1.0, 1.0]])
    held_out = torch.tensor([[0.0, i / 1000] for i in range(101)])
    support = fit_support(torch.cat([crowd, rare]), held_out)
    assert len(support.points) == 2
    assert support.threshold == pytest.approx(0.099, abs=1e-6)
    assert float(nearest_distance(support.points, rare)[0]) == 0.0


def test_spreading_out_keeps_the_far_points_and_their_order() -> None:
    crowd = torch.tensor([[i / 100, 0.0] for i in range(10)])
    rare = torch.tensor([[5.0, 0.0], [0.0, 7.0]])
    points = torch.cat([crowd, rare])
    # By hand: the first point, then the farthest one from all taken: (0, 7), (5, 0), (0.09, 0).
    assert spread_out(points, 4).tolist() == points[[0, 9, 10, 11]].tolist()
    assert spread_out(points, 12).tolist() == points.tolist()


@pytest.mark.parametrize("seed", range(5))
def test_spreading_out_takes_the_farthest_point_each_time(seed: int) -> None:
    """Beside the plain loop that looks at every point every time; some points are there twice."""
    generator = torch.Generator().manual_seed(seed)
    clusters = torch.randint(8, (300, 1), generator=generator) * torch.ones(3)
    points = clusters + 0.1 * torch.randn(300, 3, generator=generator)
    points[200:250] = points[:50]
    taken = [0]
    for _ in range(59):
        nearest = (points[:, None] - points[taken]).square().sum(2).amin(1)
        taken.append(int(nearest.argmax()))
    assert spread_out(points, 60).tolist() == points[sorted(taken)].tolist()


def test_support_in_many_dimensions_stays_small() -> None:
    generator = torch.Generator().manual_seed(0)
    known = torch.rand(MAX_POINTS + 500, 12, generator=generator)
    support = fit_support(known, torch.rand(100, 12, generator=generator))
    assert len(support.points) == MAX_POINTS


def test_off_support_share_is_zero_on_the_support_and_rises_away_from_it(
    episodes: list[Trajectory],
) -> None:
    checkpoint = tiny_checkpoint()
    states = visited_states(episodes, checkpoint.policy.normaliser)
    near = fit_support(states, states + 0.01)
    assert off_support_share(episodes, replace(checkpoint, support=near)) == 0.0
    far = fit_support(states + 10, states + 10.01)
    assert off_support_share(episodes, replace(checkpoint, support=far)) == 1.0


def facts(successes: int, off: float, n: int = 200) -> dict:
    interval = list(wilson_interval(successes, n))
    return {
        "success": successes / n,
        "off_support": off,
        "n": n,
        "intervals": {"success": interval},
    }


@pytest.mark.parametrize(
    ("before", "after", "passes"),
    [
        (facts(180, 0.02), facts(190, 0.02), True),
        (facts(180, 0.02), facts(174, 0.04), True),
        (facts(40, 0.02), facts(30, 0.02), True),  # by 5 points exactly
        (facts(180, 0.02), facts(169, 0.02), False),  # by more than 5 points
        # By 4.2 points, more than chance explains: ± 2.5 points at this n.
        (facts(1140, 0.02, 1200), facts(1090, 0.02, 1200), False),
        (facts(400, 0.02, 400), facts(400, 0.02, 400), True),  # nothing is lost
        (facts(100, 0.02, 100), facts(99, 0.02, 100), True),
        (facts(0, 0.02), facts(0, 0.02), True),
        (facts(180, 0.02), facts(190, 0.06), False),  # left the data
    ],
)
def test_gate_refuses_lost_success_and_drift(before: dict, after: dict, passes: bool) -> None:
    verdict = judge(before, after)
    assert verdict.passed is passes
    assert len(verdict.reasons) == 2


@pytest.mark.parametrize("n", [10, 30, 60, 80, 190, 300, 400, 1000])
def test_interval_of_a_perfect_or_hopeless_count_ends_at_the_rate(n: int) -> None:
    assert wilson_interval(n, n)[1] == 1.0
    assert wilson_interval(0, n)[0] == 0.0
