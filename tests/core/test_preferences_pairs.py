"""Choosing pairs and corrupting simulated labels."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.preferences.corruption import exact_flips, independent_flips
from rodif_core.preferences.pairs import CROSS_GROUP, RANDOM, choose_pairs, product_pairs

GROUPS = ["left"] * 12 + ["right"] * 44 + [None] * 24


def choose(count=200, strategy=CROSS_GROUP, random_share=0.2, seed=0, groups=GROUPS):
    return choose_pairs(
        groups,
        count=count,
        strategy=strategy,
        random_share=random_share,
        rng=np.random.default_rng(seed),
    )


def uses(pairs) -> Counter[int]:
    return Counter(i for pair in pairs for i in (pair.first, pair.second))


def test_cross_group_pairs_differ_in_group_and_the_rest_is_random():
    pairs = choose()
    assert Counter(pair.reason for pair in pairs) == {CROSS_GROUP: 160, RANDOM: 40}
    assert all(
        GROUPS[pair.first] != GROUPS[pair.second] for pair in pairs if pair.reason == CROSS_GROUP
    )


def test_every_combination_of_groups_comes_equally_often():
    pairs = choose(count=150, random_share=0.0)
    combinations = Counter(frozenset((GROUPS[pair.first], GROUPS[pair.second])) for pair in pairs)
    assert set(combinations.values()) == {50}


def test_trajectories_of_a_group_are_reused_evenly():
    count = uses(choose(count=300, random_share=0.0))
    for group in set(GROUPS):
        of_group = [count[i] for i, name in enumerate(GROUPS) if name == group]
        assert min(of_group) >= 2
        assert max(of_group) - min(of_group) <= 1


def test_random_pairs_reuse_all_trajectories_evenly():
    count = uses(choose(count=200, strategy=RANDOM))
    assert max(count.values()) - min(count[i] for i in range(len(GROUPS))) <= 1


@settings(max_examples=50, deadline=None)
@given(
    groups=st.lists(st.sampled_from(["a", "b", "c", None]), min_size=2, max_size=9),
    share=st.floats(0, 1),
    strategy=st.sampled_from([CROSS_GROUP, RANDOM]),
    data=st.data(),
)
def test_pairs_are_different_and_as_many_as_asked_for(groups, share, strategy, data):
    possible = len(groups) * (len(groups) - 1) // 2
    count = data.draw(st.integers(0, possible))
    pairs = choose(count, strategy, share, groups=groups)
    assert len({frozenset((pair.first, pair.second)) for pair in pairs}) == count


def test_random_pairs_fill_up_when_groups_run_out_of_pairs():
    pairs = choose(count=6, random_share=0.0, groups=["a", "a", "a", "b"])
    assert Counter(pair.reason for pair in pairs) == {CROSS_GROUP: 3, RANDOM: 3}


def test_same_seed_gives_the_same_pairs():
    assert choose(seed=3) == choose(seed=3)
    assert choose(seed=3) != choose(seed=4)


def test_either_trajectory_of_a_pair_may_come_first():
    first_groups = Counter(GROUPS[pair.first] for pair in choose(random_share=0.0))
    assert all(first_groups[group] > 20 for group in ("left", "right", None))


def test_wrong_input_is_named():
    with pytest.raises(UnknownNameError, match="'active'.*'cross_group', 'random'"):
        choose(strategy="active")
    with pytest.raises(ValueOutOfRangeError, match=r"random_share is 1.5.*\[0, 1\]"):
        choose(random_share=1.5)
    with pytest.raises(ValueOutOfRangeError, match="count is 4, but must be 0 … 3"):
        choose(count=4, groups=["a", "b", "c"])


def test_product_is_every_winner_with_every_loser():
    assert product_pairs([0, 1], [5, 6]) == [(0, 5), (0, 6), (1, 5), (1, 6)]


@given(count=st.integers(0, 500), rate=st.floats(0, 1))
def test_exact_flips_have_the_asked_share(count: int, rate: float):
    flips = exact_flips(count, rate, np.random.default_rng(0))
    assert flips.shape == (count,)
    assert abs(int(flips.sum()) - rate * count) <= 0.5


def test_exact_flips_fall_on_different_labels_with_another_seed():
    one = exact_flips(400, 0.3, np.random.default_rng(0))
    other = exact_flips(400, 0.3, np.random.default_rng(1))
    assert one.sum() == other.sum() == 120
    assert (one != other).any()


def test_independent_flips_come_at_about_the_rate():
    flips = independent_flips(10_000, 0.3, np.random.default_rng(0))
    assert flips.mean() == pytest.approx(0.3, abs=0.02)


def test_flip_rate_outside_the_unit_interval_is_refused():
    for flips in (exact_flips, independent_flips):
        with pytest.raises(ValueOutOfRangeError, match=r"flip rate is 1.2.*\[0, 1\]"):
            flips(10, 1.2, np.random.default_rng(0))
