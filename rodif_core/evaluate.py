"""Seeded rollouts of a checkpoint, summed up: success, mode alignment, drift, with intervals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rodif_core.drift import off_support_share
from rodif_core.intervals import wilson_interval
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.rollout import EpisodeProgress, rollout
from rodif_core.spec import RolloutConfig
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory

PLOTTED_POINTS = 32  # points per stored path, enough for a plot
MAX_PATHS = 120  # paths kept for plots


@dataclass(frozen=True)
class Evaluation:
    """Counts over n rollouts; rates follow from them.

    aligned: successful and in the preferred group, over all rollouts (the paper's alignment);
    off_support: share of visited states off the support; paths: (x, y) in metres with the group.
    """

    n: int
    successes: int
    aligned: int
    off_support: float
    groups: dict[str, int]
    modes: dict[str, int]
    reasons: dict[str, int]
    paths: tuple[tuple[str, tuple[tuple[float, float], ...]], ...]

    @property
    def success(self) -> float:
        """Success rate over all rollouts."""
        return self.successes / self.n

    @property
    def alignment(self) -> float:
        """Mode alignment rate over all rollouts."""
        return self.aligned / self.n

    @property
    def alignment_of_successes(self) -> float:
        """Mode alignment rate over the successful rollouts; 0 when there is none."""
        return self.aligned / self.successes if self.successes else 0.0

    def to_json(self) -> dict[str, Any]:
        """Rates in 0 … 1 with 95 % Wilson intervals."""
        return {
            "n": self.n,
            "success": self.success,
            "alignment": self.alignment,
            "alignment_of_successes": self.alignment_of_successes,
            "off_support": self.off_support,
            "intervals": {
                "success": list(wilson_interval(self.successes, self.n)),
                "alignment": list(wilson_interval(self.aligned, self.n)),
                "alignment_of_successes": list(wilson_interval(self.aligned, self.successes)),
            },
            "groups": self.groups,
            "modes": self.modes,
            "reasons": self.reasons,
            "paths": [[list(point) for point in points] for _, points in self.paths],
            "path_groups": [group for group, _ in self.paths],
        }


def evaluate(
    checkpoint: Checkpoint, config: RolloutConfig, *, progress: EpisodeProgress | None = None
) -> Evaluation:
    """Roll out and sum up; the same checkpoint and config give the same result."""
    return summarise(checkpoint, rollout(checkpoint, config, progress=progress))


def summarise(checkpoint: Checkpoint, trajectories: Sequence[Trajectory]) -> Evaluation:
    """Evaluation of rollouts that exist already."""
    task = get_task(checkpoint.task)
    outcomes = [trajectory.outcome for trajectory in trajectories]
    aligned = [o["success"] and o["group"] == task.preferred_group for o in outcomes]
    return Evaluation(
        n=len(outcomes),
        successes=sum(bool(o["success"]) for o in outcomes),
        aligned=sum(aligned),
        off_support=off_support_share(trajectories, checkpoint),
        groups=_counts(o["group"] or "none" for o in outcomes),
        modes=_counts(o["mode"] for o in outcomes if o["mode"] is not None),
        reasons=_counts(o["reason"] for o in outcomes),
        paths=tuple(_plot_path(trajectory) for trajectory in trajectories[:MAX_PATHS]),
    )


def thin_path(trajectory: Trajectory, points: int = PLOTTED_POINTS) -> list[list[float]]:
    """End-effector path thinned to `points` rows of [x, y, z], in metres to 0.1 mm."""
    last = len(trajectory.paths) - 1
    rows = [trajectory.paths[round(i * last / (points - 1))] for i in range(points)]
    return [[round(float(value), 4) for value in row] for row in rows]


def _plot_path(trajectory: Trajectory) -> tuple[str, tuple[tuple[float, float], ...]]:
    group = trajectory.outcome["group"] if trajectory.success else "failed"
    return group or "none", tuple((x, y) for x, y, _ in thin_path(trajectory))


def _counts(names: Any) -> dict[str, int]:
    return dict(sorted(Counter(names).items()))
