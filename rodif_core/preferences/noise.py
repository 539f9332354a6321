"""How noisy the labels are, from the labels alone; gives the conservativeness γ of a round.

Two estimates of the share of labels that contradict the annotators' common criterion:

* `bradley_terry`: one utility per trajectory. Annotator a, shown trajectory l on the left and r
  on the right, chooses left with probability

      P = k_a σ(u_l - u_r) + (1 - k_a) σ(b_a)

  k_a is the annotator's skill, σ(b_a) the share of left choices when not looking: the noisy
  Bradley-Terry model. Works with one label a pair because trajectories are reused. A plain fit
  believes its own overfitted utilities when labels are few, so the rate is averaged over the
  Gaussian (Laplace) posterior of the utilities, and over a grid of prior scales and prior skills
  weighted by their evidence.
* `overlap`: one-coin Dawid-Skene (1979) on pairs that several annotators labelled.

γ = largest available estimate + margin, below 0.5. `equal` answers carry no direction: they are
counted, not used. Simulated ground truth never enters here.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError

Array = NDArray[np.float64]

CHOICES = ("first", "second", "equal")
HIGHEST = 0.48  # γ stays below 0.5, where the paper's outer gate would be shut from the start
WITHOUT_ESTIMATE = 0.45  # γ when labels are too few; the paper's choice for its harder tasks
FEWEST_LABELS = 20  # decisive labels under which no estimate is made
FEW_PER_TRAJECTORY = 3.0  # decisive labels per trajectory under which the margin is doubled
FEWEST_OVERLAPS = 15  # pairs with two or more annotators under which overlap is not used

# Grids of the hyper-parameters: prior sd of the utilities, prior error rate (1 - skill) / 2.
_UTILITY_SDS = (0.75, 1.5, 3.0, 6.0)
_ERROR_RATES = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45)
_SKILL_SD = 0.5  # of logit skill around its prior mean: annotators resemble each other …
_BIAS_SD = 1.0  # … and rarely click one side only
# Five-point Gauss-Hermite rule for a standard normal: nodes and weights.
_NODES = np.array([-2.85697, -1.355626, 0.0, 1.355626, 2.85697])
_WEIGHTS = np.array([0.011257, 0.222076, 0.533334, 0.222076, 0.011257])


@dataclass(frozen=True)
class Comparison:
    """One label as the estimate sees it: trajectories and annotators are only names here."""

    first: int
    second: int
    choice: str  # one of CHOICES
    annotator: int
    first_was_left: bool

    def __post_init__(self) -> None:
        if self.choice not in CHOICES:
            raise UnknownNameError("choice", self.choice, CHOICES)
        if self.first == self.second:
            raise ValueOutOfRangeError("second", self.second, "another trajectory than first")


@dataclass(frozen=True)
class AnnotatorNoise:
    """What the Bradley-Terry fit says about one annotator; rates in [0, 1]."""

    annotator: int
    labels: int  # decisive ones
    skill: float  # share of answers that look at the trajectories
    left_bias: float  # share of left choices among the other answers
    error_rate: float  # expected share of contradictions, lapses of attention and coin flips


@dataclass(frozen=True)
class NoiseEstimate:
    """γ with its derivation; all rates in [0, 1]."""

    conservativeness: float  # γ
    estimates: dict[str, float]  # corruption rate by method, without margin; {} when too few labels
    margin: float  # what was added to the largest estimate
    labels: int  # all comparisons, `equal` included
    decisive: int
    trajectories: int  # that appear in decisive labels
    labels_per_trajectory: float  # decisive labels each trajectory takes part in, on average
    annotators: tuple[AnnotatorNoise, ...]
    suspicious: tuple[float, ...]  # per comparison: probability that it is corrupted (equal: 0)
    notes: tuple[str, ...]  # the derivation in sentences

    def to_json(self) -> dict[str, Any]:
        """Plain JSON types, as stored with a round (per-label probabilities left out)."""
        return {
            "conservativeness": self.conservativeness,
            "estimates": dict(self.estimates),
            "margin": self.margin,
            "labels": self.labels,
            "decisive": self.decisive,
            "trajectories": self.trajectories,
            "labels_per_trajectory": self.labels_per_trajectory,
            "annotators": [vars(item).copy() for item in self.annotators],
            "notes": list(self.notes),
        }


def estimate_noise(comparisons: Sequence[Comparison], *, margin: float = 0.05) -> NoiseEstimate:
    """Estimate the corruption rate and γ; deterministic, and blind to how things are numbered.

    margin: added to the largest estimate (the paper: γ should "match or slightly surpass" the
    true rate); doubled when there are few labels per trajectory. Raises ValueOutOfRangeError
    unless it is in [0, 0.5).
    """
    if not 0 <= margin < 0.5:
        raise ValueOutOfRangeError("margin", margin, "in [0, 0.5)")
    decisive = [item for item in comparisons if item.choice != "equal"]
    names = {item.first for item in decisive} | {item.second for item in decisive}
    per_trajectory = 2 * len(decisive) / len(names) if names else 0.0
    notes = [
        f"{len(decisive)} decisive labels of {len(comparisons)} on {len(names)} trajectories,"
        f" {per_trajectory:.1f} labels per trajectory"
    ]
    estimates: dict[str, float] = {}
    annotators: tuple[AnnotatorNoise, ...] = ()
    suspicious = np.zeros(len(comparisons))
    if len(decisive) < FEWEST_LABELS:
        gamma = WITHOUT_ESTIMATE
        notes.append(
            f"fewer than {FEWEST_LABELS} decisive labels: no estimate, γ = {gamma} to be safe"
        )
    else:
        fitted = _bradley_terry(decisive)
        estimates["bradley_terry"] = fitted.rate
        annotators = fitted.annotators
        suspicious[[item.choice != "equal" for item in comparisons]] = fitted.contradiction
        notes.append(f"noisy Bradley-Terry over trajectories: {fitted.rate:.3f}")
        overlap = _dawid_skene(decisive)
        if overlap is not None:
            estimates["overlap"] = overlap[0]
            notes.append(f"Dawid-Skene on {overlap[1]} shared pairs: {overlap[0]:.3f}")
        if per_trajectory < FEW_PER_TRAJECTORY:
            margin *= 2
            notes.append(
                f"under {FEW_PER_TRAJECTORY:g} labels per trajectory the fit is weak:"
                " the margin is doubled"
            )
        gamma = min(max(estimates.values()) + margin, HIGHEST)
        notes.append(f"γ = largest estimate + {margin:g}, at most {HIGHEST}: {gamma:.3f}")
    return NoiseEstimate(
        conservativeness=float(gamma),
        estimates=estimates,
        margin=margin,
        labels=len(comparisons),
        decisive=len(decisive),
        trajectories=len(names),
        labels_per_trajectory=per_trajectory,
        annotators=annotators,
        suspicious=tuple(float(p) for p in suspicious),
        notes=tuple(notes),
    )


def _sigmoid(x: Array) -> Array:
    return np.asarray(0.5 * (1.0 + np.tanh(x / 2.0)))


def _logit(p: float) -> float:
    return math.log(p / (1 - p))


@dataclass(frozen=True)
class _Problem:
    """Decisive labels as arrays; the parameters are [utilities n, logit skills A, biases A]."""

    left: NDArray[np.intp]  # (N,) trajectory on the left
    right: NDArray[np.intp]  # (N,)
    annotator: NDArray[np.intp]  # (N,)
    chose_left: NDArray[np.bool_]  # (N,)
    trajectories: int  # n
    annotators: int  # A

    def probabilities(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """σ(u_l - u_r), skill, σ(bias), P(left), each (N,)."""
        n, a = self.trajectories, self.annotators
        preferred = _sigmoid(x[self.left] - x[self.right])
        skill = _sigmoid(x[n + self.annotator])
        habit = _sigmoid(x[n + a + self.annotator])
        p = np.clip(skill * preferred + (1 - skill) * habit, 1e-9, 1 - 1e-9)
        return preferred, skill, habit, p

    def jacobian(self, x: Array) -> tuple[NDArray[np.intp], Array]:
        """Columns (N, 4) and values (N, 4) of dP(left)/dx; all other entries are zero."""
        n, a = self.trajectories, self.annotators
        preferred, skill, habit, _ = self.probabilities(x)
        slope = skill * preferred * (1 - preferred)
        columns = np.stack(
            [self.left, self.right, n + self.annotator, n + a + self.annotator], axis=1
        )
        values = np.stack(
            [
                slope,
                -slope,
                (preferred - habit) * skill * (1 - skill),
                (1 - skill) * habit * (1 - habit),
            ],
            axis=1,
        )
        return columns, values


@dataclass(frozen=True)
class _Prior:
    """Independent normal priors on the parameters."""

    mean: Array
    precision: Array

    @classmethod
    def of(cls, problem: _Problem, utility_sd: float, error_rate: float) -> _Prior:
        n, a = problem.trajectories, problem.annotators
        mean = np.zeros(n + 2 * a)
        mean[n : n + a] = _logit(1 - 2 * error_rate)
        sds = np.concatenate([np.full(n, utility_sd), np.full(a, _SKILL_SD), np.full(a, _BIAS_SD)])
        return cls(mean, sds**-2)


def negative_log_posterior(problem: _Problem, prior: _Prior, x: Array) -> float:
    """Up to a constant; what `_fit` minimises."""
    p = problem.probabilities(x)[3]
    likelihood = np.log(np.where(problem.chose_left, p, 1 - p)).sum()
    return float(-likelihood + 0.5 * (prior.precision * (x - prior.mean) ** 2).sum())


def gradient_and_information(problem: _Problem, prior: _Prior, x: Array) -> tuple[Array, Array]:
    """Gradient (D,) of `negative_log_posterior` and its expected Hessian (D, D)."""
    p = problem.probabilities(x)[3]
    columns, values = problem.jacobian(x)
    weight = 1 / (p * (1 - p))
    gradient = prior.precision * (x - prior.mean)
    np.add.at(gradient, columns, values * ((p - problem.chose_left) * weight)[:, None])
    information = np.diag(prior.precision)
    outer = values[:, :, None] * values[:, None, :] * weight[:, None, None]
    np.add.at(information, (columns[:, :, None], columns[:, None, :]), outer)
    return gradient, information


def _fit(problem: _Problem, prior: _Prior, start: Array) -> tuple[Array, Array, float]:
    """Mode, information (D, D) there and Laplace log evidence; damped Fisher scoring."""
    x, damping = start.copy(), 1e-3
    value = negative_log_posterior(problem, prior, x)
    gradient, information = gradient_and_information(problem, prior, x)
    for _ in range(100):
        scale = np.diag(np.diag(information))
        step = np.linalg.solve(information + damping * scale, gradient)
        tried = negative_log_posterior(problem, prior, x - step)
        if tried > value:
            damping *= 4
            if damping > 1e8:
                break
            continue
        settled = value - tried < 1e-9 * (1 + abs(value))
        x, value, damping = x - step, tried, max(damping / 3, 1e-6)
        gradient, information = gradient_and_information(problem, prior, x)
        if settled:
            break
    evidence = (
        -value + 0.5 * np.log(prior.precision).sum() - 0.5 * np.linalg.slogdet(information)[1]
    )
    return x, information, float(evidence)


def _contradiction(problem: _Problem, x: Array, information: Array, *, posterior: bool) -> Array:
    """(N,) probability that a label contradicts the true order of its two trajectories.

    The order is uncertain: u_l - u_r is normal around the fit with the Laplace variance.
    posterior=False: for a label still to come; True: for the label that was given.
    """
    n, a = problem.trajectories, problem.annotators
    covariance = np.linalg.inv(information)
    left, right = problem.left, problem.right
    variance = covariance[left, left] + covariance[right, right] - 2 * covariance[left, right]
    spread = np.sqrt(np.maximum(variance, 0.0))
    difference = (x[left] - x[right])[:, None] + spread[:, None] * _NODES
    skill = _sigmoid(x[n + problem.annotator])[:, None]
    habit = _sigmoid(x[n + a + problem.annotator])[:, None]
    p_left = skill * _sigmoid(difference) + (1 - skill) * habit
    left_better = 0.5 + 0.5 * np.sign(difference)
    if not posterior:
        wrong = left_better * (1 - p_left) + (1 - left_better) * p_left
        return np.asarray(wrong @ _WEIGHTS)
    # The utilities were fitted to this very label, so its own side of the order is favoured
    # already: what counts is the share of the remaining order it goes against.
    against = np.where(problem.chose_left[:, None], 1 - left_better, left_better)
    return np.asarray(against @ _WEIGHTS)


@dataclass(frozen=True)
class _BradleyTerry:
    rate: float
    contradiction: Array  # (N,)
    annotators: tuple[AnnotatorNoise, ...]


def _index(names: Sequence[Hashable]) -> dict[Hashable, int]:
    return {name: i for i, name in enumerate(dict.fromkeys(names))}


def as_problem(decisive: Sequence[Comparison]) -> tuple[_Problem, list[int]]:
    """Arrays for the fit, and the annotators' names in their order there."""
    lefts = [c.first if c.first_was_left else c.second for c in decisive]
    rights = [c.second if c.first_was_left else c.first for c in decisive]
    trajectory = _index([*lefts, *rights])
    names = list(dict.fromkeys(c.annotator for c in decisive))
    annotator = _index(names)
    problem = _Problem(
        left=np.array([trajectory[name] for name in lefts]),
        right=np.array([trajectory[name] for name in rights]),
        annotator=np.array([annotator[c.annotator] for c in decisive]),
        chose_left=np.array([(c.choice == "first") == c.first_was_left for c in decisive]),
        trajectories=len(trajectory),
        annotators=len(names),
    )
    return problem, names


