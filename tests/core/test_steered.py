"""Copies of a policy that each imitate its successes in one group."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rodif_core import steered
from rodif_core.diffusion.chain import add_noise
from rodif_core.errors import LearningError
from rodif_core.guided import decisions_done
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.steered import rare_groups, steered_copy
from rodif_core.trajectory import Trajectory
from tests.core.learning import chain_trajectory, tiny_checkpoint

SIDEWAYS = 0.0125  # m a control step


def drives(policy: DiffusionPolicy, group: str, *, success: bool = True) -> list[Trajectory]:
    """Three rollouts whose rod moves to one side all the time."""
    made = []
    for seed in range(3):
        one = chain_trajectory(policy, 4, seed=seed)
        actions = np.zeros_like(one.actions)
        actions[:, 0] = -SIDEWAYS if group == "left" else SIDEWAYS
        outcome = {"success": success, "mode": None, "group": group, "reason": "finished"}
        made.append(replace(one, actions=actions, outcome=outcome))
    return made


def error(policy: DiffusionPolicy, driven: list[Trajectory]) -> float:
    """Mean squared error of the noise that the policy sees in what these rollouts did."""
    histories, chunks = decisions_done(policy, driven)
    generator = torch.Generator().manual_seed(0)
    histories, chunks = histories.repeat(50, 1, 1), chunks.repeat(50, 1, 1)
    k = torch.randint(1, policy.schedule.num_steps + 1, (len(chunks),), generator=generator)
    noise = torch.randn(chunks.shape, generator=generator)
    with torch.no_grad():
        found = policy.denoiser(add_noise(policy.schedule, chunks, noise, k), k, histories)
    return float((found - noise).square().mean())


def test_each_copy_goes_the_way_of_its_group(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(steered, "UPDATES", 80)
    monkeypatch.setattr(steered, "LEARNING_RATE", 1e-2)
    checkpoint = tiny_checkpoint()
    left, right = drives(checkpoint.policy, "left"), drives(checkpoint.policy, "right")
    copies = [steered_copy(checkpoint, group, [*right, *left], 1) for group in ("left", "right")]
    goes_left, goes_right = (copy.policy for copy in copies)
    assert error(goes_left, left) < error(goes_right, left) < error(checkpoint.policy, left)
    assert error(goes_right, right) < error(goes_left, right) < error(checkpoint.policy, right)
    assert copies[0].card["parent"] == checkpoint.digest
    assert checkpoint.digest == tiny_checkpoint().digest  # the policy itself stays


def test_neither_a_group_without_successes_nor_that_of_most_is_rare():
    checkpoint = tiny_checkpoint()
    left, right = (drives(checkpoint.policy, group) for group in ("left", "right"))
    failed = drives(checkpoint.policy, "left", success=False)
    assert rare_groups(checkpoint, [*right, *left]) == ["left", "right"]
    assert rare_groups(checkpoint, [*left[:2], *right]) == ["left"]
    assert rare_groups(checkpoint, [*failed, *right]) == []
    assert rare_groups(checkpoint, failed) == []


def test_copies_are_the_same_each_time(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(steered, "UPDATES", 3)
    checkpoint = tiny_checkpoint()
    driven = [*drives(checkpoint.policy, "right"), *drives(checkpoint.policy, "left")]
    once, twice = (steered_copy(checkpoint, "right", driven, 4) for _ in range(2))
    assert once.digest == twice.digest != checkpoint.digest


def test_a_copy_of_no_success_cannot_be_made():
    checkpoint = tiny_checkpoint()
    failed = drives(checkpoint.policy, "left", success=False)
    with pytest.raises(LearningError):
        steered_copy(checkpoint, "left", failed, 0)
