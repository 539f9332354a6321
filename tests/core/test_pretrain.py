"""Pretraining: windows, resuming, and that it learns at all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rodif_core import pretrain as module
from rodif_core.demonstrations import make_demonstrations
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.policy import PolicyConfig
from rodif_core.policies.unet import UnetSize
from rodif_core.pretrain import PretrainConfig, Windows, pretrain
from rodif_core.spec import TaskName
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory

CONFIG = PretrainConfig(size=UnetSize((8, 16)), updates=30, batch_size=32, warm_up=5)


@pytest.fixture(scope="module")
def demonstrations() -> list[Trajectory]:
    return make_demonstrations(get_task(TaskName.AVOID), episodes=12, seed=5)


def test_windows_repeat_the_first_observation_and_the_last_action(
    demonstrations: list[Trajectory],
) -> None:
    one = demonstrations[0]
    normaliser = Normaliser.fit([one.observations], [one.actions])
    rows = Windows.cut([one], PolicyConfig(4, 2), normaliser)
    n = len(one.actions)
    assert rows.histories.shape == (n, 2, 4)
    assert rows.chunks.shape == (n, 16, 2)
    assert torch.equal(rows.histories[0, 0], rows.histories[0, 1])
    assert torch.equal(rows.chunks[-1], rows.chunks[-1, :1].expand(16, 2))
    actions = normaliser.to_task_action(rows.chunks[3])
    assert np.allclose(actions.numpy(), one.actions[3:19], atol=1e-6)


def test_normaliser_maps_extremes_to_one_and_back(demonstrations: list[Trajectory]) -> None:
    actions = np.concatenate([d.actions for d in demonstrations])
    normaliser = Normaliser.fit([d.observations for d in demonstrations], [actions])
    scaled = normaliser.action(torch.from_numpy(actions))
    assert float(scaled.max()) == pytest.approx(1.0, abs=1e-5)
    assert float(scaled.min()) == pytest.approx(-1.0, abs=1e-5)
    assert np.allclose(normaliser.to_task_action(scaled).numpy(), actions, atol=1e-7)


def test_held_out_loss_falls_when_it_trains(demonstrations: list[Trajectory]) -> None:
    config = replace(CONFIG, updates=200)
    curve = pretrain(TaskName.AVOID, demonstrations, config).card["held_out_curve"]
    assert curve[-1]["held_out"] < 0.7 * curve[0]["held_out"]


def test_killed_pretraining_goes_on_to_the_same_weights(
    demonstrations: list[Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SAVE_EVERY", 10)
    monkeypatch.setattr(module, "REPORT_EVERY", 5)

    class KilledError(Exception):
        pass

    def kill(update: int, _of: int, _metrics: dict[str, float]) -> None:
        if update > 20:
            raise KilledError

    with pytest.raises(KilledError):
        pretrain(TaskName.AVOID, demonstrations, CONFIG, workspace=tmp_path, progress=kill)
    resumed = pretrain(TaskName.AVOID, demonstrations, CONFIG, workspace=tmp_path)
    whole = pretrain(TaskName.AVOID, demonstrations, CONFIG)
    assert resumed.digest == whole.digest
