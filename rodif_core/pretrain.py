"""Pretraining by imitation: predict the noise in demonstrated action chunks.

Legend: B rows, K denoising steps, To observation history, Tp predicted and Te executed chunk.
"""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rodif_core.diffusion.chain import add_noise
from rodif_core.drift import fit_support, visited_states
from rodif_core.encoded_rows import encode
from rodif_core.encoder_training import train_encoder
from rodif_core.errors import LearningError, ValueOutOfRangeError
from rodif_core.policies.checkpoint import Checkpoint, SupportSet
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.policy import DiffusionPolicy, PolicyConfig
from rodif_core.presets import PretrainConfig
from rodif_core.rollout import rollout
from rodif_core.spec import RolloutConfig, TaskName
from rodif_core.tasks import get_task
from rodif_core.tasks.base import Task
from rodif_core.training_state import (
    Precision,
    UpdateProgress,
    check_device,
    claim_workspace,
    cosine_rate,
    forward_precision,
    load_state,
    save_state,
    update_average,
    usual_precision,
)
from rodif_core.trajectory import Trajectory

SAVE_EVERY = 500  # updates between partial states
REPORT_EVERY = 100  # updates between held-out losses
TRACKED_AT = (0.2, 0.4, 0.6, 0.8)  # shares of a training after which rollouts look at the policy
TRACKED_SEED = 400_000_000  # of those rollouts, apart from those of demonstrations and measurements

SuccessOf = Callable[[DiffusionPolicy], float]


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
    driven: Sequence[Trajectory] = (),
    only_encoder: bool = False,
    workspace: Path | None = None,
    kept_rows: Path | None = None,
    device: str = "cpu",
    precision: Precision | None = None,
    track: int = 0,
    progress: UpdateProgress | None = None,
) -> Checkpoint:
    """A policy (averaged weights) trained on demonstrations; goes on from states in `workspace`.

    start         go on from this policy, with its size and normaliser, for `config.round_updates`;
                  its encoder, if any, learns on for `config.encoder.round_updates`, also from what
                  was `driven`. Where pictures tell the state, may be the policy that is told it
    only_encoder  the denoiser of the start, which there must be, stays as it is
    kept_rows     folder for encoded pictures, which trainings with the same encoder may share
    precision     of the forward passes; by default mixed on a GPU
    track         rollouts of the policy after each of the first four fifths of the training; their
                  success goes to `progress` and to the card's rollout_curve, not into the weights

    Raises LearningError for fewer than two demonstrations, when the loss is not finite or the
    workspace belongs to another training, UnknownNameError for a device that is not there, and
    ValueOutOfRangeError for `only_encoder` without a start.
    """
    check_device(device)
    precision = precision or usual_precision(device)
    basis = _basis(device, precision, start, only_encoder)
    if workspace is not None:
        _claim(workspace, task_name, demonstrations, basis | _deciding(config))
    task = get_task(task_name)
    known, held_out = _split(demonstrations, config)
    encoder, encoder_curve = start.policy.encoder if start else None, None
    if config.images is not None and (encoder is None or config.encoder.round_updates):
        encoder, encoder_curve = train_encoder(
            task, known, held_out, config.images, config.encoder,
            seed=config.seed, start=encoder, driven=driven, workspace=workspace, device=device,
            precision=precision, progress=progress,
        )  # fmt: skip
    shape = _shape(task, start, config)
    card = _facts(config, shape, demonstrations) | basis
    card |= _other_curves(task_name, start, encoder_curve)
    if only_encoder and start is not None:
        policy = replace(start.policy.copy(), config=shape, encoder=encoder)
        return Checkpoint(task_name, policy, _support(known, held_out, policy), card)
    seen, unseen = (encode(task, shape, encoder, part, kept_rows) for part in (known, held_out))
    policy = start.policy.copy() if start else _fresh(shape, seen, config)
    policy = replace(policy, config=shape, encoder=encoder)
    support = _support(known, held_out, policy)
    config = config if start is None else replace(config, updates=config.round_updates)
    success_of = partial(_success, task_name, support, track) if track else None
    average, curves = _train(
        policy, seen, unseen, config, workspace, device, precision, success_of, progress
    )
    return Checkpoint(task_name, replace(policy, denoiser=average), support, card | curves)


