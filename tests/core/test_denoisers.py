"""What holds for every denoiser, whatever is inside: U-Net, transformer, MLP."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from rodif_core.contrast import contrast
from rodif_core.diffusion.chain import add_noise, chain_log_prob, noise_entries, sample_chain
from rodif_core.diffusion.schedule import NoiseSchedule
from rodif_core.guidance import guidance_target, guide
from rodif_core.log_ratio import (
    PairMatrix,
    Transitions,
    accumulate_gradient,
    compute_ratios,
    preference_loss,
)
from rodif_core.policies.checkpoint import load_checkpoint, save_checkpoint
from rodif_core.policies.policy import DiffusionPolicy
from rodif_core.policies.unet import UnetSize
from rodif_core.preferences.pairs import Preference
from rodif_core.rollout import rollout
from rodif_core.spec import Architecture, FinetuneConfig, FinetuneMethod, GuideConfig, RolloutConfig
from tests.core.learning import chain_trajectory, tiny_checkpoint, tiny_policy

CONFIG = FinetuneConfig(method=FinetuneMethod.RODIF, conservativeness=0.3, chunk_rows=8)
PREFERENCES = [Preference(0, 1), Preference(2, 1), Preference(0, 3)]


@pytest.fixture(params=list(Architecture), ids=str)
def architecture(request: pytest.FixtureRequest) -> Iterator[Architecture]:
    yield request.param


def inputs(
    policy: DiffusionPolicy, rows: int, seed: int = 0
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Noisy chunks, denoising steps and histories of a policy's shape."""
    size, generator = policy.config, torch.Generator().manual_seed(seed)
    return (
        torch.randn(rows, size.predicted_steps, size.action_dim, generator=generator),
        torch.randint(1, size.denoising_steps + 1, (rows,), generator=generator),
        torch.randn(rows, size.observation_steps, size.observation_dim, generator=generator),
    )


def trainable_policy(architecture: Architecture) -> DiffusionPolicy:
    """`tiny_policy`, but for a U-Net with two channels a group: with one, normalisation hides
    what is constant along the chunk."""
    policy = tiny_policy(architecture=architecture)
    if architecture is not Architecture.UNET:
        return policy
    config = replace(policy.config, size=UnetSize(channels=(16, 32), step_dim=8))
    return DiffusionPolicy.build(config, policy.normaliser)


def moved_copy(policy: DiffusionPolicy) -> DiffusionPolicy:
    moved, generator = policy.copy(), torch.Generator().manual_seed(9)
    with torch.no_grad():
        for value in moved.denoiser.parameters():
            value.add_(0.02 * torch.randn(value.shape, generator=generator))
    return moved


def transitions_of(reference: DiffusionPolicy) -> Transitions:
    trajectories = [chain_trajectory(reference, n, seed=n) for n in (3, 2, 4, 3)]
    return Transitions.collect(reference, trajectories, CONFIG.chunk_rows)


@pytest.mark.parametrize("rows", [1, 3])
def test_noise_has_the_shape_of_the_chunk(architecture: Architecture, rows: int) -> None:
    policy = tiny_policy(architecture=architecture)
    assert policy.config.architecture is architecture
    noisy, k, histories = inputs(policy, rows)
    noise = policy.denoiser(noisy, k, histories)
    assert noise.shape == noisy.shape
    assert noise.dtype == torch.float32
    assert bool(noise.isfinite().all())


def test_every_input_matters(architecture: Architecture) -> None:
    policy = tiny_policy(architecture=architecture)
    noisy, k, histories = inputs(policy, 2)
    before = policy.denoiser(noisy, k, histories)
    for step in range(histories.shape[1]):
        other = histories.clone()
        other[:, step, -1] += 1
        assert not torch.allclose(policy.denoiser(noisy, k, other), before), f"history {step}"
    assert not torch.allclose(policy.denoiser(noisy, k % 5 + 1, histories), before)
    assert not torch.allclose(policy.denoiser(noisy + 1, k, histories), before)


