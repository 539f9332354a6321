"""One density for sampling and scoring."""

from __future__ import annotations

import math

import pytest
import torch

from rodif_core.diffusion.chain import (
    chain_kl,
    chain_log_prob,
    chain_means,
    log_prob_ratio,
    noise_entries,
    posterior_mean,
    sample_chain,
)
from rodif_core.diffusion.schedule import NoiseSchedule
from rodif_core.errors import ValueOutOfRangeError
from tests.core.learning import tiny_policy


def test_schedule_matches_the_known_posterior_deviations_at_20_steps() -> None:
    std = NoiseSchedule(20).std
    assert std[1] == 0.0
    assert [round(float(value), 3) for value in std[2:6]] == [0.076, 0.123, 0.162, 0.195]
    assert float(std[20]) == pytest.approx(0.9965, abs=5e-4)


def test_std_floor_holds_for_every_step_when_it_is_set() -> None:
    schedule = NoiseSchedule(20, std_floor=0.1)
    assert float(schedule.std[1:].min()) == pytest.approx(0.1)
    assert schedule.scored_steps == tuple(range(20, 0, -1))
    assert NoiseSchedule(20).scored_steps == tuple(range(20, 1, -1))


@pytest.mark.parametrize("std_floor", [0.0, 0.1])
def test_sampled_log_density_equals_chain_log_prob(std_floor: float) -> None:
    policy = tiny_policy(1, std_floor=std_floor)
    schedule = policy.schedule
    generator = torch.Generator().manual_seed(5)
    history = torch.randn(6, 2, 4, generator=generator)
    noise = torch.randn(6, noise_entries(schedule), 8, 2, generator=generator)
    chain = sample_chain(policy.denoiser, schedule, history, noise)
    # The density with which each latent was drawn, from the very noise that drew it.
    expected = torch.zeros(6)
    for i, k in enumerate(range(schedule.num_steps, 0, -1)):
        std = float(schedule.std[k])
        if std > 0:
            z = noise[:, i + 1].flatten(1)
            constant = z.shape[1] * (math.log(std) + 0.5 * math.log(2 * math.pi))
            expected += -0.5 * (z**2).sum(1) - constant
    log_prob = chain_log_prob(policy.denoiser, schedule, history, chain)
    assert torch.allclose(log_prob, expected, atol=2e-3, rtol=1e-5)


def test_chain_begins_with_the_noise_and_ends_with_the_executed_chunk() -> None:
    policy = tiny_policy(1)
    generator = torch.Generator().manual_seed(5)
    histories = torch.randn(3, 2, 4, generator=generator)
    noise = torch.randn(3, noise_entries(policy.schedule), 8, 2, generator=generator)
    actions, chain = policy.act(histories, noise)
    assert torch.equal(chain[:, 0], noise[:, 0])
    executed = policy.normaliser.to_task_action(chain[:, -1, : policy.config.executed_steps])
    assert torch.equal(actions, executed)
    # The last step is a mean of clipped clean actions and stays within the clip.
    assert float(chain[:, -1].abs().max()) <= policy.schedule.clip + 1e-6


def test_log_ratio_is_exactly_zero_at_the_reference() -> None:
    policy = tiny_policy(2)
    history = torch.randn(4, 2, 4)
    chain = sample_chain(policy.denoiser, policy.schedule, history, torch.randn(4, 5, 8, 2))
    means = chain_means(policy.denoiser, policy.schedule, history, chain)
    ratio = log_prob_ratio(policy.schedule, chain, means, means.clone(), steps=8)
    assert torch.equal(ratio, torch.zeros(4))
    assert torch.equal(chain_kl(policy.schedule, means, means.clone()), torch.zeros(4))


def test_log_ratio_equals_the_difference_of_log_probs() -> None:
    reference, other = tiny_policy(2), tiny_policy(3)
    history = torch.randn(4, 2, 4)
    noise = torch.randn(4, 5, 8, 2)
    chain = sample_chain(reference.denoiser, reference.schedule, history, noise)
    schedule = reference.schedule
    means = chain_means(other.denoiser, schedule, history, chain)
    ref_means = chain_means(reference.denoiser, schedule, history, chain)
    ratio = log_prob_ratio(schedule, chain, means, ref_means, steps=8)
    difference = chain_log_prob(other.denoiser, schedule, history, chain) - chain_log_prob(
        reference.denoiser, schedule, history, chain
    )
    assert torch.allclose(ratio, difference, atol=2e-3, rtol=1e-4)


def test_posterior_mean_is_the_clean_action_when_the_noise_is_known() -> None:
    # At k = 1 the posterior collapses on the predicted clean action.
    schedule = NoiseSchedule(20)
    clean, noise = torch.rand(3, 8, 2) - 0.5, torch.randn(3, 8, 2)
    k = torch.ones(3, dtype=torch.int64)
    bar = schedule.alpha_bar[1]
    noisy = bar.sqrt() * clean + (1 - bar).sqrt() * noise
    assert torch.allclose(posterior_mean(schedule, noisy, noise, k), clean, atol=1e-5)


@pytest.mark.parametrize(
    ("field", "value"), [("num_steps", 1), ("clip", 0.0), ("std_floor", -0.1), ("std_floor", 1.0)]
)
def test_schedule_refuses_values_out_of_range(field: str, value: float) -> None:
    with pytest.raises(ValueOutOfRangeError, match=field):
        NoiseSchedule(**{field: value})
