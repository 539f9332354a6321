"""Log-ratios of whole label sets: every transition once per update, exact full-batch gradients.

Legend: N transitions (all decision steps of all trajectories), M pairs, T compared steps,
K denoising steps, To observation history, Tp predicted chunk, O observation dims, A action dims.

Reference means and log-probabilities are computed once and cached. An update takes two passes in
bounded memory: the first gives the log-ratio of every transition without a graph, from which the
loss yields one weight dL/d(log-ratio) per transition; the second runs the network in chunks and
back-propagates weight · log-ratio. The gradients add up to the full-batch gradient exactly (chain
rule).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rodif_core.diffusion.chain import (
    chain_kl,
    chain_means,
    log_prob_of_chunk_steps,
    log_prob_ratio,
)
from rodif_core.errors import LearningError
from rodif_core.losses import Compared, LossOutput, compute_delta_q, loss_of
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.preferences.pairs import Preference
from rodif_core.spec import FinetuneConfig, StepPairing
from rodif_core.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Transitions:
    """Decision steps of all trajectories, one after the other.

    histories (N, To, O) and chains (N, K + 1, Tp, A) normalised; ref_means (N, S, Tp, A) of the
    reference policy for S scored steps; ref_log_probs (N, Tp): log π_ref of each chain in nats,
    split by steps of the chunk; executed_steps: how many of them, from the first on, are executed;
    starts (trajectories + 1,): trajectory i owns the rows starts[i] … starts[i + 1] - 1.
    """

    histories: Tensor
    chains: Tensor
    ref_means: Tensor
    ref_log_probs: Tensor
    executed_steps: int
    starts: tuple[int, ...]

    @classmethod
    def collect(
        cls, reference: DiffusionPolicy, trajectories: Sequence[Trajectory], chunk_rows: int
    ) -> Transitions:
        """Stack the trajectories and cache the reference means and log-probabilities.

        Raises LearningError as `stack_decisions` does.
        """
        normalised, chains = stack_decisions(reference, trajectories)
        counts = [len(trajectory.decision_steps) for trajectory in trajectories]
        starts = (0, *np.cumsum(counts).tolist())
        denoiser, schedule = reference.denoiser, reference.schedule
        means, log_probs = [], []
        with torch.no_grad():
            for a, b in _chunks(len(chains), reference, chunk_rows):
                means.append(chain_means(denoiser, schedule, normalised[a:b], chains[a:b]))
                log_probs.append(log_prob_of_chunk_steps(schedule, chains[a:b], means[-1]))
        executed = reference.config.executed_steps
        return cls(normalised, chains, torch.cat(means), torch.cat(log_probs), executed, starts)

    def steps_of(self, trajectory: int) -> range:
        """Rows of one trajectory."""
        return range(self.starts[trajectory], self.starts[trajectory + 1])

    def counted_steps(self, config: FinetuneConfig) -> int:
        """Steps of a chunk, from the first on, that log-ratios and log-probabilities sum over."""
        return self.executed_steps if config.executed_only else self.chains.shape[2]


def stack_decisions(
    reference: DiffusionPolicy, trajectories: Sequence[Trajectory]
) -> tuple[Tensor, Tensor]:
    """histories (N, To, O) and chains (N, K + 1, Tp, A) of all decisions, both normalised.

    Raises LearningError for trajectories without decisions, or with decisions of another shape
    than the reference's.
    """
    if not trajectories or any(len(t.decision_steps) == 0 for t in trajectories):
        raise LearningError("fine-tuning needs trajectories with denoising chains, got none")
    _check_shapes(reference, trajectories)
    histories = np.concatenate([trajectory.histories for trajectory in trajectories])
    chains = np.concatenate([trajectory.chains for trajectory in trajectories])
    normalised = reference.normaliser.observation(torch.from_numpy(histories))
    return normalised, torch.from_numpy(chains)


def _check_shapes(reference: DiffusionPolicy, trajectories: Sequence[Trajectory]) -> None:
    size = reference.config
    wanted = {
        "chains": (size.denoising_steps + 1, size.predicted_steps, size.action_dim),
        "histories": (size.observation_steps, size.observation_dim),
    }
    for index, trajectory in enumerate(trajectories):
        for name, shape in wanted.items():
            found = getattr(trajectory, name).shape[1:]
            if found != shape:
                raise LearningError(
                    f"trajectory {index} has {name} of shape {found} a decision, the reference "
                    f"policy's are {shape}: another policy made it"
                )


@dataclass(frozen=True, eq=False)
class PairMatrix:
    """Which transitions are compared, and what of them stays the same while the policy moves.

    winners, losers (M, T) int64 rows; weights (M, T) ≥ 0; ref_log_probs (N,): log π_ref of every
    transition in nats; entries: numbers of a chain that each log-probability sums over.
    """

    winners: Tensor
    losers: Tensor
    weights: Tensor
    ref_log_probs: Tensor
    entries: int

    @classmethod
    def build(
        cls,
        transitions: Transitions,
        preferences: Sequence[Preference],
        config: FinetuneConfig,
    ) -> PairMatrix:
        """Step t of the winner against step t of the loser, over min(T_w, T_l) steps.

        `same_index` weighs every step 1 (the paper); `matched_state` weighs a step by
        exp(-d² / 2h²) of the distance d between the two states (normalised observations).
        """
        if not preferences:
            raise LearningError("no label prefers one trajectory over another; label some pairs")
        rows = [
            (transitions.steps_of(p.winner), transitions.steps_of(p.loser)) for p in preferences
        ]
        longest = max(min(len(w), len(l)) for w, l in rows)  # noqa: E741
        winners = torch.zeros(len(rows), longest, dtype=torch.int64)
        losers, weights = winners.clone(), torch.zeros(len(rows), longest)
        for i, (winner, loser) in enumerate(rows):
            count = min(len(winner), len(loser))
            winners[i, :count] = torch.tensor(winner[:count])
            losers[i, :count] = torch.tensor(loser[:count])
            weights[i, :count] = 1.0
        if config.step_pairing is StepPairing.MATCHED_STATE:
            states = transitions.histories[:, -1]
            distance = (states[winners] - states[losers]).norm(dim=-1)
            weights = weights * torch.exp(-0.5 * (distance / config.matched_state_scale) ** 2)
        counted = transitions.counted_steps(config)
        _, scored, _, actions = transitions.ref_means.shape
        ref_log_probs = transitions.ref_log_probs[:, :counted].sum(dim=1)
        return cls(winners, losers, weights, ref_log_probs, scored * counted * actions)


def compute_ratios(
    policy: DiffusionPolicy, transitions: Transitions, config: FinetuneConfig
) -> Tensor:
    """log π_θ - log π_ref of every transition, without a graph → (N,)."""
    with torch.no_grad():
        return torch.cat(
            [
                _ratio_chunk(policy, transitions, a, b, config)
                for a, b in _chunks(len(transitions.chains), policy, config.chunk_rows)
            ]
        )


def mean_ratio_per_trajectory(ratios: Tensor, transitions: Transitions) -> list[float]:
    """Mean log-ratio of each trajectory's decision steps: RoDiF's opinion of the trajectory."""
    starts = transitions.starts
    return [float(ratios[a:b].mean()) for a, b in zip(starts[:-1], starts[1:], strict=True)]


def kl_per_trajectory(
    policy: DiffusionPolicy, transitions: Transitions, chunk_rows: int
) -> list[float]:
    """Mean KL to the reference per decision along each stored trajectory, in nats."""
    with torch.no_grad():
        parts = []
        for a, b in _chunks(len(transitions.chains), policy, chunk_rows):
            means = chain_means(
                policy.denoiser, policy.schedule, transitions.histories[a:b],
                transitions.chains[a:b],
            )  # fmt: skip
            parts.append(chain_kl(policy.schedule, means, transitions.ref_means[a:b]))
    return mean_ratio_per_trajectory(torch.cat(parts), transitions)


def preference_loss(ratios: Tensor, matrix: PairMatrix, config: FinetuneConfig) -> LossOutput:
    """The configured loss as a function of all log-ratios (N,).

    Raises UnknownNameError for a method without a loss of its own, and LearningError where a loss
    needs a conservativeness that is not set.
    """
    return loss_of(config.method)(compare(ratios, matrix, config.kl_coef), config)


def compare(ratios: Tensor, matrix: PairMatrix, kl_coef: float) -> Compared:
    """What the losses look at, from the log-ratios (N,) and the reference's log-probabilities."""
    log_probs = matrix.ref_log_probs + ratios
    return Compared(
        compute_delta_q(ratios, matrix.winners, matrix.losers, kl_coef),
        matrix.weights,
        log_probs[matrix.winners],
        log_probs[matrix.losers],
        matrix.entries,
    )


