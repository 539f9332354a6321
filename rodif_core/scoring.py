"""One utility per trajectory from noisy labels: the first half of `rodif_guided`.

Flips must be averaged out across trajectories: with sparse pairs a trajectory's own vote share is
hardly better than a coin. Two models share strength between trajectories:

* the network: a few full-batch RoDiF updates on a throw-away copy of the policy; a trajectory's
  utility is its mean log-ratio. Needs no features.
* the Gaussian process: Bradley-Terry utilities with a Gaussian-process prior over the paths of
  the end effector and the objects, and the outcome. Learns from answers "equal" too, and predicts
  the utility of trajectories that nobody has seen.

Legend: R trajectories, M preferences, B movable objects, P points of a trajectory: of the end
effector's path and of every object's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import LearningError
from rodif_core.preferences.pairs import Preference, Tie
from rodif_core.tasks.base import Task
from rodif_core.trajectory import Trajectory

Array = NDArray[np.float64]

PATH_POINTS = 16  # of one path, evenly spaced along the end effector's; P = 16 (1 + B)
PRIOR_SD = 0.5  # of the utilities within one outcome, in Bradley-Terry log-odds
OUTCOME_VARIANCE = 0.5  # of the common utility of successes (or failures), in units of PRIOR_SD²
SCALE_FACTOR = 2.0  # length scale of each point's kernel, in median distances of that point
# Posterior standard deviations that part two clusters of utilities; less is what chance leaves
# among equals. On rollouts of Avoid and Pushing, 12 draws of labels each: two modes under 40 %
# flips and 60 labels lie 0.6 to 1.9 apart, under 30 % more than 1.1; runs of one mode that people
# call equal 0.1 to 0.7, and up to 1.1 where nobody was asked about two of them.
SEPARATED = 0.6
TIE_SD = 0.4  # of the difference of two utilities that people call equal, in log-odds
JITTER = 1e-6  # on the kernel's diagonal, for its inverse
NEWTON_STEPS = 50
TOLERANCE = 1e-9  # largest change of a utility that still counts as movement


@dataclass(frozen=True, eq=False)
class PathFeatures:
    """What the Gaussian process sees: points (R, P, 3) in metres, success (R,) bool."""

    points: Array
    success: NDArray[np.bool_]

    @classmethod
    def of(cls, trajectories: Sequence[Trajectory], task: Task) -> PathFeatures:
        """The end effector and the objects of `task` at PATH_POINTS moments, evenly spaced along
        the length of the end effector's path."""
        rows = []
        for trajectory in trajectories:
            path = trajectory.paths.astype(np.float64)
            length = np.concatenate([[0], np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()])
            places = np.linspace(0, length[-1], PATH_POINTS)
            moments = np.searchsorted(length, places).clip(max=len(path) - 1)
            objects = task.object_poses(trajectory.qpos[moments])[..., :3].astype(np.float64)
            rows.append(np.concatenate([path[moments], *objects.transpose(1, 0, 2)]))
        return cls(np.stack(rows), np.array([trajectory.success for trajectory in trajectories]))


