"""The denoising step as a vector; shared by all denoisers."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from rodif_core.errors import ValueOutOfRangeError

LONGEST_PERIOD = 10_000.0  # denoising steps / 2π, of the slowest sinusoid


class StepEmbedding(nn.Module):
    """Sinusoidal embedding of the denoising step: (B,) → (B, dim)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        half = dim // 2
        frequencies = torch.exp(-math.log(LONGEST_PERIOD) * torch.arange(half) / (half - 1))
        self.register_buffer("frequencies", frequencies, persistent=False)

    def forward(self, k: Tensor) -> Tensor:
        """Embed the steps."""
        frequencies = self.get_buffer("frequencies")
        angles = k.to(frequencies.dtype)[:, None] * frequencies[None, :]
        return torch.cat([angles.sin(), angles.cos()], dim=1)


class StepEncoder(nn.Sequential):
    """Sinusoids, then two learned layers: (B,) → (B, dim)."""

    def __init__(self, dim: int) -> None:
        super().__init__(
            StepEmbedding(dim), nn.Linear(dim, 4 * dim), nn.Mish(), nn.Linear(4 * dim, dim)
        )


def check_step_dim(name: str, dim: int) -> None:
    """Raises ValueOutOfRangeError where the sinusoids have no frequencies to spread."""
    if dim < 4 or dim % 2:
        raise ValueOutOfRangeError(name, dim, "an even number, at least 4")
