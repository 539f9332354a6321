"""The preference losses as pure functions of the whole (pairs × steps) matrix.

RoDiF and DP-DPO are the paper's own. IPO, CPO and SimPO are the baselines of its comparison
(Table robustness_baselines), which it does not write down: here they are what their own papers
say, adapted as DP-DPO is. A chain's log-probability takes the place of a text's, and every
compared step of a pair that of a pair of texts. To add a loss, write it here and enter it in
`LOSSES`.

Legend: M pairs, T steps, N transitions.
    ΔQ  delta_q             β (log-ratio of the winner's step - log-ratio of the loser's step)
    V̂   votes               σ(ΔQ / α)
    α   vote_temperature and outer_temperature (the paper uses one letter for both)
    β   kl_coef             weight of the KL term, here the scale of ΔQ
    γ   conservativeness    assumed upper bound of the share of wrong labels
    ν   vote_scale          ≈ 1
    λ   cloning_weight      weight of CPO's term that imitates winners
    π_w, π_l                π_θ of the winner's and of the loser's chain: winner_log_probs,
                            loser_log_probs; D numbers of a chain go into each (entries)

RoDiF is not a mean over pairs: its outer logistic sees the sum of all votes, so splitting a batch
and averaging the parts gives another loss. Hence every function takes the whole matrix; a weight
of 0 marks a cell that does not exist (the shorter trajectory ended).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rodif_core.errors import LearningError, UnknownNameError, ValueOutOfRangeError
from rodif_core.spec import FinetuneConfig, FinetuneMethod, Reduction

DEAD_GRADIENT = 1e-3  # an outer slope below this trains nothing worth the name


class LossOutput(NamedTuple):
    """The scalar loss and what to log about it.

    metrics: loss, mean_vote, outvoted (share of votes below 0.1), whose votes are σ(ΔQ / α) for
    every loss, and, for a loss with a gate (RoDiF), gate_margin (how far the votes are past the
    threshold; with groups, those of the last one to pass it) and outer_slope (|dL/dΣV̂|, 0 = the
    gate is shut; with groups, of the widest open one).
    """

    loss: Tensor
    metrics: dict[str, float]


class Compared(NamedTuple):
    """All that a loss may look at: (M, T) matrices of the compared steps.

    delta_q: ΔQ; weights ≥ 0; winner_log_probs, loser_log_probs: log π_θ of whole chains in nats;
    entries: numbers of a chain that each of these sums over (denoising steps × chunk × actions).
    """

    delta_q: Tensor
    weights: Tensor
    winner_log_probs: Tensor
    loser_log_probs: Tensor
    entries: int


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


def ipo_loss(
    delta_q: Tensor, weights: Tensor, *, target: float, vote_temperature: float
) -> LossOutput:
    """IPO: Σ_i Σ_t (ΔQ_{i,t} - target)². delta_q and weights are (M, T).

    Azar et al. (2024), Eq. 17, square h - 1 / (2τ) with h the difference of the log-ratios. With
    their τ = β this is β² times that for a target of 1 / 2, in the units of ΔQ. The temperature
    is that of the votes alone, which are only told.
    """
    _check(delta_q, weights)
    loss = (weights * (delta_q - target) ** 2).sum()
    return LossOutput(loss, _metrics(loss, delta_q, weights, vote_temperature))


def cpo_loss(
    compared: Compared, *, kl_coef: float, vote_temperature: float, cloning_weight: float
) -> LossOutput:
    """CPO: Σ_i Σ_t [- log σ(β (log π_w - log π_l) / α) - λ log π_w].

    Xu et al. (2024): DPO with a uniform reference, L_prefer, and cloning of the winners, L_NLL,
    added with λ = 1. The log-probabilities are sums, as written there.
    """
    α, β, λ = vote_temperature, kl_coef, cloning_weight
    _check(compared.delta_q, compared.weights)
    difference = β * (compared.winner_log_probs - compared.loser_log_probs)
    cells = -F.logsigmoid(difference / α) - λ * compared.winner_log_probs
    loss = (compared.weights * cells).sum()
    return LossOutput(loss, _metrics(loss, compared.delta_q, compared.weights, α))


def simpo_loss(
    compared: Compared, *, scale: float, margin: float, vote_temperature: float
) -> LossOutput:
    """SimPO: Σ_i Σ_t - log σ(scale (log π_w - log π_l) / D - margin).

    Meng et al. (2024), whose β and γ are scale and margin here. Their |y|, the length of a text,
    is D, the same for winner and loser. The temperature is that of the told votes alone.
    """
    _check(compared.delta_q, compared.weights)
    difference = (compared.winner_log_probs - compared.loser_log_probs) / compared.entries
    loss = -(compared.weights * F.logsigmoid(scale * difference - margin)).sum()
    return LossOutput(loss, _metrics(loss, compared.delta_q, compared.weights, vote_temperature))


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


def _rodif(compared: Compared, config: FinetuneConfig) -> LossOutput:
    if config.conservativeness is None:
        raise LearningError("conservativeness is not set: estimate it from the labels first")
    return rodif_loss(
        compared.delta_q,
        compared.weights,
        conservativeness=config.conservativeness,
        vote_temperature=config.vote_temperature,
        outer_temperature=config.outer_temperature,
        vote_scale=config.vote_scale,
        reduction=config.reduction,
        group_size=config.group_size,
    )


def _dp_dpo(compared: Compared, config: FinetuneConfig) -> LossOutput:
    α = config.vote_temperature
    return dp_dpo_loss(compared.delta_q, compared.weights, vote_temperature=α)


def _ipo(compared: Compared, config: FinetuneConfig) -> LossOutput:
    α = config.vote_temperature
    return ipo_loss(
        compared.delta_q, compared.weights, target=config.ipo_target, vote_temperature=α
    )


def _cpo(compared: Compared, config: FinetuneConfig) -> LossOutput:
    return cpo_loss(
        compared,
        kl_coef=config.kl_coef,
        vote_temperature=config.vote_temperature,
        cloning_weight=config.cpo_cloning_weight,
    )


def _simpo(compared: Compared, config: FinetuneConfig) -> LossOutput:
    return simpo_loss(
        compared,
        scale=config.simpo_scale,
        margin=config.simpo_margin,
        vote_temperature=config.vote_temperature,
    )


Loss = Callable[[Compared, FinetuneConfig], LossOutput]

# The loss that a literal fine-tuner minimises, with its settings taken from the configuration.
LOSSES: Mapping[FinetuneMethod, Loss] = {
    FinetuneMethod.RODIF: _rodif,
    FinetuneMethod.DP_DPO: _dp_dpo,
    FinetuneMethod.IPO: _ipo,
    FinetuneMethod.CPO: _cpo,
    FinetuneMethod.SIMPO: _simpo,
}


def loss_of(method: FinetuneMethod) -> Loss:
    """The loss of a literal method; raises UnknownNameError listing those that have one."""
    if method not in LOSSES:
        raise UnknownNameError("loss", method.value, [name.value for name in LOSSES])
    return LOSSES[method]