def test_order_in_chunk_and_history_matters(architecture: Architecture) -> None:
    policy = tiny_policy(architecture=architecture)
    noisy, k, histories = inputs(policy, 2)
    before = policy.denoiser(noisy, k, histories)
    if noisy.shape[1] > 1:
        turned = policy.denoiser(noisy.flip(1), k, histories).flip(1)
        assert not torch.allclose(turned, before, atol=1e-4)
    if histories.shape[1] > 1:
        assert not torch.allclose(policy.denoiser(noisy, k, histories.flip(1)), before, atol=1e-5)


def test_gradient_flows_into_every_parameter(architecture: Architecture) -> None:
    policy = trainable_policy(architecture)
    # In double precision a gradient that is only rounding stays below 1e-12.
    denoiser = policy.denoiser.double()
    noisy, k, histories = inputs(policy, 16)
    noise = denoiser(noisy.double(), k, histories.double())
    (noise - noisy.double().roll(1, 0)).pow(2).sum().backward()
    # Output by output: the bias of a key in an attention, say, is dead beside that of a value.
    weakest = {
        name: float(value.grad.abs().reshape(len(value), -1).amax(1).min())
        for name, value in denoiser.named_parameters()
    }
    assert {name: value for name, value in weakest.items() if value < 1e-9} == {}


