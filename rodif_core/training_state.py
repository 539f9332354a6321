"""What training loops share: rate, precision, average, and partial state for a killed run.

One safetensors file (parameters, averages, Adam moments) with a JSON header; written to a
temporary file, flushed and renamed, so a kill or a power cut in the middle leaves the older state.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from rodif_core.errors import LearningError, UnknownNameError

UpdateProgress = Callable[[int, int, dict[str, float]], None]  # update, of, metrics


class Precision(StrEnum):
    """In which numbers a forward pass is computed; weights and updates are always float32."""

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"  # mixed precision: the range of float32, half the memory traffic


def usual_precision(device: str) -> Precision:
    """Mixed where it is fast, on a GPU."""
    return Precision.FLOAT32 if device == "cpu" else Precision.BFLOAT16


def check_device(device: str) -> None:
    """Raises UnknownNameError for a device that this machine has not."""
    legal = ["cpu"]
    if torch.cuda.is_available():
        legal += ["cuda", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if device not in legal:
        raise UnknownNameError("device", device, legal)


def forward_precision(device: str, precision: Precision) -> torch.autocast:
    """The context of a forward pass and its loss."""
    kind = torch.device(device).type
    return torch.autocast(kind, torch.bfloat16, enabled=precision is Precision.BFLOAT16)


def cosine_rate(update: int, warm_up: int, updates: int) -> float:
    """Factor of the learning rate: linear to 1 over `warm_up` updates, then a cosine to 0."""
    if update < warm_up:
        return (update + 1) / warm_up
    fraction = (update - warm_up) / max(1, updates - warm_up)
    return 0.5 * (1 + math.cos(math.pi * fraction))


@torch.no_grad()
def update_average(average: nn.Module, model: nn.Module, decay: float) -> None:
    """Move the running average of a model's weights towards the model: decay · old + rest · new."""
    for target, source in zip(average.parameters(), model.parameters(), strict=True):
        target.lerp_(source, 1 - decay)


def claim_workspace(workspace: Path, training: dict[str, Any]) -> None:
    """Note in a folder which training its partial states belong to, before the first is there.

    training  what decides the result, in JSON types

    Raises LearningError when the folder belongs to another training: going on from its states
    would give a policy that no command makes.
    """
    workspace.mkdir(parents=True, exist_ok=True)
    file = workspace / "training.json"
    here = json.loads(json.dumps(training))
    if not file.exists():
        temporary = file.with_suffix(".partial")
        temporary.write_text(json.dumps(here, indent=1, sort_keys=True))
        _put(temporary, file)
    try:
        there = json.loads(file.read_text())
    except ValueError as error:
        raise _damaged(file, error) from error
    differing = [
        f"{name} is {there.get(name)!r} there and {here.get(name)!r} here"
        for name in sorted(there.keys() | here.keys())
        if there.get(name) != here.get(name)
    ]
    if differing:
        raise LearningError(
            f"{workspace} holds the partial state of another training: {'; '.join(differing)}. "
            "Give another folder, or delete it to begin anew"
        )


def save_state(
    path: Path,
    modules: dict[str, nn.Module],
    optimizer: torch.optim.Optimizer | None,
    facts: Any,
) -> None:
    """Write the weights of all modules, the optimizer's moments and JSON facts.

    Raises LearningError, and leaves the older state, when a weight is not finite: going on from
    such a state could never end well.
    """
    tensors: dict[str, Tensor] = {}
    for label, module in modules.items():
        for name, value in module.state_dict().items():
            if value.is_floating_point() and not bool(value.isfinite().all()):
                raise LearningError(
                    f"the weights of {label} are not finite any more ({name}); {path} keeps what "
                    "was before, if anything: train with a lower learning rate"
                )
            tensors[f"{label}/{name}"] = value.detach().cpu().clone()
    moments = {} if optimizer is None else optimizer.state_dict()["state"]
    for index, values in moments.items():
        for name, value in values.items():
            tensors[f"optimizer/{index}/{name}"] = torch.as_tensor(value).detach().cpu().clone()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".partial")
    safetensors.torch.save_file(tensors, temporary, metadata={"facts": json.dumps(facts)})
    _put(temporary, path)


def load_state(
    path: Path, modules: dict[str, nn.Module], optimizer: torch.optim.Optimizer | None
) -> Any | None:
    """Restore what `save_state` wrote and return its facts; None when there is no such file.

    Raises LearningError for a damaged file, or one of other modules.
    """
    if not path.exists():
        return None
    try:
        with safe_open(str(path), framework="pt") as file:
            facts = json.loads(file.metadata()["facts"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        for label, module in modules.items():
            prefix = f"{label}/"
            module.load_state_dict(
                {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}
            )
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise _damaged(path, error) from error
    if optimizer is not None:
        _restore_moments(optimizer, tensors)
    return facts


def _restore_moments(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer/"):
            _, index, key = name.split("/")
            state.setdefault(int(index), {})[key] = value
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})


def _put(temporary: Path, file: Path) -> None:
    """Rename, once the bytes are on the disk."""
    with temporary.open("rb") as written:
        os.fsync(written.fileno())
    os.replace(temporary, file)


def _damaged(file: Path, error: Exception) -> LearningError:
    return LearningError(f"{file} is no readable partial state ({error}); delete it to begin anew")
