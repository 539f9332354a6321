"""Finetune, evaluate and publish jobs: a whole round, delivered twice, refused, repeated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rodif_core.spec import FinetuneMethod
from server import publications, rounds
from server.states import JobKind, JobState, PublishRule, RoundState
from server.store.tables import Campaign, Checkpoint, Event, Job, Publication, Round
from tests.worker.rows import World, failing_once, make_world
from worker.jobs import evaluate, finetune, publish
from worker.running import run_job


@pytest.fixture
def world(tmp_path: Path) -> World:
    """Episodes, pairs and labels are there; no replays, since no job here looks at them."""
    world = make_world(tmp_path)
    run_job(world.bench, world.enqueue_collect(episodes=5, pairs=6))
    world.label_all(("first", "second", "first", "equal", "cannot_tell", "second"))
    return world


def _round(world: World, round_id: int) -> Round:
    return next(row for row in world.rows(Round) if row.id == round_id)


def _run(world: World, kind: JobKind, round_id: int) -> JobState | None:
    return run_job(world.bench, world.job_of(kind, round_id=round_id).id)


def _candidates(world: World) -> list[Checkpoint]:
    return [row for row in world.rows(Checkpoint) if row.round_id is not None]


def test_round_goes_from_labels_to_a_decision(world: World) -> None:
    round_id = world.launch()
    assert _run(world, JobKind.FINETUNE, round_id) == JobState.DONE
    row = _round(world, round_id)
    assert row.state == RoundState.EVALUATING
    assert row.noise is not None
    assert (row.noise["source"], row.noise["conservativeness"]) == ("given", 0.3)
    assert (row.noise["labels"], row.noise["decisive"]) == (5, 4)
    (candidate,) = _candidates(world)
    assert candidate.parent_id == world.checkpoint_id
    assert candidate.snapshot_digest == row.snapshot_digest
    assert not world.bench.scratch(f"round-{round_id}").exists()

    assert _run(world, JobKind.EVALUATE, round_id) == JobState.DONE
    row = _round(world, round_id)
    assert row.state == RoundState.GATING
    assert row.result is not None
    assert (row.result["before"]["n"], row.result["after"]["n"]) == (4, 4)
    assert set(row.result["seconds"]) == {"finetune", "evaluate"}

    assert _run(world, JobKind.PUBLISH, round_id) == JobState.DONE
    row = _round(world, round_id)
    assert row.state in (RoundState.PUBLISHED, RoundState.REJECTED)
    assert row.result is not None and len(row.result["gate"]["reasons"]) == 2
    states = [e.data["state"] for e in world.rows(Event) if e.kind == "round"]
    assert states == ["queued", "finetuning", "evaluating", "gating", row.state]
    curve = [e.data for e in world.rows(Event) if e.kind == "curve"]
    assert curve and all({"stage", "fraction"} <= set(point) for point in curve)


@pytest.mark.parametrize("method", [FinetuneMethod.IPO, FinetuneMethod.CPO, FinetuneMethod.SIMPO])
def test_round_by_a_further_baseline_makes_a_candidate(
    world: World, method: FinetuneMethod
) -> None:
    round_id = world.launch(PublishRule.NEVER, method=method)
    assert _run(world, JobKind.FINETUNE, round_id) == JobState.DONE
    (candidate,) = _candidates(world)
    assert candidate.parent_id == world.checkpoint_id
    report = candidate.metrics["finetune"]
    assert (report["method"], report["stopped"]) == (method, "all updates done")


def test_nothing_changes_when_the_jobs_of_a_round_come_twice(world: World) -> None:
    round_id = world.launch()
    for kind in (JobKind.FINETUNE, JobKind.EVALUATE, JobKind.PUBLISH):
        _run(world, kind, round_id)
        counted = {table: len(world.rows(table)) for table in (Checkpoint, Job, Publication, Event)}
        assert _run(world, kind, round_id) is None
        assert {table: len(world.rows(table)) for table in counted} == counted


def test_two_rounds_on_one_snapshot_give_the_same_weights(world: World) -> None:
    digests = []
    for _ in range(2):
        round_id = world.launch(PublishRule.NEVER)
        _run(world, JobKind.FINETUNE, round_id)
        digests.append(_candidates(world)[-1].digest)
    first, second = world.rows(Round)
    assert first.snapshot_digest == second.snapshot_digest
    assert digests[0] == digests[1] != world.rows(Checkpoint)[0].digest


def test_finetune_ends_with_one_checkpoint_when_an_attempt_died_before_its_last_step(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    calm_round = world.launch(PublishRule.NEVER)
    _run(world, JobKind.FINETUNE, calm_round)
    round_id = world.launch(PublishRule.NEVER)
    with monkeypatch.context() as patch:
        patch.setattr(finetune, "_store", failing_once(finetune._store, 0))
        assert _run(world, JobKind.FINETUNE, round_id) == JobState.QUEUED
    assert world.bench.scratch(f"round-{round_id}").exists()
    assert len(_candidates(world)) == 1
    assert _run(world, JobKind.FINETUNE, round_id) == JobState.DONE
    calm, late = _candidates(world)
    assert (late.round_id, late.digest) == (round_id, calm.digest)


def test_conservativeness_comes_from_the_labels_when_none_is_given(world: World) -> None:
    round_id = world.launch(conservativeness=None)
    _run(world, JobKind.FINETUNE, round_id)
    noise = _round(world, round_id).noise
    assert noise is not None
    assert noise["source"] == "estimated"
    # Four decisive labels are too few for an estimate; the cautious value is used.
    assert noise["conservativeness"] == 0.45
    candidate = _candidates(world)[0]
    assert candidate.metrics["finetune"]["method"] == "rodif"


def test_lesson_turns_labels_into_winners_whatever_the_side(world: World) -> None:
    round_id = world.launch()
    with world.bench.database.read() as session:
        lesson = finetune.read_lesson(session, round_id)
    assert [item.choice for item in lesson.comparisons] == [
        "first",
        "second",
        "first",
        "equal",
        "second",
    ]
    for preference, item in zip(
        lesson.preferences, [c for c in lesson.comparisons if c.choice != "equal"], strict=True
    ):
        winner = item.first if item.choice == "first" else item.second
        assert (preference.winner, {preference.winner, preference.loser}) == (
            winner,
            {item.first, item.second},
        )
    (tied,) = (item for item in lesson.comparisons if item.choice == "equal")
    assert [tie.pair for tie in lesson.ties] == [(tied.first, tied.second)]


def test_parent_is_rolled_out_once_for_many_rounds(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    rolled_out: list[str] = []
    original = evaluate._evaluate

    def counting(attempt: Any, checkpoint: Checkpoint, *rest: Any) -> dict[str, Any]:
        rolled_out.append(checkpoint.name)
        return original(attempt, checkpoint, *rest)

    monkeypatch.setattr(evaluate, "_evaluate", counting)
    for learning_rate in (1e-4, 2e-4):
        round_id = world.launch(PublishRule.NEVER, learning_rate=learning_rate)
        _run(world, JobKind.FINETUNE, round_id)
        _run(world, JobKind.EVALUATE, round_id)
    assert rolled_out == ["tiny", "avoid-round-1", "avoid-round-2"]
    first, second = world.rows(Round)
    assert first.result["before"] == second.result["before"]


def _evaluation(success: float, off_support: float = 0.0) -> dict[str, Any]:
    interval = [max(success - 0.1, 0.0), min(success + 0.1, 1.0)]
    return {
        "n": 100,
        "success": success,
        "alignment": success,
        "off_support": off_support,
        "intervals": {"success": interval},
    }


def _gated_round(world: World, rule: PublishRule, before: float, after: float) -> int:
    """A round that waits for its publish job, with the given success rates."""
    round_id = world.launch(rule)
    _run(world, JobKind.FINETUNE, round_id)
    _run(world, JobKind.EVALUATE, round_id)
    with world.bench.database.write() as session:
        row = session.get_one(Round, round_id)
        row.result = (row.result or {}) | {
            "before": _evaluation(before),
            "after": _evaluation(after),
        }
    return round_id


@pytest.mark.parametrize(
    ("rule", "after", "expected"),
    [
        (PublishRule.AUTO, 0.9, RoundState.PUBLISHED),
        (PublishRule.AUTO, 0.5, RoundState.REJECTED),
        (PublishRule.MANUAL, 0.9, RoundState.KEPT),
        (PublishRule.NEVER, 0.9, RoundState.KEPT),
    ],
)
def test_gate_decides_by_rates_and_rule(
    world: World, rule: PublishRule, after: float, expected: RoundState
) -> None:
    round_id = _gated_round(world, rule, before=0.9, after=after)
    _run(world, JobKind.PUBLISH, round_id)
    assert _round(world, round_id).state == expected
    published = world.rows(Campaign)[0].published_checkpoint_id
    moved = expected == RoundState.PUBLISHED
    assert published == (_candidates(world)[0].id if moved else world.checkpoint_id)
    assert [row.action for row in world.rows(Publication)] == (["publish"] if moved else [])


@pytest.mark.parametrize("rule", [PublishRule.AUTO, PublishRule.MANUAL])
def test_candidate_that_has_its_parents_weights_is_kept_with_the_reason(
    world: World, rule: PublishRule
) -> None:
    round_id = world.launch(rule, conservativeness=0.9)  # shuts the gate before the first update
    for kind in (JobKind.FINETUNE, JobKind.EVALUATE, JobKind.PUBLISH):
        assert _run(world, kind, round_id) == JobState.DONE
    (candidate,) = _candidates(world)
    assert candidate.digest == world.rows(Checkpoint)[0].digest
    row = _round(world, round_id)
    assert row.state == RoundState.KEPT
    gate = row.result["gate"]
    stopped = candidate.metrics["finetune"]["stopped"]
    assert (gate["passed"], gate["unchanged"]) == (True, True)
    assert gate["reasons"][-1] == f"the candidate has its parent's weights: not moved ({stopped})"
    assert world.rows(Campaign)[0].published_checkpoint_id == world.checkpoint_id
    assert world.rows(Publication) == []


def test_gate_does_not_undo_what_an_admin_published_meanwhile(world: World) -> None:
    other_round = _gated_round(world, PublishRule.MANUAL, before=0.9, after=0.9)
    _run(world, JobKind.PUBLISH, other_round)
    round_id = _gated_round(world, PublishRule.AUTO, before=0.9, after=0.95)
    chosen = _candidates(world)[0].id
    with world.bench.database.write() as session:
        publications.publish(
            session,
            world.clock(),
            campaign_id=world.campaign_id,
            checkpoint_id=chosen,
            reason="looks right",
            by=world.annotator_id,
        )
    _run(world, JobKind.PUBLISH, round_id)
    row = _round(world, round_id)
    assert row.state == RoundState.KEPT
    assert "has changed since" in row.result["gate"]["reasons"][-1]
    assert world.rows(Campaign)[0].published_checkpoint_id == chosen


def test_round_fails_with_the_reason_when_the_parent_file_is_damaged(world: World) -> None:
    parent = world.rows(Checkpoint)[0].artifact_sha256
    world.bench.artifacts.path(parent).write_bytes(b"not a checkpoint")
    round_id = world.launch()
    assert _run(world, JobKind.FINETUNE, round_id) == JobState.FAILED
    row = _round(world, round_id)
    assert row.state == RoundState.FAILED
    assert parent in (row.error or "")
    assert row.finished_at is not None


def test_cancelled_round_stops_at_the_next_progress(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    round_id = world.launch()

    def cancel_in_the_middle(*_: Any, **options: Any) -> Any:
        with world.bench.database.write() as session:
            rounds.cancel(session, world.clock(), round_id, by=None)
        options["progress"]("next stage", 0.5, {})
        raise AssertionError("progress let a cancelled round go on")

    monkeypatch.setattr(finetune, "finetune", cancel_in_the_middle)
    assert _run(world, JobKind.FINETUNE, round_id) is None
    assert _round(world, round_id).state == RoundState.CANCELLED
    assert world.job_of(JobKind.FINETUNE).state == JobState.CANCELLED
    assert _candidates(world) == []

    # What it had written stays until the next round tidies up.
    leftovers = world.bench.scratch(f"round-{round_id}")
    assert leftovers.is_dir()
    monkeypatch.undo()
    _run(world, JobKind.FINETUNE, world.launch())
    assert not leftovers.exists()


def test_publish_job_that_dies_leaves_alias_and_history_as_they_were(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    round_id = _gated_round(world, PublishRule.AUTO, before=0.9, after=0.9)
    with monkeypatch.context() as patch:
        patch.setattr(publish.rounds, "move", failing_once(rounds.move, 0))
        assert _run(world, JobKind.PUBLISH, round_id) == JobState.QUEUED
    assert world.rows(Publication) == []
    assert world.rows(Campaign)[0].published_checkpoint_id == world.checkpoint_id
    assert _run(world, JobKind.PUBLISH, round_id) == JobState.DONE
    assert len(world.rows(Publication)) == 1
