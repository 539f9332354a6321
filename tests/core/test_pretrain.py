"""Pretraining: windows, resuming, and that it learns at all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rodif_core import pretrain as module
from rodif_core.demonstrations import make_demonstrations
from rodif_core.errors import LearningError, UnknownNameError
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.policy import PolicyConfig, build_denoiser
from rodif_core.policies.unet import UnetSize
from rodif_core.presets import PRESETS, TASK_ARCHITECTURES, PretrainConfig, preset_for
from rodif_core.pretrain import Windows, pretrain
from rodif_core.spec import Architecture, TaskName
from rodif_core.tasks import get_task
from rodif_core.training_state import Precision, usual_precision
from rodif_core.trajectory import Trajectory
from tests.core.learning import TINY_SIZES

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


@pytest.mark.parametrize("architecture", list(Architecture))
def test_held_out_loss_falls_when_it_trains(
    demonstrations: list[Trajectory], architecture: Architecture
) -> None:
    shape = PRESETS[architecture]["cpu"]
    config = replace(
        shape, size=TINY_SIZES[architecture], updates=200, batch_size=32, warm_up=5,
        learning_rate=3e-3,
    )  # fmt: skip
    checkpoint = pretrain(TaskName.AVOID, demonstrations, config)
    curve = checkpoint.card["held_out_curve"]
    assert curve[-1]["held_out"] < 0.7 * curve[0]["held_out"]
    assert checkpoint.card["architecture"] == architecture
    size = checkpoint.policy.config
    assert size == config.policy_config(get_task(TaskName.AVOID))
    actions, _ = checkpoint.policy.act(
        torch.zeros(1, size.observation_steps, 4),
        torch.zeros(1, size.denoising_steps, size.predicted_steps, 2),
    )
    assert actions.shape == (1, size.executed_steps, 2)


@pytest.mark.parametrize("name", ["cpu", "paper"])
@pytest.mark.parametrize(
    ("architecture", "shape"),
    # The paper's appendix: T_obs, T_pred, K; the single action leaves no choice of T_exec.
    [
        (Architecture.UNET, (2, 16, 8, 20)),
        (Architecture.TRANSFORMER, (5, 16, 8, 16)),
        (Architecture.MLP, (1, 1, 1, 4)),
    ],
)
def test_presets_have_the_shapes_of_the_paper(
    architecture: Architecture, name: str, shape: tuple[int, ...]
) -> None:
    config = PRESETS[architecture][name].policy_config(get_task(TaskName.AVOID))
    assert config.architecture is architecture
    assert shape == (
        config.observation_steps,
        config.predicted_steps,
        config.executed_steps,
        config.denoising_steps,
    )


@pytest.mark.parametrize(
    ("architecture", "name", "weights"),
    # With 10 observation and 2 action dims.
    [
        (Architecture.UNET, "cpu", 165_810),
        (Architecture.UNET, "paper", 34_169_250),
        (Architecture.TRANSFORMER, "cpu", 400_130),
        (Architecture.TRANSFORMER, "paper", 57_110_402),
        (Architecture.MLP, "cpu", 114_210),
        (Architecture.MLP, "paper", 548_770),
    ],
)
def test_presets_have_the_documented_number_of_weights(
    architecture: Architecture, name: str, weights: int
) -> None:
    with torch.device("meta"):  # shapes without memory
        shape = PRESETS[architecture][name].policy_config(get_task(TaskName.AVOID))
        denoiser = build_denoiser(replace(shape, observation_dim=10))
    assert sum(value.numel() for value in denoiser.parameters()) == weights
    text = (Path(__file__).parents[2] / "docs" / "architectures.md").read_text()
    assert f"| `{architecture}` | `{name}` |" in text
    row = next(line for line in text.splitlines() if f"| `{architecture}` | `{name}` |" in line)
    assert f"| {weights:,} |" in row


def test_every_task_has_an_architecture_and_avoid_keeps_its_training() -> None:
    assert set(TaskName) <= set(TASK_ARCHITECTURES)
    config = preset_for(TaskName.AVOID, "cpu")
    assert config.size == UnetSize(channels=(16, 32, 64), step_dim=32)
    assert (config.updates, config.batch_size, config.learning_rate) == (10_000, 128, 1e-3)
    assert (config.weight_decay, config.warm_up, config.ema_decay) == (1e-6, 200, 0.999)
    with pytest.raises(UnknownNameError, match="unknown preset 'gpu'.*'cpu', 'paper'"):
        preset_for(TaskName.AVOID, "gpu")


def test_a_task_without_presets_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(TASK_ARCHITECTURES, "pushing")
    with pytest.raises(UnknownNameError, match="unknown task with presets 'pushing'.*'avoid'"):
        preset_for(TaskName.PUSHING, "cpu")


def test_mixed_precision_computes_in_half_and_keeps_full_weights(
    demonstrations: list[Trajectory],
) -> None:
    full = pretrain(TaskName.AVOID, demonstrations, CONFIG)
    mixed = pretrain(TaskName.AVOID, demonstrations, CONFIG, precision=Precision.BFLOAT16)
    assert full.card["precision"] == "float32" and mixed.card["precision"] == "bfloat16"
    assert all(weight.dtype == torch.float32 for weight in mixed.policy.denoiser.parameters())
    assert mixed.digest != full.digest
    ends = [one.card["held_out_curve"][-1]["held_out"] for one in (full, mixed)]
    assert ends[1] == pytest.approx(ends[0], rel=0.05)  # bfloat16 has 8 bits of fraction


def test_mixed_precision_is_usual_on_a_gpu_only() -> None:
    assert usual_precision("cpu") is Precision.FLOAT32
    assert usual_precision("cuda:0") is Precision.BFLOAT16


def test_a_device_that_is_not_there_is_refused(demonstrations: list[Trajectory]) -> None:
    with pytest.raises(UnknownNameError, match="unknown device 'tpu'.*'cpu'"):
        pretrain(TaskName.AVOID, demonstrations, CONFIG, device="tpu")


def test_tracking_tells_success_on_the_way_and_changes_no_weights(
    demonstrations: list[Trajectory],
) -> None:
    told: list[tuple[int, dict[str, float]]] = []
    tracked = pretrain(
        TaskName.AVOID, demonstrations, CONFIG, track=3,
        progress=lambda done, _, metrics: told.append((done, metrics)),
    )  # fmt: skip
    curve = tracked.card["rollout_curve"]
    assert [point["update"] for point in curve] == [6, 12, 18, 24]
    assert all(
        point["success"] * 3 == pytest.approx(round(point["success"] * 3)) for point in curve
    )
    assert [metrics for _, metrics in told if "success" in metrics] == curve
    untracked = pretrain(TaskName.AVOID, demonstrations, CONFIG)
    assert untracked.digest == tracked.digest
    assert untracked.card["rollout_curve"] == []


def test_a_card_keeps_the_curves_of_the_trainings_before(
    demonstrations: list[Trajectory],
) -> None:
    config = replace(CONFIG, round_updates=5)
    first = pretrain(TaskName.AVOID, demonstrations, config, track=1)
    first = replace(first, card=first.card | {"encoder_curve": [{"update": 0.0, "loss": 1.0}]})
    second = pretrain(TaskName.AVOID, demonstrations, config, start=first)
    third = pretrain(TaskName.AVOID, demonstrations, config, start=second)
    names = ("held_out_curve", "rollout_curve")
    assert third.card["earlier_curves"] == [
        {name: one.card[name] for name in names} for one in (first, second)
    ]
    assert len(third.card["earlier_curves"][0]["rollout_curve"]) == 4
    assert third.card["encoder_curve"] == first.card["encoder_curve"]


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
        pretrain(TaskName.AVOID, demonstrations, CONFIG, workspace=tmp_path, track=2, progress=kill)
    resumed = pretrain(TaskName.AVOID, demonstrations, CONFIG, workspace=tmp_path, track=2)
    whole = pretrain(TaskName.AVOID, demonstrations, CONFIG, track=2)
    assert resumed.digest == whole.digest
    assert resumed.card["rollout_curve"] == whole.card["rollout_curve"]


def test_a_workspace_of_another_training_is_refused_and_kept(
    demonstrations: list[Trajectory], tmp_path: Path
) -> None:
    pretrain(TaskName.AVOID, demonstrations, CONFIG, workspace=tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    longer = replace(CONFIG, updates=31)
    with pytest.raises(LearningError, match="updates is 30 there and 31 here"):
        pretrain(TaskName.AVOID, demonstrations, longer, workspace=tmp_path)
    with pytest.raises(LearningError, match="demonstrations is"):
        pretrain(TaskName.AVOID, demonstrations[:-1], CONFIG, workspace=tmp_path)
    # How many rounds follow does not decide this one.
    again = pretrain(TaskName.AVOID, demonstrations, replace(CONFIG, rounds=2), workspace=tmp_path)
    assert again.card["preset"]["rounds"] == 2
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