def accumulate_gradient(
    policy: DiffusionPolicy,
    transitions: Transitions,
    config: FinetuneConfig,
    loss_of_ratios: Callable[[Tensor], LossOutput],
) -> LossOutput:
    """Add the exact full-batch gradient to the parameters' `.grad`; returns the loss."""
    ratios = compute_ratios(policy, transitions, config).requires_grad_()
    output = loss_of_ratios(ratios)
    (weights,) = torch.autograd.grad(output.loss, ratios)
    for a, b in _chunks(len(transitions.chains), policy, config.chunk_rows):
        part = _ratio_chunk(policy, transitions, a, b, config)
        (weights[a:b] * part).sum().backward()
    return LossOutput(output.loss.detach(), output.metrics)


def _ratio_chunk(
    policy: DiffusionPolicy, transitions: Transitions, a: int, b: int, config: FinetuneConfig
) -> Tensor:
    steps = transitions.counted_steps(config)
    chain = transitions.chains[a:b]
    means = chain_means(policy.denoiser, policy.schedule, transitions.histories[a:b], chain)
    return log_prob_ratio(policy.schedule, chain, means, transitions.ref_means[a:b], steps)


def _chunks(count: int, policy: DiffusionPolicy, rows: int) -> list[tuple[int, int]]:
    """Boundaries of network calls of about `rows` rows; the same for reference and candidate,
    so that equal weights give bit-equal means and log-ratios of exactly 0."""
    size = max(1, rows // len(policy.schedule.scored_steps))
    return [(a, min(a + size, count)) for a in range(0, count, size)]
