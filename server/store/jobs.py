"""Queued work as rows: put in, claim with a lease and a fencing token, renew, finish, fail.

Every change of a claimed row names the claim (`attempt` and `owner`), so a worker that has lost
its lease changes nothing. Nothing here commits; the caller's transaction also carries the effects
of the job step.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, and_, func, not_, or_, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from server.errors import ConflictError, LeaseLostError, NotFoundError
from server.states import JobKind, JobState
from server.store.session import JOBS_TO_SEND
from server.store.tables import Job

DEFAULT_MAX_ATTEMPTS = 5
# A message can be lost while others wait (it went down with its worker); then it comes late.
BUSY_PATIENCE = timedelta(minutes=15)


@dataclass(frozen=True)
class Claim:
    """The right to work on a job: valid while the row still shows this attempt and owner."""

    job_id: int
    attempt: int
    owner: str


def enqueue(
    session: Session,
    now: datetime,
    *,
    kind: JobKind,
    campaign_id: int,
    payload: dict[str, Any],
    round_id: int | None = None,
    pair_id: int | None = None,
    dedupe_key: str | None = None,
    created_by: int | None = None,
    max_attempts: int = DEFAULT_MAX_ATTEMPTS,
) -> Job:
    """Add a job that is sent after the commit; an equal `dedupe_key` gives back the job there is.

    `sent_at` is set at once: when the sending fails, `stuck_jobs` finds the row by its age.
    """
    if dedupe_key is not None and (existing := _by_dedupe_key(session, dedupe_key)) is not None:
        return existing
    job = Job(
        kind=kind,
        campaign_id=campaign_id,
        round_id=round_id,
        pair_id=pair_id,
        payload=payload,
        dedupe_key=dedupe_key,
        created_by=created_by,
        max_attempts=max_attempts,
        created_at=now,
        sent_at=now,
    )
    try:
        with session.begin_nested():
            session.add(job)
    except IntegrityError:
        # Another transaction has put the same key in between (PostgreSQL only).
        if dedupe_key is None or (existing := _by_dedupe_key(session, dedupe_key)) is None:
            raise
        return existing
    send_after_commit(session, job.id, kind)
    return job


def _by_dedupe_key(session: Session, key: str) -> Job | None:
    return session.scalars(select(Job).where(Job.dedupe_key == key)).one_or_none()


def send_after_commit(session: Session, job_id: int, kind: JobKind) -> None:
    """Have `Database.write` tell the queue about this job once the transaction is committed."""
    session.info.setdefault(JOBS_TO_SEND, []).append((job_id, JobKind(kind)))


def claim(
    session: Session, now: datetime, job_id: int, *, owner: str, lease: timedelta
) -> Claim | None:
    """Take a job that is queued, or running with a lease that ran out; None when it is neither.

    `owner` must differ between processes (host name and process id, say).
    """
    statement = (
        update(Job)
        .where(Job.id == job_id, Job.attempt < Job.max_attempts, _free(now))
        .values(
            state=JobState.RUNNING,
            owner=owner,
            attempt=Job.attempt + 1,
            lease_expires_at=now + lease,
            started_at=func.coalesce(Job.started_at, now),
            error=None,
        )
        .returning(Job.attempt)
        .execution_options(synchronize_session=False)
    )
    attempt = session.execute(statement).scalar_one_or_none()
    return None if attempt is None else Claim(job_id, attempt, owner)


def _free(now: datetime) -> ColumnElement[bool]:
    return or_(
        Job.state == JobState.QUEUED,
        and_(Job.state == JobState.RUNNING, Job.lease_expires_at < now),
    )


def renew(
    session: Session,
    now: datetime,
    claim: Claim,
    *,
    lease: timedelta,
    progress: float | None = None,
    stage: str | None = None,
) -> None:
    """Heart-beat: prolong the lease, and show progress (0 … 1) and stage.

    Raises LeaseLostError when the job was cancelled or passed on.
    """
    values: dict[str, Any] = {"lease_expires_at": now + lease}
    if progress is not None:
        values["progress"] = progress
    if stage is not None:
        values["stage"] = stage
    _change(session, claim, values)


def finish(session: Session, now: datetime, claim: Claim, result: dict[str, Any]) -> None:
    """Mark the job done, in the transaction of its last effects.

    Raises LeaseLostError when the job was cancelled or passed on: the effects roll back with it.
    """
    _change(
        session,
        claim,
        {
            "state": JobState.DONE,
            "result": result,
            "progress": 1.0,
            "finished_at": now,
            "lease_expires_at": None,
            "owner": None,
        },
    )


def fail(session: Session, now: datetime, claim: Claim, error: str, *, retry: bool) -> JobState:
    """End an attempt: back to queued while attempts are left and `retry`, otherwise failed.

    Returns the new state. Raises LeaseLostError when the job was cancelled or passed on.
    """
    max_attempts = session.scalars(select(Job.max_attempts).where(Job.id == claim.job_id)).one()
    again = retry and claim.attempt < max_attempts
    state = JobState.QUEUED if again else JobState.FAILED
    values: dict[str, Any] = {
        "state": state,
        "error": error,
        "lease_expires_at": None,
        "owner": None,
        "finished_at": None if again else now,
    }
    if again:
        values["sent_at"] = now
    _change(session, claim, values)
    return state


def _change(session: Session, claim: Claim, values: dict[str, Any]) -> None:
    statement = (
        update(Job)
        .where(_holds(claim))
        .values(**values)
        .returning(Job.id)
        .execution_options(synchronize_session=False)
    )
    if session.execute(statement).scalar_one_or_none() is None:
        raise LeaseLostError(
            f"job {claim.job_id}, attempt {claim.attempt} of {claim.owner!r},"
            " was cancelled or has passed to another worker"
        )
    job = session.get(Job, claim.job_id)
    if job is not None:
        session.refresh(job)


def _holds(claim: Claim) -> ColumnElement[bool]:
    return and_(
        Job.id == claim.job_id,
        Job.attempt == claim.attempt,
        Job.owner == claim.owner,
        Job.state == JobState.RUNNING,
    )


def running_claims(session: Session) -> list[Claim]:
    """The claims that hold now, also those whose lease has run out."""
    query = select(Job.id, Job.attempt, Job.owner).where(Job.state == JobState.RUNNING)
    rows = session.execute(query.order_by(Job.id))
    return [Claim(job_id, attempt, owner) for job_id, attempt, owner in rows if owner is not None]


def hand_back(session: Session, claim: Claim) -> bool:
    """Queue the job of a worker that was stopped on purpose; False when the claim is gone.

    One more attempt is allowed in place of the interrupted one. Its number stays used, so that the
    claim can never become valid again. The next tick sends the job.
    """
    statement = (
        update(Job)
        .where(_holds(claim))
        .values(
            state=JobState.QUEUED,
            max_attempts=Job.max_attempts + 1,
            lease_expires_at=None,
            owner=None,
            sent_at=None,
        )
        .returning(Job.id)
        .execution_options(synchronize_session=False)
    )
    return session.execute(statement).scalar_one_or_none() is not None


def stuck_jobs(
    session: Session,
    now: datetime,
    *,
    patience: timedelta,
    busy_kinds: Collection[JobKind] = (),
    limit: int = 200,
) -> list[tuple[int, JobKind]]:
    """Jobs to send again: queued or with an expired lease, and last sent `patience` ago.

    Queued jobs of `busy_kinds`, whose queue still holds messages, are not stuck but waiting: they
    are sent again only after BUSY_PATIENCE. What is returned is marked as sent and goes out after
    the commit. Harmless when two ticks overlap.
    """
    waiting = and_(
        Job.state == JobState.QUEUED,
        Job.kind.in_(busy_kinds),
        Job.sent_at > now - BUSY_PATIENCE,
    )
    due = (
        select(Job.id)
        .where(
            _free(now),
            Job.attempt < Job.max_attempts,
            or_(Job.sent_at.is_(None), and_(Job.sent_at <= now - patience, not_(waiting))),
        )
        .order_by(Job.id)
        .limit(limit)
        .with_for_update(skip_locked=True)
    )
    statement = (
        update(Job)
        .where(Job.id.in_(due.scalar_subquery()))
        .values(sent_at=now)
        .returning(Job.id, Job.kind)
        .execution_options(synchronize_session=False)
    )
    jobs = sorted((row.id, JobKind(row.kind)) for row in session.execute(statement))
    for job_id, kind in jobs:
        send_after_commit(session, job_id, kind)
    return jobs


def give_up_exhausted(session: Session, now: datetime) -> Sequence[Job]:
    """Fail the jobs whose last allowed attempt died without a word; returns them.

    A job that kills its worker every time (out of memory, say) ends here and not in a loop.
    """
    statement = (
        update(Job)
        .where(Job.attempt >= Job.max_attempts, _free(now))
        .values(
            state=JobState.FAILED,
            error="the worker died in every one of the allowed attempts",
            finished_at=now,
            lease_expires_at=None,
            owner=None,
        )
        .returning(Job.id)
        .execution_options(synchronize_session=False)
    )
    ids = list(session.scalars(statement))
    jobs = select(Job).where(Job.id.in_(ids)).order_by(Job.id)
    return session.scalars(jobs.execution_options(populate_existing=True)).all()


def cancel(session: Session, now: datetime, job_id: int) -> bool:
    """Cancel a queued or running job; its worker notices at the next renewal. False if ended."""
    statement = (
        update(Job)
        .where(Job.id == job_id, Job.state.in_((JobState.QUEUED, JobState.RUNNING)))
        .values(state=JobState.CANCELLED, finished_at=now, lease_expires_at=None, owner=None)
        .returning(Job.id)
        .execution_options(synchronize_session=False)
    )
    changed = session.execute(statement).scalar_one_or_none() is not None
    if changed:
        session.expire_all()
    return changed


def retry(session: Session, now: datetime, job_id: int) -> Job:
    """Queue a failed job again with fresh attempts, or one that was cancelled by itself; raises
    ConflictError for any other. Jobs that were cancelled with their round stay so.

    Attempts keep counting up, so that an old claim can never become valid again.
    """
    job = session.get(Job, job_id, with_for_update=True)
    if job is None:
        raise NotFoundError("job", job_id)
    called_off = job.state == JobState.CANCELLED and job.round_id is None
    if job.state != JobState.FAILED and not called_off:
        raise ConflictError(
            f"job {job_id} is {job.state!r}; only jobs in state 'failed', and collections and"
            " replays in state 'cancelled', can be retried"
        )
    job.state = JobState.QUEUED
    job.max_attempts = job.attempt + DEFAULT_MAX_ATTEMPTS
    job.error = None
    job.finished_at = None
    job.progress = 0.0
    job.stage = ""
    job.sent_at = now
    session.flush()
    send_after_commit(session, job.id, JobKind(job.kind))
    return job