def _basis(
    device: str, precision: Precision, start: Checkpoint | None, only_encoder: bool
) -> dict[str, Any]:
    """What decides a training beside its config and what was shown."""
    if only_encoder and start is None:
        raise ValueOutOfRangeError("only_encoder", True, "False without a start")
    basis = {"device": device, "precision": precision.value, "start": start and start.digest}
    return basis | ({"only_encoder": True} if only_encoder else {})


def _facts(
    config: PretrainConfig, shape: PolicyConfig, demonstrations: Sequence[Trajectory]
) -> dict[str, Any]:
    """What a card says first."""
    facts = {"architecture": shape.architecture.value, "demonstrations": len(demonstrations)}
    return {"kind": "pretrained", **facts, "preset": asdict(config)}


def _claim(
    workspace: Path,
    task_name: TaskName,
    demonstrations: Sequence[Trajectory],
    deciding: dict[str, Any],
) -> None:
    shown = {"task": task_name.value, "demonstrations": _fingerprint(demonstrations)}
    claim_workspace(workspace, deciding | shown)


def _split(
    demonstrations: Sequence[Trajectory], config: PretrainConfig
) -> tuple[list[Trajectory], list[Trajectory]]:
    """Those to train on, and those that are held out.

    Drawn afresh for every training: one that goes on from another policy may hold out what that
    policy was trained on, and its held-out loss then says little.
    """
    if len(demonstrations) < 2:
        raise LearningError(
            f"{len(demonstrations)} demonstrations: training needs at least 2, as one is held out"
        )
    count = max(1, int(len(demonstrations) * config.held_out))
    order = np.random.default_rng([config.seed, 0]).permutation(len(demonstrations))
    shuffled = [demonstrations[i] for i in order]
    return shuffled[count:], shuffled[:count]


def _deciding(config: PretrainConfig) -> dict[str, Any]:
    """What decides the result of one training; how many follow it does not, so that a finished
    series can have another round."""
    following = ("looks", "rounds", "recoveries", "drives")
    return {k: v for k, v in asdict(config).items() if k not in following}


def _other_curves(
    task_name: TaskName, start: Checkpoint | None, encoder_curve: Any | None
) -> dict[str, Any]:
    """The encoder's curve and, on the card of a policy that another one of the task goes on from,
    what its card says about its trainings; of the encoder there too, once it has learned on."""
    if start is None or start.task != task_name:
        return {"encoder_curve": encoder_curve}
    names = ["held_out_curve", "rollout_curve"] + (["encoder_curve"] if encoder_curve else [])
    before = {name: start.card[name] for name in names if name in start.card}
    return {
        "encoder_curve": encoder_curve or start.card.get("encoder_curve"),
        "earlier_curves": [*start.card.get("earlier_curves", []), before],
    }


def _fingerprint(demonstrations: Sequence[Trajectory]) -> str:
    digest = hashlib.sha256()
    for one in demonstrations:
        digest.update(one.observations.tobytes() + one.actions.tobytes())
    return digest.hexdigest()[:16]


def _shape(task: Task, start: Checkpoint | None, config: PretrainConfig) -> PolicyConfig:
    """The start's, which gets eyes if it was told the state until now."""
    fresh = config.policy_config(task)
    return fresh if start is None else replace(start.policy.config, images=config.images)


def _support(
    known: Sequence[Trajectory], held_out: Sequence[Trajectory], policy: DiffusionPolicy
) -> SupportSet:
    """Of the task's observations, also where the policy reads other rows."""
    own = None
    if policy.encoder is not None:
        own = Normaliser.fit([d.observations for d in known], [d.actions for d in known])
    scale = own or policy.normaliser
    return fit_support(visited_states(known, scale), visited_states(held_out, scale), own)


