"""From what the cameras' keypoints are to the numbers of the state that they show.

Legend: P proprioception dims, F features, T told dims, the rest of the task's observation.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rodif_core.policies.normaliser import Normaliser

WIDTH = 128  # hidden units


class Telling(nn.Module):
    """Two layers from proprioception and features to what is told, all of it normalised.

    The scale of the task's observations (P + T,) is kept beside the weights, so that `forward` can
    read and tell in task units.
    """

    centre: Tensor
    scale: Tensor

    def __init__(self, felt: int, features: int, told: int) -> None:
        super().__init__()
        self.felt = felt
        self.layers = nn.Sequential(
            nn.Linear(felt + features, WIDTH), nn.ReLU(), nn.Linear(WIDTH, told)
        )
        self.register_buffer("centre", torch.zeros(felt + told))
        self.register_buffer("scale", torch.ones(felt + told))

    def keep_scale(self, states: Normaliser) -> None:
        """Read and tell in the units of these observations from now on."""
        self.centre.copy_(states.observation_centre)
        self.scale.copy_(states.observation_scale)

    def kept_scale(self) -> Normaliser:
        """That of the observations; there are no actions in it."""
        none = torch.zeros(0)
        return Normaliser(self.centre, self.scale, none, none)

    def normalised(self, felt: Tensor, features: Tensor) -> Tensor:
        """(…, P) normalised and (…, F) → (…, T) normalised."""
        told: Tensor = self.layers(torch.cat([felt, features], dim=-1))
        return told

    def forward(self, felt: Tensor, features: Tensor) -> Tensor:
        """(…, P) in task units and (…, F) → (…, T) in task units."""
        own = slice(None, self.felt)
        told = self.normalised((felt - self.centre[own]) / self.scale[own], features)
        return told * self.scale[self.felt :] + self.centre[self.felt :]
