"""Corruption of simulated labels: labels that contradict the annotators' true criterion."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import ValueOutOfRangeError


def _check(count: int, rate: float) -> None:
    if count < 0:
        raise ValueOutOfRangeError("count", count, "at least 0")
    if not 0 <= rate <= 1:
        raise ValueOutOfRangeError("flip rate", rate, "in [0, 1]")


def exact_flips(count: int, rate: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(count,) bool with exactly rate * count true entries (halves round up), placed at random.

    The paper's protocol: a fixed portion of the labels is inverted (its appendix on corruption).
    """
    _check(count, rate)
    flips = np.zeros(count, dtype=np.bool_)
    flips[rng.permutation(count)[: math.floor(rate * count + 0.5)]] = True
    return flips


def independent_flips(count: int, rate: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(count,) bool, each entry true with probability `rate` on its own."""
    _check(count, rate)
    return np.asarray(rng.random(count) < rate)
