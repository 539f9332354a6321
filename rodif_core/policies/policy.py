"""A diffusion policy: denoiser + schedule + normaliser + chunking, as one value.

Legend: B rows, K denoising steps, To observation history, Tp predicted chunk, Te executed chunk,
O observation dims, A action dims.
"""

from __future__ import annotations

import copy
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from rodif_core.diffusion.chain import sample_chain
from rodif_core.diffusion.schedule import NoiseSchedule
from rodif_core.errors import ValueOutOfRangeError
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.unet import ConditionalUnet1d


@dataclass(frozen=True)
class PolicyConfig:
    """Shape of a U-Net policy. Defaults: the paper's Avoid (K = 20, To = 2, Tp = 16)."""

    observation_dim: int
    action_dim: int
    observation_steps: int = 2  # To
    predicted_steps: int = 16  # Tp
    executed_steps: int = 8  # Te, receding horizon
    denoising_steps: int = 20  # K
    channels: tuple[int, ...] = (16, 32, 64)  # CPU preset
    step_dim: int = 32
    clip: float = 1.0
    std_floor: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", tuple(self.channels))
        if not 1 <= self.executed_steps <= self.predicted_steps:
            raise ValueOutOfRangeError(
                "executed_steps", self.executed_steps, f"1 … {self.predicted_steps}"
            )
        multiple = 2 ** (len(self.channels) - 1)
        if self.predicted_steps % multiple:
            raise ValueOutOfRangeError(
                "predicted_steps", self.predicted_steps, f"a multiple of {multiple}"
            )

    def to_json(self) -> dict[str, Any]:
        """Plain JSON types."""
        return asdict(self) | {"channels": list(self.channels)}


@dataclass(frozen=True, eq=False)
class DiffusionPolicy:
    """Weights and constants that turn an observation history into an action chunk."""

    config: PolicyConfig
    denoiser: ConditionalUnet1d
    schedule: NoiseSchedule
    normaliser: Normaliser

    @classmethod
    def build(cls, config: PolicyConfig, normaliser: Normaliser) -> DiffusionPolicy:
        """A policy with fresh weights (from torch's current random state)."""
        denoiser = ConditionalUnet1d(
            action_dim=config.action_dim,
            observation_dim=config.observation_dim,
            observation_steps=config.observation_steps,
            channels=config.channels,
            step_dim=config.step_dim,
        )
        schedule = NoiseSchedule(config.denoising_steps, config.clip, config.std_floor)
        return cls(config, denoiser, schedule, normaliser)

    def copy(self) -> DiffusionPolicy:
        """Same constants, own weights."""
        return DiffusionPolicy(
            self.config, copy.deepcopy(self.denoiser), self.schedule, self.normaliser
        )

    @torch.no_grad()
    def act(self, histories: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Choose chunks.

        histories (B, To, O) in task units; noise (B, `noise_entries`, Tp, A) standard normal.
        Returns the executed actions (B, Te, A) in task units and the chains (B, K + 1, Tp, A).
        """
        chain = sample_chain(
            self.denoiser, self.schedule, self.normaliser.observation(histories), noise
        )
        executed = chain[:, -1, : self.config.executed_steps]
        return self.normaliser.to_task_action(executed), chain
