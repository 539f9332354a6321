"""Encoders that tell the state, and policies of told states that get eyes."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from rodif_core.demonstrations import make_demonstrations
from rodif_core.encoded_rows import encode
from rodif_core.encoder_training import EncoderConfig, train_encoder
from rodif_core.errors import ValueOutOfRangeError
from rodif_core.policies.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.policy import PolicyConfig
from rodif_core.policies.resnet import ImageConfig, ImageEncoder
from rodif_core.policies.telling import Telling
from rodif_core.presets import PretrainConfig, preset_for
from rodif_core.pretrain import pretrain
from rodif_core.rollout import rollout
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import RolloutConfig, TaskName
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory

TASK = get_task(TaskName.ALIGNING)
FELT, HIDDEN = TASK.proprioception_dim, TASK.observation_dim - TASK.proprioception_dim
IMAGES = ImageConfig(pixels=64, width=8, keypoints=4, told=HIDDEN)
ENCODER = EncoderConfig(
    moments=200, updates=60, round_updates=4, batch_size=16, warm_up=5, learning_rate=3e-3
)


@pytest.fixture(scope="module")
def demonstrations() -> list[Trajectory]:
    return make_demonstrations(TASK, episodes=4, seed=1)


@pytest.fixture(scope="module")
def twin() -> Checkpoint:
    return load_checkpoint(shipped_checkpoint(TaskName.ALIGNING_STATE))


@pytest.fixture(scope="module")
def seeing(demonstrations: list[Trajectory], twin: Checkpoint) -> Checkpoint:
    return pretrain(TASK.name, demonstrations, _config(), start=twin)


def _config() -> PretrainConfig:
    usual = preset_for(TaskName.ALIGNING_STATE, "cpu")
    return replace(
        usual, round_updates=5, batch_size=32, held_out=0.25, images=IMAGES, encoder=ENCODER
    )


def test_telling_in_task_units_is_the_normalised_one_scaled() -> None:
    torch.manual_seed(0)
    head, felt, features = Telling(2, 3, 2), torch.randn(5, 2), torch.randn(5, 3)
    assert torch.equal(head(felt, features), head.normalised(felt, features))
    centre, scale = torch.tensor([1.0, -2.0, 0.5, 30.0]), torch.tensor([2.0, 0.5, 0.1, 10.0])
    head.keep_scale(Normaliser(centre, scale, torch.zeros(1), torch.ones(1)))
    told = head(felt * scale[:2] + centre[:2], features)
    expected = head.normalised(felt, features) * scale[2:] + centre[2:]
    assert told.detach() == pytest.approx(expected.detach(), abs=1e-5)
    assert torch.equal(head.kept_scale().observation_centre, centre)
    assert torch.equal(head.kept_scale().observation_scale, scale)


def test_rows_of_a_telling_encoder_are_observations_as_it_sees_them(
    seeing: Checkpoint, demonstrations: list[Trajectory]
) -> None:
    policy = seeing.policy
    assert policy.config.observation_dim == TASK.observation_dim
    told = encode(TASK, policy.config, policy.encoder, demonstrations)
    rows, true = (
        np.concatenate([one.observations for one in each]) for each in (told, demonstrations)
    )
    assert np.array_equal(rows[:, :FELT], true[:, :FELT])
    wrong = ((rows - true) ** 2)[:, FELT:].mean(axis=0)
    # Better than always telling the mean, and not perfect after so few pictures.
    moving = true[:, FELT:].var(axis=0) > 1e-4
    assert 0 < (wrong / true[:, FELT:].var(axis=0).clip(1e-9))[moving].mean() < 0.8


def test_a_policy_that_was_told_gets_eyes_and_keeps_its_scale(
    seeing: Checkpoint, twin: Checkpoint
) -> None:
    before, after = twin.policy, seeing.policy
    assert after.config == replace(before.config, images=IMAGES)
    for name, value in before.normaliser.tensors().items():
        assert torch.equal(after.normaliser.tensors()[name], value)
    # Five updates of it are a short way from where it began.
    pairs = zip(before.denoiser.parameters(), after.denoiser.parameters(), strict=True)
    assert 0 < max(float((a - b).detach().abs().max()) for a, b in pairs) < 0.02
    assert seeing.card["start"] == twin.digest
    assert "earlier_curves" not in seeing.card  # those of the other task's policy are on its card
    again = load_checkpoint(save_checkpoint(seeing))
    assert again.digest == seeing.digest
    first, second = (rollout(one, RolloutConfig(1, 3))[0] for one in (seeing, again))
    assert np.array_equal(first.actions, second.actions)
    assert first.histories.shape[1:] == (1, TASK.observation_dim)


def test_encoder_with_a_head_of_its_own_learns_on_at_once_and_in_the_same_scale(
    seeing: Checkpoint, demonstrations: list[Trajectory]
) -> None:
    known = seeing.policy.encoder
    assert known is not None and known.telling is not None
    before = copy.deepcopy(known.state_dict())
    learnt, curve = train_encoder(
        TASK, demonstrations[:2], demonstrations[3:], IMAGES, ENCODER, seed=0, start=known
    )
    assert all(torch.equal(value, before[name]) for name, value in known.state_dict().items())
    assert curve[0]["loss"] < 0.7 * seeing.card["encoder_curve"][0]["loss"]  # it knows much already
    assert learnt.telling is not None
    assert torch.equal(learnt.telling.scale, known.telling.scale)
    pairs = zip(learnt.parameters(), known.parameters(), strict=True)
    assert all(not torch.equal(a, b) for a, b in pairs)


def test_denoiser_stays_when_only_the_encoder_learns(
    seeing: Checkpoint, demonstrations: list[Trajectory]
) -> None:
    after = pretrain(TASK.name, demonstrations, _config(), start=seeing, only_encoder=True)
    assert after.card["only_encoder"] and "held_out_curve" not in after.card
    assert len(after.card["earlier_curves"]) == 1

    def same(name: str) -> bool:
        parts = [getattr(one.policy, name).state_dict().values() for one in (seeing, after)]
        return all(torch.equal(a, b) for a, b in zip(*parts, strict=True))

    assert same("denoiser") and not same("encoder")


def test_training_the_encoder_alone_needs_a_denoiser_that_stays(
    demonstrations: list[Trajectory],
) -> None:
    with pytest.raises(ValueOutOfRangeError, match="only_encoder is True.*False without a start"):
        pretrain(TASK.name, demonstrations, _config(), only_encoder=True)


def test_what_is_told_must_be_what_the_task_hides() -> None:
    config = replace(_config(), images=replace(IMAGES, told=3))
    with pytest.raises(ValueOutOfRangeError, match=f"told is 3, but must be 0 or {HIDDEN}"):
        config.policy_config(TASK)
    with pytest.raises(ValueOutOfRangeError, match="told is -1.*at least 0"):
        replace(IMAGES, told=-1)


def test_json_names_what_is_told_only_where_something_is() -> None:
    shape = _config().policy_config(TASK)
    assert shape.to_json()["images"]["told"] == HIDDEN
    assert PolicyConfig.from_json(shape.to_json()) == shape
    blind = replace(IMAGES, told=0)  # as in the files from before
    seen = replace(shape, observation_dim=FELT + blind.feature_dim, images=blind)
    assert "told" not in seen.to_json()["images"]


def test_keypoints_alone_make_the_features_of_an_encoder_that_tells_nothing() -> None:
    torch.manual_seed(0)
    telling = ImageEncoder(IMAGES, FELT)
    plain = ImageEncoder(replace(IMAGES, told=0))
    plain.load_state_dict({k: v for k, v in telling.state_dict().items() if "telling" not in k})
    frames = torch.randint(0, 256, (1, 2, 2, 64, 64, 3), dtype=torch.uint8)
    felt = torch.zeros(1, 2, FELT)
    assert telling(felt, frames).shape == (1, 2, FELT + HIDDEN)
    assert torch.equal(plain(felt, frames)[..., FELT:], telling.look(frames))
