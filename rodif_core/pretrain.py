"""Pretraining by imitation: predict the noise in demonstrated action chunks.

Legend: B rows, K denoising steps, To observation history, Tp predicted and Te executed chunk.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rodif_core.diffusion.chain import add_noise
from rodif_core.drift import fit_support, visited_states
from rodif_core.errors import LearningError, UnknownNameError, ValueOutOfRangeError
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.policies.mlp import MlpSize
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.policy import DiffusionPolicy, PolicyConfig, Size
from rodif_core.policies.transformer import TransformerSize
from rodif_core.policies.unet import UnetSize
from rodif_core.spec import Architecture, TaskName
from rodif_core.tasks import Task, get_task
from rodif_core.training_state import load_state, save_state
from rodif_core.trajectory import Trajectory

SAVE_EVERY = 500  # updates between partial states
REPORT_EVERY = 100  # updates between held-out losses
Progress = Callable[[int, int, dict[str, float]], None]  # update, of, metrics


@dataclass(frozen=True)
class PretrainConfig:
    """How a policy is pretrained: its shape, but for the task's dims, and the training.

    Defaults: the CPU preset of the U-Net, with which Avoid's shipped checkpoint was trained.
    """

    size: Size = UnetSize()  # widths; its type is the architecture
    observation_steps: int = 2  # To
    predicted_steps: int = 16  # Tp
    executed_steps: int = 8  # Te: control steps between two decisions of the policy
    denoising_steps: int = 20  # K
    updates: int = 10_000
    batch_size: int = 128
    learning_rate: float = 1e-3
    weight_decay: float = 1e-6
    warm_up: int = 200
    ema_decay: float = 0.999
    held_out: float = 0.1  # share of demonstrations kept for the held-out loss and the support
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.held_out < 0.5:
            raise ValueOutOfRangeError("held_out", self.held_out, "in (0, 0.5)")
        if self.updates < 1:
            raise ValueOutOfRangeError("updates", self.updates, "at least 1")

    def policy_config(self, observation_dim: int, action_dim: int) -> PolicyConfig:
        """The policy's shape for a task of these dims."""
        return PolicyConfig(
            observation_dim,
            action_dim,
            self.observation_steps,
            self.predicted_steps,
            self.executed_steps,
            self.denoising_steps,
            self.size,
        )


# The architecture of each task, by name (paper, Table 1).
TASK_ARCHITECTURES: dict[str, Architecture] = {
    "avoid": Architecture.UNET,
    "pushing": Architecture.UNET,
    "sorting": Architecture.TRANSFORMER,
    "aligning": Architecture.MLP,
    "aligning-state": Architecture.MLP,
    "stacking": Architecture.TRANSFORMER,
    "stacking-state": Architecture.TRANSFORMER,
}

# To, Tp and K are the paper's (appendix, architectures and training hyperparameters); Te is ours
# but for the single action. Where the sizes come from is told in docs/architectures.md.
_TRANSFORMER = PretrainConfig(
    size=TransformerSize(),
    observation_steps=5,
    denoising_steps=16,
    updates=40_000,
    learning_rate=5e-4,
    warm_up=500,
)
_MLP = PretrainConfig(
    size=MlpSize(),
    observation_steps=1,
    predicted_steps=1,
    executed_steps=1,
    denoising_steps=4,
    updates=60_000,
    batch_size=512,
)
_PAPER: dict[str, Any] = {  # what a GPU is for: wide, long, large batches
    "updates": 60_000,
    "batch_size": 256,
    "learning_rate": 1e-4,
    "warm_up": 500,
}
PRESETS = {
    Architecture.UNET: {
        "cpu": PretrainConfig(),
        "paper": PretrainConfig(size=UnetSize(channels=(256, 512, 1024)), **_PAPER),
    },
    Architecture.TRANSFORMER: {
        "cpu": _TRANSFORMER,
        "paper": replace(
            _TRANSFORMER,
            size=TransformerSize(
                width=512, heads=8, encoder_layers=4, decoder_layers=7, feedforward=3200
            ),
            **_PAPER,
        ),
    },
    Architecture.MLP: {
        "cpu": _MLP,
        "paper": replace(_MLP, size=MlpSize(width=256, blocks=4), **_PAPER | {"batch_size": 1024}),
    },
}


# Pushing needs wider layers and more updates than Avoid, and both look again sooner: a cube that
# turned away from the rod is lost within eight control steps.
_TASK_CHANGES: dict[tuple[str, str], dict[str, Any]] = {
    ("pushing", "cpu"): {
        "size": UnetSize(channels=(32, 64, 128)),
        "executed_steps": 4,
        "updates": 25_000,
    },
    ("pushing", "paper"): {"executed_steps": 4},
    ("sorting", "cpu"): {"executed_steps": 4, "updates": 30_000},
    ("sorting", "paper"): {"executed_steps": 4},
}


def preset_for(task: TaskName, name: str) -> PretrainConfig:
    """The task's architecture in that preset; raises UnknownNameError listing the legal names."""
    presets = PRESETS[TASK_ARCHITECTURES[task]]
    if name not in presets:
        raise UnknownNameError("preset", name, presets)
    return replace(presets[name], **_TASK_CHANGES.get((task.value, name), {}))


@dataclass(frozen=True, eq=False)
class Windows:
    """Training rows: histories (R, To, O) and chunks (R, Tp, A), normalised."""

    histories: Tensor
    chunks: Tensor

    @classmethod
    def cut(
        cls, demonstrations: Sequence[Trajectory], config: PolicyConfig, normaliser: Normaliser
    ) -> Windows:
        """One row per control step; histories repeat the first observation before the start,
        chunks repeat the last action after the end."""
        histories, chunks = [], []
        for demonstration in demonstrations:
            steps = np.arange(len(demonstration.actions))
            past = steps[:, None] + np.arange(1 - config.observation_steps, 1)
            future = steps[:, None] + np.arange(config.predicted_steps)
            histories.append(demonstration.observations[past.clip(min=0)])
            chunks.append(demonstration.actions[future.clip(max=len(steps) - 1)])
        return cls(
            normaliser.observation(torch.from_numpy(np.concatenate(histories))),
            normaliser.action(torch.from_numpy(np.concatenate(chunks))),
        )


