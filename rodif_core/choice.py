"""The choice among policies by what their fresh rollouts show; nothing here knows the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rodif_core.gate import OFF_SUPPORT_RATIO, OFF_SUPPORT_SLACK
from rodif_core.policies.policy import DiffusionPolicy

NOISE = 0.04  # of a rate near 1 over 100 rollouts: two standard errors
SUCCESS_SLACK = 0.03  # a scale may lose this much success against the parent on the same seeds


@dataclass(frozen=True, eq=False)
class Trial:
    """One guidance scale and what its fresh rollouts show."""

    scale: float
    policy: DiffusionPolicy
    success: float
    off_support: float
    predicted: float  # share of rollouts that succeed and that the labels predict to be preferred

    def to_json(self) -> dict[str, float]:
        """Plain JSON types."""
        return {
            "scale": self.scale,
            "success": self.success,
            "off_support": self.off_support,
            "predicted_preferred": self.predicted,
        }

    @classmethod
    def from_json(cls, facts: Mapping[str, float], policy: DiffusionPolicy) -> Trial:
        """The trial of `policy` that `to_json` told of."""
        return cls(
            facts["scale"],
            policy,
            facts["success"],
            facts["off_support"],
            facts["predicted_preferred"],
        )


def improves(base: Trial, before: Trial, after: Trial) -> bool:
    """Whether a self-training pass replaces what it started from.

    It imitates successes and so is believed, unless its rollouts say clearly otherwise: it left
    the data, or it is liked less by more than chance explains.
    """
    kept = after.predicted - after.off_support >= before.predicted - before.off_support - NOISE
    return kept and after.off_support <= _off_support_limit(base)


def choose(base: Trial, trials: Sequence[Trial]) -> Trial:
    """The scale whose rollouts the labels like best, less what leaves the data, among those that
    keep success and support.

    When none keeps both, the one with the most success less what leaves the data. Ties go to the
    smaller scale.
    """
    limit = _off_support_limit(base)
    sound = [
        trial
        for trial in trials
        if trial.success >= base.success - SUCCESS_SLACK and trial.off_support <= limit
    ]
    if sound:
        return max(sound, key=lambda trial: (trial.predicted - trial.off_support, -trial.scale))
    return min(trials, key=lambda trial: (trial.off_support - trial.success, trial.scale))


def _off_support_limit(base: Trial) -> float:
    # Half the gate's slack: the gate will look at other rollouts.
    return OFF_SUPPORT_RATIO * base.off_support + OFF_SUPPORT_SLACK / 2
