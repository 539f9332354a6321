"""Rounds, checkpoints, jobs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fastapi import APIRouter, Response, status
from sqlalchemy import select
from sqlalchemy.orm import Session

from server import checkpoints, rounds
from server.api.access import ReadSession, Staff, UseServices, WriteSession
from server.api.params import Cursor, Limit, PathId
from server.campaigns import get_campaign
from server.errors import NotFoundError
from server.rounds import RoundRequest
from server.schemas.common import Id, Page, ShortText
from server.schemas.rounds import (
    CheckpointOut,
    JobOut,
    LabelBehind,
    LineageStep,
    RoundCreate,
    RoundOut,
)
from server.states import JobState, Role
from server.store.paging import page
from server.store.tables import Checkpoint, Event, Job, LabelSnapshot, Round

router = APIRouter(tags=["rounds"])


# What an evaluation draws, some 100 kB a round: only in the answer for one round.
_DRAWN = ("paths", "path_groups")


def _without_paths(result: dict[str, Any] | None) -> dict[str, Any] | None:
    if result is None:
        return None
    short = dict(result)
    for name in ("before", "after"):
        if isinstance(short.get(name), dict):
            short[name] = {key: short[name][key] for key in short[name] if key not in _DRAWN}
    return short


def _rounds_out(session: Session, rows: Sequence[Round]) -> list[RoundOut]:
    stopped = Checkpoint.metrics[("finetune", "stopped")].as_string()
    made = session.execute(
        select(Checkpoint.round_id, Checkpoint.id, stopped).where(
            Checkpoint.round_id.in_([row.id for row in rows])
        )
    )
    candidates = {round_id: (candidate_id, why) for round_id, candidate_id, why in made}
    sizes = dict(
        session.execute(
            select(LabelSnapshot.digest, LabelSnapshot.size).where(
                LabelSnapshot.digest.in_({row.snapshot_digest for row in rows})
            )
        ).all()
    )
    extra = ("candidate_checkpoint_id", "labels", "stopped")
    names = [name for name in RoundOut.model_fields if name not in extra]
    shown = []
    for row in rows:
        candidate_id, why = candidates.get(row.id, (None, None))
        own = {name: getattr(row, name) for name in names}
        labels = sizes[row.snapshot_digest]
        shown.append(
            RoundOut(candidate_checkpoint_id=candidate_id, stopped=why, labels=labels, **own)
        )
    return shown


def _round_out(session: Session, row: Round) -> RoundOut:
    return _rounds_out(session, [row])[0]


def _get_round(session: Session, round_id: int) -> Round:
    found = session.get(Round, round_id)
    if found is None:
        raise NotFoundError("round", round_id)
    return found


@router.get("/campaigns/{campaign_id}/rounds")
def list_rounds(
    campaign_id: PathId,
    _me: Staff,
    session: ReadSession,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[RoundOut]:
    """Rounds of the campaign, newest first; without the paths that their evaluations draw."""
    get_campaign(session, campaign_id)
    query = select(Round).where(Round.campaign_id == campaign_id)
    rows, next_cursor = page(
        session, query, Round.id, limit=limit, cursor=cursor, newest_first=True
    )
    items = _rounds_out(session, rows)
    for item in items:
        item.result = _without_paths(item.result)
    return Page[RoundOut](items=items, next_cursor=next_cursor)


@router.post("/campaigns/{campaign_id}/rounds", status_code=status.HTTP_202_ACCEPTED)
def launch_round(
    campaign_id: PathId,
    body: RoundCreate,
    me: Staff,
    session: WriteSession,
    services: UseServices,
    response: Response,
) -> RoundOut:
    """Freeze the labels and fine-tune on them; follow the round at `Location`."""
    evaluation = None
    if body.evaluation is not None:
        evaluation = body.evaluation.model_dump(exclude_none=True)
    started = rounds.launch(
        session,
        services.clock(),
        campaign_id,
        RoundRequest(
            config=body.config,
            publish_rule=body.publish_rule,
            evaluation=evaluation,
            snapshot_digest=body.snapshot_digest,
            seed=body.seed,
        ),
        started_by=me.id,
        may_loosen=me.role == Role.ADMIN,
    )
    response.headers["Location"] = f"/api/v1/rounds/{started.id}"
    return _round_out(session, started)


@router.get("/rounds/{round_id}")
def get_round(round_id: PathId, _me: Staff, session: ReadSession) -> RoundOut:
    """One round."""
    return _round_out(session, _get_round(session, round_id))


@router.post("/rounds/{round_id}/cancel")
def cancel_round(
    round_id: PathId, me: Staff, session: WriteSession, services: UseServices
) -> RoundOut:
    """Stop the round; its worker notices at the next sign of life."""
    return _round_out(session, rounds.cancel(session, services.clock(), round_id, by=me.id))


@router.get("/rounds/{round_id}/curves")
def round_curves(round_id: PathId, _me: Staff, session: ReadSession) -> list[dict[str, Any]]:
    """Points of the learning curves, in order: stage, step and metrics such as loss, mean_vote."""
    _get_round(session, round_id)
    query = select(Event.data).where(Event.round_id == round_id, Event.kind == "curve")
    return list(session.scalars(query.order_by(Event.id)))


def _checkpoints_out(session: Session, rows: Sequence[Checkpoint]) -> list[CheckpointOut]:
    compared = checkpoints.from_comparison_rounds(session, rows)
    names = [name for name in CheckpointOut.model_fields if name != "comparison"]
    return [
        CheckpointOut(comparison=row.id in compared, **{name: getattr(row, name) for name in names})
        for row in rows
    ]


@router.get("/checkpoints")
def list_checkpoints(
    _me: Staff,
    session: ReadSession,
    task: ShortText | None = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[CheckpointOut]:
    """Checkpoints, newest first."""
    query = select(Checkpoint)
    if task is not None:
        query = query.where(Checkpoint.task == task)
    rows, next_cursor = page(
        session, query, Checkpoint.id, limit=limit, cursor=cursor, newest_first=True
    )
    return Page[CheckpointOut](items=_checkpoints_out(session, rows), next_cursor=next_cursor)


@router.get("/checkpoints/{checkpoint_id}")
def get_checkpoint(checkpoint_id: PathId, _me: Staff, session: ReadSession) -> CheckpointOut:
    """One checkpoint."""
    return _checkpoints_out(session, [checkpoints.get_checkpoint(session, checkpoint_id)])[0]


@router.get("/checkpoints/{checkpoint_id}/lineage")
def checkpoint_lineage(
    checkpoint_id: PathId, _me: Staff, session: ReadSession
) -> list[LineageStep]:
    """The checkpoint and its parents, down to the labels behind each."""
    steps = checkpoints.lineage(session, checkpoint_id)
    shown = _checkpoints_out(session, [step["checkpoint"] for step in steps])
    return [
        LineageStep.model_validate(step | {"checkpoint": checkpoint})
        for step, checkpoint in zip(steps, shown, strict=True)
    ]


@router.get("/checkpoints/{checkpoint_id}/labels")
def checkpoint_labels(
    checkpoint_id: PathId,
    _me: Staff,
    session: ReadSession,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[LabelBehind]:
    """The labels that the checkpoint learned from, oldest first."""
    rows, next_cursor = checkpoints.labels_behind(
        session, checkpoint_id, limit=limit, cursor=cursor
    )
    items = [LabelBehind.model_validate(row) for row in rows]
    return Page[LabelBehind](items=items, next_cursor=next_cursor)


@router.get("/jobs")
def list_jobs(
    _me: Staff,
    session: ReadSession,
    campaign_id: Id | None = None,
    state: JobState | None = None,
    limit: Limit = 100,
) -> list[JobOut]:
    """Newest jobs first."""
    query = select(Job).order_by(Job.id.desc()).limit(limit)
    if campaign_id is not None:
        query = query.where(Job.campaign_id == campaign_id)
    if state is not None:
        query = query.where(Job.state == state)
    return [JobOut.model_validate(row) for row in session.scalars(query)]


@router.get("/jobs/{job_id}")
def get_job(job_id: PathId, _me: Staff, session: ReadSession) -> JobOut:
    """One job."""
    job = session.get(Job, job_id)
    if job is None:
        raise NotFoundError("job", job_id)
    return JobOut.model_validate(job)


@router.post("/jobs/{job_id}/retry")
def retry_job(job_id: PathId, me: Staff, session: WriteSession, services: UseServices) -> JobOut:
    """Queue a failed job again."""
    return JobOut.model_validate(rounds.retry_job(session, services.clock(), job_id, by=me.id))
