"""Exact full-batch gradients, zero at the reference, pairing rules."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rodif_core.diffusion.chain import chain_log_prob, chain_means, log_prob_of_chunk_steps
from rodif_core.errors import LearningError, UnknownNameError
from rodif_core.log_ratio import (
    PairMatrix,
    Transitions,
    accumulate_gradient,
    compare,
    compute_ratios,
    preference_loss,
)
from rodif_core.losses import LOSSES
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.preferences.pairs import Preference
from rodif_core.spec import FinetuneConfig, FinetuneMethod, Reduction, StepPairing
from tests.core.learning import chain_trajectory, tiny_policy

CONFIG = FinetuneConfig(method=FinetuneMethod.RODIF, conservativeness=0.3, chunk_rows=8)
PREFERENCES = [Preference(0, 1), Preference(2, 1), Preference(0, 3)]


def batch(seed: int = 0) -> tuple:
    """A reference, a moved policy, and four trajectories of unequal length."""
    reference = tiny_policy(seed)
    moved = tiny_policy(seed).copy()
    generator = torch.Generator().manual_seed(9)
    with torch.no_grad():
        for value in moved.denoiser.parameters():
            value.add_(0.02 * torch.randn(value.shape, generator=generator))
    trajectories = [chain_trajectory(reference, n, seed=n) for n in (3, 2, 4, 3)]
    transitions = Transitions.collect(reference, trajectories, CONFIG.chunk_rows)
    return reference, moved, transitions


def double_batch(config: FinetuneConfig) -> tuple:
    """The moved policy, the transitions and their pairs in double precision, where the order of
    summing does not show; in single it does, on one processor more than on another."""
    _, moved, transitions = batch()
    matrix = PairMatrix.build(transitions, PREFERENCES, config)
    return (
        replace(moved, denoiser=moved.denoiser.double()),
        replace(
            transitions, histories=transitions.histories.double(),
            chains=transitions.chains.double(), ref_means=transitions.ref_means.double(),
        ),
        replace(
            matrix, weights=matrix.weights.double(), ref_log_probs=matrix.ref_log_probs.double()
        ),
    )  # fmt: skip


@pytest.mark.parametrize("chunk_rows", [4, 8, 13, 1000])
def test_ratios_are_exactly_zero_and_votes_one_half_at_the_reference(chunk_rows: int) -> None:
    reference = tiny_policy(0)
    trajectories = [chain_trajectory(reference, n, seed=n) for n in (3, 2, 4, 3)]
    config = replace(CONFIG, chunk_rows=chunk_rows)
    transitions = Transitions.collect(reference, trajectories, chunk_rows)
    ratios = compute_ratios(reference.copy(), transitions, config)
    assert torch.equal(ratios, torch.zeros(12))
    matrix = PairMatrix.build(transitions, PREFERENCES, config)
    assert preference_loss(ratios, matrix, config).metrics["mean_vote"] == 0.5


def gradient(policy: DiffusionPolicy) -> torch.Tensor:
    """All gradients of the network as one row; they are taken away."""
    parts = [value.grad.flatten() for value in policy.denoiser.parameters()]
    policy.denoiser.zero_grad(set_to_none=True)
    return torch.cat(parts)


ALL_LOSSES = [(method, Reduction.SUM) for method in LOSSES]
ALL_LOSSES += [(FinetuneMethod.RODIF, Reduction.MEAN), (FinetuneMethod.RODIF, Reduction.GROUP)]


@pytest.mark.parametrize("executed_only", [False, True])
@pytest.mark.parametrize(("method", "reduction"), ALL_LOSSES)
def test_chunked_gradient_equals_that_of_one_backward_pass(
    method: FinetuneMethod, reduction: Reduction, executed_only: bool
) -> None:
    config = replace(
        CONFIG, method=method, reduction=reduction, group_size=2, executed_only=executed_only
    )
    moved, transitions, matrix = double_batch(config)
    gradients = []
    for rows in (4, 13):
        told = accumulate_gradient(
            moved, transitions, replace(config, chunk_rows=rows),
            lambda ratios: preference_loss(ratios, matrix, config),
        ).loss  # fmt: skip
        gradients.append(gradient(moved))
    # The plain way: log π_θ of whole chains with their graph, from the densities themselves.
    chains, count = transitions.chains, transitions.counted_steps(config)
    means = chain_means(moved.denoiser, moved.schedule, transitions.histories, chains)
    log_probs, reference = (
        log_prob_of_chunk_steps(moved.schedule, chains, some)[:, :count].sum(dim=1)
        for some in (means, transitions.ref_means)
    )
    loss = preference_loss(log_probs - reference, matrix, config).loss
    loss.backward()
    plain = gradient(moved)
    assert float(plain.abs().max()) > 0
    assert float(told) == pytest.approx(float(loss.detach()), rel=1e-9)
    for chunked in gradients:
        assert torch.allclose(chunked, plain, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize(("executed_only", "steps"), [(False, 8), (True, 4)])
def test_reference_free_losses_get_the_log_probabilities_of_the_chains(
    executed_only: bool, steps: int
) -> None:
    config = replace(CONFIG, executed_only=executed_only)
    moved, transitions, matrix = double_batch(config)
    means = chain_means(
        moved.denoiser, moved.schedule, transitions.histories, transitions.chains
    ).detach()
    expected = log_prob_of_chunk_steps(moved.schedule, transitions.chains, means)
    expected = expected[:, :steps].sum(dim=1)
    compared = compare(compute_ratios(moved, transitions, config), matrix, config.kl_coef)
    assert torch.allclose(compared.winner_log_probs, expected[matrix.winners])
    assert torch.allclose(compared.loser_log_probs, expected[matrix.losers])
    # K = 5 without k = 1, chunk steps, two dims of the action.
    assert compared.entries == 4 * steps * 2
    if not executed_only:
        whole = chain_log_prob(
            moved.denoiser, moved.schedule, transitions.histories, transitions.chains
        )
        assert torch.allclose(expected, whole)


def test_cached_log_probabilities_are_the_references() -> None:
    reference, _, transitions = batch()
    whole = chain_log_prob(
        reference.denoiser, reference.schedule, transitions.histories, transitions.chains
    )
    assert torch.allclose(transitions.ref_log_probs.sum(dim=1), whole, rtol=1e-5)


def test_method_without_a_loss_of_its_own_is_named() -> None:
    _, _, transitions = batch()
    matrix = PairMatrix.build(transitions, PREFERENCES, CONFIG)
    with pytest.raises(UnknownNameError, match="loss 'rodif_guided'.*'rodif', 'dp_dpo', 'ipo'"):
        preference_loss(
            torch.zeros(12), matrix, replace(CONFIG, method=FinetuneMethod.RODIF_GUIDED)
        )


def test_accumulated_gradient_equals_finite_differences_in_a_parameter_direction() -> None:
    policy, double, matrix = double_batch(CONFIG)

    def loss_of_ratios(ratios: torch.Tensor):
        return preference_loss(ratios, matrix, CONFIG)

    accumulate_gradient(policy, double, CONFIG, loss_of_ratios)
    parameter = policy.denoiser.output[1].weight
    direction = torch.randn(
        parameter.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    slope = float((parameter.grad * direction).sum())
    step, values = 1e-5, []
    for sign in (1, -1):
        with torch.no_grad():
            parameter.add_(sign * step * direction)
        values.append(float(loss_of_ratios(compute_ratios(policy, double, CONFIG)).loss))
        with torch.no_grad():
            parameter.sub_(sign * step * direction)
    assert slope == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-4)


def test_pairs_are_compared_over_the_shorter_trajectory() -> None:
    _, _, transitions = batch()
    matrix = PairMatrix.build(transitions, PREFERENCES, CONFIG)
    assert matrix.weights.sum(1).tolist() == [2, 2, 3]
    # Trajectory rows: 0-2, 3-4, 5-8, 9-11.
    assert matrix.winners[0, :2].tolist() == [0, 1]
    assert matrix.losers[2].tolist() == [9, 10, 11]


def test_matched_state_weighs_a_step_by_the_distance_of_its_states() -> None:
    _, _, transitions = batch()
    config = replace(CONFIG, step_pairing=StepPairing.MATCHED_STATE, matched_state_scale=0.5)
    matrix = PairMatrix.build(transitions, [Preference(0, 1)], config)
    distance = (transitions.histories[0, -1] - transitions.histories[3, -1]).norm()
    assert float(matrix.weights[0, 0]) == pytest.approx(float(torch.exp(-2 * distance**2)))


def test_pair_matrix_without_preferences_says_what_to_do() -> None:
    _, _, transitions = batch()
    with pytest.raises(LearningError, match="label some pairs"):
        PairMatrix.build(transitions, [], CONFIG)


def test_chains_of_another_policy_are_refused() -> None:
    longer = tiny_policy(steps=7)
    with pytest.raises(LearningError, match=r"trajectory 1 .*\(8, 8, 2\).*are \(6, 8, 2\)"):
        Transitions.collect(
            tiny_policy(),
            [chain_trajectory(tiny_policy(), 2, seed=0), chain_trajectory(longer, 2, seed=1)],
            64,
        )