def pretrain(
    task_name: TaskName,
    demonstrations: Sequence[Trajectory],
    config: PretrainConfig,
    *,
    start: Checkpoint | None = None,
    workspace: Path | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Checkpoint:
    """Train a policy on demonstrations; goes on from `workspace` when a partial state is there.

    start  go on from this policy, with its size and normaliser, instead of from fresh weights

    The result holds the averaged weights, the normaliser and the support set. Raises
    LearningError when the loss is not finite.
    """
    task = get_task(task_name)
    held_out_count = max(1, int(len(demonstrations) * config.held_out))
    order = np.random.default_rng([config.seed, 0]).permutation(len(demonstrations))
    held_out = [demonstrations[i] for i in order[:held_out_count]]
    known = [demonstrations[i] for i in order[held_out_count:]]
    policy = start.policy.copy() if start is not None else _fresh(task, known, config)
    shape, normaliser = policy.config, policy.normaliser
    average, curve = _train(
        policy,
        Windows.cut(known, shape, normaliser),
        Windows.cut(held_out, shape, normaliser),
        config,
        workspace,
        device,
        progress,
    )
    support = fit_support(visited_states(known, normaliser), visited_states(held_out, normaliser))
    trained = replace(policy, denoiser=average)
    card = {
        "kind": "pretrained",
        "architecture": shape.architecture.value,
        "preset": asdict(config),
        "start": None if start is None else start.digest,
        "demonstrations": len(demonstrations),
        "held_out_curve": curve,
    }
    return Checkpoint(task_name, trained, support, card)


def _fresh(task: Task, known: Sequence[Trajectory], config: PretrainConfig) -> DiffusionPolicy:
    """Untrained weights that depend on the seed alone."""
    normaliser = Normaliser.fit([d.observations for d in known], [d.actions for d in known])
    shape = config.policy_config(task.observation_dim, task.action_dim)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return DiffusionPolicy.build(shape, normaliser)


def _train(
    policy: DiffusionPolicy,
    rows: Windows,
    held_out: Windows,
    config: PretrainConfig,
    workspace: Path | None,
    device: str,
    progress: Progress | None,
) -> tuple[Any, list[dict[str, float]]]:
    model = policy.denoiser.to(device)
    average = copy.deepcopy(model)
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    state_file = workspace / "pretrain.safetensors" if workspace is not None else None
    modules: dict[str, nn.Module] = {"model": model, "average": average}
    facts = load_state(state_file, modules, optimizer) if state_file is not None else None
    start, curve = (facts["update"], facts["curve"]) if facts else (0, [])
    histories, chunks = rows.histories.to(device), rows.chunks.to(device)
    for update in range(start, config.updates):
        # A generator per update: a resumed run draws the same batches as an unbroken one.
        generator = torch.Generator().manual_seed(config.seed * 1_000_003 + update)
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * _rate(update, config)
        pick = torch.randint(len(chunks), (config.batch_size,), generator=generator).to(device)
        loss = _noise_loss(policy, model, histories[pick], chunks[pick], generator)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        _update_average(average, model, min(config.ema_decay, (1 + update) / (10 + update)))
        if update % REPORT_EVERY == 0 or update == config.updates - 1:
            metrics = {
                "loss": float(loss.detach()),
                "held_out": _held_out_loss(policy, average, held_out),
            }
            if not math.isfinite(metrics["loss"]):
                raise LearningError(f"the loss became {metrics['loss']} at update {update}")
            curve.append({"update": float(update), **metrics})
            if progress is not None:
                progress(update + 1, config.updates, metrics)
        if state_file is not None and (update + 1) % SAVE_EVERY == 0:
            save_state(state_file, modules, optimizer, {"update": update + 1, "curve": curve})
    return average.cpu().eval(), curve


def _noise_loss(
    policy: DiffusionPolicy,
    model: nn.Module,
    histories: Tensor,
    chunks: Tensor,
    generator: torch.Generator,
) -> Tensor:
    steps = policy.schedule.num_steps
    k = torch.randint(1, steps + 1, (len(chunks),), generator=generator).to(chunks.device)
    noise = torch.randn(chunks.shape, generator=generator).to(chunks.device)
    noisy = add_noise(policy.schedule, chunks, noise, k)
    return F.mse_loss(model(noisy, k, histories), noise)


@torch.no_grad()
def _held_out_loss(policy: DiffusionPolicy, model: nn.Module, rows: Windows) -> float:
    generator = torch.Generator().manual_seed(0)  # the same draws each time: a smooth curve
    device = next(model.parameters()).device
    pick = torch.randint(len(rows.chunks), (512,), generator=generator)
    histories, chunks = rows.histories[pick].to(device), rows.chunks[pick].to(device)
    return float(_noise_loss(policy, model, histories, chunks, generator))


def _rate(update: int, config: PretrainConfig) -> float:
    if update < config.warm_up:
        return (update + 1) / config.warm_up
    fraction = (update - config.warm_up) / max(1, config.updates - config.warm_up)
    return 0.5 * (1 + math.cos(math.pi * fraction))


@torch.no_grad()
def _update_average(average: nn.Module, model: nn.Module, decay: float) -> None:
    for target, source in zip(average.parameters(), model.parameters(), strict=True):
        target.lerp_(source, 1 - decay)
