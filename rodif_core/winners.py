"""Which labelled trajectories are worth imitating: the first half of `rodif_guided`.

Both models of `scoring` give their opinion; the configured one decides, the other is stored beside
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rodif_core.contrast import StageProgress, contrast
from rodif_core.errors import LearningError
from rodif_core.log_ratio import (
    PairMatrix,
    Transitions,
    compute_ratios,
    mean_ratio_per_trajectory,
)
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.preferences.pairs import Preference, Tie
from rodif_core.scoring import PathFeatures, PathUtility, split_threshold, standardise
from rodif_core.spec import FinetuneConfig, FinetuneMethod, Scorer
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scores:
    """Utilities of the labelled trajectories (R,), both opinions, and who is kept as a winner."""

    network: Array
    path_utility: PathUtility
    path_cut: float
    eligible: NDArray[np.bool_]  # (R,): may be a winner
    kept: list[int]
    stopped: str  # why the network's scoring ended

    def to_json(self) -> dict[str, Any]:
        """What the round stores; agreement = share of eligible trajectories that both models
        place on the same side of their cuts, None where the network tells none apart."""
        paths, network = self.path_utility.utilities, self.network
        agreement = None
        if np.ptp(network[self.eligible]) > 0:
            side = network[self.eligible] > split_threshold(network[self.eligible])
            agreement = float((side == (paths[self.eligible] > self.path_cut)).mean())
        return {
            "network": [round(float(value), 4) for value in network],
            "gaussian_process": [round(float(value), 4) for value in paths],
            "agreement": agreement,
            "kept": self.kept,
            "trajectories": len(network),
            "stopped": self.stopped,
        }


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
    progress: StageProgress | None = None,
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
    # Failures are out of the question as winners; the cut runs between the others.
    success = np.array([trajectory.success for trajectory in trajectories])
    eligible = success | (not config.guide.require_success)
    if eligible.sum() < 2:
        raise LearningError(
            f"{int(eligible.sum())} of {len(eligible)} labelled trajectories succeeded; "
            "guidance needs at least 2: collect more episodes"
        )
    path_cut = path_utility.cut(eligible)
    if config.guide.scorer is Scorer.GAUSSIAN_PROCESS:
        liked = path_utility.utilities > path_cut
    elif np.ptp(network[eligible]) == 0:
        raise LearningError(
            f"the scorer {config.guide.scorer.value!r} needs the network's opinion, and it tells "
            f"no two trajectories apart: {moved.stopped}"
        )
    else:
        opinion = standardise(network)
        if config.guide.scorer is Scorer.COMBINED:
            opinion = opinion + standardise(path_utility.utilities)
        liked = opinion > split_threshold(opinion[eligible])
    kept = np.flatnonzero(eligible & liked).tolist()
    return Scores(network, path_utility, path_cut, eligible, kept, moved.stopped)
