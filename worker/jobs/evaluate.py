"""Seeded rollouts of a round's candidate and of its parent, on the same seeds."""

from __future__ import annotations

from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from rodif_core.evaluate import evaluate
from rodif_core.policies.checkpoint import load_checkpoint
from rodif_core.spec import RolloutConfig
from server import rounds
from server.states import JobKind, RoundState
from server.store import jobs
from server.store.tables import Checkpoint, Job, Round
from worker.attempt import Attempt

# Episodes stepped together: progress shows after each portion. `rodif evaluate` steps more of them
# together, so that its paths differ in their last digits, and now and then an episode's end.
BATCH = 50


def run(attempt: Attempt) -> None:
    """Do the job; a parent that was evaluated on these seeds before is not rolled out again."""
    round_id = attempt.facts.round_id
    assert round_id is not None
    with attempt.bench.database.read() as session:
        this = session.get_one(Round, round_id)
        config = RolloutConfig(**this.evaluation, max_parallel=BATCH)
        parent = session.get_one(Checkpoint, this.parent_checkpoint_id)
        candidate = session.scalars(select(Checkpoint).where(Checkpoint.round_id == round_id)).one()
        before = known_evaluation(session, parent.id, this.evaluation)
    if before is None:
        before = _evaluate(attempt, parent, config, "evaluate parent", 0.0)
    with attempt.step() as session:
        row = session.get_one(Round, round_id)
        row.result = (row.result or {}) | {"before": before}
    after = _evaluate(attempt, candidate, config, "evaluate candidate", 0.5)
    with attempt.step() as session:
        seconds = {"finetune": _finetune_seconds(session, round_id), "evaluate": attempt.seconds()}
        row = session.get_one(Round, round_id)
        row.result = {"before": before, "after": after, "seconds": seconds}
        now = attempt.bench.clock()
        rounds.move(session, now, round_id, RoundState.GATING)
        jobs.enqueue(
            session,
            now,
            kind=JobKind.PUBLISH,
            campaign_id=attempt.facts.campaign_id,
            round_id=round_id,
            payload={},
            dedupe_key=f"publish:{round_id}",
            created_by=row.started_by,
        )
        attempt.finish(session, {"success": after["success"], "alignment": after["alignment"]})


def _evaluate(
    attempt: Attempt, checkpoint: Checkpoint, config: RolloutConfig, stage: str, start: float
) -> dict[str, Any]:
    def show(done: int, total: int) -> None:
        attempt.progress(stage, start + 0.5 * done / total)

    attempt.progress(stage, start)
    policy = load_checkpoint(attempt.bench.artifacts.get(checkpoint.artifact_sha256))
    return evaluate(policy, config, progress=show).to_json()


def known_evaluation(
    session: Session, checkpoint_id: int, evaluation: dict[str, Any]
) -> dict[str, Any] | None:
    """What earlier rounds measured of a checkpoint with the same number of episodes and seed."""
    as_parent = select(Round).where(Round.parent_checkpoint_id == checkpoint_id)
    as_candidate = (
        select(Round)
        .join(Checkpoint, Checkpoint.round_id == Round.id)
        .where(Checkpoint.id == checkpoint_id)
    )
    for query, key in ((as_parent, "before"), (as_candidate, "after")):
        for earlier in session.scalars(query):
            if earlier.evaluation == evaluation and key in (earlier.result or {}):
                found: dict[str, Any] = (earlier.result or {})[key]
                return found
    return None


def _finetune_seconds(session: Session, round_id: int) -> float:
    query = select(Job).where(Job.round_id == round_id, Job.kind == JobKind.FINETUNE)
    return float((session.scalars(query).one().result or {})["seconds"])
