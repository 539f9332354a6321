"""The noise estimate: its gradient, and what it finds in labels whose noise is known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.preferences import noise
from rodif_core.preferences.corruption import exact_flips
from rodif_core.preferences.noise import Comparison, estimate_noise
from rodif_core.preferences.pairs import product_pairs

WINNERS, LOSERS = range(20), range(20, 40)


def labelled(pairs: list[tuple[int, int]], rate: float, rng: np.random.Generator, annotators=5):
    """(winner, loser) pairs as shown on random sides, an exact share answered the wrong way."""
    flips = exact_flips(len(pairs), rate, rng)
    comparisons = []
    for (winner, loser), flip in zip(pairs, flips, strict=True):
        winner_first = bool(rng.random() < 0.5)
        comparisons.append(
            Comparison(
                first=winner if winner_first else loser,
                second=loser if winner_first else winner,
                choice="first" if winner_first != flip else "second",
                annotator=int(rng.integers(annotators)),
                first_was_left=bool(rng.random() < 0.5),
            )
        )
    return comparisons, flips


def sparse(rng: np.random.Generator, count: int) -> list[tuple[int, int]]:
    product = product_pairs(WINNERS, LOSERS)
    return [product[i] for i in rng.permutation(len(product))[:count]]


def test_gradient_agrees_with_finite_differences():
    rng = np.random.default_rng(0)
    problem, _ = noise.as_problem(labelled(sparse(rng, 40), 0.3, rng)[0])
    prior = noise._Prior.of(problem, 1.5, 0.2)
    x = rng.normal(size=problem.trajectories + 2 * problem.annotators)
    gradient, _ = noise.gradient_and_information(problem, prior, x)
    for i in range(len(x)):
        step = np.zeros_like(x)
        step[i] = 1e-5
        slope = (
            noise.negative_log_posterior(problem, prior, x + step)
            - noise.negative_log_posterior(problem, prior, x - step)
        ) / 2e-5
        assert gradient[i] == pytest.approx(slope, rel=1e-5, abs=1e-6)


def test_information_is_the_expected_outer_product_of_the_score():
    # Worked by hand: one label, u = 0, skill 1/2, no habit: P = 1/2, dP/du_l = 1/2 * 1/4 = 1/8,
    # information of u_l = (1/8)^2 / (1/2 * 1/2) + 1 / 2^2 = 1/16 + 1/4.
    comparison = Comparison(3, 7, "first", annotator=0, first_was_left=True)
    problem, _ = noise.as_problem([comparison])
    prior = noise._Prior.of(problem, 2.0, 0.25)
    _, information = noise.gradient_and_information(problem, prior, np.zeros(4))
    assert information[0, 0] == pytest.approx(1 / 16 + 1 / 4)
    assert information[0, 1] == pytest.approx(-1 / 16)


@pytest.mark.parametrize("rate", [0.0, 0.2, 0.3, 0.4])
def test_product_design_gives_the_true_rate_within_five_points(rate: float):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        comparisons, _ = labelled(product_pairs(WINNERS, LOSERS), rate, rng)
        estimate = estimate_noise(comparisons)
        assert estimate.estimates["bradley_terry"] == pytest.approx(rate, abs=0.05)
        assert rate <= estimate.conservativeness <= rate + 0.1


@pytest.mark.parametrize("rate", [0.0, 0.2, 0.3, 0.4])
def test_sixty_sparse_labels_give_the_true_rate_within_ten_points(rate: float):
    gammas = []
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        estimate = estimate_noise(labelled(sparse(rng, 60), rate, rng)[0])
        assert estimate.estimates["bradley_terry"] == pytest.approx(rate, abs=0.1)
        gammas.append(estimate.conservativeness)
    assert sum(gamma >= rate for gamma in gammas) >= 5
    assert max(gammas) < 0.5


def test_suspicious_labels_are_the_flipped_ones():
    rng = np.random.default_rng(5)
    comparisons, flips = labelled(product_pairs(WINNERS, LOSERS), 0.2, rng)
    suspicious = np.array(estimate_noise(comparisons).suspicious)
    # Probability that a flipped label is more suspicious than a good one (area under the ROC).
    better = (suspicious[flips][:, None] > suspicious[~flips][None, :]).mean()
    assert better > 0.9


def test_left_clicker_is_found_among_careful_annotators():
    rng = np.random.default_rng(3)
    comparisons, _ = labelled(sparse(rng, 250), 0.05, rng)
    lazy = [
        replace(c, choice="first" if c.first_was_left else "second")
        if c.annotator == 2 and rng.random() < 0.8
        else c
        for c in comparisons
    ]
    people = {item.annotator: item for item in estimate_noise(lazy).annotators}
    careful = [item for name, item in people.items() if name != 2]
    assert people[2].skill < min(item.skill for item in careful) - 0.1
    assert people[2].left_bias > max(item.left_bias for item in careful) + 0.1
    assert people[2].error_rate > max(item.error_rate for item in careful)


def test_estimate_does_not_depend_on_order_or_numbering():
    rng = np.random.default_rng(4)
    comparisons, _ = labelled(sparse(rng, 80), 0.3, rng)
    renumbered = [
        replace(c, first=900 - 7 * c.first, second=900 - 7 * c.second, annotator=50 - c.annotator)
        for c in comparisons
    ]
    shuffled = [renumbered[i] for i in rng.permutation(len(renumbered))]
    plain, other = estimate_noise(comparisons), estimate_noise(shuffled)
    assert other.conservativeness == pytest.approx(plain.conservativeness, abs=1e-4)
    assert [a.skill for a in reversed(other.annotators)] == pytest.approx(
        [a.skill for a in plain.annotators], abs=1e-4
    )


def test_swapping_first_and_second_changes_nothing():
    rng = np.random.default_rng(6)
    comparisons, _ = labelled(sparse(rng, 80), 0.2, rng)
    swapped = [
        replace(
            c,
            first=c.second,
            second=c.first,
            choice="second" if c.choice == "first" else "first",
            first_was_left=not c.first_was_left,
        )
        for c in comparisons
    ]
    assert estimate_noise(swapped) == estimate_noise(comparisons)


def test_equal_answers_are_counted_but_say_nothing_about_the_rate():
    rng = np.random.default_rng(7)
    comparisons, _ = labelled(sparse(rng, 60), 0.2, rng)
    ties = [Comparison(i, i + 1, "equal", 0, True) for i in range(30)]
    plain, mixed = estimate_noise(comparisons), estimate_noise(comparisons + ties)
    assert mixed.labels == 90 and mixed.decisive == 60
    assert mixed.conservativeness == plain.conservativeness
    assert mixed.suspicious[60:] == (0.0,) * 30


def test_overlap_tells_the_rate_from_shared_pairs():
    rng = np.random.default_rng(8)
    comparisons = []
    for annotator in range(4):
        more, _ = labelled(product_pairs(WINNERS, LOSERS)[::3], 0.2, rng)
        comparisons += [replace(c, annotator=annotator) for c in more]
    estimate = estimate_noise(comparisons)
    assert estimate.estimates["overlap"] == pytest.approx(0.2, abs=0.04)
    assert estimate.conservativeness == pytest.approx(max(estimate.estimates.values()) + 0.05)


def test_too_few_labels_give_a_safe_value_and_say_so():
    rng = np.random.default_rng(9)
    estimate = estimate_noise(labelled(sparse(rng, 19), 0.0, rng)[0])
    assert estimate.estimates == {}
    assert estimate.conservativeness == noise.WITHOUT_ESTIMATE
    assert any("fewer than 20" in note for note in estimate.notes)
    assert estimate_noise([]).conservativeness == noise.WITHOUT_ESTIMATE


def test_margin_doubles_when_trajectories_are_hardly_reused():
    pairs = [(2 * i, 2 * i + 1) for i in range(40)]
    estimate = estimate_noise(labelled(pairs, 0.2, np.random.default_rng(10))[0])
    assert estimate.labels_per_trajectory == 1.0
    assert estimate.margin == pytest.approx(0.1)
    assert any("doubled" in note for note in estimate.notes)


def test_json_form_is_plain_and_complete():
    rng = np.random.default_rng(11)
    estimate = estimate_noise(labelled(sparse(rng, 60), 0.2, rng)[0])
    stored = json.loads(json.dumps(estimate.to_json()))
    assert stored["conservativeness"] == estimate.conservativeness
    assert len(stored["annotators"]) == 5 and stored["notes"]


def test_wrong_input_is_named():
    with pytest.raises(UnknownNameError, match="'left'.*'first', 'second', 'equal'"):
        Comparison(0, 1, "left", 0, True)
    with pytest.raises(ValueOutOfRangeError, match="another trajectory"):
        Comparison(1, 1, "first", 0, True)
    with pytest.raises(ValueOutOfRangeError, match=r"margin is 0.5"):
        estimate_noise([], margin=0.5)
