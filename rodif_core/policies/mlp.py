"""Residual MLP over the flattened chunk (the paper's single-action architecture).

Legend: B rows, Tp predicted chunk (1 in the paper), A action dims, To observation history,
O observation dims. The sizes are those of D3IL's diffusion MLP: 128 wide with six hidden layers,
256 with eight for its hardest task; a block here has two hidden layers. No dropout.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.policies.step_embedding import StepEncoder, check_step_dim


@dataclass(frozen=True)
class MlpSize:
    """Widths of an MLP. Defaults: the CPU preset."""

    width: int = 128
    blocks: int = 3
    step_dim: int = 32  # of the denoising step's embedding

    def __post_init__(self) -> None:
        for name in ("width", "blocks"):
            if getattr(self, name) < 1:
                raise ValueOutOfRangeError(name, getattr(self, name), "at least 1")
        check_step_dim("step_dim", self.step_dim)


class ResidualLayers(nn.Module):
    """Two pre-activated layers beside the identity: (B, width) → (B, width)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(width),
            nn.Mish(),
            nn.Linear(width, width),
            nn.Mish(),
            nn.Linear(width, width),
        )

    def forward(self, hidden: Tensor) -> Tensor:
        """(B, width) → (B, width)."""
        result: Tensor = hidden + self.layers(hidden)
        return result


class MlpDenoiser(nn.Module):
    """Noise predictor ε(a^k, k, s) for short chunks, above all for single actions."""

    def __init__(
        self,
        *,
        action_dim: int,
        observation_dim: int,
        observation_steps: int,
        predicted_steps: int,
        size: MlpSize,
    ) -> None:
        super().__init__()
        chunk_dim = action_dim * predicted_steps
        self.step_embedding = StepEncoder(size.step_dim)
        self.input = nn.Linear(
            chunk_dim + size.step_dim + observation_dim * observation_steps, size.width
        )
        self.blocks = nn.Sequential(*(ResidualLayers(size.width) for _ in range(size.blocks)))
        self.output = nn.Sequential(nn.Mish(), nn.Linear(size.width, chunk_dim))

    def forward(self, noisy: Tensor, k: Tensor, history: Tensor) -> Tensor:
        """(B, Tp, A), (B,), (B, To, O) → predicted noise (B, Tp, A)."""
        known = torch.cat([noisy.flatten(1), self.step_embedding(k), history.flatten(1)], dim=1)
        output: Tensor = self.output(self.blocks(self.input(known)))
        return output.view_as(noisy)
