"""The literal fine-tuners: full-batch Adam on one of the losses of `losses.LOSSES`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from rodif_core.errors import LearningError
from rodif_core.log_ratio import PairMatrix, Transitions, accumulate_gradient, preference_loss
from rodif_core.losses import DEAD_GRADIENT
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.spec import FinetuneConfig
from rodif_core.training_state import load_state, save_state

# stage, fraction of the stage in 0 … 1, metrics to plot; raising from it stops the work
StageProgress = Callable[[str, float, dict[str, float]], None]
SAVE_EVERY = 5  # updates between partial states


@dataclass(frozen=True, eq=False)
class ContrastResult:
    """A moved copy of the reference, the metrics of every update, and why it stopped."""

    policy: DiffusionPolicy
    curve: list[dict[str, float]]
    stopped: str


def contrast(
    reference: DiffusionPolicy,
    transitions: Transitions,
    matrix: PairMatrix,
    config: FinetuneConfig,
    *,
    stage: str,
    workspace: Path | None = None,
    progress: StageProgress | None = None,
) -> ContrastResult:
    """Up to `config.updates` exact full-batch updates.

    With a loss that has a gate (RoDiF) the optimizer stops as soon as it shuts (the votes passed
    their threshold): the loss is flat there, but Adam's momentum alone would go on and wreck the
    policy. A gate that is shut before the first update (γ ≥ 0.5 with the sum) is reported in
    `stopped`. Goes on from `workspace` when a partial state is there. Raises LearningError on a
    non-finite loss.
    """
    policy = reference.copy()
    optimizer = torch.optim.Adam(policy.denoiser.parameters(), lr=config.learning_rate)
    file = workspace / f"{stage}.safetensors" if workspace is not None else None
    modules = {"denoiser": policy.denoiser}
    curve: list[dict[str, float]] = []
    if file is not None:
        curve = load_state(file, modules, optimizer) or []
    stopped = "all updates done"
    for update in range(len(curve), config.updates):
        optimizer.zero_grad(set_to_none=True)
        output = accumulate_gradient(
            policy, transitions, config, lambda ratios: preference_loss(ratios, matrix, config)
        )
        if not math.isfinite(output.metrics["loss"]):
            raise LearningError(
                f"the loss became {output.metrics['loss']} at update {update} of {stage}"
            )
        shut = _gate_is_shut(output.metrics, config, update)
        if shut is not None:
            stopped = shut
            break
        optimizer.step()
        curve.append({"update": float(update), **output.metrics})
        if file is not None and (update + 1) % SAVE_EVERY == 0:
            save_state(file, modules, optimizer, curve)
        if progress is not None:
            progress(stage, (update + 1) / config.updates, output.metrics)
    return ContrastResult(policy, curve, stopped)


def _gate_is_shut(metrics: dict[str, Any], config: FinetuneConfig, update: int) -> str | None:
    if "gate_margin" not in metrics:  # a loss without a gate pulls until the updates are done
        return None
    # The slope is that of the loss; its outer logistic's own is outer_temperature times it.
    if update == 0 and metrics["outer_slope"] * config.outer_temperature < DEAD_GRADIENT:
        return (
            f"dead gradient: with conservativeness {config.conservativeness} and reduction "
            f"{config.reduction.value!r} the outer slope is {metrics['outer_slope']:.1e} before "
            "the first update; use a conservativeness below 0.5 or reduction 'mean'"
        )
    if metrics["gate_margin"] > 0:
        return f"the gate shut at update {update}: mean vote {metrics['mean_vote']:.3f}"
    return None
