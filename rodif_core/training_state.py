"""What training loops share: rate, precision, and partial state on disk for a killed run to go on.

One safetensors file (parameters, averages, Adam moments) with a JSON header; written to a
temporary file and renamed, so a kill in the middle leaves the older state.
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
from safetensors import safe_open
from torch import Tensor, nn

from rodif_core.errors import LearningError, UnknownNameError

Progress = Callable[[int, int, dict[str, float]], None]  # update, of, metrics


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
        os.replace(temporary, file)
    there = json.loads(file.read_text())
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
    path: Path, modules: dict[str, nn.Module], optimizer: torch.optim.Optimizer, facts: Any
) -> None:
    """Write the weights of all modules, the optimizer's moments and JSON facts."""
    tensors: dict[str, Tensor] = {}
    for label, module in modules.items():
        for name, value in module.state_dict().items():
            tensors[f"{label}/{name}"] = value.detach().cpu().clone()
    for index, moments in optimizer.state_dict()["state"].items():
        for name, value in moments.items():
            tensors[f"optimizer/{index}/{name}"] = torch.as_tensor(value).detach().cpu().clone()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".partial")
    safetensors.torch.save_file(tensors, temporary, metadata={"facts": json.dumps(facts)})
    os.replace(temporary, path)


def load_state(
    path: Path, modules: dict[str, nn.Module], optimizer: torch.optim.Optimizer
) -> Any | None:
    """Restore what `save_state` wrote and return its facts; None when there is no such file."""
    if not path.exists():
        return None
    with safe_open(str(path), framework="pt") as file:
        facts = json.loads(file.metadata()["facts"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    for label, module in modules.items():
        prefix = f"{label}/"
        module.load_state_dict(
            {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}
        )
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer/"):
            _, index, key = name.split("/")
            state.setdefault(int(index), {})[key] = value
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})
    return facts
