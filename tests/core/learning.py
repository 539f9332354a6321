"""Small policies and hand-made trajectories for the learning tests."""

from __future__ import annotations

import numpy as np
import torch

from rodif_core.policies.checkpoint import Checkpoint, SupportSet
from rodif_core.policies.mlp import MlpSize
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.policy import DiffusionPolicy, PolicyConfig
from rodif_core.policies.transformer import TransformerSize
from rodif_core.policies.unet import UnetSize
from rodif_core.spec import Architecture, TaskName
from rodif_core.trajectory import Trajectory

TINY_SIZES = {
    Architecture.UNET: UnetSize(channels=(8, 16), step_dim=8),
    Architecture.TRANSFORMER: TransformerSize(16, 2, 1, 2, 24),
    Architecture.MLP: MlpSize(width=24, blocks=2, step_dim=8),
}
TINY_HISTORIES = {Architecture.UNET: 2, Architecture.TRANSFORMER: 3, Architecture.MLP: 1}


def tiny_policy(
    seed: int = 0,
    *,
    std_floor: float = 0.0,
    steps: int = 5,
    architecture: Architecture = Architecture.UNET,
) -> DiffusionPolicy:
    """Avoid's dims, a network of some ten thousand weights or fewer, K = `steps`; the MLP acts
    one step at a time."""
    torch.manual_seed(seed)
    single = architecture is Architecture.MLP
    config = PolicyConfig(
        observation_dim=4,
        action_dim=2,
        observation_steps=TINY_HISTORIES[architecture],
        predicted_steps=1 if single else 8,
        executed_steps=1 if single else 4,
        denoising_steps=steps,
        size=TINY_SIZES[architecture],
        std_floor=std_floor,
    )
    normaliser = Normaliser(
        torch.tensor([0.5, 0.0, 0.5, 0.0]), torch.full((4,), 0.4),
        torch.zeros(2), torch.full((2,), 0.0125),
    )  # fmt: skip
    return DiffusionPolicy.build(config, normaliser)


def tiny_checkpoint(seed: int = 0, *, architecture: Architecture = Architecture.UNET) -> Checkpoint:
    """A checkpoint around `tiny_policy`."""
    policy = tiny_policy(seed, architecture=architecture)
    support = SupportSet(torch.zeros(3, 4), 0.1)
    return Checkpoint(TaskName.AVOID, policy, support, {"kind": "test"})


def chain_trajectory(
    policy: DiffusionPolicy, decisions: int, seed: int, *, x: float = 0.5, success: bool = True
) -> Trajectory:
    """An episode whose chains the policy itself sampled, at made-up observations around `x`."""
    generator = torch.Generator().manual_seed(seed)
    size = policy.config
    histories = torch.randn(decisions, size.observation_steps, 4, generator=generator) * 0.05
    histories = histories + torch.tensor([x, 0.0, x, 0.0])
    noise = torch.randn(
        decisions, size.denoising_steps + 1, size.predicted_steps, 2, generator=generator
    )
    _, chains = policy.act(histories, noise)
    n = decisions * size.executed_steps
    path = np.zeros((n + 1, 3), dtype=np.float32)
    path[:, 0] = np.linspace(0.5, x, n + 1)
    path[:, 1] = np.linspace(-0.28, 0.35, n + 1)
    return Trajectory(
        observations=np.zeros((n + 1, 4), dtype=np.float32),
        actions=np.zeros((n, 2), dtype=np.float32),
        qpos=np.zeros((n + 1, 7), dtype=np.float32),
        paths=path,
        histories=histories.numpy(),
        chains=chains.numpy(),
        decision_steps=np.arange(decisions, dtype=np.int32) * size.executed_steps,
        context={},
        outcome={"success": success, "mode": None, "group": None, "reason": "finished"},
        info={"seed": seed},
    )
