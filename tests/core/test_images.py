"""Policies that see: the ResNet-18 encoder, and how it composes with every denoiser."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch.nn import functional as F

from rodif_core.diffusion.chain import add_noise, noise_entries
from rodif_core.errors import CheckpointFileError, LearningError, ValueOutOfRangeError
from rodif_core.guidance import guide
from rodif_core.policies.checkpoint import (
    Checkpoint,
    SupportSet,
    load_checkpoint,
    save_checkpoint,
)
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.policies.resnet import (
    BasicBlock,
    ImageConfig,
    ImageEncoder,
    ResNet18,
    SpatialSoftArgmax,
)
from rodif_core.spec import Architecture, GuideConfig, TaskName
from tests.core.learning import tiny_policy

IMAGES = ImageConfig(cameras=2, pixels=64, width=8, keypoints=6)
PROPRIOCEPTION = 4


@pytest.fixture(params=list(Architecture), ids=str)
def policy(request: pytest.FixtureRequest) -> Iterator[DiffusionPolicy]:
    yield seeing_policy(request.param)


def seeing_policy(architecture: Architecture, seed: int = 0) -> DiffusionPolicy:
    """`tiny_policy`, with two cameras beside its four state dims."""
    blind = tiny_policy(seed, architecture=architecture)
    config = replace(
        blind.config, observation_dim=PROPRIOCEPTION + IMAGES.feature_dim, images=IMAGES
    )
    torch.manual_seed(seed)
    own, count = blind.normaliser, IMAGES.feature_dim
    centre = torch.cat([own.observation_centre, torch.zeros(count)])
    scale = torch.cat([own.observation_scale, torch.ones(count)])
    normaliser = replace(own, observation_centre=centre, observation_scale=scale)
    return DiffusionPolicy.build(config, normaliser)


def frames(rows: int, steps: int, seed: int = 0, *, pixels: int = IMAGES.pixels) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    shape = (rows, steps, 2, pixels, pixels, 3)
    return torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)


def test_full_width_network_is_resnet18() -> None:
    # The published ResNet-18 has 11,689,512 weights, 513,000 of them in the classifier.
    with torch.device("meta"):
        network = ResNet18(64)
        assert network(torch.zeros(1, 3, 96, 96)).shape == (1, 512, 3, 3)
    assert sum(value.numel() for value in network.parameters()) == 11_689_512 - 513_000
    assert sum(isinstance(module, BasicBlock) for module in network.modules()) == 8


def test_encoder_turns_two_cameras_of_96_pixels_into_rows() -> None:
    torch.manual_seed(0)
    encoder = ImageEncoder(ImageConfig())
    feeling = torch.randn(2, 3, 8)
    rows = encoder(feeling, frames(2, 3, pixels=96))
    assert rows.shape == (2, 3, 8 + 2 * 2 * 32)
    assert torch.equal(rows[..., :8], feeling)
    assert float(rows[..., 8:].detach().abs().max()) <= 1
    assert float(rows[..., 8:].detach().std(dim=(0, 1)).min()) > 0  # images differ, features too


def test_soft_argmax_is_the_expected_coordinate_of_each_map() -> None:
    layer = SpatialSoftArgmax(channels=3, keypoints=3)
    with torch.no_grad():
        layer.maps.weight.copy_(torch.eye(3)[:, :, None, None])
    maps = torch.zeros(1, 3, 3, 5)
    maps[0, 0, 0, 4] = 100.0  # top right
    maps[0, 1, 2, 1] = 100.0  # bottom, second from the left
    # The third map is flat: its expected coordinate is the middle.
    x, y = layer(maps).detach()[0].view(2, 3)
    assert x.tolist() == pytest.approx([1.0, -0.5, 0.0], abs=1e-6)
    assert y.tolist() == pytest.approx([-1.0, 1.0, 0.0], abs=1e-6)


def test_features_of_a_frame_depend_on_that_frame_and_camera_alone() -> None:
    torch.manual_seed(0)
    encoder = ImageEncoder(IMAGES)
    feeling, seen = torch.zeros(2, 3, PROPRIOCEPTION), frames(2, 3)
    before = encoder(feeling, seen).detach()
    seen[1, 2, 0] = 255 - seen[1, 2, 0]
    changed = (encoder(feeling, seen).detach() - before).abs() > 1e-5
    first_camera = slice(PROPRIOCEPTION, PROPRIOCEPTION + 2 * IMAGES.keypoints)
    assert bool(changed[1, 2, first_camera].any())
    changed[1, 2, first_camera] = False
    assert not bool(changed.any())


def test_encoder_refuses_frames_of_another_type_or_shape() -> None:
    encoder, feeling = ImageEncoder(IMAGES), torch.zeros(2, 3, PROPRIOCEPTION)
    with pytest.raises(ValueOutOfRangeError, match=r"torch\.float32.*must be torch\.uint8"):
        encoder(feeling, frames(2, 3).float())
    with pytest.raises(ValueOutOfRangeError, match=r"\(2, 3, 1, 64, 64, 3\).*\(2, 3, 2, 64, 64, 3"):
        encoder(feeling, frames(2, 3)[:, :, :1])


@pytest.mark.parametrize(
    ("field", "value", "legal"),
    [
        ("cameras", 0, "at least 1"),
        ("keypoints", 0, "at least 1"),
        ("pixels", 100, "multiple of 32, at least 64"),
        ("pixels", 32, "multiple of 32, at least 64"),
        ("width", 24, "multiple of 16"),
        ("width", 4, "8 or a multiple of 16"),
    ],
)
def test_image_config_names_value_and_legal_ones(field: str, value: int, legal: str) -> None:
    with pytest.raises(ValueOutOfRangeError, match=f"{field} is {value}.*{legal}"):
        ImageConfig(**{field: value})


def test_observation_rows_must_be_longer_than_the_image_features() -> None:
    config = tiny_policy().config
    with pytest.raises(ValueOutOfRangeError, match="observation_dim is 24.*above the 24"):
        replace(config, observation_dim=24, images=IMAGES)
    assert replace(config, observation_dim=28, images=IMAGES).proprioception_dim == 4
    assert config.proprioception_dim == 4


def test_policy_without_images_says_so() -> None:
    with pytest.raises(LearningError, match="no image encoder"):
        tiny_policy().observe(torch.zeros(1, 2, 4), frames(1, 2))


def test_frames_of_a_window_are_encoded_once_whatever_the_denoising(
    policy: DiffusionPolicy,
) -> None:
    size, batches = policy.config, []
    assert policy.encoder is not None
    policy.encoder.cameras[0].register_forward_hook(lambda _, args, __: batches.append(args[0]))
    with torch.no_grad():
        histories = policy.observe(
            torch.zeros(3, size.observation_steps, PROPRIOCEPTION),
            frames(3, size.observation_steps),
        )
    noise = torch.randn(3, noise_entries(policy.schedule), size.predicted_steps, 2)
    actions, _ = policy.act(histories, noise)
    assert actions.shape == (3, size.executed_steps, 2)
    assert [len(batch) for batch in batches] == [3 * size.observation_steps]


def test_histories_can_be_cut_from_a_window_encoded_as_a_whole() -> None:
    policy = seeing_policy(Architecture.TRANSFORMER)
    steps, length = policy.config.observation_steps, 6
    feeling, seen = torch.randn(1, length, PROPRIOCEPTION), frames(1, length)
    with torch.no_grad():
        whole = policy.observe(feeling, seen)[0].unfold(0, steps, 1).transpose(1, 2)
        for i in range(length - steps + 1):
            window = slice(i, i + steps)
            alone = policy.observe(feeling[:, window], seen[:, window])[0]
            assert torch.allclose(whole[i], alone, atol=1e-5)


def test_gradient_flows_through_the_denoiser_into_every_encoder_weight(
    policy: DiffusionPolicy,
) -> None:
    size = policy.config
    assert policy.encoder is not None
    policy.encoder.double()
    denoiser = policy.denoiser.double()
    feeling = torch.randn(4, size.observation_steps, PROPRIOCEPTION, dtype=torch.float64)
    histories = policy.observe(feeling, frames(4, size.observation_steps))
    noisy = torch.randn(4, size.predicted_steps, 2, dtype=torch.float64)
    denoiser(noisy, torch.tensor([1, 2, 3, 5]), histories).pow(2).sum().backward()
    weakest = {n: float(v.grad.abs().max()) for n, v in policy.encoder.named_parameters()}
    assert {name: value for name, value in weakest.items() if value < 1e-12} == {}


def test_proprioception_and_both_cameras_reach_the_action(policy: DiffusionPolicy) -> None:
    size = policy.config
    feeling = torch.randn(2, size.observation_steps, PROPRIOCEPTION)
    noise = torch.randn(2, noise_entries(policy.schedule), size.predicted_steps, 2)

    def chains(feeling: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return policy.act(policy.observe(feeling, seen), noise)[1]

    seen = frames(2, size.observation_steps)
    before = chains(feeling, seen)
    assert not torch.allclose(chains(feeling + 0.1, seen), before, atol=1e-5)
    for camera in range(2):
        other = seen.clone()
        other[:, -1, camera] = 255 - other[:, -1, camera]
        assert not torch.allclose(chains(feeling, other), before, atol=1e-6), f"camera {camera}"


def test_checkpoint_keeps_the_encoder_bit_for_bit(policy: DiffusionPolicy) -> None:
    support = SupportSet(torch.zeros(3, policy.config.observation_dim), 0.1)
    original = Checkpoint(TaskName.AVOID, policy, support, {"kind": "test"})
    data = save_checkpoint(original)
    copy = load_checkpoint(data)
    assert copy.digest == original.digest
    assert copy.policy.config == policy.config
    assert save_checkpoint(copy) == data
    feeling, seen = torch.randn(1, 1, PROPRIOCEPTION), frames(1, 1)
    assert torch.equal(copy.policy.observe(feeling, seen), policy.observe(feeling, seen))


def test_digest_and_loading_notice_the_encoder() -> None:
    policy, other = seeing_policy(Architecture.MLP), seeing_policy(Architecture.MLP)
    support = SupportSet(torch.zeros(3, policy.config.observation_dim), 0.1)
    original = Checkpoint(TaskName.AVOID, policy, support, {})
    assert other.encoder is not None
    with torch.no_grad():
        next(other.encoder.parameters()).view(-1)[0] += 1e-3
    assert replace(original, policy=other).digest != original.digest
    blind = save_checkpoint(replace(original, policy=replace(policy, encoder=None)))
    with pytest.raises(CheckpointFileError, match="Missing key.*cameras"):
        load_checkpoint(blind)


def test_guidance_moves_the_denoiser_and_keeps_the_encoder() -> None:
    policy = seeing_policy(Architecture.MLP)
    with torch.no_grad():
        histories = policy.observe(torch.randn(4, 1, PROPRIOCEPTION), frames(4, 1))
    config = GuideConfig(updates=3, batch_size=8)
    guided = guide(policy, histories, torch.zeros(4, 1, 2), 1.0, config, seed=0)
    assert guided.encoder is policy.encoder
    pairs = zip(guided.denoiser.parameters(), policy.denoiser.parameters(), strict=True)
    assert not all(torch.equal(a, b) for a, b in pairs)


def test_learns_to_act_on_what_it_sees() -> None:
    # A bright square on a dark ground; the action is where it is in the first camera, plus what
    # proprioception adds. Without the image the squared error would be 0.7² / 3 = 0.163, without
    # proprioception 0.6² / 12 = 0.03.
    policy, generator = seeing_policy(Architecture.MLP), torch.Generator().manual_seed(2)
    assert policy.encoder is not None

    def batch(rows: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        corners = torch.randint(0, 48, (rows, 2), generator=generator)
        seen = torch.zeros(rows, 1, 2, 64, 64, 3, dtype=torch.uint8)
        for row, (x, y) in enumerate(corners.tolist()):
            seen[row, 0, 0, y : y + 16, x : x + 16] = 255
        feeling = torch.zeros(rows, 1, PROPRIOCEPTION)
        feeling[..., 0] = (torch.rand(rows, 1, generator=generator) - 0.5) * 0.8 + 0.5
        shift = (feeling[:, :, :1] - 0.5) / 0.8
        return seen, feeling, ((corners / 24 - 1)[:, None] * 0.7 + shift * 0.6)

    parameters = [*policy.denoiser.parameters(), *policy.encoder.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=4e-3)

    for _ in range(150):
        seen, feeling, chunks = batch(16)
        # Each image is encoded once and serves eight draws of the noise.
        rows = policy.normaliser.observation(policy.observe(feeling, seen))
        histories, chunks = (value.repeat_interleave(8, dim=0) for value in (rows, chunks))
        k = torch.randint(1, 6, (len(chunks),), generator=generator)
        noise = torch.randn(chunks.shape, generator=generator)
        noisy = add_noise(policy.schedule, chunks, noise, k)
        optimizer.zero_grad(set_to_none=True)
        F.mse_loss(policy.denoiser(noisy, k, histories), noise).backward()
        optimizer.step()
    seen, feeling, chunks = batch(200)
    with torch.no_grad():
        noise = torch.randn(200, noise_entries(policy.schedule), 1, 2, generator=generator)
        chains = policy.act(policy.observe(feeling, seen), noise)[1]
    assert float(F.mse_loss(chains[:, -1], chunks.clamp(-1, 1))) < 0.02
