"""`rodif pretrain` from its first training through its rounds, with small sizes."""

from __future__ import annotations

import argparse
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.progress import Progress

from rodif_core import rollout as rollouts
from rodif_core.demonstrations import make_demonstrations, save_demonstrations
from rodif_core.encoder_training import EncoderConfig
from rodif_core.errors import LearningError, ValueOutOfRangeError
from rodif_core.policies.checkpoint import Checkpoint, load_checkpoint
from rodif_core.policies.resnet import ImageConfig
from rodif_core.presets import PretrainConfig, preset_for
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import RolloutConfig, TaskName
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory
from worker.cli import pretrain
from worker.cli.main import main

TASK, TOLD = TaskName.ALIGNING, TaskName.ALIGNING_STATE
CONFIG = replace(
    preset_for(TOLD, "cpu"), begin_with=TOLD, rounds=2, recoveries=3, round_updates=5,
    images=ImageConfig(pixels=64, width=8, keypoints=4, told=14),
    encoder=EncoderConfig(moments=50, updates=3, round_updates=2, batch_size=8),
)  # fmt: skip


def trained(workspace: Path, demos: Path | None = None, **changes: Any) -> Checkpoint:
    args = argparse.Namespace(
        task=TASK.value, demos=demos, demonstrations=4, preferred_share=None, seed=0, device="cpu",
        precision=None, workspace=workspace, track=0, processes=1, begin_with=None,
    )  # fmt: skip
    with Progress(disable=True) as bar:
        return pretrain._train(args, replace(CONFIG, **changes), bar)


def test_policy_that_was_told_the_state_is_begun_with(tmp_path: Path):
    made = trained(tmp_path)
    assert made.task is TASK
    assert made.card["demonstrations"] > 4  # takeovers from the policy begun with are among them
    assert made.card["recoveries"] == made.card["demonstrations"] - 4
    assert len(made.card["success_before_rounds"]) == 1  # of its own, not of the other task's
    assert made.card["preset"]["begin_with"] == TOLD.value
    begun = load_checkpoint(shipped_checkpoint(TOLD)).digest
    first = (tmp_path / "round-0" / "training.json").read_text()
    assert begun in first and made.card["start"] not in first


def test_encoder_learns_alone_in_looks_and_the_denoiser_moves_in_rounds(tmp_path: Path):
    begun = load_checkpoint(shipped_checkpoint(TOLD)).policy.denoiser.state_dict()
    looked = trained(tmp_path, rounds=0, looks=2)
    kept = looked.policy.denoiser.state_dict()
    assert all(torch.equal(kept[name], value) for name, value in begun.items())
    assert len(looked.card["earlier_curves"]) == 1
    assert looked.card["only_encoder"] and looked.card["rounds"] == 0
    # The same folder can have a round more: its looks are there already.
    more = trained(tmp_path, rounds=1, looks=2)
    moved = more.policy.denoiser.state_dict()
    assert not any(torch.equal(moved[name], begun[name]) for name in begun if "weight" in name)
    assert more.card["start"] == looked.digest
    assert "only_encoder" not in more.card and len(more.card["success_before_rounds"]) == 2


def test_policy_that_sees_learns_from_a_set_with_pictures_drawn_of_it(tmp_path: Path):
    file = tmp_path / "set.npz"
    save_demonstrations(file, make_demonstrations(get_task(TASK), episodes=3, seed=2))
    images = replace(CONFIG.images or ImageConfig(), told=0)
    made = trained(
        tmp_path / "work", file, begin_with=None, rounds=0, updates=2, images=images,
    )  # fmt: skip
    assert made.policy.encoder is not None
    assert made.card["demonstration_set"]["sources"] == {"scripted": 3}
    assert (made.card["demonstrations"], made.card["recoveries"]) == (3, 0)


def test_a_set_has_rounds_only_where_they_are_asked_for(tmp_path: Path):
    file = tmp_path / "set.npz"
    save_demonstrations(file, make_demonstrations(get_task("sorting"), episodes=3, seed=2))
    preset = preset_for(TaskName.SORTING, "cpu")
    wishes = {"task": "sorting", "preset": "cpu", "demos": file}
    none = {"demonstrations": None, "preferred_share": None, "begin_with": None}
    assert preset.rounds == 3
    asked = argparse.Namespace(**wishes, **none, rounds=None)
    assert pretrain._for_a_set(asked, preset).rounds == 0
    asked.rounds = 3
    assert pretrain._for_a_set(asked, preset).rounds == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["avoid", "--demonstrations", "9"], "--demonstrations is for scripted demonstrations"),
        (["avoid", "--left-share", "0.5"], "--preferred-share is for scripted demonstrations"),
        (["pushing"], "is of task 'avoid', but must be of 'pushing'"),
        (["aligning"], "begins with the shipped policy of 'aligning-state'.*--preset paper"),
        (["stacking"], "begins with the shipped policy of 'stacking-state'.*--preset paper"),
    ],
)
def test_what_does_not_go_together_with_a_set_is_told(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file, out = tmp_path / "set.npz", tmp_path / "policy.safetensors"
    save_demonstrations(file, make_demonstrations(get_task("avoid"), episodes=2, seed=2))
    assert main(["pretrain", *arguments, "--demos", str(file), "--out", str(out)]) == 1
    assert re.search(message, capsys.readouterr().err)
    assert not out.exists()


def test_looks_need_a_policy_to_begin_with():
    with pytest.raises(ValueOutOfRangeError, match="looks is 2.*0 without a policy to begin with"):
        PretrainConfig(looks=2)
    with pytest.raises(ValueOutOfRangeError, match="looks and rounds together is 0.*at least 1"):
        PretrainConfig(begin_with=TOLD)


def test_broken_run_goes_on_without_driving_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    driven: list[int] = []
    drive = rollouts.rollout

    def count(
        checkpoint: Checkpoint, config: RolloutConfig, *, progress: Any = None
    ) -> list[Trajectory]:
        driven.append(config.episodes)
        return drive(checkpoint, config, progress=progress)

    monkeypatch.setattr(rollouts, "rollout", count)
    whole = trained(tmp_path)
    assert driven == [3, 3]
    (tmp_path / "round-1" / "pretrain.safetensors").unlink(missing_ok=True)
    assert trained(tmp_path).digest == whole.digest
    assert driven == [3, 3]
    # Other sizes are another drive, and then another training.
    with pytest.raises(LearningError, match="partial state of another training"):
        trained(tmp_path, recoveries=4)
    assert driven == [3, 3, 4]
