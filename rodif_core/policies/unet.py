"""Conditional 1-D U-Net over the action chunk (the paper's state-based architecture).

Legend: B rows, Tp predicted chunk (a multiple of 2^(levels - 1)), A action dims, To observation
history, O observation dims, C channels. FiLM conditioning on the denoising step and the flattened
observation history, group normalisation, Mish.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

KERNEL = 5  # taps of every residual convolution
GROUPS = 8  # of the group normalisation


class StepEmbedding(nn.Module):
    """Sinusoidal embedding of the denoising step: (B,) → (B, dim)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        half = dim // 2
        frequencies = torch.exp(-math.log(10_000.0) * torch.arange(half) / (half - 1))
        self.register_buffer("frequencies", frequencies, persistent=False)

    def forward(self, k: Tensor) -> Tensor:
        """Embed the steps."""
        frequencies = self.get_buffer("frequencies")
        angles = k.to(frequencies.dtype)[:, None] * frequencies[None, :]
        return torch.cat([angles.sin(), angles.cos()], dim=1)


class ConvBlock(nn.Sequential):
    """Convolution, group normalisation, Mish: (B, C_in, T) → (B, C_out, T)."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__(
            nn.Conv1d(channels_in, channels_out, KERNEL, padding=KERNEL // 2),
            nn.GroupNorm(GROUPS, channels_out),
            nn.Mish(),
        )


class ResidualBlock(nn.Module):
    """Two convolution blocks with a FiLM (scale and shift) from the condition in between."""

    def __init__(self, channels_in: int, channels_out: int, condition_dim: int) -> None:
        super().__init__()
        self.first = ConvBlock(channels_in, channels_out)
        self.second = ConvBlock(channels_out, channels_out)
        self.film = nn.Sequential(nn.Mish(), nn.Linear(condition_dim, 2 * channels_out))
        self.skip = (
            nn.Conv1d(channels_in, channels_out, 1)
            if channels_in != channels_out
            else nn.Identity()
        )

    def forward(self, signal: Tensor, condition: Tensor) -> Tensor:
        """(B, C_in, T), (B, condition_dim) → (B, C_out, T)."""
        scale, shift = self.film(condition).unsqueeze(-1).chunk(2, dim=1)
        hidden = self.first(signal) * (1 + scale) + shift
        result: Tensor = self.second(hidden) + self.skip(signal)
        return result


class ConditionalUnet1d(nn.Module):
    """Noise predictor ε(a^k, k, s) for action chunks."""

    def __init__(
        self,
        *,
        action_dim: int,
        observation_dim: int,
        observation_steps: int,
        channels: Sequence[int],
        step_dim: int,
    ) -> None:
        super().__init__()
        self.step_embedding = nn.Sequential(
            StepEmbedding(step_dim),
            nn.Linear(step_dim, 4 * step_dim),
            nn.Mish(),
            nn.Linear(4 * step_dim, step_dim),
        )
        condition_dim = step_dim + observation_dim * observation_steps
        widths = [action_dim, *channels]
        self.down_blocks = nn.ModuleList()
        self.downsamplers = nn.ModuleList()
        for level, (width_in, width) in enumerate(zip(widths[:-1], channels, strict=True)):
            last = level == len(channels) - 1
            self.down_blocks.append(ResidualBlock(width_in, width, condition_dim))
            self.downsamplers.append(
                nn.Identity() if last else nn.Conv1d(width, width, 3, stride=2, padding=1)
            )
        self.middle = ResidualBlock(channels[-1], channels[-1], condition_dim)
        self.upsamplers = nn.ModuleList()
        self.up_blocks = nn.ModuleList()
        for width, width_out in zip(reversed(channels[1:]), reversed(channels[:-1]), strict=True):
            self.up_blocks.append(ResidualBlock(2 * width, width_out, condition_dim))
            self.upsamplers.append(nn.ConvTranspose1d(width_out, width_out, 4, stride=2, padding=1))
        self.output = nn.Sequential(
            ConvBlock(2 * channels[0], channels[0]), nn.Conv1d(channels[0], action_dim, 1)
        )

    def forward(self, noisy: Tensor, k: Tensor, history: Tensor) -> Tensor:
        """(B, Tp, A), (B,), (B, To, O) → predicted noise (B, Tp, A)."""
        condition = torch.cat([self.step_embedding(k), history.flatten(1)], dim=1)
        signal = noisy.transpose(1, 2)
        skips: list[Tensor] = []
        for block, down in zip(self.down_blocks, self.downsamplers, strict=True):
            signal = block(signal, condition)
            skips.append(signal)
            signal = down(signal)
        signal = self.middle(signal, condition)
        for block, up in zip(self.up_blocks, self.upsamplers, strict=True):
            signal = up(block(torch.cat([signal, skips.pop()], dim=1), condition))
        output: Tensor = self.output(torch.cat([signal, skips.pop()], dim=1))
        return output.transpose(1, 2)