@dataclass(frozen=True, eq=False)
class PathUtility:
    """Posterior mode of Bradley-Terry utilities under a Gaussian-process prior.

    The kernel adds up over the points, so that a criterion about one stretch of one path is
    learned from few labels, and it joins successes with successes and failures with failures
    only: what makes a good run good says little about a failed one.

    scales (P,) metres; utilities (R,); weights (R,) = K⁻¹ utilities; covariance (R, R) of the
    utilities' posterior, Laplace's approximation.
    """

    features: PathFeatures
    scales: Array
    utilities: Array
    weights: Array
    covariance: Array

    @classmethod
    def fit(
        cls,
        features: PathFeatures,
        preferences: Sequence[Preference],
        ties: Sequence[Tie] = (),
    ) -> PathUtility:
        """Newton's method on the concave log-posterior; deterministic.

        A tie says that two utilities differ by no more than about TIE_SD. With several modes most
        answers can be ties, and they alone tell that a mode nobody has compared with the preferred
        one is as far from it as those that were.

        Raises LearningError without preferences.
        """
        if not preferences:
            raise LearningError("no label prefers one trajectory over another; label some pairs")
        scales = SCALE_FACTOR * _median_distances(features.points)
        count = len(features.points)
        kernel = _kernel(features, features, scales) + JITTER * np.eye(count)
        precision = np.linalg.inv(kernel)
        design = _differences(preferences, count)
        tied = _differences(ties, count)
        # Both are quadratic in the utilities, and act on them as one prior.
        confidence = precision + tied.T @ tied / TIE_SD**2
        utilities = np.zeros(count)
        hessian = confidence
        for _ in range(NEWTON_STEPS):
            chance = 1 / (1 + np.exp(-(design @ utilities)))
            gradient = design.T @ (1 - chance) - confidence @ utilities
            hessian = design.T @ (design * (chance * (1 - chance))[:, None]) + confidence
            step = np.linalg.solve(hessian, gradient)
            utilities = utilities + step
            if np.abs(step).max() < TOLERANCE:
                break
        covariance = np.asarray(np.linalg.inv(hessian), dtype=np.float64)
        return cls(features, scales, utilities, precision @ utilities, covariance)

    def predict(self, features: PathFeatures) -> Array:
        """Posterior-mode utility of other paths → (R',)."""
        predicted: Array = _kernel(features, self.features, self.scales) @ self.weights
        return predicted

    def cut(self, eligible: NDArray[np.bool_]) -> float:
        """The utility above which an eligible trajectory (mask (R,)) is one to imitate.

        Where the labels part the eligible ones, that is between the two clusters. Where they do
        not, as among runs that all go the wanted way, it lies below them all by what people call
        equal. Raises LearningError when all their utilities are equal.
        """
        values = self.utilities[eligible]
        cut = split_threshold(values)
        high, low = eligible & (self.utilities > cut), eligible & (self.utilities <= cut)
        contrast = high / high.sum() - low / low.sum()
        distance = float(contrast @ self.utilities)
        if distance < SEPARATED * float(np.sqrt(contrast @ self.covariance @ contrast)):
            return float(values.min()) - TIE_SD
        return cut


def _differences(labels: Sequence[Preference | Tie], count: int) -> Array:
    """(M, count); times utilities, each row is the first trajectory's less the second's."""
    rows = np.zeros((len(labels), count))
    for row, label in zip(rows, labels, strict=True):
        first, second = label.pair
        row[first], row[second] = 1.0, -1.0
    return rows


def standardise(scores: Array) -> Array:
    """Zero mean, unit standard deviation; all zeros when the scores do not differ."""
    spread = float(scores.std())
    return (scores - scores.mean()) / spread if spread > 0 else np.zeros_like(scores)


def split_threshold(scores: Array) -> float:
    """The cut that splits the scores best into a high and a low cluster (exact 1-D 2-means).

    Unlike the mean, it does not depend on how many trajectories are good. Returns the midpoint
    between the two neighbouring scores; raises LearningError when all scores are equal.
    """
    ordered = np.sort(scores)
    if ordered[0] == ordered[-1]:
        raise LearningError("the labels do not separate the trajectories: all scores are equal")
    best, cut = np.inf, 0.0
    for i in range(1, len(ordered)):
        low, high = ordered[:i], ordered[i:]
        scatter = low.var() * len(low) + high.var() * len(high)
        if scatter < best and low[-1] < high[0]:
            best, cut = scatter, float(low[-1] + high[0]) / 2
    return cut


def _median_distances(points: Array) -> Array:
    """Median distance between two different trajectories at each point (P,), in metres."""
    medians = []
    for place in points.transpose(1, 0, 2):
        distances = np.linalg.norm(place[:, None] - place[None], axis=-1)
        positive = distances[distances > 0]
        medians.append(np.median(positive) if len(positive) else 1.0)
    return np.array(medians)


def _kernel(a: PathFeatures, b: PathFeatures, scales: Array) -> Array:
    """(R, R') covariance; point by point, as all at once would take gigabytes at R = 1,000."""
    alike = np.zeros((len(a.points), len(b.points)))
    for place, scale in enumerate(scales):
        squared = ((a.points[:, None, place] - b.points[None, :, place]) ** 2).sum(-1)
        alike += np.exp(-0.5 * squared / scale**2)
    same_outcome = a.success[:, None] == b.success[None]
    result: Array = PRIOR_SD**2 * same_outcome * (alike / len(scales) + OUTCOME_VARIANCE)
    return result
