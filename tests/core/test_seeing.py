"""A task with cameras from demonstrations to rollouts: encoder, policy, drift, recoveries."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rodif_core import encoder_training
from rodif_core.demonstrations import make_demonstrations
from rodif_core.encoded_rows import encode
from rodif_core.encoder_training import EncoderConfig, train_encoder
from rodif_core.errors import ValueOutOfRangeError
from rodif_core.evaluate import summarise
from rodif_core.policies.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from rodif_core.policies.mlp import MlpSize
from rodif_core.policies.resnet import ImageConfig, ImageEncoder
from rodif_core.presets import PRESETS, PretrainConfig, preset_for
from rodif_core.pretrain import pretrain
from rodif_core.recoveries import make_recoveries
from rodif_core.rollout import rollout
from rodif_core.sight import Sight, draw
from rodif_core.spec import Architecture, RolloutConfig, TaskName
from rodif_core.tasks import get_task
from rodif_core.tasks.camera import Camera
from rodif_core.trajectory import Trajectory

TASK = get_task(TaskName.ALIGNING)
IMAGES = ImageConfig(pixels=64, width=8, keypoints=4)
ENCODER = EncoderConfig(moments=200, updates=40, batch_size=16, warm_up=5, learning_rate=3e-3)
CONFIG = PretrainConfig(
    size=MlpSize(width=16, blocks=1),
    observation_steps=1,
    predicted_steps=1,
    executed_steps=1,
    denoising_steps=4,
    updates=5,
    batch_size=32,
    held_out=0.25,
    images=IMAGES,
    encoder=ENCODER,
)


@pytest.fixture(scope="module")
def demonstrations() -> list[Trajectory]:
    return make_demonstrations(TASK, episodes=4, seed=1)


@pytest.fixture(scope="module")
def checkpoint(demonstrations: list[Trajectory]) -> Checkpoint:
    return pretrain(TASK.name, demonstrations, CONFIG)


def test_encoder_learns_where_things_are(checkpoint: Checkpoint) -> None:
    curve = checkpoint.card["encoder_curve"]
    assert curve[-1]["loss"] < 0.5 * curve[0]["loss"]
    assert np.isfinite([point["held_out"] for point in curve]).all()


def test_policy_reads_proprioception_and_features(
    checkpoint: Checkpoint, demonstrations: list[Trajectory]
) -> None:
    policy, one = checkpoint.policy, demonstrations[0]
    assert policy.config.observation_dim == 6 + IMAGES.feature_dim
    with Sight(TASK, policy.config, policy.encoder) as sight:
        rows = sight.rows(one.observations[:3], one.qpos[:3])
    assert np.array_equal(rows[:, :6], one.observations[:3, :6])
    with Camera(TASK, 64, 64) as camera:
        frames = torch.from_numpy(draw(camera, TASK, one.qpos[:3]))
    felt = torch.tensor(one.observations[:3, :6])
    with torch.no_grad():
        expected = policy.observe(felt[:, None], frames[:, None])[:, 0]
    assert rows == pytest.approx(expected.numpy(), abs=1e-6)


def test_rollout_keeps_states_as_observations_and_rows_as_histories(
    checkpoint: Checkpoint,
) -> None:
    config = RolloutConfig(episodes=2, seed=3)
    first, second = rollout(checkpoint, config), rollout(checkpoint, config)
    for one, again in zip(first, second, strict=True):
        assert one.observations.shape[1] == TASK.observation_dim
        assert one.histories.shape[1:] == (1, 6 + IMAGES.feature_dim)
        assert np.array_equal(one.histories[:, 0, :6], one.observations[one.decision_steps][:, :6])
        assert np.array_equal(one.chains, again.chains)
    assert 0 <= summarise(checkpoint, first).off_support <= 1


def test_history_of_a_chunked_policy_has_the_rows_of_its_last_steps(
    demonstrations: list[Trajectory],
) -> None:
    config = replace(
        CONFIG, observation_steps=2, predicted_steps=4, executed_steps=4,
        encoder=replace(ENCODER, updates=2),
    )  # fmt: skip
    one = pretrain(TASK.name, demonstrations, config)
    (made,) = rollout(one, RolloutConfig(episodes=1, seed=3))
    before = made.observations[np.maximum(made.decision_steps - 1, 0)]
    assert np.array_equal(made.histories[:, 0, :6], before[:, :6])
    with Sight(TASK, one.policy.config, one.policy.encoder) as sight:
        step = made.decision_steps[2]
        rows = sight.rows(made.observations[step - 1 : step + 1], made.qpos[step - 1 : step + 1])
    assert made.histories[2] == pytest.approx(rows, abs=1e-5)


def test_file_keeps_the_scale_of_states(checkpoint: Checkpoint) -> None:
    again = load_checkpoint(save_checkpoint(checkpoint))
    assert again.digest == checkpoint.digest
    assert again.support.normaliser is not None
    scale = again.state_normaliser.observation_scale
    assert scale.shape == (TASK.observation_dim,)
    assert again.support.points.shape[1] == TASK.observation_dim


def test_experts_take_over_from_a_policy_that_sees(checkpoint: Checkpoint) -> None:
    made = make_recoveries(TASK, rollout(checkpoint, RolloutConfig(episodes=2, seed=11)))
    assert all(one.observations.shape[1] == TASK.observation_dim for one in made)
    config = replace(CONFIG, updates=2)
    further = pretrain(TASK.name, [*made, *make_demonstrations(TASK, episodes=4, seed=1)], config,
                       start=checkpoint)  # fmt: skip
    assert further.policy.encoder is checkpoint.policy.encoder


def test_pictures_are_encoded_once_for_all_trainings_with_one_encoder(
    checkpoint: Checkpoint, demonstrations: list[Trajectory], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    policy, two = checkpoint.policy, demonstrations[:2]
    plain = encode(TASK, policy.config, policy.encoder, two)
    first = encode(TASK, policy.config, policy.encoder, two, tmp_path / "rows")
    files = sorted((tmp_path / "rows").iterdir())
    assert len(files) == 2

    drawn: list[int] = []
    rows = Sight.rows

    def count(self: Sight, observations: Any, qpos: Any) -> Any:
        drawn.append(len(qpos))
        return rows(self, observations, qpos)

    monkeypatch.setattr(Sight, "rows", count)
    third = demonstrations[2]
    again = encode(TASK, policy.config, policy.encoder, [*two, third], tmp_path / "rows")
    assert drawn == [len(third.qpos)]
    for one, other, same in zip(plain, first, again, strict=False):
        assert one.observations == pytest.approx(other.observations, abs=1e-6)
        assert np.array_equal(other.observations, same.observations)
    blurred = copy.deepcopy(policy.encoder)
    assert blurred is not None
    with torch.no_grad():
        next(blurred.parameters()).mul_(0.5)
    encode(TASK, policy.config, blurred, two, tmp_path / "rows")
    assert drawn[1:] == [len(one.qpos) for one in two]


def test_encoder_learns_on_from_what_the_policy_met(
    checkpoint: Checkpoint, demonstrations: list[Trajectory]
) -> None:
    met = rollout(checkpoint, RolloutConfig(episodes=1, seed=9))
    learning = replace(CONFIG, round_updates=2, encoder=replace(ENCODER, round_updates=6))
    after = pretrain(TASK.name, demonstrations, learning, start=checkpoint, driven=met)
    before = checkpoint.card["encoder_curve"]
    assert after.card["earlier_curves"][0]["encoder_curve"] == before
    assert after.card["encoder_curve"][-1]["update"] == 5
    same_pictures = pretrain(TASK.name, demonstrations, learning, start=checkpoint)
    frozen = pretrain(TASK.name, demonstrations, replace(CONFIG, round_updates=2), start=checkpoint)
    encoders = [
        torch.cat([p.flatten() for p in one.policy.encoder.parameters()])
        for one in (checkpoint, frozen, same_pictures, after)
        if one.policy.encoder is not None
    ]
    assert torch.equal(encoders[0], encoders[1])
    assert not torch.equal(encoders[0], encoders[2])
    assert not torch.equal(encoders[2], encoders[3])
    assert frozen.card["encoder_curve"] == before


def test_known_encoder_waits_until_its_new_head_makes_sense(
    checkpoint: Checkpoint, demonstrations: list[Trajectory]
) -> None:
    known = checkpoint.policy.encoder
    assert known is not None
    config = replace(ENCODER, round_updates=6, warm_up=3)
    parts = (TASK, demonstrations[:3], demonstrations[3:], IMAGES)
    learnt, curve = train_encoder(*parts, config, seed=0, start=known)
    assert [point["update"] for point in curve] == [0, 5]
    fresh, _ = train_encoder(*parts, replace(ENCODER, updates=6), seed=0)

    def moved(one: ImageEncoder) -> float:
        pairs = zip(one.parameters(), known.parameters(), strict=True)
        return max(float((a - b).abs().max()) for a, b in pairs)

    # At most three steps of Adam, each of about the learning rate a weight.
    assert 0 < moved(learnt) < 4 * config.learning_rate < moved(fresh)


@pytest.mark.parametrize("known", [False, True])
def test_killed_encoder_training_goes_on_to_the_same_weights(
    known: bool,
    checkpoint: Checkpoint,
    demonstrations: list[Trajectory],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(encoder_training, "SAVE_EVERY", 4)
    monkeypatch.setattr(encoder_training, "REPORT_EVERY", 2)
    config = replace(ENCODER, updates=8, round_updates=8, warm_up=2)
    parts = (TASK, demonstrations[:3], demonstrations[3:], IMAGES, config)
    start = checkpoint.policy.encoder if known else None
    whole, curve = train_encoder(*parts, seed=0, start=start)

    class KilledError(Exception):
        pass

    def kill(done: int, _of: int, _metrics: dict[str, float]) -> None:
        if done > 5:
            raise KilledError

    with pytest.raises(KilledError):
        train_encoder(*parts, seed=0, start=start, workspace=tmp_path, progress=kill)
    resumed, again = train_encoder(*parts, seed=0, start=start, workspace=tmp_path)
    assert again == curve
    for one, other in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(one, other)


def test_same_state_gives_the_same_picture(demonstrations: list[Trajectory]) -> None:
    rows = demonstrations[0].qpos[:2]
    with Camera(TASK, 96, 96) as camera:
        first = draw(camera, TASK, rows)
    with Camera(TASK, 96, 96) as camera:
        camera.picture(demonstrations[1].qpos[-1])  # what was drawn before leaves no trace
        second = draw(camera, TASK, rows)
    assert first.shape == (2, 2, 96, 96, 3)
    assert np.array_equal(first, second)
    assert first[0, 0].std() > 10 and first[0, 1].std() > 10
    assert not np.array_equal(first[0, 0], first[0, 1])


def test_policy_and_task_must_agree_on_cameras(checkpoint: Checkpoint) -> None:
    policy = checkpoint.policy
    with pytest.raises(ValueOutOfRangeError, match="cameras of the policy is 2.*'avoid'"):
        Sight(get_task("avoid"), policy.config, policy.encoder)
    blind = replace(policy.config, images=None)
    with pytest.raises(ValueOutOfRangeError, match="observation dims of the policy"):
        Sight(TASK, blind, None)
    with pytest.raises(
        ValueOutOfRangeError, match="number of cameras is 0, but must be 2, as task 'aligning'"
    ):
        PRESETS[Architecture.MLP]["cpu"].policy_config(TASK)


@pytest.mark.parametrize("name", ["cpu", "paper"])
@pytest.mark.parametrize("task", [TaskName.ALIGNING, TaskName.STACKING])
def test_presets_of_tasks_with_cameras_see(task: TaskName, name: str) -> None:
    images = preset_for(task, name).policy_config(get_task(task)).images
    assert images is not None
    assert images.width == {"cpu": 16, "paper": 64}[name]
