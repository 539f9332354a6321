"""Fine-tuning: a checkpoint, trajectories and preferences in; a candidate checkpoint out.

`rodif`, `dp_dpo`, `ipo`, `cpo` and `simpo` minimise a loss (`contrast`); `rodif_guided`, the
default, scores the trajectories with RoDiF and then guides (`guided`). Same labels, same door.
Deterministic on a CPU: equal arguments give equal weights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rodif_core.contrast import StageProgress, contrast
from rodif_core.errors import LearningError
from rodif_core.guided import finetune_guided
from rodif_core.log_ratio import PairMatrix, Transitions, kl_per_trajectory
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.preferences.pairs import Preference, Tie
from rodif_core.spec import GATED_METHODS, FinetuneConfig, FinetuneMethod
from rodif_core.training_state import claim_workspace
from rodif_core.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class FinetuneResult:
    """The candidate and what the round stores about its making (JSON types).

    report: method, pairs, ties, trajectories, decisions, kl_winners and kl_losers (nats per
    decision on the stored states of trajectories that win or lose most of their labels); of the
    literal methods curve and stopped; of `rodif_guided` scores, base, trials, self_training and
    chosen.
    """

    checkpoint: Checkpoint
    report: dict[str, Any]


def finetune(
    checkpoint: Checkpoint,
    trajectories: Sequence[Trajectory],
    preferences: Sequence[Preference],
    config: FinetuneConfig,
    *,
    ties: Sequence[Tie] = (),
    workspace: Path | None = None,
    progress: StageProgress | None = None,
) -> FinetuneResult:
    """Steer the policy towards the preferred trajectories; the given checkpoint is the reference.

    preferences and ties index into trajectories; only `rodif_guided` learns from ties, the
    literal methods know none. `workspace` keeps partial state, so that a second call with the same
    arguments goes on where the first was killed: after the last saved update, and for
    `rodif_guided` after the last finished trial. Raises LearningError without usable labels, when
    conservativeness is not set for a method that needs it (estimate it from the labels first), and
    for a workspace of another fine-tuning.
    """
    if config.conservativeness is None and config.method in GATED_METHODS:
        raise LearningError("conservativeness is not set: estimate it from the labels first")
    labels: list[Preference | Tie] = [*preferences, *ties]
    for label in labels:
        if not all(0 <= index < len(trajectories) for index in label.pair):
            raise LearningError(f"{label} names a trajectory outside 0 … {len(trajectories) - 1}")
    if workspace is not None:
        claim_workspace(workspace, _identity(checkpoint, trajectories, preferences, ties, config))
    transitions = Transitions.collect(checkpoint.policy, trajectories, config.chunk_rows)
    report: dict[str, Any] = {
        "method": config.method.value,
        "pairs": len(preferences),
        "ties": len(ties),
        "trajectories": len(trajectories),
        "decisions": len(transitions.chains),
    }
    if config.method is FinetuneMethod.RODIF_GUIDED:
        policy, details = finetune_guided(
            checkpoint, trajectories, preferences, transitions, config,
            ties=ties, workspace=workspace, progress=progress,
        )  # fmt: skip
        report |= details
    else:
        matrix = PairMatrix.build(transitions, preferences, config)
        result = contrast(
            checkpoint.policy, transitions, matrix, config,
            stage=config.method.value, workspace=workspace, progress=progress,
        )  # fmt: skip
        policy = result.policy
        report |= {"curve": result.curve, "stopped": result.stopped}
    report |= _drift(policy, transitions, preferences, config)
    card = {"kind": "finetuned", "parent": checkpoint.digest, "config": config.to_json()}
    return FinetuneResult(replace(checkpoint, policy=policy, card=card), report)


def _identity(
    checkpoint: Checkpoint,
    trajectories: Sequence[Trajectory],
    preferences: Sequence[Preference],
    ties: Sequence[Tie],
    config: FinetuneConfig,
) -> dict[str, Any]:
    """What decides the candidate, in JSON types."""
    runs = hashlib.sha256()
    for one in trajectories:
        runs.update(one.histories.tobytes() + one.chains.tobytes() + one.paths.tobytes())
    labels = hashlib.sha256(repr([label.pair for label in preferences]).encode())
    labels.update(repr([label.pair for label in ties]).encode())
    return {
        "parent": checkpoint.digest,
        "config": config.to_json(),
        "trajectories": runs.hexdigest()[:16],
        "labels": labels.hexdigest()[:16],
    }


def _drift(
    policy: DiffusionPolicy,
    transitions: Transitions,
    preferences: Sequence[Preference],
    config: FinetuneConfig,
) -> dict[str, float]:
    """KL to the reference on stored states: a diagnosis, not a measure of support."""
    kl = np.asarray(kl_per_trajectory(policy, transitions, config.chunk_rows))
    balance = np.zeros(len(kl))
    for preference in preferences:
        balance[preference.winner] += 1
        balance[preference.loser] -= 1
    means = {"kl_winners": kl[balance > 0], "kl_losers": kl[balance < 0]}
    return {name: float(rows.mean()) if len(rows) else 0.0 for name, rows in means.items()}
