"""Queued work that somebody calls off: collections and replays. A round is cancelled as a whole."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy.orm import Session

from server.errors import ConflictError, NotFoundError
from server.states import JobState, PairState
from server.store import jobs
from server.store.events import add_event, audit
from server.store.tables import Job, Pair


def cancel_job(session: Session, now: datetime, job_id: int, *, by: int | None) -> Job:
    """Cancel a queued or running job; its worker stops at its next step and stores nothing more.

    What it has stored stays: episodes are rolled out. A pair that waits for its replay is failed,
    until the job is retried. A second time is no change. Raises NotFoundError, and ConflictError
    for a job of a round or one that has ended otherwise.
    """
    # Locked before its pair, as a job's step does: the other order could deadlock with it.
    job = session.get(Job, job_id, with_for_update=True)
    if job is None:
        raise NotFoundError("job", job_id)
    if job.round_id is not None:
        raise ConflictError(
            f"job {job_id} belongs to round {job.round_id}; cancel the round, which ends its jobs"
        )
    if job.state == JobState.CANCELLED:
        return job
    if not jobs.cancel(session, now, job_id):
        raise ConflictError(
            f"job {job_id} is {job.state!r}; only jobs in state 'queued' or 'running' can be"
            " cancelled"
        )
    if job.pair_id is not None:
        pair = session.get_one(Pair, job.pair_id)
        if pair.state == PairState.WAITING:
            pair.state = PairState.FAILED
    add_event(
        session,
        now,
        campaign_id=job.campaign_id,
        job_id=job_id,
        kind="job",
        data={"job_id": job_id, "kind": job.kind, "state": job.state, "error": None},
    )
    audit(session, now, actor_id=by, action="job.cancel", subject=f"job/{job_id}")
    session.flush()
    return job
