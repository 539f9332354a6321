"""The paper's preference losses as pure functions of the whole (pairs × steps) matrix.

Legend: M pairs, T steps, N transitions.
    ΔQ  delta_q             β (log-ratio of the winner's step - log-ratio of the loser's step)
    V̂   votes               σ(ΔQ / α)
    α   vote_temperature and outer_temperature (the paper uses one letter for both)
    β   kl_coef             weight of the KL term, here the scale of ΔQ
    γ   conservativeness    assumed upper bound of the share of wrong labels
    ν   vote_scale          ≈ 1

RoDiF is not a mean over pairs: its outer logistic sees the sum of all votes, so splitting a batch
and averaging the parts gives another loss. Hence every function takes the whole matrix; a weight
of 0 marks a cell that does not exist (the shorter trajectory ended).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rodif_core.errors import LearningError, ValueOutOfRangeError
from rodif_core.spec import Reduction

DEAD_GRADIENT = 1e-3  # an outer slope below this trains nothing worth the name


class LossOutput(NamedTuple):
    """The scalar loss and what to log about it.

    metrics: loss, mean_vote, outvoted (share of votes below 0.1) and, for RoDiF, gate_margin
    (how far the votes are past the threshold; with groups, those of the last one to pass it) and
    outer_slope (|dL/dΣV̂|, 0 = the gate is shut; with groups, of the widest open one).
    """

    loss: Tensor
    metrics: dict[str, float]


def compute_delta_q(ratios: Tensor, winners: Tensor, losers: Tensor, kl_coef: float) -> Tensor:
    """ΔQ of Eq. c-function-diffusion.

    ratios (N,): log π_θ - log π_ref of each transition; winners, losers (M, T) int64 indices into
    it (any legal index where no step exists). Returns (M, T).
    """
    return kl_coef * (ratios[winners] - ratios[losers])


def dp_dpo_loss(delta_q: Tensor, weights: Tensor, *, vote_temperature: float) -> LossOutput:
    """Eq. dense_loss: - Σ_i Σ_t log σ(ΔQ_{i,t} / α). delta_q and weights are (M, T)."""
    α = vote_temperature
    _check(delta_q, weights)
    loss = -(weights * F.logsigmoid(delta_q / α)).sum()
    return LossOutput(loss, _metrics(loss, delta_q, weights, α))


def rodif_loss(
    delta_q: Tensor,
    weights: Tensor,
    *,
    conservativeness: float,
    vote_temperature: float,
    outer_temperature: float,
    vote_scale: float,
    reduction: Reduction = Reduction.SUM,
    group_size: int = 64,
) -> LossOutput:
    """Eq. final_robust_loss: - log σ((Σ_i Σ_t V̂_{i,t} - ν (1 - γ) M T) / α).

    delta_q and weights are (M, T); with weights, M T is their sum. `mean` divides votes and
    threshold by M T; `group` uses one outer logistic per `group_size` consecutive pairs and adds
    them up. Raises ValueOutOfRangeError for γ outside [0, 1).
    """
    γ, ν = conservativeness, vote_scale
    if not 0 <= γ < 1:
        raise ValueOutOfRangeError("conservativeness", γ, "in [0, 1)")
    _check(delta_q, weights)
    votes = weights * torch.sigmoid(delta_q / vote_temperature)
    if reduction is Reduction.GROUP:
        sums = torch.stack([part.sum() for part in votes.split(group_size)])
        counts = torch.stack([part.sum() for part in weights.split(group_size)])
    else:
        sums, counts = votes.sum().view(1), weights.sum().view(1)
    margins = sums - ν * (1 - γ) * counts
    if reduction is Reduction.MEAN:
        margins = margins / counts
    loss = -F.logsigmoid(margins / outer_temperature).sum()
    slope = torch.sigmoid(-margins / outer_temperature) / outer_temperature
    metrics = _metrics(loss, delta_q, weights, vote_temperature)
    metrics["gate_margin"] = float(margins.detach().min())
    metrics["outer_slope"] = float(slope.detach().max())
    return LossOutput(loss, metrics)


def _check(delta_q: Tensor, weights: Tensor) -> None:
    if delta_q.shape != weights.shape:
        raise ValueOutOfRangeError(
            "shape of weights", tuple(weights.shape), f"that of delta_q, {tuple(delta_q.shape)}"
        )
    if not bool((weights > 0).any()):
        raise LearningError("no step of any pair can be compared: all weights are 0")


def _metrics(loss: Tensor, delta_q: Tensor, weights: Tensor, α: float) -> dict[str, float]:
    votes = torch.sigmoid(delta_q.detach() / α)
    total = weights.sum()
    return {
        "loss": float(loss.detach()),
        "mean_vote": float((weights * votes).sum() / total),
        "outvoted": float((weights * (votes < 0.1)).sum() / total),
    }