def _fresh(
    shape: PolicyConfig, known: Sequence[Trajectory], config: PretrainConfig
) -> DiffusionPolicy:
    """Untrained weights that depend on the seed alone."""
    normaliser = Normaliser.fit([d.observations for d in known], [d.actions for d in known])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return DiffusionPolicy.build(shape, normaliser)


def _train(
    policy: DiffusionPolicy,
    known: Sequence[Trajectory],
    unknown: Sequence[Trajectory],
    config: PretrainConfig,
    workspace: Path | None,
    device: str,
    precision: Precision,
    success_of: SuccessOf | None,
    progress: UpdateProgress | None,
) -> tuple[Any, dict[str, Any]]:
    """The averaged denoiser, and the curves on the way to it."""
    rows, held_out = (Windows.cut(d, policy.config, policy.normaliser) for d in (known, unknown))
    model = policy.denoiser.to(device)
    average = copy.deepcopy(model)
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    state_file = workspace / "pretrain.safetensors" if workspace is not None else None
    modules: dict[str, nn.Module] = {"model": model, "average": average}
    facts = load_state(state_file, modules, optimizer) if state_file is not None else None
    start, curve, tracked = 0, [], []
    if facts:
        start, curve, tracked = facts["update"], facts["curve"], facts.get("tracked", [])
    looks = {round(share * config.updates) for share in TRACKED_AT} if success_of else set()
    histories, chunks = rows.histories.to(device), rows.chunks.to(device)
    for update in range(start, config.updates):
        loss = _update(policy, model, optimizer, histories, chunks, config, update, precision)
        update_average(average, model, min(config.ema_decay, (1 + update) / (10 + update)))
        if update % REPORT_EVERY == 0 or update == config.updates - 1:
            metrics = {
                "loss": float(loss),
                "held_out": _held_out_loss(policy, average, held_out),
            }
            if not math.isfinite(metrics["loss"]):
                raise LearningError(f"the loss became {metrics['loss']} at update {update}")
            curve.append({"update": float(update), **metrics})
            if progress is not None:
                progress(update + 1, config.updates, metrics)
        if success_of is not None and update + 1 in looks:
            seen = copy.deepcopy(average).cpu().eval()
            success = success_of(replace(policy, denoiser=seen))
            tracked.append({"update": float(update + 1), "success": success})
            if progress is not None:
                progress(update + 1, config.updates, tracked[-1])
        if state_file is not None and (update + 1) % SAVE_EVERY == 0:
            facts = {"update": update + 1, "curve": curve, "tracked": tracked}
            save_state(state_file, modules, optimizer, facts)
    return average.cpu().eval(), {"held_out_curve": curve, "rollout_curve": tracked}


def _update(
    policy: DiffusionPolicy,
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    histories: Tensor,
    chunks: Tensor,
    config: PretrainConfig,
    update: int,
    precision: Precision,
) -> Tensor:
    """One step of the optimiser on a batch; returns its loss."""
    # A generator per update: a resumed run draws the same batches as an unbroken one.
    generator = torch.Generator().manual_seed(config.seed * 1_000_003 + update)
    for group in optimizer.param_groups:
        group["lr"] = config.learning_rate * cosine_rate(update, config.warm_up, config.updates)
    device = chunks.device
    pick = torch.randint(len(chunks), (config.batch_size,), generator=generator).to(device)
    with forward_precision(device.type, precision):
        loss = _noise_loss(policy, model, histories[pick], chunks[pick], generator)
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    optimizer.step()
    return loss.detach()


def _success(
    task_name: TaskName, support: SupportSet, episodes: int, policy: DiffusionPolicy
) -> float:
    """Share of fresh rollouts in which the policy succeeds; always the same starts."""
    runs = rollout(
        Checkpoint(task_name, policy, support, {}), RolloutConfig(episodes, TRACKED_SEED)
    )
    return sum(one.success for one in runs) / episodes


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
