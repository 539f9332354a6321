"""Sampling a denoising chain and scoring it, both through `posterior_mean` and `schedule.std`.

Legend: B rows, K denoising steps, To observation history, Tp predicted chunk, O observation dims,
A action dims. `chain[:, 0]` is a^K (pure noise), `chain[:, K]` is a^0 (executed); all normalised,
never clamped. Paper: Eq. denosing-sampler and Eq. policy-chain.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from rodif_core.diffusion.schedule import NoiseSchedule

LOG_SQRT_TWO_PI = 0.9189385332046727  # log of the standard normal's normalising constant


class Denoiser(Protocol):
    """Noise predictor ε(a^k, k, s): (B, Tp, A), (B,) int64, (B, To, O) → (B, Tp, A)."""

    def __call__(self, noisy: Tensor, k: Tensor, history: Tensor) -> Tensor:
        """Predict the noise in `noisy`."""
        ...


def posterior_mean(schedule: NoiseSchedule, noisy: Tensor, noise: Tensor, k: Tensor) -> Tensor:
    """Mean μ_k of a^{k-1} given a^k and the predicted noise.

    noisy, noise (B, Tp, A); k (B,) in 1 … K; returns (B, Tp, A).
    """
    bar = schedule.alpha_bar.to(noisy)[k].view(-1, 1, 1)
    clean = (noisy - (1 - bar).sqrt() * noise) / bar.sqrt()
    clean = clean.clamp(-schedule.clip, schedule.clip)
    clean_weight = schedule.clean_weight.to(noisy)[k].view(-1, 1, 1)
    noisy_weight = schedule.noisy_weight.to(noisy)[k].view(-1, 1, 1)
    return clean_weight * clean + noisy_weight * noisy


def add_noise(schedule: NoiseSchedule, clean: Tensor, noise: Tensor, k: Tensor) -> Tensor:
    """a^k of the forward process: (B, Tp, A) clean and noise, k (B,) in 1 … K."""
    bar = schedule.alpha_bar.to(clean)[k].view(-1, 1, 1)
    return bar.sqrt() * clean + (1 - bar).sqrt() * noise


def sample_chain(
    denoiser: Denoiser, schedule: NoiseSchedule, history: Tensor, noise: Tensor
) -> Tensor:
    """Run the reverse process and keep every latent.

    history (B, To, O); noise (B, `noise_entries(schedule)`, Tp, A) standard normal: noise[:, 0]
    is a^K, noise[:, i] drives the i-th step. Returns the chain (B, K + 1, Tp, A).
    """
    steps = schedule.num_steps
    latents = [noise[:, 0]]
    for i, k in enumerate(range(steps, 0, -1)):
        rows = torch.full((len(history),), k, dtype=torch.int64, device=history.device)
        current = latents[-1]
        mean = posterior_mean(schedule, current, denoiser(current, rows, history), rows)
        std = float(schedule.std[k])
        latents.append(mean + std * noise[:, i + 1] if std > 0 else mean)
    return torch.stack(latents, dim=1)


def noise_entries(schedule: NoiseSchedule) -> int:
    """Standard-normal draws of shape (Tp, A) that one chain consumes; k = 1 may need none."""
    return schedule.num_steps + (1 if schedule.std_floor > 0 else 0)


def chain_means(
    denoiser: Denoiser, schedule: NoiseSchedule, history: Tensor, chain: Tensor
) -> Tensor:
    """Means μ_k for every scored step of given chains, in one network call.

    history (B, To, O), chain (B, K + 1, Tp, A) → (B, S, Tp, A) with S scored steps, in the order
    of `schedule.scored_steps`.
    """
    scored = schedule.scored_steps
    batch, count = len(chain), len(scored)
    noisy = chain[:, :count].reshape(batch * count, *chain.shape[2:])
    k = torch.tensor(scored, device=chain.device).repeat(batch)
    means = posterior_mean(
        schedule, noisy, denoiser(noisy, k, history.repeat_interleave(count, dim=0)), k
    )
    return means.view(batch, count, *chain.shape[2:])


def chain_log_prob(
    denoiser: Denoiser, schedule: NoiseSchedule, history: Tensor, chain: Tensor
) -> Tensor:
    """log π(a⁺ | s⁺) of Eq. policy-chain: sum over scored steps, chunk and action dims → (B,)."""
    means = chain_means(denoiser, schedule, history, chain)
    return log_prob_of_chunk_steps(schedule, chain, means).sum(dim=1)


def log_prob_of_chunk_steps(schedule: NoiseSchedule, chain: Tensor, means: Tensor) -> Tensor:
    """log p(chain) in nats, split by steps of the chunk: their sum over all Tp is the whole.

    chain (B, K + 1, Tp, A), means (B, S, Tp, A) of `chain_means`; returns (B, Tp).
    """
    count = means.shape[1]
    std = schedule.std.to(chain)[list(schedule.scored_steps)].view(1, count, 1, 1)
    residual = (chain[:, 1 : count + 1] - means) / std
    return (-0.5 * residual**2 - std.log() - LOG_SQRT_TWO_PI).sum(dim=(1, 3))


def log_prob_ratio(
    schedule: NoiseSchedule, chain: Tensor, means: Tensor, ref_means: Tensor, steps: int
) -> Tensor:
    """log p_θ(chain) - log π_ref(chain) from both means, exactly 0 where the means are equal.

    Algebraically chain_log_prob(θ) - chain_log_prob(ref), without subtracting two large sums.
    `steps` leading chunk steps count (Tp: all of them). Returns (B,).
    """
    count = means.shape[1]
    std = schedule.std.to(chain)[list(schedule.scored_steps)].view(1, count, 1, 1)
    target = chain[:, 1 : count + 1]
    per_element = (means - ref_means) * (2 * target - means - ref_means) / (2 * std**2)
    return per_element[:, :, :steps].sum(dim=(1, 2, 3))


def chain_kl(schedule: NoiseSchedule, means: Tensor, ref_means: Tensor) -> Tensor:
    """KL(p_θ ‖ π_ref) of each decision, along the stored chain, in nats → (B,)."""
    count = means.shape[1]
    std = schedule.std.to(means)[list(schedule.scored_steps)].view(1, count, 1, 1)
    return ((means - ref_means) ** 2 / (2 * std**2)).sum(dim=(1, 2, 3))