def test_same_seed_builds_the_same_weights(architecture: Architecture) -> None:
    weights = [tiny_policy(seed, architecture=architecture).denoiser for seed in (1, 1, 2)]
    one, same, other = ([*module.state_dict().values()] for module in weights)
    assert all(torch.equal(a, b) for a, b in zip(one, same, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_row_does_not_depend_on_the_other_rows(architecture: Architecture) -> None:
    policy = tiny_policy(architecture=architecture)
    one, two = inputs(policy, 6, seed=1), inputs(policy, 6, seed=2)
    for mine, other in zip(one, two, strict=True):
        other[3] = mine[3]
    together = policy.denoiser(*one)
    assert torch.equal(policy.denoiser(*two)[3], together[3])
    assert torch.allclose(
        policy.denoiser(*(value[3:4] for value in one))[0], together[3], atol=1e-5
    )


def test_training_mode_changes_nothing(architecture: Architecture) -> None:
    policy = tiny_policy(architecture=architecture)
    rows = inputs(policy, 5)
    assert torch.equal(policy.denoiser.train()(*rows), policy.denoiser.eval()(*rows))
    random = (nn.Dropout, nn.modules.batchnorm._BatchNorm)
    assert not any(isinstance(module, random) for module in policy.denoiser.modules())


@pytest.mark.parametrize("std_floor", [0.0, 0.1])
def test_sampled_log_density_equals_chain_log_prob(
    architecture: Architecture, std_floor: float
) -> None:
    policy = tiny_policy(1, std_floor=std_floor, architecture=architecture)
    schedule, size = policy.schedule, policy.config
    histories = inputs(policy, 6)[2]
    noise = torch.randn(
        6, noise_entries(schedule), size.predicted_steps, 2,
        generator=torch.Generator().manual_seed(5),
    )  # fmt: skip
    chain = sample_chain(policy.denoiser, schedule, histories, noise)
    # The density with which each latent was drawn, from the very noise that drew it.
    expected = torch.zeros(6)
    for i, k in enumerate(range(schedule.num_steps, 0, -1)):
        std = float(schedule.std[k])
        if std > 0:
            z = noise[:, i + 1].flatten(1)
            constant = z.shape[1] * (math.log(std) + 0.5 * math.log(2 * math.pi))
            expected += -0.5 * (z**2).sum(1) - constant
    log_prob = chain_log_prob(policy.denoiser, schedule, histories, chain)
    assert torch.allclose(log_prob, expected, atol=2e-3, rtol=1e-5)


@pytest.mark.parametrize("chunk_rows", [4, 13, 1000])
def test_ratios_are_exactly_zero_and_votes_one_half_at_the_reference(
    architecture: Architecture, chunk_rows: int
) -> None:
    reference = tiny_policy(architecture=architecture)
    trajectories = [chain_trajectory(reference, n, seed=n) for n in (3, 2, 4, 3)]
    config = replace(CONFIG, chunk_rows=chunk_rows)
    transitions = Transitions.collect(reference, trajectories, chunk_rows)
    matrix = PairMatrix.build(transitions, PREFERENCES, config)
    policy = reference.copy()
    assert torch.equal(compute_ratios(policy, transitions, config), torch.zeros(12))
    output = accumulate_gradient(
        policy, transitions, config, lambda ratios: preference_loss(ratios, matrix, config)
    )
    assert output.metrics["mean_vote"] == 0.5


def test_means_are_the_same_bits_with_and_without_a_gradient(architecture: Architecture) -> None:
    policy = tiny_policy(architecture=architecture)
    rows = inputs(policy, 7)
    with_gradient = policy.denoiser(*rows)
    with torch.no_grad():
        assert torch.equal(policy.denoiser(*rows), with_gradient)


def test_chunked_gradient_equals_the_plain_one(architecture: Architecture) -> None:
    reference = tiny_policy(architecture=architecture)
    transitions, moved = transitions_of(reference), moved_copy(reference)
    matrix = PairMatrix.build(transitions, PREFERENCES, CONFIG)
    gradients = []
    for rows in (4, 1_000_000):
        moved.denoiser.zero_grad(set_to_none=True)
        accumulate_gradient(
            moved, transitions, replace(CONFIG, chunk_rows=rows),
            lambda ratios: preference_loss(ratios, matrix, CONFIG),
        )  # fmt: skip
        gradients.append(torch.cat([value.grad.flatten() for value in moved.denoiser.parameters()]))
    assert float(gradients[0].abs().max()) > 0
    assert torch.allclose(gradients[0], gradients[1], rtol=1e-4, atol=1e-5)


def test_gradient_equals_finite_differences_in_a_random_direction(
    architecture: Architecture,
) -> None:
    reference = tiny_policy(architecture=architecture)
    transitions, moved = transitions_of(reference), moved_copy(reference)
    policy = replace(moved, denoiser=moved.denoiser.double())
    double = replace(
        transitions, histories=transitions.histories.double(),
        chains=transitions.chains.double(), ref_means=transitions.ref_means.double(),
    )  # fmt: skip
    matrix = PairMatrix.build(transitions, PREFERENCES, CONFIG)
    matrix = replace(matrix, weights=matrix.weights.double())

    def loss() -> float:
        return float(preference_loss(compute_ratios(policy, double, CONFIG), matrix, CONFIG).loss)

    accumulate_gradient(
        policy, double, CONFIG, lambda ratios: preference_loss(ratios, matrix, CONFIG)
    )
    parameters = list(policy.denoiser.parameters())
    generator = torch.Generator().manual_seed(1)
    directions = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in parameters]
    slope = sum(float((p.grad * d).sum()) for p, d in zip(parameters, directions, strict=True))
    step, values = 1e-6, []
    with torch.no_grad():
        for move in (step, -2 * step):
            for parameter, direction in zip(parameters, directions, strict=True):
                parameter.add_(move * direction)
            values.append(loss())
    assert slope == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-4)


def test_checkpoint_survives_the_file_form_bit_for_bit(architecture: Architecture) -> None:
    original = tiny_checkpoint(architecture=architecture)
    data = save_checkpoint(original)
    copy = load_checkpoint(data)
    assert copy.digest == original.digest
    assert copy.policy.config == original.policy.config
    assert save_checkpoint(copy) == data
    rows = inputs(original.policy, 4)
    assert torch.equal(copy.policy.denoiser(*rows), original.policy.denoiser(*rows))


def test_contrast_moves_votes_towards_the_labels(architecture: Architecture) -> None:
    reference = tiny_policy(architecture=architecture)
    transitions = transitions_of(reference)
    config = replace(CONFIG, updates=6, learning_rate=1e-3, conservativeness=0.0)
    matrix = PairMatrix.build(transitions, PREFERENCES, config)
    result = contrast(reference, transitions, matrix, config, stage="rodif")
    assert result.curve[0]["mean_vote"] == 0.5
    assert result.curve[-1]["mean_vote"] > 0.5
    assert result.curve[-1]["loss"] < result.curve[0]["loss"]


