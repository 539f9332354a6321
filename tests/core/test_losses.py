"""The losses: numbers worked by hand, symmetries, limits, dead gradients, a contract for all."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rodif_core.errors import LearningError, UnknownNameError, ValueOutOfRangeError
from rodif_core.losses import (
    LOSSES,
    Compared,
    LossOutput,
    compute_delta_q,
    cpo_loss,
    dp_dpo_loss,
    ipo_loss,
    loss_of,
    rodif_loss,
    simpo_loss,
)
from rodif_core.spec import GATED_METHODS, FinetuneConfig, FinetuneMethod, Reduction

PLAIN = {"vote_temperature": 1.0, "outer_temperature": 1.0, "vote_scale": 1.0}


def sigma(value: float) -> float:
    """The logistic function, for the hand-worked numbers."""
    return 1 / (1 + math.exp(-value))


# M = T = 2 with log-ratios of four transitions, β = 0.5:
#   winners' steps: 2, -1 | 0, 3   losers' steps: 0, 1 | 2, 1
#   ΔQ = 0.5 * [[2 - 0, -1 - 1], [0 - 2, 3 - 1]] = [[1, -1], [-1, 1]]
RATIOS = torch.tensor([2.0, -1.0, 0.0, 3.0, 1.0], dtype=torch.float64)
WINNERS = torch.tensor([[0, 1], [2, 3]])
LOSERS = torch.tensor([[2, 4], [0, 4]])
HALF = torch.tensor([[1.0, -1.0], [-1.0, 1.0]], dtype=torch.float64)
ONES = torch.ones(2, 2, dtype=torch.float64)
# log π_θ of the same steps: log π_w - log π_l = [[2, -1], [-2, 1]], over D = 4 numbers each.
COMPARED = Compared(
    HALF,
    ONES,
    torch.tensor([[-1.0, -2.0], [-3.0, -1.0]], dtype=torch.float64),
    torch.tensor([[-3.0, -1.0], [-1.0, -2.0]], dtype=torch.float64),
    entries=4,
)
CONFIG = FinetuneConfig(conservativeness=0.3, vote_temperature=0.8)
for_every_method = pytest.mark.parametrize("method", list(LOSSES))


def drawn(seed: int, pairs: int = 3, steps: int = 4) -> Compared:
    """Random steps: ΔQ, weights in (0, 1), log-probabilities around -5 nats."""
    generator = torch.Generator().manual_seed(seed)
    shape = (pairs, steps)
    delta_q, winner, loser = (
        torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(3)
    )
    weights = torch.rand(shape, generator=generator, dtype=torch.float64) + 1e-3
    return Compared(delta_q, weights, winner - 5, loser - 5, 6)


def test_delta_q_is_the_scaled_difference_of_log_ratios() -> None:
    assert torch.equal(compute_delta_q(RATIOS, WINNERS, LOSERS, 0.5), HALF)


def test_dp_dpo_matches_hand_worked_number() -> None:
    # -Σ log σ(ΔQ) = 2 log(1 + e^-1) + 2 log(1 + e) = 2 * 0.3132617 + 2 * 1.3132617
    loss = dp_dpo_loss(HALF, ONES, vote_temperature=1.0).loss
    assert float(loss) == pytest.approx(3.2530466, abs=1e-6)


def test_rodif_matches_hand_worked_number() -> None:
    # Votes: 0.7310586 twice, 0.2689414 twice: sum 2. Threshold (1 - 0.25) * 4 = 3.
    # -log σ(2 - 3) = log(1 + e) = 1.3132617
    output = rodif_loss(HALF, ONES, conservativeness=0.25, **PLAIN)
    assert float(output.loss) == pytest.approx(1.3132617, abs=1e-6)
    assert output.metrics["gate_margin"] == pytest.approx(-1.0)
    assert output.metrics["mean_vote"] == pytest.approx(0.5)


def test_rodif_uses_both_temperatures_and_the_vote_scale() -> None:
    # α = 2 inside: votes σ(±0.5), sum 2. ν = 0.9: threshold 0.9 * 0.75 * 4 = 2.7. α = 0.5 outside.
    output = rodif_loss(
        HALF, ONES, conservativeness=0.25, vote_temperature=2.0, outer_temperature=0.5,
        vote_scale=0.9,
    )  # fmt: skip
    assert float(output.loss) == pytest.approx(-math.log(sigma((2 - 2.7) / 0.5)), abs=1e-9)


def test_reduction_mean_divides_votes_and_threshold() -> None:
    output = rodif_loss(HALF, ONES, conservativeness=0.25, reduction=Reduction.MEAN, **PLAIN)
    assert float(output.loss) == pytest.approx(-math.log(sigma(0.5 - 0.75)), abs=1e-9)


def test_reduction_group_adds_one_logistic_per_group() -> None:
    output = rodif_loss(
        HALF, ONES, conservativeness=0.25, reduction=Reduction.GROUP, group_size=1, **PLAIN
    )
    # Each pair alone: votes 1, threshold 1.5.
    assert float(output.loss) == pytest.approx(-2 * math.log(sigma(-0.5)), abs=1e-9)


def test_rodif_of_halves_differs_from_the_whole_when_a_batch_is_split() -> None:
    whole = rodif_loss(HALF, ONES, conservativeness=0.25, **PLAIN).loss
    halves = [
        rodif_loss(HALF[i : i + 1], ONES[i : i + 1], conservativeness=0.25, **PLAIN).loss
        for i in range(2)
    ]
    assert float(sum(halves)) != pytest.approx(float(whole), rel=1e-3)


def test_zero_weight_removes_a_cell_from_votes_and_threshold() -> None:
    weights = torch.tensor([[1.0, 0.0], [1.0, 1.0]], dtype=torch.float64)
    output = rodif_loss(HALF, weights, conservativeness=0.25, **PLAIN)
    expected = sigma(1) + sigma(-1) + sigma(1) - 0.75 * 3
    assert output.metrics["gate_margin"] == pytest.approx(expected)
    dpo = dp_dpo_loss(HALF, weights, vote_temperature=1.0).loss
    assert float(dpo) == pytest.approx(-math.log(sigma(1) * sigma(-1) * sigma(1)))


def test_ipo_matches_hand_worked_number() -> None:
    # Σ (ΔQ - 0.5)² = 2 * 0.5² + 2 * 1.5² = 0.5 + 4.5
    output = ipo_loss(HALF, ONES, target=0.5, vote_temperature=1.0)
    assert float(output.loss) == pytest.approx(5.0)
    assert output.metrics["mean_vote"] == pytest.approx(0.5)


def test_cpo_matches_hand_worked_number() -> None:
    # β = 0.5 on the differences: [[1, -0.5], [-1, 0.5]]. -Σ log σ = 0.3132617 + 0.9740770
    # + 1.3132617 + 0.4740770 = 3.0746774. Cloning: 0.1 * (1 + 2 + 3 + 1) = 0.7.
    output = cpo_loss(COMPARED, kl_coef=0.5, vote_temperature=1.0, cloning_weight=0.1)
    assert float(output.loss) == pytest.approx(3.7746774, abs=1e-6)
    # α = 0.5 doubles the differences: -log σ of ±2 and ±1, and leaves the cloning alone.
    output = cpo_loss(COMPARED, kl_coef=0.5, vote_temperature=0.5, cloning_weight=0.1)
    expected = -math.log(sigma(2) * sigma(-1) * sigma(-2) * sigma(1)) + 0.7
    assert float(output.loss) == pytest.approx(expected)


def test_simpo_matches_hand_worked_number() -> None:
    # scale / D = 2 / 4 on the differences: [[1, -0.5], [-1, 0.5]]; less the margin 1:
    # [[0, -1.5], [-2, -0.5]]. -Σ log σ = 0.6931472 + 1.7014133 + 2.1269280 + 0.9740770
    output = simpo_loss(COMPARED, scale=2.0, margin=1.0, vote_temperature=1.0)
    assert float(output.loss) == pytest.approx(5.4955655, abs=1e-6)


@given(st.floats(-30, 30), st.floats(0.01, 5))
def test_ipo_pulls_every_step_to_its_target_and_not_beyond(value: float, target: float) -> None:
    delta_q = torch.tensor([[value]], dtype=torch.float64, requires_grad=True)
    loss = ipo_loss(delta_q, torch.ones_like(delta_q), target=target, vote_temperature=1.0).loss
    (slope,) = torch.autograd.grad(loss, delta_q)
    assert float(slope) == pytest.approx(2 * (value - target), abs=1e-9)


@given(st.integers(0, 2**31), st.floats(-20, 0))
def test_cpo_without_cloning_is_dp_dpo_with_a_uniform_reference(seed: int, level: float) -> None:
    some = drawn(seed)
    # π_ref is e^level everywhere, so that log-ratio = log π_θ - level.
    delta_q = 0.3 * ((some.winner_log_probs - level) - (some.loser_log_probs - level))
    dpo = dp_dpo_loss(delta_q, some.weights, vote_temperature=0.8).loss
    cpo = cpo_loss(some, kl_coef=0.3, vote_temperature=0.8, cloning_weight=0.0).loss
    assert float(cpo) == pytest.approx(float(dpo))


def test_cloning_pulls_winners_alone_and_each_by_its_weight() -> None:
    some = drawn(5)
    winners = some.winner_log_probs.clone().requires_grad_()
    losers = some.loser_log_probs.clone().requires_grad_()

    def slopes(weight: float) -> tuple[torch.Tensor, ...]:
        moving = some._replace(winner_log_probs=winners, loser_log_probs=losers)
        loss = cpo_loss(moving, kl_coef=0.1, vote_temperature=1.0, cloning_weight=weight).loss
        return torch.autograd.grad(loss, (winners, losers))

    without, cloned = slopes(0.0), slopes(0.7)
    assert torch.allclose(cloned[0], without[0] - 0.7 * some.weights)
    assert torch.equal(cloned[1], without[1])


@given(st.integers(0, 2**31), st.integers(2, 50))
def test_simpo_sees_the_mean_over_a_chains_numbers(seed: int, times: int) -> None:
    some = drawn(seed)
    longer = some._replace(
        winner_log_probs=times * some.winner_log_probs,
        loser_log_probs=times * some.loser_log_probs,
        entries=times * some.entries,
    )
    losses = [
        float(simpo_loss(one, scale=2.0, margin=0.5, vote_temperature=1.0).loss)
        for one in (some, longer)
    ]
    assert losses[0] == pytest.approx(losses[1])


def test_every_method_but_the_guided_one_has_a_loss() -> None:
    assert set(LOSSES) == set(FinetuneMethod) - {FinetuneMethod.RODIF_GUIDED}
    with pytest.raises(UnknownNameError, match="loss 'rodif_guided'; legal values are 'rodif', "):
        loss_of(FinetuneMethod.RODIF_GUIDED)


@for_every_method
def test_loss_and_votes_are_told_and_a_gate_only_by_a_loss_that_has_one(
    method: FinetuneMethod,
) -> None:
    output = LOSSES[method](COMPARED, CONFIG)
    assert output.loss.shape == ()
    assert output.metrics["loss"] == float(output.loss)
    # A word means one thing: votes are σ(ΔQ / α) whatever the loss looks at.
    assert output.metrics["mean_vote"] == pytest.approx(0.5)
    assert output.metrics["outvoted"] == 0.0
    gate = {"gate_margin", "outer_slope"} & set(output.metrics)
    assert gate == ({"gate_margin", "outer_slope"} if method in GATED_METHODS else set())


@pytest.mark.parametrize("method", [name for name in LOSSES if name in GATED_METHODS])
def test_gated_loss_without_a_conservativeness_says_what_to_do(method: FinetuneMethod) -> None:
    with pytest.raises(LearningError, match="estimate it from the labels"):
        LOSSES[method](COMPARED, FinetuneConfig())


def shuffled(some: Compared, order: torch.Tensor) -> Compared:
    return Compared(*(matrix[order] for matrix in some[:4]), some.entries)


@for_every_method
@given(seed=st.integers(0, 2**31))
def test_losses_do_not_change_when_pairs_are_permuted(method: FinetuneMethod, seed: int) -> None:
    some = drawn(seed, 6, 3)
    order = torch.randperm(6, generator=torch.Generator().manual_seed(seed))
    losses = [float(LOSSES[method](one, CONFIG).loss) for one in (some, shuffled(some, order))]
    assert losses[0] == pytest.approx(losses[1])


@for_every_method
def test_what_has_no_weight_does_not_count(method: FinetuneMethod) -> None:
    some = drawn(1)
    some.weights[1, 2] = 0.0
    other = Compared(*(matrix.clone() for matrix in some[:4]), some.entries)
    for matrix in (other.delta_q, other.winner_log_probs, other.loser_log_probs):
        matrix[1, 2] += 7.0
    assert float(LOSSES[method](some, CONFIG).loss) == float(LOSSES[method](other, CONFIG).loss)


@given(st.integers(0, 2**31))
def test_votes_of_swapped_pairs_add_to_one(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    delta_q = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    ones = torch.ones_like(delta_q)
    votes = [
        rodif_loss(d, ones, conservativeness=0.3, **PLAIN).metrics["mean_vote"]
        for d in (delta_q, -delta_q)
    ]
    assert sum(votes) == pytest.approx(1.0)


@given(st.integers(0, 2**31), st.floats(-50, 50))
def test_delta_q_ignores_a_constant_added_to_all_log_ratios(seed: int, shift: float) -> None:
    ratios = torch.randn(5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    before = compute_delta_q(ratios, WINNERS, LOSERS, 0.1)
    after = compute_delta_q(ratios + shift, WINNERS, LOSERS, 0.1)
    assert torch.allclose(before, after, atol=1e-12)


@for_every_method
def test_gradient_equals_finite_differences(method: FinetuneMethod) -> None:
    some = drawn(3)
    inputs = (some.delta_q, some.winner_log_probs, some.loser_log_probs)
    for matrix in inputs:
        matrix.requires_grad_()

    def loss(*moving: torch.Tensor) -> torch.Tensor:
        delta_q, winner, loser = moving
        return LOSSES[method](Compared(delta_q, some.weights, winner, loser, 6), CONFIG).loss

    assert torch.autograd.gradcheck(loss, inputs)


@pytest.mark.parametrize("gamma", [-0.1, 1.0, 1.5, math.nan])
def test_conservativeness_outside_its_range_is_refused(gamma: float) -> None:
    with pytest.raises(ValueOutOfRangeError, match=r"conservativeness is .* must be in \[0, 1\)"):
        rodif_loss(HALF, ONES, conservativeness=gamma, **PLAIN)


def test_outer_slope_is_dead_when_gamma_passes_one_half_under_the_sum() -> None:
    zeros = torch.zeros(40, 10, dtype=torch.float64)
    ones = torch.ones_like(zeros)
    alive = rodif_loss(zeros, ones, conservativeness=0.4, **PLAIN).metrics["outer_slope"]
    dead = rodif_loss(zeros, ones, conservativeness=0.6, **PLAIN).metrics["outer_slope"]
    assert alive == pytest.approx(1.0)
    assert dead < 1e-15


@for_every_method
def test_loss_without_any_comparable_step_is_refused(method: FinetuneMethod) -> None:
    with pytest.raises(LearningError, match="all weights are 0"):
        LOSSES[method](COMPARED._replace(weights=torch.zeros_like(ONES)), CONFIG)


@for_every_method
def test_weights_of_another_shape_are_named(method: FinetuneMethod) -> None:
    def loss() -> LossOutput:
        return LOSSES[method](COMPARED._replace(weights=torch.ones(2, 3)), CONFIG)

    with pytest.raises(ValueOutOfRangeError, match=r"shape of weights is \(2, 3\).*\(2, 2\)"):
        loss()
