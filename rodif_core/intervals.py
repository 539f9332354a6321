"""Binomial confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence

Z_95 = 1.959963984540054  # two-sided 95 % quantile of the standard normal


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """95 % Wilson score interval of a rate; (0, 1) when nothing was observed."""
    if n == 0:
        return 0.0, 1.0
    rate = successes / n
    z2 = Z_95**2
    centre = (rate + z2 / (2 * n)) / (1 + z2 / n)
    half = Z_95 / (1 + z2 / n) * math.sqrt(rate * (1 - rate) / n + z2 / (4 * n**2))
    # At the ends the bound is the rate itself; rounding would leave it an atom inside.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == n else min(1.0, centre + half)
    return low, high


def surely_below(
    before: float, interval_before: Sequence[float], after: float, interval_after: Sequence[float]
) -> bool:
    """Whether the 95 % interval of the difference of two independent rates lies below 0.

    Newcombe's hybrid of two Wilson intervals (Statistics in Medicine 17, 1998, method 10).
    """
    reach = math.hypot(interval_after[1] - after, before - interval_before[0])
    return after - before + reach < 0
