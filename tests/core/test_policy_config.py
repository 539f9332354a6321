"""The shape of a policy: its JSON form and its checks, for each architecture."""

from __future__ import annotations

import json
from typing import Any

import pytest

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.policies.mlp import MlpSize
from rodif_core.policies.policy import PolicyConfig
from rodif_core.policies.resnet import ImageConfig
from rodif_core.policies.transformer import TransformerSize
from rodif_core.policies.unet import UnetSize


@pytest.mark.parametrize(
    "config",
    [
        PolicyConfig(4, 2),
        PolicyConfig(10, 2, size=UnetSize(channels=(32, 64), step_dim=16), std_floor=0.1),
        PolicyConfig(10, 2, 5, 16, 8, 16, TransformerSize(width=32, heads=2)),
        PolicyConfig(20, 3, 1, 1, 1, 4, MlpSize(width=64)),
        PolicyConfig(136, 3, 1, 1, 1, 4, MlpSize(), ImageConfig(width=64)),
    ],
    ids=lambda config: f"{config.architecture} {config.observation_dim}",
)
def test_config_survives_json(config: PolicyConfig) -> None:
    assert PolicyConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


def test_json_of_a_unet_is_what_the_first_checkpoints_hold() -> None:
    assert PolicyConfig(4, 2).to_json() == {
        "observation_dim": 4,
        "action_dim": 2,
        "observation_steps": 2,
        "predicted_steps": 16,
        "executed_steps": 8,
        "denoising_steps": 20,
        "channels": [16, 32, 64],
        "step_dim": 32,
        "clip": 1.0,
        "std_floor": 0.0,
    }


def test_json_of_the_others_names_the_architecture_and_its_own_sizes_only() -> None:
    plain = PolicyConfig(20, 3, 1, 1, 1, 4, MlpSize(64, 2, 16)).to_json()
    sizes = {name: plain[name] for name in ("architecture", "width", "blocks", "step_dim")}
    assert sizes == {"architecture": "mlp", "width": 64, "blocks": 2, "step_dim": 16}
    assert "channels" not in plain and "images" not in plain


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"architecture": "nonesuch"},
            "unknown architecture 'nonesuch'.*'unet', 'transformer', 'mlp'",
        ),
        ({"size": {"width": 8}}, "unknown mlp policy field 'size'"),
        ({"channels": [16]}, "unknown mlp policy field 'channels'.*'width', 'blocks'"),
    ],
)
def test_foreign_names_in_json_are_told_with_the_legal_ones(
    change: dict[str, Any], message: str
) -> None:
    plain = PolicyConfig(20, 3, 1, 1, 1, 4, MlpSize()).to_json()
    with pytest.raises(UnknownNameError, match=message):
        PolicyConfig.from_json(plain | change)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: UnetSize(channels=()), "channels is .*positive multiples of 8"),
        (lambda: UnetSize(channels=(16, 20)), r"channels is \(16, 20\).*multiples of 8"),
        (lambda: UnetSize(step_dim=3), "step_dim is 3.*even number, at least 4"),
        (lambda: TransformerSize(width=30), "width is 30.*multiple of 4 heads"),
        (lambda: TransformerSize(decoder_layers=0), "decoder_layers is 0.*at least 1"),
        (lambda: MlpSize(blocks=0), "blocks is 0.*at least 1"),
        (lambda: MlpSize(step_dim=2), "step_dim is 2.*at least 4"),
        (lambda: PolicyConfig(4, 2, predicted_steps=10), "predicted_steps is 10.*multiple of 4"),
        (lambda: PolicyConfig(4, 2, executed_steps=17), "executed_steps is 17.*1 … 16"),
        (lambda: PolicyConfig(4, 0), "action_dim is 0.*at least 1"),
        (lambda: PolicyConfig(4, 2, 0), "observation_steps is 0.*at least 1"),
    ],
)
def test_illegal_sizes_name_the_value_and_the_legal_ones(make: Any, message: str) -> None:
    with pytest.raises(ValueOutOfRangeError, match=message):
        make()
