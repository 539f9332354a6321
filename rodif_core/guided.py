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
from torch import Tensor

from rodif_core.choice import Trial, choose, improves
from rodif_core.contrast import StageProgress
from rodif_core.drift import off_support_share
from rodif_core.guidance import guide
from rodif_core.log_ratio import PairMatrix, Transitions, stack_decisions
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.preferences.pairs import Preference, Tie
from rodif_core.rollout import rollout
from rodif_core.scoring import PathFeatures
from rodif_core.spec import (
    SEEDS_PER_ROUND,
    SEEDS_PER_USE,
    SELECTION_SEED,
    FinetuneConfig,
    RolloutConfig,
)
from rodif_core.tasks import get_task
from rodif_core.training_state import load_state, save_state
from rodif_core.trajectory import Trajectory
from rodif_core.winners import Scores, score

IMITATION = 1.0  # guidance scale that only imitates


@dataclass(frozen=True, eq=False)
class _Run:
    """One fine-tuning: what all of its trials share."""

    checkpoint: Checkpoint
    scores: Scores
    config: FinetuneConfig
    workspace: Path | None
    progress: StageProgress | None

    def stage(self, name: str) -> Any:
        """StageProgress of one guidance, as `guide` calls it."""
        progress = self.progress
        if progress is None:
            return None
        return lambda done, of, metrics: progress(name, done / of, metrics)

    def tell(self, stage: str, fraction: float, trial: Trial) -> None:
        """StageProgress in what a trial showed."""
        if self.progress is not None:
            facts = trial.to_json()
            self.progress(stage, fraction, {name: facts[name] for name in facts if name != "scale"})


def finetune_guided(
    checkpoint: Checkpoint,
    trajectories: Sequence[Trajectory],
    preferences: Sequence[Preference],
    transitions: Transitions,
    config: FinetuneConfig,
    *,
    ties: Sequence[Tie] = (),
    workspace: Path | None,
    progress: StageProgress | None,
) -> tuple[DiffusionPolicy, dict[str, Any]]:
    """Score, guide at every scale, choose; optional self-training. Returns policy and report.

    `workspace` keeps every finished trial; an unfinished one is begun again.
    """
    matrix = PairMatrix.build(transitions, preferences, config)
    scores = score(
        checkpoint, trajectories, preferences, transitions, matrix, config,
        ties=ties, workspace=workspace, progress=progress,
    )  # fmt: skip
    kept = [trajectories[i] for i in scores.kept]
    this = _Run(checkpoint, scores, config, workspace, progress)
    base = _try(this, "base", checkpoint.policy, 0.0)
    trials: list[Trial] = []
    for scale in config.guide.scales:
        trials.append(_guide(this, kept, scale))
        this.tell("choose", len(trials) / len(config.guide.scales), trials[-1])
    chosen = choose(base, trials)
    retrained: list[Trial] = []
    for extra in range(config.guide.self_training_rounds):
        fresh = _self_train(this, base, chosen, extra)
        if fresh is None:
            break
        retrained.append(fresh)
        this.tell("choose again", (extra + 1) / config.guide.self_training_rounds, fresh)
        chosen = fresh if improves(base, chosen, fresh) else chosen
    report = {
        "scores": scores.to_json(),
        "base": base.to_json(),
        "trials": [trial.to_json() for trial in trials],
        "self_training": [trial.to_json() for trial in retrained],
        "chosen": chosen.to_json(),
    }
    return chosen.policy, report


def _guide(this: _Run, kept: Sequence[Trajectory], scale: float) -> Trial:
    """Move towards what was done in the kept trajectories by one scale."""
    name = f"guide s={scale:g}"
    done = _load_trial(this, name)
    if done is not None:
        return done
    reference = this.checkpoint.policy
    policy = guide(
        reference, *decisions_done(reference, kept), scale, this.config.guide, this.config.seed,
        this.stage(name),
    )  # fmt: skip
    return _try(this, name, policy, scale)


