"""A checkpoint: immutable weights + config + normaliser + support set, as one safetensors file.

Everything that is not a tensor is JSON in the file's header. No pickle: loading a foreign file
can fail, but cannot run code.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from rodif_core.errors import CheckpointFileError, RodifError
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.policy import DiffusionPolicy, PolicyConfig
from rodif_core.spec import TaskName, parse_name

FORMAT = "rodif-checkpoint-1"
_WEIGHTS = "denoiser."
# Only in policies that see images.
_ENCODER = "encoder."
_STATES = "support.normaliser."


@dataclass(frozen=True, eq=False)
class SupportSet:
    """States that the demonstrations and the reference policy visit, for the drift measure.

    points (P, S) normalised observations of the task; threshold: the 99th percentile of the
    distance of held-out demonstration states to `points`. A policy that sees pictures reads other
    rows than the task's observations; `normaliser` is then that of the observations.
    """

    points: Tensor
    threshold: float
    normaliser: Normaliser | None = None


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A policy that can be published. `card` tells where it comes from and what it reaches."""

    task: TaskName
    policy: DiffusionPolicy
    support: SupportSet
    card: dict[str, Any]

    @property
    def digest(self) -> str:
        """SHA-256 of the weights and of all that decides behaviour (not of the card)."""
        return _digest(self)

    @property
    def state_normaliser(self) -> Normaliser:
        """Scales the task's observations, as the support set's points are."""
        return self.support.normaliser or self.policy.normaliser


def save_checkpoint(checkpoint: Checkpoint) -> bytes:
    """The file form; equal checkpoints give equal bytes."""
    header = {
        "format": FORMAT,
        "task": checkpoint.task.value,
        "config": json.dumps(checkpoint.policy.config.to_json(), sort_keys=True),
        "support_threshold": repr(checkpoint.support.threshold),
        "card": json.dumps(checkpoint.card, sort_keys=True),
        "digest": checkpoint.digest,
    }
    # safetensors writes its header in hash order; one JSON string keeps the bytes the same.
    blob: bytes = safetensors.torch.save(
        _tensors(checkpoint), metadata={"rodif": json.dumps(header, sort_keys=True)}
    )
    return blob


def load_checkpoint(data: bytes) -> Checkpoint:
    """Read a file made by `save_checkpoint`; raises CheckpointFileError when it is damaged."""
    try:
        tensors = safetensors.torch.load(data)
        size = int.from_bytes(data[:8], "little")
        header = json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["rodif"])
        if not isinstance(header, dict):
            raise CheckpointFileError(f"checkpoint header is a {type(header).__name__}")
        checkpoint = _rebuild(tensors, header)
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise CheckpointFileError(
            f"not a readable checkpoint file ({len(data)} bytes): {error}"
        ) from error
    except CheckpointFileError:
        raise
    except RodifError as error:
        raise CheckpointFileError(f"checkpoint file describes no legal policy: {error}") from error
    if checkpoint.digest != header["digest"]:
        raise CheckpointFileError(
            f"checkpoint file is damaged: its content has digest {checkpoint.digest[:12]}…, "
            f"its header says {str(header['digest'])[:12]}…"
        )
    return checkpoint


def _tensors(checkpoint: Checkpoint) -> dict[str, Tensor]:
    policy = checkpoint.policy
    tensors = policy.normaliser.tensors() | {"support.points": checkpoint.support.points}
    for name, value in policy.denoiser.state_dict().items():
        tensors[_WEIGHTS + name] = value
    if policy.encoder is not None:
        for name, value in policy.encoder.state_dict().items():
            tensors[_ENCODER + name] = value
    if checkpoint.support.normaliser is not None:
        tensors |= checkpoint.support.normaliser.tensors(_STATES)
    return {name: value.detach().cpu().contiguous() for name, value in tensors.items()}


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors of one module, by their names in it."""
    return {
        name.removeprefix(prefix): value
        for name, value in tensors.items()
        if name.startswith(prefix)
    }


def _rebuild(tensors: dict[str, Tensor], header: dict[str, Any]) -> Checkpoint:
    if header.get("format") != FORMAT:
        raise CheckpointFileError(
            f"checkpoint has format {header.get('format')!r}; this version reads {FORMAT!r}"
        )
    config = PolicyConfig.from_json(json.loads(header["config"]))
    # The weights come from the file; drawing fresh ones must not disturb the caller's randomness.
    with torch.random.fork_rng(devices=[]):
        policy = DiffusionPolicy.build(config, Normaliser.from_tensors(tensors))
    policy.denoiser.load_state_dict(_part(tensors, _WEIGHTS), strict=True)
    if policy.encoder is not None:
        policy.encoder.load_state_dict(_part(tensors, _ENCODER), strict=True)
    scaled = any(name.startswith(_STATES) for name in tensors)
    states = Normaliser.from_tensors(tensors, _STATES) if scaled else None
    support = SupportSet(tensors["support.points"], float(header["support_threshold"]), states)
    task = parse_name(TaskName, header["task"], "task")
    return Checkpoint(task, policy, support, json.loads(header["card"]))


def _digest(checkpoint: Checkpoint) -> str:
    digest = hashlib.sha256()
    facts = [checkpoint.task.value, checkpoint.policy.config.to_json()]
    digest.update(json.dumps([*facts, checkpoint.support.threshold], sort_keys=True).encode())
    for name, value in sorted(_tensors(checkpoint).items()):
        digest.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()
