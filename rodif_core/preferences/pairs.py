"""Which two trajectories a person is asked to compare, and what the answer becomes.

Trajectories are named by their index in a list that the caller keeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError

CROSS_GROUP = "cross_group"  # two different behaviour groups
RANDOM = "random"  # any two
STRATEGIES = (CROSS_GROUP, RANDOM)


@dataclass(frozen=True)
class Preference:
    """One decisive label: somebody holds trajectory `winner` above trajectory `loser`."""

    winner: int
    loser: int

    @property
    def pair(self) -> tuple[int, int]:
        """Winner and loser."""
        return self.winner, self.loser


@dataclass(frozen=True)
class Tie:
    """Two trajectories that an annotator called equally good."""

    first: int
    second: int

    @property
    def pair(self) -> tuple[int, int]:
        """Both, in the order in which they were named."""
        return self.first, self.second


@dataclass(frozen=True)
class ChosenPair:
    """Two trajectories to compare and why they were chosen (one of STRATEGIES)."""

    first: int
    second: int
    reason: str


def choose_pairs(
    groups: Sequence[str | None],
    *,
    count: int,
    strategy: str,
    random_share: float,
    rng: np.random.Generator,
) -> list[ChosenPair]:
    """Choose `count` different pairs of trajectories, in an order fit for labelling.

    groups        behaviour group of each trajectory; None is a group of its own
    strategy      "cross_group": every combination of two groups equally often as long as it has
                  pairs left, or "random"
    random_share  share in [0, 1] of pairs drawn at random whatever the strategy; they keep the
                  noise estimate and the coverage honest

    Trajectories are reused evenly: the least used one comes next, chance decides ties. An even
    reuse is what lets one label a pair tell the noise (see `preferences.noise`). When no pairs
    across groups are left, the rest is random, and its reason says so.

    Raises UnknownNameError, ValueOutOfRangeError (more pairs than exist, share outside [0, 1]).
    """
    _check(len(groups), count, strategy, random_share)
    n = len(groups)
    members = [[i for i in range(n) if groups[i] == name] for name in sorted(set(groups), key=str)]
    across = list(combinations(range(len(members)), 2))
    picked_across = [0] * len(across)
    uses = np.zeros(n)
    taken: set[frozenset[int]] = set()
    chosen: list[ChosenPair] = []
    random_count = count if strategy == RANDOM else round(count * random_share)

    def take(left: Sequence[int], right: Sequence[int], reason: str) -> bool:
        pair = _least_used_pair(left, right, uses, taken, rng)
        if pair is None:
            return False
        taken.add(frozenset(pair))
        uses[list(pair)] += 1
        first, second = pair if rng.random() < 0.5 else pair[::-1]
        chosen.append(ChosenPair(first, second, reason))
        return True

    while across and len(chosen) < count - random_count:
        least = min(range(len(across)), key=lambda i: (picked_across[i], i))
        left, right = (members[i] for i in across[least])
        if take(left, right, CROSS_GROUP):
            picked_across[least] += 1
        else:
            del across[least], picked_across[least]
    everyone = range(n)
    while len(chosen) < count:
        take(everyone, everyone, RANDOM)
    return [chosen[i] for i in rng.permutation(len(chosen))]


def _check(n: int, count: int, strategy: str, random_share: float) -> None:
    if strategy not in STRATEGIES:
        raise UnknownNameError("pair strategy", strategy, STRATEGIES)
    if not 0 <= random_share <= 1:
        raise ValueOutOfRangeError("random_share", random_share, "in [0, 1]")
    possible = n * (n - 1) // 2
    if not 0 <= count <= possible:
        raise ValueOutOfRangeError(
            "count", count, f"0 … {possible}, the number of pairs of {n} trajectories"
        )


def _least_used_pair(
    left: Sequence[int],
    right: Sequence[int],
    uses: np.ndarray,
    taken: set[frozenset[int]],
    rng: np.random.Generator,
) -> tuple[int, int] | None:
    """The least used trajectory of `left` with the least used partner in `right` still free."""
    for a in _least_used_first(left, uses, rng):
        for b in _least_used_first(right, uses, rng):
            if a != b and frozenset((a, b)) not in taken:
                return a, b
    return None


def _least_used_first(
    items: Sequence[int], uses: np.ndarray, rng: np.random.Generator
) -> list[int]:
    shuffled = rng.permutation(np.asarray(items))
    return [int(i) for i in shuffled[np.argsort(uses[shuffled], kind="stable")]]


def product_pairs(winners: Sequence[int], losers: Sequence[int]) -> list[tuple[int, int]]:
    """All (winner, loser) pairs: the paper's Cartesian design (20 x 20 for Avoid)."""
    return [(winner, loser) for winner in winners for loser in losers]
