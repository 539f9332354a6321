"""Scoring, guidance, the literal fine-tuners and the guided one, on hand-made chains."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rodif_core.choice import Trial, choose, improves
from rodif_core.contrast import contrast
from rodif_core.diffusion.chain import add_noise
from rodif_core.drift import SupportSet
from rodif_core.errors import LearningError
from rodif_core.finetune import finetune
from rodif_core.guidance import guidance_target, guide
from rodif_core.guided import decisions_done, near_data
from rodif_core.log_ratio import PairMatrix, Transitions
from rodif_core.losses import LOSSES
from rodif_core.preferences.pairs import Preference, Tie
from rodif_core.scoring import TIE_SD, PathFeatures, PathUtility, split_threshold, standardise
from rodif_core.spec import GATED_METHODS, FinetuneConfig, FinetuneMethod, GuideConfig
from rodif_core.tasks import get_task
from tests.core.learning import chain_trajectory, tiny_checkpoint, tiny_policy

AVOID = get_task("avoid")
RODIF = FinetuneConfig(
    method=FinetuneMethod.RODIF, conservativeness=0.3, updates=6, learning_rate=1e-3, chunk_rows=64
)
CROSS = [Preference(w, l) for w in range(3) for l in range(3, 6)]  # noqa: E741


def labelled_trajectories() -> list:
    """Three winners on the left, three losers on the right."""
    policy = tiny_policy()
    sides = [0.4] * 3 + [0.6] * 3
    return [chain_trajectory(policy, 3, seed=i, x=x + 0.01 * i) for i, x in enumerate(sides)]


for_every_literal_method = pytest.mark.parametrize("method", list(LOSSES))


@for_every_literal_method
def test_literal_fine_tuner_raises_the_mean_vote(method: FinetuneMethod) -> None:
    config = replace(RODIF, method=method)
    report = finetune(tiny_checkpoint(), labelled_trajectories(), CROSS, config).report
    votes = [point["mean_vote"] for point in report["curve"]]
    assert votes[0] == 0.5
    assert votes[-1] > 0.55
    assert report["kl_winners"] > 0


@for_every_literal_method
def test_equal_arguments_give_equal_weights(method: FinetuneMethod) -> None:
    config = replace(RODIF, method=method)
    results = [
        finetune(tiny_checkpoint(), labelled_trajectories(), CROSS, config).checkpoint.digest
        for _ in range(2)
    ]
    assert results[0] == results[1]


@pytest.mark.parametrize("method", [name for name in LOSSES if name not in GATED_METHODS])
def test_loss_without_a_gate_needs_no_conservativeness_and_does_all_updates(
    method: FinetuneMethod,
) -> None:
    weights = []
    for gamma in (None, 0.9):  # a γ at which RoDiF's gradient is dead
        config = replace(RODIF, method=method, conservativeness=gamma, updates=3)
        result = finetune(tiny_checkpoint(), labelled_trajectories(), CROSS, config)
        assert result.report["stopped"] == "all updates done"
        assert len(result.report["curve"]) == 3
        weights.append(result.checkpoint.policy.denoiser.state_dict())
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


@for_every_literal_method
def test_killed_run_goes_on_to_the_same_weights(method: FinetuneMethod, tmp_path: Path) -> None:
    config = replace(RODIF, method=method)
    whole = finetune(tiny_checkpoint(), labelled_trajectories(), CROSS, config)

    class KilledError(Exception):
        pass

    def kill(_stage: str, fraction: float, _metrics: dict[str, float]) -> None:
        if fraction > 0.9:
            raise KilledError

    arguments = (tiny_checkpoint(), labelled_trajectories(), CROSS, config)
    with pytest.raises(KilledError):
        finetune(*arguments, workspace=tmp_path, progress=kill)
    assert list(tmp_path.iterdir()), "the partial state was written"
    resumed = finetune(*arguments, workspace=tmp_path)
    assert resumed.checkpoint.digest == whole.checkpoint.digest
    assert resumed.report["curve"] == whole.report["curve"]


def test_workspace_of_another_fine_tuning_is_refused(tmp_path: Path) -> None:
    finetune(tiny_checkpoint(), labelled_trajectories(), CROSS, RODIF, workspace=tmp_path)
    flipped = [Preference(one.loser, one.winner) for one in CROSS]
    with pytest.raises(LearningError, match="labels is .* there and .* here"):
        finetune(tiny_checkpoint(), labelled_trajectories(), flipped, RODIF, workspace=tmp_path)
    with pytest.raises(LearningError, match="config is .* there"):
        finetune(
            tiny_checkpoint(), labelled_trajectories(), CROSS, replace(RODIF, updates=3),
            workspace=tmp_path,
        )  # fmt: skip


@pytest.mark.parametrize("name", ["rodif.safetensors", "training.json"])
def test_damaged_partial_state_is_named(tmp_path: Path, name: str) -> None:
    arguments = (tiny_checkpoint(), labelled_trajectories(), CROSS, RODIF)
    finetune(*arguments, workspace=tmp_path)
    file = tmp_path / name
    file.write_bytes(file.read_bytes()[:40])
    with pytest.raises(LearningError, match=f"{name} is no readable partial state.*delete it"):
        finetune(*arguments, workspace=tmp_path)


def test_optimizer_stops_when_the_gate_shuts() -> None:
    config = replace(RODIF, conservativeness=0.45, updates=200)
    report = finetune(tiny_checkpoint(), labelled_trajectories(), CROSS, config).report
    assert report["stopped"].startswith("the gate shut at update")
    assert len(report["curve"]) < 200


def test_dead_gradient_is_reported_and_trains_nothing() -> None:
    config = replace(RODIF, conservativeness=0.9)
    parent = tiny_checkpoint()
    policy = parent.policy
    trajectories = labelled_trajectories()
    transitions = Transitions.collect(policy, trajectories, config.chunk_rows)
    matrix = PairMatrix.build(transitions, CROSS * 10, config)
    result = contrast(policy, transitions, matrix, config, stage="rodif")
    assert "dead gradient" in result.stopped
    assert "below 0.5" in result.stopped
    assert result.curve == []
    for after, before in zip(
        result.policy.denoiser.parameters(), policy.denoiser.parameters(), strict=True
    ):
        assert torch.equal(after, before)


@pytest.mark.parametrize("method", sorted(GATED_METHODS))
def test_missing_conservativeness_is_refused(method: FinetuneMethod) -> None:
    config = replace(RODIF, method=method, conservativeness=None)
    with pytest.raises(LearningError, match="estimate it from the labels"):
        finetune(tiny_checkpoint(), labelled_trajectories(), CROSS, config)


def test_preference_outside_the_trajectories_is_named() -> None:
    with pytest.raises(LearningError, match=r"winner=7.*0 … 5"):
        finetune(tiny_checkpoint(), labelled_trajectories(), [Preference(7, 0)], RODIF)
    with pytest.raises(LearningError, match=r"second=9.*0 … 5"):
        finetune(tiny_checkpoint(), labelled_trajectories(), CROSS, RODIF, ties=[Tie(0, 9)])


@pytest.mark.parametrize(("scale", "expected"), [(0.0, 0.2), (1.0, 1.0), (2.0, 1.8), (3.0, 2.6)])
def test_guidance_target_matches_hand_worked_number(scale: float, expected: float) -> None:
    # ε_ref = 0.2, ε = 1: the reference is off by 0.8, and s times that is added to it.
    target = guidance_target(torch.tensor([0.2]), torch.tensor([1.0]), scale)
    assert float(target) == pytest.approx(expected)


def test_guidance_lowers_the_denoising_error_on_the_kept_decisions() -> None:
    policy = tiny_policy()
    histories, chunks = torch.zeros(8, 2, 4), torch.full((8, 8, 2), 0.5)
    config = GuideConfig(updates=60, batch_size=64, learning_rate=5e-3, ema_decay=0.9)
    moved = guide(policy, histories, chunks, 1.0, config, seed=0)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(chunks.shape, generator=generator)
    k = torch.arange(8) % 5 + 1
    noisy = add_noise(policy.schedule, chunks, noise, k)
    errors = [
        float((p.denoiser(noisy, k, histories) - noise).pow(2).mean().detach())
        for p in (policy, moved)
    ]
    assert errors[1] < 0.7 * errors[0]


def test_guidance_without_winners_says_what_to_do() -> None:
    with pytest.raises(LearningError, match="more labels are needed"):
        guide(tiny_policy(), torch.zeros(0, 2, 4), torch.zeros(0, 8, 2), 2.0, GuideConfig(), 0)


def test_path_utility_of_two_paths_matches_hand_worked_number() -> None:
    # One point per path: the median distance is their distance d, the scale 2d, so the kernel's
    # off-diagonal is exp(-1/8) and K = 0.25 [[1.5, c], [c, 1.5]] with c = exp(-1/8) + 0.5.
    # By symmetry u_0 = -u_1 = u, and K⁻¹ (u, -u) = (u, -u) / (0.25 (1.5 - c)), so that with four
    # labels u / (0.25 (1 - exp(-1/8))) = 4 (1 - σ(2u)).
    points = np.array([[[0.0, 0.0, 0.0]], [[3.0, 4.0, 0.0]]])
    features = PathFeatures(points, np.array([True, True]))
    fit = PathUtility.fit(features, [Preference(0, 1)] * 4)
    u = fit.utilities[0]
    variance = 0.25 * (1 - np.exp(-1 / 8))
    assert fit.utilities[1] == pytest.approx(-u)
    assert u / variance == pytest.approx(4 * (1 - 1 / (1 + np.exp(-2 * u))), rel=1e-4)
    assert fit.predict(features) == pytest.approx(fit.utilities, abs=1e-4)


def test_path_utility_of_a_tied_pair_matches_hand_worked_number() -> None:
    # As above; a tie pulls with the slope of (2u)² / (2 TIE_SD²), which is 2u / TIE_SD² for each.
    points = np.array([[[0.0, 0.0, 0.0]], [[3.0, 4.0, 0.0]]])
    features = PathFeatures(points, np.array([True, True]))
    u = PathUtility.fit(features, [Preference(0, 1)] * 4, [Tie(1, 0)]).utilities[0]
    variance = 0.25 * (1 - np.exp(-1 / 8))
    pulled = u / variance + 2 * u / TIE_SD**2
    assert pulled == pytest.approx(4 * (1 - 1 / (1 + np.exp(-2 * u))), rel=1e-4)
    assert 0 < u < PathUtility.fit(features, [Preference(0, 1)] * 4).utilities[0]


def test_ties_tell_a_mode_apart_that_was_hardly_compared_with_the_preferred_one() -> None:
    rng = np.random.default_rng(0)
    # The preferred way, one beside it, and one far away; eight trajectories each.
    places = np.repeat([0.40, 0.45, 0.60], 8) + rng.normal(0, 0.005, 24)
    policy = tiny_policy()
    runs = [chain_trajectory(policy, 1, seed=i, x=float(x)) for i, x in enumerate(places)]
    features = PathFeatures.of(runs, AVOID)
    preferences = [Preference(i % 8, 16 + j) for i, j in enumerate(rng.integers(0, 8, 40))]
    ties = [Tie(8 + i % 8, 16 + j) for i, j in enumerate(rng.integers(0, 8, 40))]

    def liked(ties: list[Tie]) -> np.ndarray:
        utilities = PathUtility.fit(features, preferences, ties).utilities
        return np.asarray(utilities > split_threshold(utilities))

    assert liked([])[:16].all()  # what lies beside the preferred way passes for it
    assert liked(ties).tolist() == [True] * 8 + [False] * 16


def test_path_utility_recovers_the_side_from_sparse_noisy_labels() -> None:
    rng = np.random.default_rng(0)
    policy = tiny_policy()
    sides = [0.4 if i < 12 else 0.6 for i in range(24)]
    trajectories = [
        chain_trajectory(policy, 1, seed=i, x=x + rng.normal(0, 0.02)) for i, x in enumerate(sides)
    ]
    preferences = []
    for _ in range(60):
        winner, loser = int(rng.integers(12)), int(rng.integers(12, 24))
        if rng.random() < 0.3:
            winner, loser = loser, winner
        preferences.append(Preference(winner, loser))
    utilities = PathUtility.fit(PathFeatures.of(trajectories, AVOID), preferences).utilities
    above = utilities > split_threshold(utilities)
    assert (above == np.array([x < 0.5 for x in sides])).mean() > 0.9


def test_the_memory_of_path_utilities_does_not_grow_with_the_points() -> None:
    rng = np.random.default_rng(0)
    features = PathFeatures(rng.normal(size=(300, 64, 3)), np.ones(300, dtype=bool))
    tracemalloc.start()
    PathUtility.fit(features, [Preference(0, 1)])
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 20 * 300 * 300 * 8  # a score of matrices (R, R) of doubles; at once it takes 384


def test_path_features_are_evenly_spaced_along_the_path() -> None:
    points = PathFeatures.of([chain_trajectory(tiny_policy(), 9, seed=0, x=0.4)], AVOID).points[0]
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps.max() < 1.6 * steps.min()


def test_path_features_also_follow_every_object() -> None:
    task = get_task("pushing")
    one = chain_trajectory(tiny_policy(), 9, seed=0, x=0.4)
    # The red cube moves 1 cm a step along x from 0.4 m, the green one stays; heights are 3 cm.
    steps = np.arange(len(one.paths))
    qpos = np.zeros((len(steps), 7 + 14), dtype=np.float32)
    qpos[:, 7], qpos[:, 9] = 0.4 + 0.01 * steps, 0.03
    qpos[:, 14:17] = (0.6, -0.1, 0.03)
    (points,) = PathFeatures.of([replace(one, qpos=qpos)], task).points
    assert points.shape == (3 * 16, 3)
    assert points[:16] == pytest.approx(PathFeatures.of([one], AVOID).points[0], abs=1e-9)
    assert points[16] == pytest.approx((0.4, 0.0, 0.03), abs=1e-6)
    assert points[31] == pytest.approx((0.4 + 0.01 * steps[-1], 0.0, 0.03), abs=1e-6)
    assert np.ptp(points[32:], axis=0) == pytest.approx(0.0)


def test_split_threshold_does_not_depend_on_the_share_of_good_ones() -> None:
    scores = np.array([0.0, 0.1, 0.2, 5.0, 0.05, 0.15, 0.12, 0.11])
    assert 0.2 < split_threshold(scores) < 5.0
    assert split_threshold(scores) == pytest.approx(2.6)


def test_split_of_equal_scores_is_refused() -> None:
    with pytest.raises(LearningError, match="do not separate"):
        split_threshold(np.ones(4))


def test_standardise_gives_zeros_when_scores_do_not_differ() -> None:
    assert np.array_equal(standardise(np.ones(3)), np.zeros(3))


def test_runs_of_one_mode_that_people_call_equal_are_all_kept() -> None:
    rng = np.random.default_rng(0)
    policy = tiny_policy()
    good = [chain_trajectory(policy, 1, seed=i, x=0.4 + rng.normal(0, 0.01)) for i in range(12)]
    bad = [chain_trajectory(policy, 1, seed=20 + i, x=0.6, success=False) for i in range(6)]
    features = PathFeatures.of([*good, *bad], AVOID)
    preferences = [Preference(i % 12, 12 + j) for i, j in enumerate(rng.integers(0, 6, 60))]
    ties = [Tie(i % 12, int(j)) for i, j in enumerate(rng.integers(0, 12, 20)) if i % 12 != j]
    fit = PathUtility.fit(features, preferences, ties)
    assert (fit.utilities[:12] > fit.cut(features.success)).all()
    # What nobody has seen is liked when it goes the same way, unless people would tell it apart.
    assert fit.cut(features.success) < fit.utilities[:12].min()


def test_two_modes_are_parted_although_a_third_of_the_labels_is_wrong() -> None:
    rng = np.random.default_rng(1)
    policy = tiny_policy()
    places = np.repeat([0.4, 0.6], 12) + rng.normal(0, 0.01, 24)
    runs = [chain_trajectory(policy, 1, seed=i, x=float(x)) for i, x in enumerate(places)]
    features = PathFeatures.of(runs, AVOID)
    preferences = []
    for i in range(120):
        winner, loser = int(rng.integers(12)), int(rng.integers(12, 24))
        wrong = i % 3 == 0
        preferences.append(Preference(loser, winner) if wrong else Preference(winner, loser))
    fit = PathUtility.fit(features, preferences)
    kept = fit.utilities > fit.cut(features.success)
    assert kept.tolist() == [True] * 12 + [False] * 12


def trial(scale: float, success: float, off: float, predicted: float) -> Trial:
    return Trial(scale, tiny_policy(), success, off, predicted)


def test_choice_prefers_what_labels_predict_among_sound_scales() -> None:
    base = trial(0.0, 0.9, 0.02, 0.2)
    trials = [trial(1.0, 0.95, 0.02, 0.6), trial(2.0, 0.94, 0.03, 0.9), trial(3.0, 0.9, 0.2, 1.0)]
    assert choose(base, trials).scale == 2.0


def test_choice_takes_the_least_harm_when_no_scale_is_sound() -> None:
    base = trial(0.0, 0.9, 0.02, 0.2)
    trials = [trial(1.0, 0.5, 0.3, 0.9), trial(2.0, 0.8, 0.1, 0.4)]
    assert choose(base, trials).scale == 2.0


def test_self_training_is_believed_unless_it_is_clearly_worse() -> None:
    base, before = trial(0.0, 0.9, 0.02, 0.2), trial(1.0, 0.95, 0.02, 0.95)
    assert improves(base, before, trial(1.0, 0.94, 0.02, 0.94))
    assert not improves(base, before, trial(1.0, 0.85, 0.02, 0.85))
    assert not improves(base, before, trial(1.0, 0.99, 0.2, 0.99))


def test_imitated_is_what_was_done_in_the_steps_after_a_decision() -> None:
    policy = tiny_policy()
    short = chain_trajectory(policy, 3, seed=1)
    steps = np.arange(len(short.actions), dtype=np.float32)
    one = replace(short, actions=np.stack([steps, -steps], axis=1) * 1e-3)
    ahead, executed = policy.config.predicted_steps, policy.config.executed_steps
    assert ahead > executed  # so that some steps of a chunk were decided again
    histories, chunks = decisions_done(policy, [one, one])
    assert len(histories) == 6 and chunks.shape == (6, ahead, 2)
    for decision in range(3):
        for step in range(ahead):
            at = min(decision * executed + step, len(one.actions) - 1)
            wanted = policy.normaliser.action(torch.tensor([at * 1e-3, -at * 1e-3]))
            torch.testing.assert_close(chunks[decision, step], wanted)
    assert torch.equal(chunks[3:], chunks[:3])


def test_self_training_leaves_out_what_strays_but_keeps_the_nearer_half() -> None:
    policy = tiny_policy()
    home = policy.normaliser.observation(torch.zeros(1, 4))
    checkpoint = replace(tiny_checkpoint(), support=SupportSet(home, 0.1))
    near = chain_trajectory(policy, 3, seed=0)  # all its made-up observations are 0
    shares = [0.0, 0.5, 0.25, 1.0]
    mixed = []
    for share in shares:
        observations = near.observations.copy()
        observations[: round(share * len(observations))] = 9.0
        mixed.append(replace(near, observations=observations))
    assert near_data(checkpoint, mixed, limit=0.3) == [mixed[0], mixed[2]]
    assert near_data(checkpoint, mixed, limit=0.6) == mixed[:3]
    assert near_data(checkpoint, mixed[1:], limit=0.0) == mixed[1:3]  # the nearer half of three
    assert near_data(checkpoint, [], limit=0.3) == []
