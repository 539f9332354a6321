"""The default fine-tuner from labels to the chosen policy, small, with real rollouts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rodif_core.errors import LearningError
from rodif_core.finetune import FinetuneResult, finetune
from rodif_core.policies.checkpoint import Checkpoint, load_checkpoint
from rodif_core.preferences.pairs import Preference, Tie
from rodif_core.rollout import rollout
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import FinetuneConfig, GuideConfig, RolloutConfig, Scorer, TaskName
from rodif_core.trajectory import Trajectory
from tests.core.learning import chain_trajectory, tiny_checkpoint, tiny_policy

GUIDE = GuideConfig(
    score_updates=2,
    scales=(1.0, 2.0),
    updates=3,
    batch_size=32,
    selection_rollouts=10,
    self_training_rounds=1,
    self_training_rollouts=10,
    self_training_updates=3,
)
SMALL = FinetuneConfig(conservativeness=0.3, guide=GUIDE)


class KilledError(Exception):
    """What a test throws into a fine-tuning to end it."""


@pytest.fixture(scope="module")
def shipped() -> Checkpoint:
    return load_checkpoint(shipped_checkpoint(TaskName.AVOID))


@pytest.fixture(scope="module")
def runs(shipped: Checkpoint) -> list[Trajectory]:
    return [one for one in rollout(shipped, RolloutConfig(episodes=24, seed=3)) if one.success]


def labels(runs: Sequence[Trajectory]) -> tuple[list[Preference], list[Tie]]:
    """Left is better than right, and two on one side are equal."""
    left = [i for i, one in enumerate(runs) if one.outcome["group"] == "left"]
    right = [i for i, one in enumerate(runs) if one.outcome["group"] == "right"]
    assert len(left) >= 2 and len(right) >= 2
    ties = [Tie(a, b) for side in (left, right) for a, b in zip(side, side[1:], strict=False)]
    return [Preference(i, j) for i in left for j in right], ties


@pytest.fixture(scope="module")
def whole(shipped: Checkpoint, runs: list[Trajectory]) -> FinetuneResult:
    preferences, ties = labels(runs)
    return finetune(shipped, runs, preferences, SMALL, ties=ties)


def test_the_labels_model_keeps_the_preferred_side_and_both_scales_are_tried(
    whole: FinetuneResult, runs: list[Trajectory]
) -> None:
    report = whole.report
    sides = {runs[i].outcome["group"] for i in report["scores"]["kept"]}
    assert sides == {"left"}
    assert [trial["scale"] for trial in report["trials"]] == [1.0, 2.0]
    assert len(report["self_training"]) == 1
    assert report["chosen"] in [*report["trials"], *report["self_training"]]
    assert report["ties"] > 0


@pytest.mark.parametrize("stage", ["choose", "self-training 1"])
def test_a_killed_run_goes_on_to_the_same_weights_and_repeats_no_finished_trial(
    shipped: Checkpoint,
    runs: list[Trajectory],
    whole: FinetuneResult,
    tmp_path: Path,
    stage: str,
) -> None:
    preferences, ties = labels(runs)

    def kill(at: str, _fraction: float, _metrics: dict[str, float]) -> None:
        if at == stage:
            raise KilledError

    def run(progress: Any) -> FinetuneResult:
        return finetune(
            shipped, runs, preferences, SMALL, ties=ties, workspace=tmp_path, progress=progress
        )

    with pytest.raises(KilledError):
        run(kill)
    stages: list[str] = []
    resumed = run(lambda at, *_: stages.append(at))
    assert resumed.checkpoint.digest == whole.checkpoint.digest
    assert resumed.report == whole.report
    assert "guide s=1" not in stages  # was finished before
    assert ("guide s=2" in stages) == (stage == "choose")


def hopeless(count: int = 6) -> list[Trajectory]:
    """Runs of a policy that never arrives: three are called successful all the same."""
    policy = tiny_policy()
    return [
        chain_trajectory(policy, 3, seed=i, x=0.4 + 0.04 * i, success=i < 4) for i in range(count)
    ]


CROSS = [Preference(i, j) for i in range(2) for j in range(2, 6)]


@pytest.mark.parametrize("scorer", list(Scorer))
def test_every_scorer_reaches_a_choice_although_no_fresh_rollout_is_liked(scorer: Scorer) -> None:
    config = replace(SMALL, guide=replace(GUIDE, scorer=scorer))
    report = finetune(tiny_checkpoint(), hopeless(), CROSS, config).report
    assert report["scores"]["kept"]
    assert report["self_training"] == []
    assert report["chosen"]["predicted_preferred"] == 0.0


def test_a_dead_network_does_not_stop_a_scorer_that_does_not_ask_it() -> None:
    dead = replace(SMALL, conservativeness=0.9)
    many = CROSS * 20
    scores = finetune(tiny_checkpoint(), hopeless(), many, dead).report["scores"]
    assert scores["agreement"] is None
    assert "dead gradient" in scores["stopped"]
    asked = replace(dead, guide=replace(GUIDE, scorer=Scorer.NETWORK))
    with pytest.raises(LearningError, match="'network' needs .* dead gradient"):
        finetune(tiny_checkpoint(), hopeless(), many, asked)


def test_failures_can_be_winners_only_when_success_is_not_required() -> None:
    failed = [replace(one, outcome=one.outcome | {"success": False}) for one in hopeless()]
    with pytest.raises(LearningError, match="0 of 6 labelled trajectories succeeded"):
        finetune(tiny_checkpoint(), failed, CROSS, SMALL)
    anyway = replace(SMALL, guide=replace(GUIDE, require_success=False))
    kept = finetune(tiny_checkpoint(), failed, CROSS, anyway).report["scores"]["kept"]
    assert set(kept) <= {0, 1, 2, 3, 4, 5} and kept