def _bradley_terry(decisive: Sequence[Comparison]) -> _BradleyTerry:
    """Fit every point of the hyper-parameter grid and average by evidence."""
    problem, names = as_problem(decisive)
    n, a = problem.trajectories, problem.annotators
    evidences, expected, given, skills, habits = [], [], [], [], []
    for utility_sd in _UTILITY_SDS:
        start = None
        for error_rate in _ERROR_RATES:
            prior = _Prior.of(problem, utility_sd, error_rate)
            # Skill and utilities trade off: the neighbour's fit is a good start on the way from
            # a confident prior, which keeps the likelihood nearly concave, to a doubting one.
            x, information, evidence = _fit(problem, prior, prior.mean if start is None else start)
            start = x
            evidences.append(evidence)
            expected.append(_contradiction(problem, x, information, posterior=False))
            given.append(_contradiction(problem, x, information, posterior=True))
            skills.append(_sigmoid(x[n : n + a]))
            habits.append(_sigmoid(x[n + a :]))
    weight = np.exp(np.array(evidences) - max(evidences))
    weight /= weight.sum()
    wrong = weight @ np.array(expected)
    skill, habit = weight @ np.array(skills), weight @ np.array(habits)
    counts = np.bincount(problem.annotator, minlength=a)
    errors = np.bincount(problem.annotator, weights=wrong, minlength=a) / counts
    people = tuple(
        AnnotatorNoise(
            annotator=names[i],
            labels=int(counts[i]),
            skill=float(skill[i]),
            left_bias=float(habit[i]),
            error_rate=float(errors[i]),
        )
        for i in sorted(range(a), key=lambda i: names[i])
    )
    return _BradleyTerry(float(wrong.mean()), weight @ np.array(given), people)


