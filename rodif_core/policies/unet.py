"""Conditional 1-D U-Net over the action chunk (the paper's state-based architecture).

Legend: B rows, Tp predicted chunk (a multiple of 2^(levels - 1)), A action dims, To observation
history, O observation dims, C channels. FiLM conditioning on the denoising step and the flattened
observation history, group normalisation, Mish.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.policies.step_embedding import StepEncoder, check_step_dim

KERNEL = 5  # taps of every residual convolution
GROUPS = 8  # of the group normalisation


@dataclass(frozen=True)
class UnetSize:
    """Widths of a U-Net. Defaults: the CPU preset (0.16 million parameters on Avoid)."""

    channels: tuple[int, ...] = (16, 32, 64)  # one entry a level
    step_dim: int = 32  # of the denoising step's embedding

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", tuple(self.channels))
        if not self.channels or any(width < 1 or width % GROUPS for width in self.channels):
            raise ValueOutOfRangeError(
                "channels", self.channels, f"one or more positive multiples of {GROUPS}"
            )
        check_step_dim("step_dim", self.step_dim)

    @property
    def chunk_multiple(self) -> int:
        """The chunk is halved between levels, so its length must be a multiple of this."""
        multiple: int = 2 ** (len(self.channels) - 1)
        return multiple


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
        size: UnetSize,
    ) -> None:
        super().__init__()
        channels = size.channels
        self.step_embedding = StepEncoder(size.step_dim)
        condition_dim = size.step_dim + observation_dim * observation_steps
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