def decisions_done(
    policy: DiffusionPolicy, trajectories: Sequence[Trajectory]
) -> tuple[Tensor, Tensor]:
    """histories (N, To, O) of all decisions, and the actions done from each on (N, Tp, A), the last
    one again after the end; both normalised.

    A decision's own chunk is executed in its first Te steps; what came of the others was decided
    later, nearer to them and looking again. That is the better thing to plan.
    Raises LearningError as `stack_decisions` does.
    """
    histories, _ = stack_decisions(policy, trajectories)
    chunks = []
    for one in trajectories:
        steps = one.decision_steps[:, None] + np.arange(policy.config.predicted_steps)
        chunks.append(one.actions[steps.clip(max=len(one.actions) - 1)])
    return histories, policy.normaliser.action(torch.from_numpy(np.concatenate(chunks)))


def _try(this: _Run, name: str, policy: DiffusionPolicy, scale: float) -> Trial:
    """Fresh rollouts of a policy; all trials of a round use the same seeds. Keeps the trial."""
    done = _load_trial(this, name)
    if done is not None:
        return done
    settings = RolloutConfig(this.config.guide.selection_rollouts, _fresh_seed(this.config))
    rollouts = rollout(replace(this.checkpoint, policy=policy), settings)
    off = off_support_share(rollouts, this.checkpoint)
    success = float(np.mean([trajectory.success for trajectory in rollouts]))
    liked = _liked(this, rollouts)
    trial = Trial(scale, policy, success, off, len(liked) / len(rollouts))
    if this.workspace is not None:
        modules = {"denoiser": policy.denoiser}
        save_state(_trial_file(this.workspace, name), modules, None, trial.to_json())
    return trial


def _load_trial(this: _Run, name: str) -> Trial | None:
    """What an earlier attempt at the same fine-tuning has finished."""
    if this.workspace is None:
        return None
    policy = this.checkpoint.policy.copy()
    modules = {"denoiser": policy.denoiser}
    facts = load_state(_trial_file(this.workspace, name), modules, None)
    return None if facts is None else Trial.from_json(facts, policy)


def _trial_file(workspace: Path, name: str) -> Path:
    return workspace / f"{name.replace(' ', '-')}.safetensors"


def _liked(this: _Run, rollouts: Sequence[Trajectory]) -> list[Trajectory]:
    """The rollouts that succeed and that the labels predict to be preferred."""
    features = PathFeatures.of(rollouts, get_task(this.checkpoint.task))
    predicted = this.scores.path_utility.predict(features) > this.scores.path_cut
    pairs = zip(rollouts, predicted, strict=True)
    return [trajectory for trajectory, preferred in pairs if preferred and trajectory.success]


def _fresh_seed(config: FinetuneConfig, use: int = 0) -> int:
    return SELECTION_SEED + SEEDS_PER_ROUND * config.seed + SEEDS_PER_USE * use


def _self_train(this: _Run, base: Trial, chosen: Trial, extra: int) -> Trial | None:
    """Imitate the chosen policy's own liked rollouts near the data, made with less noise than it
    has itself.

    Most failures begin where the policy wavers between two ways round an obstacle. With less noise
    it wavers less and still takes many ways, and imitation makes that its own. Its scale is 1: the
    policy is where it should go, and pushing on costs success. None: no rollout was liked.
    """
    name = f"self-training {extra + 1}"
    done = _load_trial(this, name)
    if done is not None:
        return done
    checkpoint, guiding = this.checkpoint, this.config.guide
    settings = RolloutConfig(guiding.self_training_rollouts, _fresh_seed(this.config, extra + 1))
    steady = rollout(
        replace(checkpoint, policy=chosen.policy), settings, noise_scale=guiding.self_training_noise
    )
    liked = near_data(checkpoint, _liked(this, steady), base.off_support)
    if not liked:
        return None
    policy = guide(
        chosen.policy, *decisions_done(checkpoint.policy, liked), IMITATION,
        replace(guiding, updates=guiding.self_training_updates),
        this.config.seed + extra + 1, this.stage(name),
    )  # fmt: skip
    return _try(this, name, policy, chosen.scale)


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
