"""`rodif pretrain` from its first training through its rounds, with small sizes."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from rich.progress import Progress

from rodif_core.encoder_training import EncoderConfig
from rodif_core.policies.checkpoint import load_checkpoint
from rodif_core.policies.resnet import ImageConfig
from rodif_core.presets import preset_for
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import TaskName
from worker.cli import pretrain


def test_policy_that_was_told_the_state_is_begun_with(tmp_path: Path):
    task, told = TaskName.ALIGNING, TaskName.ALIGNING_STATE
    config = replace(
        preset_for(told, "cpu"), begin_with=told, rounds=1, recoveries=3, round_updates=5,
        images=ImageConfig(pixels=64, width=4, keypoints=4, told=14),
        encoder=EncoderConfig(moments=50, updates=3, batch_size=8),
    )  # fmt: skip
    args = argparse.Namespace(
        task=task.value, demonstrations=4, preferred_share=None, seed=0, device="cpu",
        precision=None, workspace=tmp_path, track=0,
    )  # fmt: skip
    with Progress(disable=True) as bar:
        made = pretrain._train(args, config, bar)
    assert made.task is task
    assert made.card["demonstrations"] > 4  # takeovers from the policy begun with are among them
    assert made.card["recoveries"] == made.card["demonstrations"] - 4
    assert len(made.card["success_before_rounds"]) == 1  # of its own, not of the other task's
    assert made.card["preset"]["begin_with"] == told.value
    begun = load_checkpoint(shipped_checkpoint(told)).digest
    first = (tmp_path / "round-0" / "training.json").read_text()
    assert begun in first and made.card["start"] not in first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["round-0", "round-1", "rows"]
