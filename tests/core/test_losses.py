"""The paper's losses: numbers worked by hand, symmetries, limits, dead gradients."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rodif_core.errors import LearningError, ValueOutOfRangeError
from rodif_core.losses import compute_delta_q, dp_dpo_loss, rodif_loss
from rodif_core.spec import Reduction

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


@given(st.integers(0, 2**31))
def test_losses_do_not_change_when_pairs_are_permuted(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    delta_q = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    order = torch.randperm(6, generator=generator)
    ones = torch.ones_like(delta_q)
    for loss in (
        lambda d: dp_dpo_loss(d, ones, vote_temperature=0.7).loss,
        lambda d: rodif_loss(d, ones, conservativeness=0.3, **PLAIN).loss,
    ):
        assert float(loss(delta_q)) == pytest.approx(float(loss(delta_q[order])))


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


@pytest.mark.parametrize("method", ["rodif", "dp_dpo"])
def test_gradient_equals_finite_differences(method: str) -> None:
    generator = torch.Generator().manual_seed(3)
    delta_q = torch.randn(3, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    weights = torch.rand(3, 4, generator=generator, dtype=torch.float64)

    def loss(values: torch.Tensor) -> torch.Tensor:
        if method == "dp_dpo":
            return dp_dpo_loss(values, weights, vote_temperature=0.8).loss
        return rodif_loss(values, weights, conservativeness=0.4, **PLAIN).loss

    assert torch.autograd.gradcheck(loss, (delta_q,))


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


def test_loss_without_any_comparable_step_is_refused() -> None:
    with pytest.raises(LearningError, match="all weights are 0"):
        dp_dpo_loss(HALF, torch.zeros_like(ONES), vote_temperature=1.0)
