"""Demonstrations as the rows that a policy reads: every frame is drawn and encoded once.

Legend: N control steps, O dims of a row: those of the observation, or proprioception and features.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray

from rodif_core.policies.policy import PolicyConfig
from rodif_core.policies.resnet import ImageEncoder
from rodif_core.sight import Sight
from rodif_core.tasks.base import Task
from rodif_core.trajectory import Trajectory


def encode(
    task: Task,
    shape: PolicyConfig,
    encoder: ImageEncoder | None,
    demonstrations: Sequence[Trajectory],
    kept: Path | None = None,
) -> list[Trajectory]:
    """The demonstrations with the rows (N + 1, O) that a policy reads as their observations.

    kept  folder where encoded rows stay for the next training with the same encoder: drawing and
          encoding pictures takes as long as training a small denoiser on them

    Raises ValueOutOfRangeError when task and policy do not fit together.
    """
    with Sight(task, shape, encoder) as sight:
        if encoder is None or kept is None:
            return [_seen(one, sight.rows(one.observations, one.qpos)) for one in demonstrations]
        kept.mkdir(parents=True, exist_ok=True)
        weights = _digest(value.numpy() for value in encoder.state_dict().values())
        return [_seen(one, _kept_rows(kept, weights, sight, one)) for one in demonstrations]


def _seen(one: Trajectory, rows: NDArray[np.float32]) -> Trajectory:
    return replace(one, observations=rows)


def _kept_rows(kept: Path, weights: str, sight: Sight, one: Trajectory) -> NDArray[np.float32]:
    """From the file named by what decides the rows; written to another name first, so that a kill
    leaves none that is cut short."""
    shown = _digest([one.observations, one.qpos])
    file = kept / f"{weights}-{shown}.safetensors"
    if not file.exists():
        rows = torch.from_numpy(sight.rows(one.observations, one.qpos))
        temporary = file.with_suffix(f".{os.getpid()}.partial")  # others may encode it just now
        safetensors.torch.save_file({"rows": rows}, temporary)
        os.replace(temporary, file)
    return np.asarray(safetensors.torch.load_file(file)["rows"].numpy())


def _digest(arrays: Iterable[NDArray[np.float32]]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()[:16]
