"""Teach an image encoder where things are, before a policy learns to act on its features.

From pixels to actions in one go, a policy needs many passes over many pictures. The simulation
knows what a picture shows, so the encoder learns that first, from moments drawn evenly out of all
demonstrations; then it is frozen, every frame is encoded once, and the denoiser trains on rows of
numbers, as in a task without pictures. (The paper trains both together.) A policy comes to see what
no demonstration shows, so the encoder can go on learning from the policy's own rollouts: what their
pictures show is known as well.

Legend: O dims of the rows that a policy reads, proprioception and features.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rodif_core.errors import LearningError, ValueOutOfRangeError
from rodif_core.moments import Moments
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.resnet import ImageConfig, ImageEncoder
from rodif_core.policies.telling import Telling
from rodif_core.tasks.base import Task
from rodif_core.training_state import (
    Precision,
    UpdateProgress,
    cosine_rate,
    forward_precision,
    load_state,
    save_state,
)
from rodif_core.trajectory import Trajectory

SAVE_EVERY = 250  # updates between partial states
REPORT_EVERY = 50
HELD_OUT_MOMENTS = 256


@dataclass(frozen=True)
class EncoderConfig:
    """How the encoder is trained. Defaults: the CPU preset."""

    moments: int = 20_000  # pictures of how many states, at most; 55 KB each
    rearranged: int = 0  # pictures more, with untouched objects put elsewhere
    updates: int = 4_000
    round_updates: int = 0  # of a training that goes on from another policy; 0: its encoder stays
    batch_size: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    warm_up: int = 200

    def __post_init__(self) -> None:
        for name in ("moments", "updates", "batch_size"):
            if getattr(self, name) < 1:
                raise ValueOutOfRangeError(name, getattr(self, name), "at least 1")
        for name in ("rearranged", "round_updates"):
            if getattr(self, name) < 0:
                raise ValueOutOfRangeError(name, getattr(self, name), "at least 0")


class _Lesson(nn.Module):
    """Encoder and head: from pictures and proprioception to the hidden part of the state.

    The head is the encoder's own, or one that is thrown away when it has told what it was for.
    """

    def __init__(self, images: ImageConfig, felt: int, hidden: int) -> None:
        super().__init__()
        self.encoder = ImageEncoder(images, felt)
        self.passing = None if images.told else Telling(felt, images.coordinates, hidden)

    @property
    def head(self) -> Telling:
        """The encoder's, if it has one."""
        head = self.encoder.telling or self.passing
        assert head is not None  # one of them is always there
        return head

    def error(self, frames: Tensor, felt: Tensor, hidden: Tensor) -> Tensor:
        """Mean squared error of what is told, in units of the observations' half ranges."""
        seen = self.encoder.look(frames[:, None])[:, 0]
        return F.mse_loss(self.head.normalised(felt, seen), hidden)


def train_encoder(
    task: Task,
    known: Sequence[Trajectory],
    held_out: Sequence[Trajectory],
    images: ImageConfig,
    config: EncoderConfig,
    *,
    seed: int,
    start: ImageEncoder | None = None,
    driven: Sequence[Trajectory] = (),
    workspace: Path | None = None,
    device: str = "cpu",
    precision: Precision = Precision.FLOAT32,
    progress: UpdateProgress | None = None,
) -> tuple[ImageEncoder, list[dict[str, float]]]:
    """A trained encoder and its curve; goes on from `workspace` when a partial state is there.

    start   go on from this encoder for `config.round_updates`; where its head was thrown away,
            after a warm-up in which only a new one learns, as that would else spoil what it knows
    driven  rollouts of a policy, where half of the moments are then drawn

    Raises LearningError when the loss is not finite and GraphicsError where nothing can be drawn.
    """
    told = start.telling if start is not None else None
    states = Normaliser.fit([d.observations for d in known], [d.actions for d in known])
    states = states if told is None else told.kept_scale()
    chance = np.random.default_rng([seed, 3])  # apart from the split's and the weights'
    seen = _moments(task, known, driven, images, states, config, chance)
    unseen = Moments.draw(task, held_out, images, states, HELD_OUT_MOMENTS)
    model = _model(images, seen, states, start, seed).to(device)
    updates, waiting = config.updates, 0
    if start is not None:
        updates = config.round_updates
        waiting = 0 if told is not None else min(config.warm_up, updates // 2)
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    state_file = workspace / "encoder.safetensors" if workspace is not None else None
    modules: dict[str, nn.Module] = {"model": model}
    facts = load_state(state_file, modules, optimizer) if state_file is not None else None
    first, curve = (facts["update"], facts["curve"]) if facts else (0, [])
    for update in range(first, updates):
        model.encoder.requires_grad_(update >= waiting)
        rate = cosine_rate(update - waiting, config.warm_up, updates - waiting)
        rate = config.learning_rate * (rate if update >= waiting else 1.0)
        generator = torch.Generator().manual_seed(seed * 1_000_003 + update)
        pick = torch.randint(len(seen.felt), (config.batch_size,), generator=generator)
        with forward_precision(device, precision):
            loss = model.error(*seen.pick(pick, device))
        _step(optimizer, loss, rate)
        if update % REPORT_EVERY == 0 or update == updates - 1:
            curve.append(_report(model, float(loss.detach()), unseen, update, device))
            if progress is not None:
                progress(update + 1, updates, curve[-1])
        if state_file is not None and (update + 1) % SAVE_EVERY == 0:
            save_state(state_file, modules, optimizer, {"update": update + 1, "curve": curve})
    return model.encoder.cpu().eval().requires_grad_(False), curve


def _model(
    images: ImageConfig, seen: Moments, states: Normaliser, start: ImageEncoder | None, seed: int
) -> _Lesson:
    """With weights that depend on the seed alone, but for those that are known."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = _Lesson(images, seen.felt.shape[1], seen.hidden.shape[1])
    model.head.keep_scale(states)
    if start is not None:
        model.encoder.load_state_dict(start.state_dict())
    return model


def _step(optimizer: torch.optim.Optimizer, loss: Tensor, rate: float) -> None:
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    optimizer.step()


def _moments(
    task: Task,
    known: Sequence[Trajectory],
    driven: Sequence[Trajectory],
    images: ImageConfig,
    states: Normaliser,
    config: EncoderConfig,
    rng: np.random.Generator,
) -> Moments:
    """Of what experts have shown alone, or half of that and half of what a policy met."""
    count, elsewhere = config.moments, config.rearranged
    if not driven:
        return Moments.draw(task, known, images, states, count, elsewhere, rng)
    met = Moments.draw(task, driven, images, states, count // 2, elsewhere // 2, rng)
    count, elsewhere = count - count // 2, elsewhere - elsewhere // 2
    return Moments.draw(task, known, images, states, count, elsewhere, rng).and_those(met)


@torch.no_grad()
def _report(
    model: _Lesson, loss: float, unseen: Moments, update: int, device: str
) -> dict[str, float]:
    if not math.isfinite(loss):
        raise LearningError(f"the encoder's loss became {loss} at update {update}")
    held_out = float(model.error(*unseen.pick(torch.arange(len(unseen.felt)), device)))
    return {"update": float(update), "loss": loss, "held_out": held_out}
