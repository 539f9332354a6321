"""Guided denoising: the second half of `rodif_guided`.

On the decision steps of kept trajectories, with fresh noise ε in what was done next, the network
regresses on ε_ref + s (ε - ε_ref), where ε_ref is the frozen reference's prediction. s = 1 is
imitation of the kept trajectories; s > 1 goes past them, away from the reference. It is a bounded
least-squares target: unlike a log-ratio it cannot run away.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from rodif_core.diffusion.chain import add_noise
from rodif_core.errors import LearningError
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.spec import GuideConfig
from rodif_core.training_state import UpdateProgress, update_average

REPORT_EVERY = 10  # updates between reports


def guidance_target(anchor: Tensor, noise: Tensor, scale: float) -> Tensor:
    """ε_ref + s (ε - ε_ref): the reference's own prediction at s = 0, plain imitation at s = 1."""
    return anchor + scale * (noise - anchor)


def guide(
    reference: DiffusionPolicy,
    histories: Tensor,
    chunks: Tensor,
    scale: float,
    config: GuideConfig,
    seed: int,
    progress: UpdateProgress | None = None,
) -> DiffusionPolicy:
    """Move a copy of the reference towards the kept decisions and return its running average.

    histories (N, To, O) and chunks (N, Tp, A) normalised; Adam with a cosine rate to 0.
    Raises LearningError when nothing was kept or the loss is not finite.
    """
    if len(chunks) == 0:
        raise LearningError("no trajectory was kept as a winner; more labels are needed")
    policy = reference.copy()
    average = copy.deepcopy(policy.denoiser)
    optimizer = torch.optim.Adam(policy.denoiser.parameters(), lr=config.learning_rate)
    generator = torch.Generator().manual_seed(seed)
    steps = reference.schedule.num_steps
    for update in range(config.updates):
        rate = 0.5 * (1 + math.cos(math.pi * update / config.updates))
        optimizer.param_groups[0]["lr"] = config.learning_rate * rate
        pick = torch.randint(len(chunks), (config.batch_size,), generator=generator)
        k = torch.randint(1, steps + 1, (config.batch_size,), generator=generator)
        noise = torch.randn(chunks[pick].shape, generator=generator)
        noisy = add_noise(reference.schedule, chunks[pick], noise, k)
        with torch.no_grad():
            anchor = reference.denoiser(noisy, k, histories[pick])
            target = guidance_target(anchor, noise, scale)
        loss = F.mse_loss(policy.denoiser(noisy, k, histories[pick]), target)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise LearningError(f"the guidance loss became {value} at update {update}")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        update_average(average, policy.denoiser, config.ema_decay)
        if progress is not None and (update % REPORT_EVERY == 0 or update == config.updates - 1):
            progress(update + 1, config.updates, {"loss": value})
    return replace(policy, denoiser=average)
