"""Label snapshot → noise estimate → fine-tuning → candidate checkpoint.

The learner keeps partial results in a folder of the round: an attempt that dies is taken up by the
next one on the same machine, after its last saved update or finished trial. On another machine it
starts again and comes to the same weights.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import shutil
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import InstrumentedAttribute, Session

from rodif_core.errors import LearningError
from rodif_core.finetune import FinetuneResult, finetune
from rodif_core.policies.checkpoint import load_checkpoint, save_checkpoint
from rodif_core.preferences.noise import CHOICES, Comparison, estimate_noise
from rodif_core.preferences.pairs import Preference, Tie
from rodif_core.spec import FinetuneConfig
from rodif_core.trajectory import Trajectory
from server import rounds
from server.states import DECISIVE, Choice, JobKind, RoundState
from server.store import jobs
from server.store.labels import snapshot_labels
from server.store.tables import Checkpoint, Episode, Label, Pair, Round
from worker.attempt import Attempt

WORKSPACE = "round-{}"  # name of the folder of partial results, by round id


@dataclass(frozen=True)
class Lesson:
    """What a round learns from; indices point into `episode_files`."""

    parent_file: str
    config: FinetuneConfig
    episode_files: tuple[str, ...]
    comparisons: tuple[Comparison, ...]

    @property
    def preferences(self) -> list[Preference]:
        """The comparisons that say which one is better."""
        return [
            Preference(item.first, item.second)
            if item.choice == Choice.FIRST
            else Preference(item.second, item.first)
            for item in self.comparisons
            if item.choice != Choice.EQUAL
        ]

    @property
    def ties(self) -> list[Tie]:
        """The comparisons that call both equally good."""
        return [
            Tie(item.first, item.second) for item in self.comparisons if item.choice == Choice.EQUAL
        ]


def run(attempt: Attempt) -> None:
    """Do the job, or what is left of it."""
    round_id = attempt.facts.round_id
    assert round_id is not None
    with attempt.bench.database.read() as session:  # long reads: no writer waits for them
        lesson = read_lesson(session, round_id)
        remove_old_workspaces(session, attempt)
    with attempt.step() as session:
        rounds.move(session, attempt.bench.clock(), round_id, RoundState.FINETUNING)
    attempt.progress("noise", 0.0)
    noise, config = choose_conservativeness(lesson)
    with attempt.step() as session:
        session.get_one(Round, round_id).noise = noise
    artifacts = attempt.bench.artifacts
    workspace = attempt.bench.scratch(WORKSPACE.format(round_id))
    workspace.mkdir(parents=True, exist_ok=True)
    result = finetune(
        load_checkpoint(artifacts.get(lesson.parent_file)),
        [Trajectory.from_bytes(artifacts.get(file)) for file in lesson.episode_files],
        lesson.preferences,
        config,
        ties=lesson.ties,
        workspace=workspace,
        progress=attempt.progress,
    )
    file = artifacts.put(save_checkpoint(result.checkpoint))
    with attempt.step() as session:
        checkpoint_id = _store(session, attempt, result, file)
        attempt.finish(session, {"checkpoint_id": checkpoint_id, "seconds": attempt.seconds()})
    shutil.rmtree(workspace, ignore_errors=True)


def remove_old_workspaces(session: Session, attempt: Attempt) -> None:
    """Cancelled rounds leave their partial results behind; failed ones may still be retried."""
    over = rounds.FINAL_STATES - {RoundState.FAILED}
    for round_id in session.scalars(select(Round.id).where(Round.state.in_(over))):
        shutil.rmtree(attempt.bench.scratch(WORKSPACE.format(round_id)), ignore_errors=True)


def read_lesson(session: Session, round_id: int) -> Lesson:
    """The round's parent, configuration and labels, in the order of the snapshot.

    Raises LearningError when no label says which episode is better.
    """
    this = session.get_one(Round, round_id)
    labels = snapshot_labels(
        session,
        this.snapshot_digest,
        Label.choice,
        Label.pair_id,
        Label.annotator_id,
        Label.left_episode_id,
    )
    wanted = [label for label in labels if label.choice in CHOICES]
    if not any(label.choice in DECISIVE for label in wanted):
        raise LearningError(
            f"round {round_id} has {len(labels)} labels, but none says which episode is better"
        )
    ends = (Pair.first_episode_id, Pair.second_episode_id)
    pairs = _by_id(session, Pair.id, {label.pair_id for label in wanted}, *ends)
    used = {e for p in pairs.values() for e in (p.first_episode_id, p.second_episode_id)}
    episodes = _by_id(session, Episode.id, used, Episode.artifact_sha256)
    index = {episode_id: i for i, episode_id in enumerate(sorted(episodes))}
    comparisons = tuple(
        Comparison(
            first=index[pairs[label.pair_id].first_episode_id],
            second=index[pairs[label.pair_id].second_episode_id],
            choice=label.choice,
            annotator=label.annotator_id,
            first_was_left=label.left_episode_id == pairs[label.pair_id].first_episode_id,
        )
        for label in wanted
    )
    return Lesson(
        parent_file=session.get_one(Checkpoint, this.parent_checkpoint_id).artifact_sha256,
        config=FinetuneConfig.from_json(this.config),
        episode_files=tuple(episodes[i].artifact_sha256 for i in sorted(episodes)),
        comparisons=comparisons,
    )


def _by_id(
    session: Session,
    key: InstrumentedAttribute[int],
    ids: set[int],
    *columns: InstrumentedAttribute[Any],
) -> dict[int, Any]:
    """Columns of one table by id, in portions below the engines' parameter limits."""
    wanted = sorted(ids)
    rows: dict[int, Any] = {}
    for start in range(0, len(wanted), 500):
        portion = select(key, *columns).where(key.in_(wanted[start : start + 500]))
        rows |= {row.id: row for row in session.execute(portion)}
    return rows


