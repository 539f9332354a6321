"""The checkpoint file: round trip, equal bytes, damaged and foreign files, the shipped one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import safetensors.torch
import torch

from rodif_core import shipped
from rodif_core.errors import CheckpointFileError
from rodif_core.policies.checkpoint import (
    FORMAT,
    load_checkpoint,
    save_checkpoint,
)
from rodif_core.shipped import shipped_checkpoint, shipped_tasks
from rodif_core.spec import TaskName
from tests.core.learning import tiny_checkpoint


def test_checkpoint_survives_the_file_form_bit_for_bit() -> None:
    original = tiny_checkpoint()
    data = save_checkpoint(original)
    copy = load_checkpoint(data)
    assert copy.digest == original.digest
    assert save_checkpoint(copy) == data
    history, noise = torch.randn(2, 2, 4), torch.randn(2, 5, 8, 2)
    assert torch.equal(copy.policy.act(history, noise)[1], original.policy.act(history, noise)[1])


def test_loading_leaves_the_random_state_of_the_caller_alone() -> None:
    data = save_checkpoint(tiny_checkpoint())
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    load_checkpoint(data)
    assert torch.equal(torch.rand(2), expected)


def test_digest_changes_with_a_single_weight() -> None:
    original, other = tiny_checkpoint(), tiny_checkpoint()
    with torch.no_grad():
        next(other.policy.denoiser.parameters()).view(-1)[0] += 1e-3
    assert other.digest != original.digest


@pytest.mark.parametrize("damage", ["empty", "cut", "text"])
def test_damaged_file_gives_a_clear_error(damage: str) -> None:
    data = save_checkpoint(tiny_checkpoint())
    damaged = {"empty": b"", "cut": data[: len(data) // 2], "text": b"hello world" * 9}[damage]
    with pytest.raises(CheckpointFileError, match="not a readable checkpoint file"):
        load_checkpoint(damaged)


def test_flipped_weight_byte_is_found_by_the_digest() -> None:
    data = bytearray(save_checkpoint(tiny_checkpoint()))
    data[-9] ^= 0x01
    with pytest.raises(CheckpointFileError, match="content has digest"):
        load_checkpoint(bytes(data))


def test_file_of_another_format_names_both_formats() -> None:
    header = json.dumps({"format": "rodif-checkpoint-99"})
    data = safetensors.torch.save({"x": torch.zeros(1)}, metadata={"rodif": header})
    with pytest.raises(CheckpointFileError, match=f"'rodif-checkpoint-99'.*{FORMAT}"):
        load_checkpoint(data)


@pytest.mark.parametrize("task", shipped_tasks())
def test_shipped_checkpoint_loads_and_tells_what_it_reaches(task: TaskName) -> None:
    checkpoint = load_checkpoint(shipped_checkpoint(task))
    assert checkpoint.task is task
    assert checkpoint.card["kind"] == "pretrained"  # the rest of the card: tests/test_models.py


def test_a_task_without_a_checkpoint_names_those_that_have_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped_file = shipped._file
    monkeypatch.setattr(
        shipped, "_file", lambda task: tmp_path if task == "pushing" else shipped_file(task)
    )
    with pytest.raises(CheckpointFileError, match=r"'pushing'.*'avoid'.*rodif pretrain pushing"):
        shipped_checkpoint(TaskName.PUSHING)
