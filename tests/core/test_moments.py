"""Moments for encoders: states as they were, and with untouched objects elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rodif_core.demonstrations import make_demonstrations
from rodif_core.moments import Moments, rearranged
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.resnet import ImageConfig
from rodif_core.spec import TaskName
from rodif_core.tasks import get_task
from rodif_core.tasks.base import Task
from rodif_core.trajectory import Trajectory

WITH_CAMERAS = (TaskName.ALIGNING, TaskName.STACKING)


def shown(task: Task) -> list[Trajectory]:
    return make_demonstrations(task, episodes=2, seed=3)


def beginning(one: Trajectory) -> Trajectory:
    """Its first state alone, where nothing has been touched."""
    first = {name: getattr(one, name)[[0, 0]] for name in ("observations", "qpos", "paths")}
    return replace(one, **first, actions=one.actions[:1])


@pytest.mark.parametrize("name", WITH_CAMERAS)
def test_states_whose_objects_were_all_touched_stay_as_they_were(name: TaskName):
    task = get_task(name)
    one, other = shown(task)
    moved = replace(one, context=other.context)  # no object lies where that start would have it
    qpos, observations = rearranged(task, [moved], 40, np.random.default_rng(0))
    for row, seen in zip(qpos, observations, strict=True):
        step = int(np.flatnonzero((one.qpos == row).all(axis=1))[0])
        assert seen == pytest.approx(one.observations[step], abs=1e-5)


@pytest.mark.parametrize("name", WITH_CAMERAS)
def test_untouched_objects_lie_elsewhere_and_the_robot_stays(name: TaskName):
    task = get_task(name)
    one = beginning(shown(task)[0])
    qpos, observations = rearranged(task, [one], 200, np.random.default_rng(0))
    before, after = task.object_poses(one.qpos[0]), task.object_poses(qpos)
    assert np.array_equal(qpos[:, : task.robot_joints], one.qpos[[0] * 200, : task.robot_joints])
    moved = np.linalg.norm(after[:, :, :2] - before[:, :2], axis=2)
    assert (moved > 0).all()
    assert after[:, :, 2] == pytest.approx(np.tile(before[:, 2], (200, 1)), abs=1e-4)
    assert np.linalg.norm(after[:, :, 3:], axis=2) == pytest.approx(1.0, abs=1e-5)
    rng = np.random.default_rng(1)
    starts = np.stack([task.start_objects(task.sample_context(rng)) for _ in range(500)])
    low, high = starts[:, :, :2].min(axis=0), starts[:, :, :2].max(axis=0)
    legal = ((after[:, :, :2] >= low) & (after[:, :, :2] <= high)).all(axis=2)
    assert 0.7 < legal.mean() < 1  # the nudged ones may leave the range of starts
    told = task.proprioception_dim
    assert np.array_equal(observations[:, :told], one.observations[[0] * 200, :told])
    assert (observations[:, told:].std(axis=0) > 0).any()


def test_observation_tells_of_the_new_places():
    task = get_task(TaskName.STACKING)
    qpos, observations = rearranged(task, shown(task), 30, np.random.default_rng(1))
    places = observations[:, 14:29].reshape(-1, 3, 5)[:, :, :3]  # x, y, z of every block
    assert places == pytest.approx(task.object_poses(qpos)[:, :, :3], abs=1e-6)


def test_moments_are_the_asked_number_and_the_rearranged_ones_come_last():
    task = get_task(TaskName.ALIGNING)
    episodes = shown(task)
    states = Normaliser.fit([d.observations for d in episodes], [d.actions for d in episodes])
    images = ImageConfig(pixels=64, width=8, keypoints=4)
    plain = Moments.draw(task, episodes, images, states, 6)
    both = Moments.draw(task, episodes, images, states, 6, 5, np.random.default_rng(0))
    assert both.frames.shape == (11, 2, 64, 64, 3)
    assert torch.equal(both.frames[:6], plain.frames)
    assert torch.equal(both.hidden[:6], plain.hidden)
    again = Moments.draw(task, episodes, images, states, 6, 5, np.random.default_rng(0))
    assert torch.equal(both.frames, again.frames)
    assert len(plain.and_those(both).felt) == 17
