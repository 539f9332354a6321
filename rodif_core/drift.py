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

from rodif_core.policies.checkpoint import SupportSet
from rodif_core.policies.normaliser import Normaliser
from rodif_core.trajectory import Trajectory

PERCENTILE = 0.99
VOXEL = 0.03  # edge of the thinning grid, normalised units: well below the threshold it yields
_CHUNK = 2048  # rows of the distance matrix held at once


def visited_states(trajectories: Sequence[Trajectory], normaliser: Normaliser) -> Tensor:
    """All visited states of the trajectories: (rows, O) normalised observations."""
    rows = np.concatenate([trajectory.observations for trajectory in trajectories])
    return normaliser.observation(torch.from_numpy(rows))


def nearest_distance(points: Tensor, states: Tensor) -> Tensor:
    """Distance of every state (S, O) to its nearest point (P, O) → (S,)."""
    return torch.cat([torch.cdist(chunk, points).amin(1) for chunk in states.split(_CHUNK)])


def fit_support(known: Tensor, held_out: Tensor) -> SupportSet:
    """Thin the known states to one a voxel, so that rare modes count as much as frequent ones."""
    voxels = torch.floor(known / VOXEL).to(torch.int64)
    _, inverse = torch.unique(voxels, dim=0, return_inverse=True)
    first = torch.full((int(inverse.max()) + 1,), len(known), dtype=torch.int64)
    first.scatter_reduce_(0, inverse, torch.arange(len(known)), reduce="amin")
    points = known[first.sort().values].contiguous()
    distances = nearest_distance(points, held_out)
    return SupportSet(points, float(distances.quantile(PERCENTILE)))


def off_support_share(
    trajectories: Sequence[Trajectory], normaliser: Normaliser, support: SupportSet
) -> float:
    """Share of visited states off the support, in 0 … 1."""
    distances = nearest_distance(support.points, visited_states(trajectories, normaliser))
    return float((distances > support.threshold).float().mean())
