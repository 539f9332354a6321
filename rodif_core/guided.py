"""`rodif_guided`: RoDiF as a label denoiser, then guidance, then a choice by fresh rollouts.

Nothing here knows the true criterion: the choice among guidance scales looks at success and
drift, which the simulation knows, and at the utility that the labels themselves predict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rodif_core.choice import Trial, choose, improves
from rodif_core.contrast import Progress, contrast
from rodif_core.drift import off_support_share
from rodif_core.errors import LearningError
from rodif_core.guidance import guide
from rodif_core.log_ratio import (
    PairMatrix,
    Transitions,
    compute_ratios,
    mean_ratio_per_trajectory,
)
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.preferences.pairs import Preference, Tie
from rodif_core.rollout import rollout
from rodif_core.scoring import PathFeatures, PathUtility, split_threshold, standardise
from rodif_core.spec import FinetuneConfig, FinetuneMethod, RolloutConfig, Scorer
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory

Array = NDArray[np.float64]
# Rollouts inside a round never share a seed with an evaluation, nor with each other by use.
SELECTION_SEED, SEEDS_PER_ROUND, SEEDS_PER_USE = 7_000_000, 10_000, 1_000
IMITATION = 1.0  # guidance scale that only imitates


@dataclass(frozen=True, eq=False)
class Scores:
    """Utilities of the labelled trajectories, both opinions, and who is kept as a winner."""

    network: Array
    gaussian_process: Array
    used: Array
    threshold: float
    kept: list[int]
    path_utility: PathUtility
    path_threshold: float
    network_threshold: float
    eligible: NDArray[np.bool_]  # (R,): may be a winner

    def to_json(self) -> dict[str, Any]:
        """What the round stores; agreement = share of eligible trajectories that both models
        place on the same side of their cuts."""
        network_side = self.network[self.eligible] > self.network_threshold
        path_side = self.gaussian_process[self.eligible] > self.path_threshold
        return {
            "network": [round(float(value), 4) for value in self.network],
            "gaussian_process": [round(float(value), 4) for value in self.gaussian_process],
            "agreement": float((network_side == path_side).mean()),
            "kept": self.kept,
            "trajectories": len(self.used),
        }


def finetune_guided(
    checkpoint: Checkpoint,
    trajectories: Sequence[Trajectory],
    preferences: Sequence[Preference],
    transitions: Transitions,
    config: FinetuneConfig,
    *,
    ties: Sequence[Tie] = (),
    workspace: Path | None,
    progress: Progress | None,
) -> tuple[DiffusionPolicy, dict[str, Any]]:
    """Score, guide at every scale, choose; optional self-training. Returns policy and report."""
    matrix = PairMatrix.build(transitions, preferences, config)
    scores = score(
        checkpoint, trajectories, preferences, transitions, matrix, config,
        ties=ties, workspace=workspace, progress=progress,
    )  # fmt: skip
    histories, chunks = _kept_decisions(transitions, scores.kept)
    base = _try(checkpoint, checkpoint.policy, 0.0, scores, config)
    trials: list[Trial] = []
    for scale in config.guide.scales:
        policy = guide(
            checkpoint.policy, histories, chunks, scale, config.guide, config.seed,
            _stage(progress, f"guide s={scale:g}"),
        )  # fmt: skip
        trials.append(_try(checkpoint, policy, scale, scores, config))
        _tell(progress, "choose", len(trials) / len(config.guide.scales), trials[-1])
    chosen = choose(base, trials)
    retrained: list[Trial] = []
    for extra in range(config.guide.self_training_rounds):
        fresh = _self_train(checkpoint, base, chosen, scores, config, extra, progress)
        if fresh is None:
            break
        retrained.append(fresh)
        _tell(progress, "choose again", (extra + 1) / config.guide.self_training_rounds, fresh)
        chosen = fresh if improves(base, chosen, fresh) else chosen
    report = {
        "scores": scores.to_json(),
        "base": base.to_json(),
        "trials": [trial.to_json() for trial in trials],
        "self_training": [trial.to_json() for trial in retrained],
        "chosen": chosen.to_json(),
    }
    return chosen.policy, report


def score(
    checkpoint: Checkpoint,
    trajectories: Sequence[Trajectory],
    preferences: Sequence[Preference],
    transitions: Transitions,
    matrix: PairMatrix,
    config: FinetuneConfig,
    *,
    ties: Sequence[Tie] = (),
    workspace: Path | None = None,
    progress: Progress | None = None,
) -> Scores:
    """Utilities from both models; winners lie above the cut of the configured one."""
    scorer = replace(config, method=FinetuneMethod.RODIF, updates=config.guide.score_updates)
    moved = contrast(
        checkpoint.policy, transitions, matrix, scorer,
        stage="score", workspace=workspace, progress=progress,
    )  # fmt: skip
    ratios = compute_ratios(moved.policy, transitions, config)
    network = np.asarray(mean_ratio_per_trajectory(ratios, transitions))
    path_utility = PathUtility.fit(
        PathFeatures.of(trajectories, get_task(checkpoint.task)), preferences, ties
    )
    opinions = {
        Scorer.NETWORK: standardise(network),
        Scorer.GAUSSIAN_PROCESS: standardise(path_utility.utilities),
        Scorer.COMBINED: standardise(network) + standardise(path_utility.utilities),
    }
    used = opinions[config.guide.scorer]
    # Failures are out of the question as winners; the cut runs between the others.
    success = np.array([trajectory.success for trajectory in trajectories])
    eligible = success | (not config.guide.require_success)
    if eligible.sum() < 2:
        raise LearningError(
            f"{int(eligible.sum())} of {len(eligible)} labelled trajectories succeeded; "
            "guidance needs at least 2: collect more episodes"
        )
    threshold = split_threshold(used[eligible])
    kept = np.flatnonzero(eligible & (used > threshold)).tolist()
    return Scores(
        network,
        path_utility.utilities,
        used,
        threshold,
        kept,
        path_utility,
        split_threshold(path_utility.utilities[eligible]),
        split_threshold(network[eligible]),
        eligible,
    )


def _kept_decisions(transitions: Transitions, kept: Sequence[int]) -> tuple[Tensor, Tensor]:
    rows = torch.tensor([row for i in kept for row in transitions.steps_of(i)])
    return transitions.histories[rows], transitions.chains[rows, -1]


def _try(
    checkpoint: Checkpoint,
    policy: DiffusionPolicy,
    scale: float,
    scores: Scores,
    config: FinetuneConfig,
) -> Trial:
    """Fresh rollouts of a policy; all trials of a round use the same seeds."""
    settings = RolloutConfig(config.guide.selection_rollouts, _fresh_seed(config))
    rollouts = rollout(replace(checkpoint, policy=policy), settings)
    off = off_support_share(rollouts, checkpoint)
    success = float(np.mean([trajectory.success for trajectory in rollouts]))
    liked = _liked(checkpoint, rollouts, scores)
    return Trial(scale, policy, success, off, len(liked) / len(rollouts))


def _liked(
    checkpoint: Checkpoint, rollouts: Sequence[Trajectory], scores: Scores
) -> list[Trajectory]:
    """The rollouts that succeed and that the labels predict to be preferred."""
    features = PathFeatures.of(rollouts, get_task(checkpoint.task))
    predicted = scores.path_utility.predict(features) > scores.path_threshold
    pairs = zip(rollouts, predicted, strict=True)
    return [trajectory for trajectory, preferred in pairs if preferred and trajectory.success]


def _fresh_seed(config: FinetuneConfig, use: int = 0) -> int:
    return SELECTION_SEED + SEEDS_PER_ROUND * config.seed + SEEDS_PER_USE * use


def _self_train(
    checkpoint: Checkpoint,
    base: Trial,
    chosen: Trial,
    scores: Scores,
    config: FinetuneConfig,
    extra: int,
    progress: Progress | None,
) -> Trial | None:
    """Imitate the chosen policy's own liked rollouts near the data, made with less noise than it
    has itself.

    Most failures begin where the policy wavers between two ways round an obstacle. With less noise
    it wavers less and still takes many ways, and imitation makes that its own. Its scale is 1: the
    policy is where it should go, and pushing on costs success. None: no rollout was liked.
    """
    guiding = config.guide
    settings = RolloutConfig(guiding.self_training_rollouts, _fresh_seed(config, extra + 1))
    steady = rollout(
        replace(checkpoint, policy=chosen.policy), settings, noise_scale=guiding.self_training_noise
    )
    liked = near_data(checkpoint, _liked(checkpoint, steady, scores), base.off_support)
    if not liked:
        return None
    lessons = Transitions.collect(checkpoint.policy, liked, config.chunk_rows)
    policy = guide(
        chosen.policy, lessons.histories, lessons.chains[:, -1], IMITATION,
        replace(guiding, updates=guiding.self_training_updates),
        config.seed + extra + 1, _stage(progress, f"self-training {extra + 1}"),
    )  # fmt: skip
    return _try(checkpoint, policy, chosen.scale, scores, config)


def near_data(
    checkpoint: Checkpoint, trajectories: Sequence[Trajectory], limit: float
) -> list[Trajectory]:
    """Those that leave the data no more than `limit`, but at least the nearer half of them all.

    Without this a narrow way beside the demonstrations could become the policy's favourite.
    """
    off = [off_support_share([one], checkpoint) for one in trajectories]
    order = np.argsort(off, kind="stable")
    count = max(sum(share <= limit for share in off), (len(off) + 1) // 2)
    return [trajectories[i] for i in sorted(order[:count].tolist())]


def _tell(progress: Progress | None, stage: str, fraction: float, trial: Trial) -> None:
    if progress is not None:
        facts = trial.to_json()
        progress(stage, fraction, {name: facts[name] for name in facts if name != "scale"})


def _stage(progress: Progress | None, name: str) -> Any:
    if progress is None:
        return None
    return lambda done, of, metrics: progress(name, done / of, metrics)
