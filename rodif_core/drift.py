"""How far a policy has left the data: the share of visited states off the support.

A state is off the support when its nearest neighbour among demonstration and reference states is
farther than the 99th percentile of held-out demonstration states (normalised observations).
Alignment of 1.0 can hide a policy that left the data; KL on stored states does not see it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from rodif_core.policies.checkpoint import Checkpoint, SupportSet
from rodif_core.policies.normaliser import Normaliser
from rodif_core.trajectory import Trajectory

PERCENTILE = 0.99
VOXEL = 0.03  # edge of the thinning grid, normalised units: well below the threshold it yields
MAX_POINTS = 8192  # kept at most: in 20 dimensions a voxel holds one state, and thins nothing
SLACK = 0.9999  # of squared lengths: far more than single precision rounds away
_CHUNK = 2048  # rows of the distance matrix held at once


def visited_states(trajectories: Sequence[Trajectory], normaliser: Normaliser) -> Tensor:
    """All visited states of the trajectories: (rows, O) normalised observations."""
    rows = np.concatenate([trajectory.observations for trajectory in trajectories])
    return normaliser.observation(torch.from_numpy(rows))


def nearest_distance(points: Tensor, states: Tensor) -> Tensor:
    """Distance of every state (S, O) to its nearest point (P, O) → (S,)."""
    return torch.cat([torch.cdist(chunk, points).amin(1) for chunk in states.split(_CHUNK)])


def fit_support(
    known: Tensor, held_out: Tensor, normaliser: Normaliser | None = None
) -> SupportSet:
    """Thin the known states, so that rare modes count as much as frequent ones: one a voxel, then
    the MAX_POINTS that cover them best. The threshold is that of the thinned set; `normaliser`
    is theirs where it is not the policy's."""
    voxels = torch.floor(known / VOXEL).to(torch.int64)
    _, inverse = torch.unique(voxels, dim=0, return_inverse=True)
    first = torch.full((int(inverse.max()) + 1,), len(known), dtype=torch.int64)
    first.scatter_reduce_(0, inverse, torch.arange(len(known)), reduce="amin")
    points = spread_out(known[first.sort().values], MAX_POINTS)
    distances = nearest_distance(points, held_out)
    return SupportSet(points, float(distances.quantile(PERCENTILE)), normaliser)


def spread_out(points: Tensor, count: int) -> Tensor:
    """At most `count` of the points (P, O), in their order: each next one is the farthest from
    those taken so far (Gonzalez 1985: at most twice the covering radius of the best choice)."""
    if len(points) <= count:
        return points.contiguous()
    taken = torch.zeros(count, dtype=torch.int64)  # the first is row 0
    distances = (points - points[0]).square().sum(1)  # squared, to the nearest of those taken
    nearest = torch.zeros(len(points), dtype=torch.int64)  # which of those that is
    for index in range(1, count):
        taken[index] = distances.argmax()
        newest = points[taken[index]]
        # By the triangle inequality a point that is nearer to its own than half the way from there
        # to the newest is farther from the newest, and need not be looked at.
        ways = (points[taken[:index]] - newest).square().sum(1)
        rows = torch.nonzero(SLACK * ways[nearest] < 4 * distances).squeeze(1)
        fresh = (points[rows] - newest).square().sum(1)
        closer = fresh < distances[rows]
        distances[rows[closer]] = fresh[closer]
        nearest[rows[closer]] = index
    return points[taken.sort().values].contiguous()


def off_support_share(trajectories: Sequence[Trajectory], checkpoint: Checkpoint) -> float:
    """Share of visited states off the checkpoint's support, in 0 … 1."""
    states = visited_states(trajectories, checkpoint.state_normaliser)
    distances = nearest_distance(checkpoint.support.points, states)
    return float((distances > checkpoint.support.threshold).float().mean())
