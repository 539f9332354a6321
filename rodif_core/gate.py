"""The gate between a candidate and publication. Torch-free: it reads two evaluations as JSON.

It knows nothing of the true criterion: it judges whether the candidate still solves the task and
stays on the data. Whether it is what people want is theirs to say, with the next labels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rodif_core.intervals import surely_below

MOST_LOST = 0.05  # success that a candidate may lose, even where chance could explain more …
ROUNDING = 1e-9  # … and what a difference of two rates is off by in binary
OFF_SUPPORT_RATIO = 1.5  # candidate may leave the data at most this much more than its parent …
OFF_SUPPORT_SLACK = 0.02  # … plus this share, so that a parent at 0 does not forbid everything


@dataclass(frozen=True)
class GateVerdict:
    """Whether a candidate may be published; one sentence for every check, passed or not."""

    passed: bool
    reasons: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {"passed": self.passed, "reasons": list(self.reasons)}


def judge(before: Mapping[str, Any], after: Mapping[str, Any]) -> GateVerdict:
    """Compare two `Evaluation.to_json()`: success must not fall, drift must stay small.

    Success counts as fallen when the rate fell by more than MOST_LOST, or by more than chance
    explains: the 95 % interval of the difference lies below 0.
    """
    reasons = []
    lost = before["success"] - after["success"]
    success_ok = lost <= MOST_LOST + ROUNDING and not surely_below(
        before["success"],
        before["intervals"]["success"],
        after["success"],
        after["intervals"]["success"],
    )
    reasons.append(
        f"success {before['success']:.1%} → {after['success']:.1%} (n = {after['n']}): "
        + ("kept" if success_ok else "fell too far")
    )
    limit = OFF_SUPPORT_RATIO * before["off_support"] + OFF_SUPPORT_SLACK
    support_ok = after["off_support"] <= limit
    reasons.append(
        f"off-support share {before['off_support']:.1%} → {after['off_support']:.1%}, "
        f"limit {limit:.1%}: " + ("on the data" if support_ok else "left the data")
    )
    return GateVerdict(success_ok and support_ok, tuple(reasons))
