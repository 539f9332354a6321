"""A policy is compared with the task that its file names."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rodif_core.errors import CheckpointFileError
from rodif_core.fit import check_fit
from rodif_core.policies.checkpoint import SupportSet, load_checkpoint
from rodif_core.shipped import shipped_checkpoint, shipped_tasks
from rodif_core.spec import TaskName
from tests.core.learning import tiny_checkpoint


@pytest.mark.parametrize("task", shipped_tasks())
def test_shipped_policies_fit_their_tasks(task: TaskName):
    check_fit(load_checkpoint(shipped_checkpoint(task)))


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (TaskName.PUSHING, "numbers of an observation beside pictures: 4 in the file.*must be 20"),
        (TaskName.ALIGNING, "cameras: 0 in the file, but must be 2"),
    ],
)
def test_network_of_another_task_is_refused(task: TaskName, message: str):
    with pytest.raises(CheckpointFileError, match=message):
        check_fit(replace(tiny_checkpoint(), task=task))


def test_support_of_another_task_is_refused():
    foreign = replace(tiny_checkpoint(), support=SupportSet(torch.zeros(3, 5), 0.1))
    with pytest.raises(CheckpointFileError, match="state in its support: 5 in the file.*must be 4"):
        check_fit(foreign)


def test_normaliser_of_another_width_is_refused():
    good = tiny_checkpoint()
    normaliser = replace(good.policy.normaliser, action_scale=torch.ones(3))
    foreign = replace(good, policy=replace(good.policy, normaliser=normaliser))
    with pytest.raises(CheckpointFileError, match="action_scale of its normaliser: 3 in the file"):
        check_fit(foreign)


def test_pictures_without_a_scale_of_states_are_refused():
    shipped = load_checkpoint(shipped_checkpoint(TaskName.ALIGNING))
    foreign = replace(shipped, support=replace(shipped.support, normaliser=None))
    with pytest.raises(CheckpointFileError, match="no normaliser of the task's observations"):
        check_fit(foreign)
