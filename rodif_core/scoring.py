"""One utility per trajectory from noisy labels: the first half of `rodif_guided`.

Flips must be averaged out across trajectories: with sparse pairs a trajectory's own vote share is
hardly better than a coin. Two models share strength between trajectories:

* the network: a few full-batch RoDiF updates on a throw-away copy of the policy; a trajectory's
  utility is its mean log-ratio. Needs no features.
* the Gaussian process: Bradley-Terry utilities with a Gaussian-process prior over the
  end-effector path. Also predicts the utility of paths that nobody has seen.

Legend: R trajectories, M preferences, F features of a path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import LearningError
from rodif_core.preferences.pairs import Preference
from rodif_core.trajectory import Trajectory

Array = NDArray[np.float64]

PATH_POINTS = 16  # points of a path, evenly spaced in time, that make its features
PRIOR_SD = 1.0  # of the utilities, in Bradley-Terry log-odds
JITTER = 1e-6  # on the kernel's diagonal, for the Cholesky factor
NEWTON_STEPS = 50
TOLERANCE = 1e-9  # largest change of a utility that still counts as movement


def path_features(trajectories: Sequence[Trajectory]) -> Array:
    """End-effector paths at PATH_POINTS moments: (R, 3 * PATH_POINTS) in metres."""
    rows = []
    for trajectory in trajectories:
        steps = np.linspace(0, len(trajectory.paths) - 1, PATH_POINTS).round().astype(int)
        rows.append(trajectory.paths[steps].astype(np.float64).ravel())
    return np.stack(rows)


@dataclass(frozen=True, eq=False)
class PathUtility:
    """Posterior mode of Bradley-Terry utilities under a Gaussian-process prior on paths.

    features (R, F) of the labelled trajectories; utilities (R,); weights (R,) = K⁻¹ utilities.
    """

    features: Array
    length_scale: float
    utilities: Array
    weights: Array

    @classmethod
    def fit(cls, features: Array, preferences: Sequence[Preference]) -> PathUtility:
        """Newton's method on the concave log-posterior; deterministic.

        The length scale is the median distance between paths. Raises LearningError without
        preferences.
        """
        if not preferences:
            raise LearningError("no label prefers one trajectory over another; label some pairs")
        distances = _distances(features, features)
        positive = distances[distances > 0]
        length_scale = float(np.median(positive)) if len(positive) else 1.0
        count = len(features)
        kernel = _kernel(distances, length_scale) + JITTER * np.eye(count)
        precision = np.linalg.inv(kernel)
        design = np.zeros((len(preferences), count))
        rows = np.arange(len(preferences))
        design[rows, [p.winner for p in preferences]] = 1.0
        design[rows, [p.loser for p in preferences]] = -1.0
        utilities = np.zeros(count)
        for _ in range(NEWTON_STEPS):
            chance = 1 / (1 + np.exp(-(design @ utilities)))
            gradient = design.T @ (1 - chance) - precision @ utilities
            hessian = design.T @ (design * (chance * (1 - chance))[:, None]) + precision
            step = np.linalg.solve(hessian, gradient)
            utilities = utilities + step
            if np.abs(step).max() < TOLERANCE:
                break
        return cls(features, length_scale, utilities, precision @ utilities)

    def predict(self, features: Array) -> Array:
        """Posterior-mode utility of other paths: (R', F) → (R',)."""
        kernel = _kernel(_distances(features, self.features), self.length_scale)
        predicted: Array = kernel @ self.weights
        return predicted


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


def _distances(a: Array, b: Array) -> Array:
    result: Array = np.sqrt(((a[:, None] - b[None]) ** 2).sum(-1))
    return result


def _kernel(distances: Array, length_scale: float) -> Array:
    result: Array = PRIOR_SD**2 * np.exp(-0.5 * (distances / length_scale) ** 2)
    return result