def choose_conservativeness(lesson: Lesson) -> tuple[dict[str, Any], FinetuneConfig]:
    """What the labels say about their noise, and the configuration with γ filled in.

    A γ that was given stays; the estimate is stored beside it all the same.
    """
    estimate = estimate_noise(lesson.comparisons)
    given = lesson.config.conservativeness
    used = estimate.conservativeness if given is None else given
    noise = estimate.to_json() | {
        "conservativeness": used,
        "source": "estimated" if given is None else "given",
    }
    if given is not None:
        noise["notes"] = [*noise["notes"], f"γ = {given:g} was given with the round"]
    return noise, dataclasses.replace(lesson.config, conservativeness=used)


def _store(session: Session, attempt: Attempt, result: FinetuneResult, file: str) -> int:
    """Insert the candidate and queue its evaluation; returns the checkpoint's id."""
    now, round_id = attempt.bench.clock(), attempt.facts.round_id
    assert round_id is not None
    this = session.get_one(Round, round_id)
    parent = session.get_one(Checkpoint, this.parent_checkpoint_id)
    candidate = Checkpoint(
        task=parent.task,
        name=f"{parent.task}-round-{round_id}",
        digest=result.checkpoint.digest,
        artifact_sha256=file,
        parent_id=parent.id,
        round_id=round_id,
        snapshot_digest=this.snapshot_digest,
        config=dict(parent.config),
        metrics={"finetune": result.report},
        code_version=importlib.metadata.version("rodif-studio"),
        created_at=now,
    )
    session.add(candidate)
    session.flush()
    rounds.move(session, now, round_id, RoundState.EVALUATING)
    jobs.enqueue(
        session,
        now,
        kind=JobKind.EVALUATE,
        campaign_id=this.campaign_id,
        round_id=round_id,
        payload={},
        dedupe_key=f"evaluate:{round_id}",
        created_by=this.started_by,
    )
    return candidate.id