def test_guidance_approaches_its_target(architecture: Architecture) -> None:
    reference = tiny_policy(architecture=architecture)
    size, generator = reference.config, torch.Generator().manual_seed(4)
    histories = inputs(reference, 32)[2]
    chunks = torch.full((32, size.predicted_steps, 2), 0.5)
    config = GuideConfig(updates=60, learning_rate=3e-3, batch_size=64, ema_decay=0.8)
    guided = guide(reference, histories, chunks, 1.5, config, seed=0)
    k = torch.randint(1, size.denoising_steps + 1, (32,), generator=generator)
    noise = torch.randn(chunks.shape, generator=generator)
    rows = add_noise(reference.schedule, chunks, noise, k), k, histories
    with torch.no_grad():
        anchor = reference.denoiser(*rows)
        target = guidance_target(anchor, noise, 1.5)
        after = F.mse_loss(guided.denoiser(*rows), target)
    assert float(after) < 0.8 * float(F.mse_loss(anchor, target))


def test_learns_a_synthetic_task_far_better_than_guessing_zero(
    architecture: Architecture,
) -> None:
    # The chunk is a function of the last observation, so that noise can be told apart from it.
    policy = trainable_policy(architecture)
    size, generator = policy.config, torch.Generator().manual_seed(3)
    mixing = torch.randn(size.observation_dim, 2, generator=generator)
    ramp = torch.linspace(1, 0.5, size.predicted_steps)[:, None]

    def batch(rows: int) -> tuple[torch.Tensor, torch.Tensor]:
        histories = torch.randn(
            rows, size.observation_steps, size.observation_dim, generator=generator
        )
        return histories, torch.tanh(histories[:, -1:] @ mixing / 2) * ramp

    def loss(rows: int) -> torch.Tensor:
        histories, chunks = batch(rows)
        k = torch.randint(1, size.denoising_steps + 1, (rows,), generator=generator)
        noise = torch.randn(chunks.shape, generator=generator)
        noisy = add_noise(policy.schedule, chunks, noise, k)
        return F.mse_loss(policy.denoiser(noisy, k, histories), noise)

    optimizer = torch.optim.Adam(policy.denoiser.parameters(), lr=5e-3)
    for _ in range(300):
        optimizer.zero_grad(set_to_none=True)
        loss(128).backward()
        optimizer.step()
    with torch.no_grad():
        # The zero predictor's loss is the noise's variance, 1.
        assert float(loss(1000)) < 0.1
        histories, chunks = batch(500)
        noise = torch.randn(500, size.denoising_steps, *chunks.shape[1:], generator=generator)
        made = sample_chain(policy.denoiser, policy.schedule, histories, noise)[:, -1]
        # The loss alone would let through who guesses the mean action, and so errs by the variance.
        assert float(F.mse_loss(made, chunks)) < 0.3 * float(chunks.var())


def test_rollouts_of_every_denoiser_can_be_finetuned(architecture: Architecture) -> None:
    checkpoint = tiny_checkpoint(architecture=architecture)
    size = checkpoint.policy.config
    episodes = rollout(checkpoint, RolloutConfig(episodes=2, seed=7))
    for episode in episodes:
        assert episode.histories.shape[1:] == (size.observation_steps, 4)
        assert episode.chains.shape[1:] == (size.denoising_steps + 1, size.predicted_steps, 2)
        assert set(episode.decision_steps % size.executed_steps) == {0}
    transitions = Transitions.collect(checkpoint.policy, episodes, 1024)
    ratios = compute_ratios(checkpoint.policy.copy(), transitions, FinetuneConfig())
    assert torch.equal(ratios, torch.zeros(len(ratios)))


def test_four_denoising_steps_leave_three_with_a_density() -> None:
    # The single-action policy's K; deviations as D3IL's cosine schedule has them at K = 4.
    schedule = NoiseSchedule(4)
    assert schedule.scored_steps == (4, 3, 2)
    assert [round(float(v), 3) for v in schedule.std[1:]] == [0.0, 0.355, 0.647, 0.925]
