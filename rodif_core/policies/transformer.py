"""Transformer over action chunks (the paper's ACT: Zhao et al. 2023, as a diffusion policy).

Legend: B rows, Tp predicted chunk, A action dims, To observation history, O observation dims,
D width, H heads. The encoder reads one token per remembered observation and one for the denoising
step; the decoder has one token per action of the noisy chunk, which look at each other and at the
encoder's tokens. Layers are normalised first, positions are learned, and there is no dropout:
sampling and scoring must see the same network.

Attention is written out rather than taken from torch, whose layers choose other kernels with and
without a gradient; log-ratios of exactly 0 at the reference need the same arithmetic in both.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.policies.step_embedding import StepEncoder, check_step_dim

POSITION_STD = 0.02  # of the learned positions at the start, as is common for transformers


@dataclass(frozen=True)
class TransformerSize:
    """Widths of a transformer. Defaults: the CPU preset, which is D3IL's encoder-decoder."""

    width: int = 64  # D
    heads: int = 4  # H
    encoder_layers: int = 2
    decoder_layers: int = 4
    feedforward: int = 256  # hidden width of the layers' two-layer networks

    def __post_init__(self) -> None:
        for name in ("heads", "encoder_layers", "decoder_layers", "feedforward"):
            if getattr(self, name) < 1:
                raise ValueOutOfRangeError(name, getattr(self, name), "at least 1")
        if self.width < 1 or self.width % self.heads:
            raise ValueOutOfRangeError("width", self.width, f"a multiple of {self.heads} heads")
        check_step_dim("width", self.width)


class Attention(nn.Module):
    """Multi-head attention of `queries` on `memory`, without biases."""

    def __init__(self, size: TransformerSize) -> None:
        super().__init__()
        self.heads = size.heads
        self.query = nn.Linear(size.width, size.width, bias=False)
        self.key_value = nn.Linear(size.width, 2 * size.width, bias=False)
        self.output = nn.Linear(size.width, size.width, bias=False)

    def forward(self, queries: Tensor, memory: Tensor) -> Tensor:
        """(B, Q, D), (B, M, D) → (B, Q, D)."""

        def split(tokens: Tensor) -> Tensor:
            return tokens.unflatten(-1, (self.heads, -1)).transpose(1, 2)  # (B, H, tokens, D / H)

        query = split(self.query(queries))
        key, value = (split(part) for part in self.key_value(memory).chunk(2, dim=-1))
        scores = query @ key.transpose(-2, -1) / query.shape[-1] ** 0.5
        mixed: Tensor = self.output((scores.softmax(-1) @ value).transpose(1, 2).flatten(-2))
        return mixed


class FeedForward(nn.Sequential):
    """Normalised two-layer network on every token alone: (B, Q, D) → (B, Q, D)."""

    def __init__(self, size: TransformerSize) -> None:
        super().__init__(
            nn.LayerNorm(size.width),
            nn.Linear(size.width, size.feedforward),
            nn.GELU(),
            nn.Linear(size.feedforward, size.width),
        )


class EncoderLayer(nn.Module):
    """Tokens look at each other: (B, Q, D) → (B, Q, D)."""

    def __init__(self, size: TransformerSize) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(size.width)
        self.attention = Attention(size)
        self.feedforward = FeedForward(size)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, Q, D) → (B, Q, D)."""
        normed = self.norm(tokens)
        tokens = tokens + self.attention(normed, normed)
        result: Tensor = tokens + self.feedforward(tokens)
        return result


class DecoderLayer(nn.Module):
    """Tokens look at each other, then at the encoder's tokens."""

    def __init__(self, size: TransformerSize) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(size.width)
        self.attention = Attention(size)
        self.memory_norm = nn.LayerNorm(size.width)
        self.memory_attention = Attention(size)
        self.feedforward = FeedForward(size)

    def forward(self, tokens: Tensor, memory: Tensor) -> Tensor:
        """(B, Q, D), (B, M, D) → (B, Q, D)."""
        normed = self.norm(tokens)
        tokens = tokens + self.attention(normed, normed)
        tokens = tokens + self.memory_attention(self.memory_norm(tokens), memory)
        result: Tensor = tokens + self.feedforward(tokens)
        return result


class TransformerDenoiser(nn.Module):
    """Noise predictor ε(a^k, k, s) for action chunks over an observation history."""

    def __init__(
        self,
        *,
        action_dim: int,
        observation_dim: int,
        observation_steps: int,
        predicted_steps: int,
        size: TransformerSize,
    ) -> None:
        super().__init__()
        width = size.width

        def positions(count: int) -> nn.Parameter:
            return nn.Parameter(POSITION_STD * torch.randn(count, width))

        self.step_embedding = StepEncoder(width)
        self.observation_embedding = nn.Linear(observation_dim, width)
        self.observation_positions = positions(observation_steps)
        self.action_embedding = nn.Linear(action_dim, width)
        self.action_positions = positions(predicted_steps)
        self.encoder = nn.Sequential(*(EncoderLayer(size) for _ in range(size.encoder_layers)))
        self.memory_norm = nn.LayerNorm(width)
        self.decoder = nn.ModuleList(DecoderLayer(size) for _ in range(size.decoder_layers))
        self.output = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, action_dim))

    def forward(self, noisy: Tensor, k: Tensor, history: Tensor) -> Tensor:
        """(B, Tp, A), (B,), (B, To, O) → predicted noise (B, Tp, A)."""
        seen = self.observation_embedding(history) + self.observation_positions
        memory = torch.cat([self.step_embedding(k)[:, None], seen], dim=1)
        memory = self.memory_norm(self.encoder(memory))
        tokens = self.action_embedding(noisy) + self.action_positions
        for layer in self.decoder:
            tokens = layer(tokens, memory)
        output: Tensor = self.output(tokens)
        return output