def _dawid_skene(decisive: Sequence[Comparison]) -> tuple[float, int] | None:
    """(corruption rate, shared pairs) by one-coin Dawid-Skene EM; None when too few are shared.

    Each annotator errs on their own with one accuracy; a Beta(4, 2) prior keeps people with few
    shared labels near the others. The truth of a shared pair is a fair coin before the labels.
    """
    shared: dict[tuple[int, int], list[tuple[int, float]]] = defaultdict(list)
    for item in decisive:
        low, high = sorted((item.first, item.second))
        says_low = (item.choice == "first") == (item.first == low)
        shared[low, high].append((item.annotator, 1.0 if says_low else -1.0))
    pairs = [votes for votes in shared.values() if len({who for who, _ in votes}) >= 2]
    if len(pairs) < FEWEST_OVERLAPS:
        return None
    people = _index([who for votes in pairs for who, _ in votes])
    pair = np.array([i for i, votes in enumerate(pairs) for _ in votes])
    who = np.array([people[name] for votes in pairs for name, _ in votes])
    vote = np.array([v for votes in pairs for _, v in votes])
    accuracy = np.full(len(people), 0.75)
    agrees = np.full(len(vote), 0.5)
    for _ in range(500):
        log_odds = np.log(accuracy / (1 - accuracy))
        support = np.bincount(pair, weights=vote * log_odds[who]).astype(np.float64)
        low_better = _sigmoid(support)[pair]
        agrees = np.where(vote > 0, low_better, 1 - low_better)
        updated = (np.bincount(who, weights=agrees) + 3) / (np.bincount(who) + 4)
        moved = float(np.abs(updated - accuracy).max())
        accuracy = updated
        if moved < 1e-8:
            break
    return float(1 - agrees.mean()), len(pairs)
