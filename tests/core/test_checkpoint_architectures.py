"""Checkpoint files over the versions: the first ones know no architecture but the U-Net."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import safetensors.torch

import rodif_core
from rodif_core.errors import CheckpointFileError
from rodif_core.policies.checkpoint import load_checkpoint, save_checkpoint
from rodif_core.spec import Architecture
from tests.core.learning import tiny_checkpoint

AVOID = Path(rodif_core.__file__).parent / "checkpoints" / "avoid.safetensors"
# Of the shipped Avoid policy, from before there was more than one architecture.
AVOID_DIGEST = "484f6e84bcc5a490ad40ec57308a207cecf0dd371c7115aaf4028a169e4fc330"


def test_checkpoint_from_before_there_were_architectures_keeps_its_digest_and_bytes() -> None:
    data = AVOID.read_bytes()
    checkpoint = load_checkpoint(data)
    assert checkpoint.policy.config.architecture is Architecture.UNET
    assert checkpoint.digest == AVOID_DIGEST
    assert save_checkpoint(checkpoint) == data


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"architecture": "nonesuch"},
            "unknown architecture 'nonesuch'.*'unet', 'transformer', 'mlp'",
        ),
        ({"depth": 3}, "unknown unet policy field 'depth'.*'channels'"),
        ({"channels": [16, 20]}, "channels is .16, 20.*multiples of 8"),
        ({"channels": [8, 16, 32]}, "size mismatch"),
    ],
)
def test_file_with_an_illegal_policy_names_what_is_wrong(
    change: dict[str, object], message: str
) -> None:
    data = save_checkpoint(tiny_checkpoint())
    size = int.from_bytes(data[:8], "little")
    header = json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["rodif"])
    header["config"] = json.dumps(json.loads(header["config"]) | change)
    tensors = safetensors.torch.load(data)
    changed = safetensors.torch.save(tensors, metadata={"rodif": json.dumps(header)})
    with pytest.raises(CheckpointFileError, match=message):
        load_checkpoint(changed)
