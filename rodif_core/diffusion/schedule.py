"""The DDPM noise schedule: squared cosine (s = 0.008), noise prediction, posterior variance.

Legend: K denoising steps; arrays have K + 1 entries and are indexed by k = 1 … K (entry 0 is the
clean action). Source of the constants: the cosine schedule that D3IL and diffusion policies use.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch

from rodif_core.errors import ValueOutOfRangeError

COSINE_OFFSET = 0.008  # keeps the first steps from being noiseless
MAX_BETA = 0.999  # the last step would otherwise divide by zero


@dataclass(frozen=True)
class NoiseSchedule:
    """Constants of the denoising chain; part of every checkpoint.

    num_steps    K ≥ 2
    clip         the predicted clean action is clipped to ±clip inside the mean (normalised units);
                 needed because at large k a small error of the noise is blown up without bound
    std_floor    0: step k = 1 is deterministic and absent from every log-probability;
                 above 0: the smallest standard deviation, when sampling and when scoring alike
    """

    num_steps: int = 20
    clip: float = 1.0
    std_floor: float = 0.0

    def __post_init__(self) -> None:
        if self.num_steps < 2:
            raise ValueOutOfRangeError("num_steps", self.num_steps, "at least 2")
        if self.clip <= 0:
            raise ValueOutOfRangeError("clip", self.clip, "above 0")
        if not 0 <= self.std_floor < 1:
            raise ValueOutOfRangeError("std_floor", self.std_floor, "in [0, 1)")

    @cached_property
    def alpha_bar(self) -> torch.Tensor:
        """(K + 1,) float32; product of (1 - beta) up to k, 1 at k = 0."""
        return torch.cumprod(1.0 - self._betas, dim=0).float()

    @cached_property
    def std(self) -> torch.Tensor:
        """(K + 1,) float32; posterior standard deviation of a^{k-1} given a^k, entry 0 unused."""
        bar = torch.cumprod(1.0 - self._betas, dim=0)
        variance = torch.zeros_like(bar)
        variance[1:] = (1 - bar[:-1]) / (1 - bar[1:]) * self._betas[1:]
        std = variance.sqrt()
        std[1:] = std[1:].clamp(min=self.std_floor)
        return std.float()

    @cached_property
    def clean_weight(self) -> torch.Tensor:
        """(K + 1,) float32; weight of the predicted clean action in the posterior mean."""
        bar = torch.cumprod(1.0 - self._betas, dim=0)
        weight = torch.zeros_like(bar)
        weight[1:] = bar[:-1].sqrt() * self._betas[1:] / (1 - bar[1:])
        return weight.float()

    @cached_property
    def noisy_weight(self) -> torch.Tensor:
        """(K + 1,) float32; weight of a^k in the posterior mean."""
        bar = torch.cumprod(1.0 - self._betas, dim=0)
        weight = torch.zeros_like(bar)
        weight[1:] = (1 - self._betas[1:]).sqrt() * (1 - bar[:-1]) / (1 - bar[1:])
        return weight.float()

    @property
    def scored_steps(self) -> tuple[int, ...]:
        """Denoising steps k with a density, in the order of sampling (K first)."""
        last = 1 if self.std_floor > 0 else 2
        return tuple(range(self.num_steps, last - 1, -1))

    @cached_property
    def _betas(self) -> torch.Tensor:
        def bar(fraction: float) -> float:
            return math.cos((fraction + COSINE_OFFSET) / (1 + COSINE_OFFSET) * math.pi / 2) ** 2

        steps = self.num_steps
        betas = [0.0] + [
            min(1 - bar(k / steps) / bar((k - 1) / steps), MAX_BETA) for k in range(1, steps + 1)
        ]
        return torch.tensor(betas, dtype=torch.float64)
