"""Run one job: claim it, keep the lease, do it, and say what became of it."""

from __future__ import annotations

import importlib
import logging
import traceback
from datetime import datetime, timedelta

from sqlalchemy.orm import Session

from rodif_core.errors import RodifError
from server import rounds
from server.errors import LeaseLostError
from server.states import JobKind, JobState, PairState, RoundState
from server.store import jobs
from server.store.events import add_event
from server.store.tables import Job, Pair, Round
from worker.attempt import Attempt, JobFacts
from worker.workbench import Workbench

logger = logging.getLogger(__name__)


def run_job(bench: Workbench, job_id: int) -> JobState | None:
    """Claim and run; None when there is nothing to do (ended, or another worker has it).

    Errors of the RodifError tree end the job with their message. Any other error is logged with
    its stack and tried again until the job's attempts are used up.
    """
    attempt = _claim(bench, job_id)
    if attempt is None:
        return None
    kind = attempt.facts.kind
    try:
        with attempt:
            # Imported here and by name: job modules load torch, mujoco and viser.
            importlib.import_module(f"worker.jobs.{kind.value}").run(attempt)
        return JobState.DONE
    except LeaseLostError as error:
        logger.warning("job %d stops: %s", job_id, error)
        return None
    except RodifError as error:
        logger.warning("job %d (%s) failed: %s", job_id, kind, error)
        return _fail(attempt, str(error), retry=False)
    except Exception as error:
        logger.exception("job %d (%s), attempt %d", job_id, kind, attempt.claim.attempt)
        return _fail(attempt, "".join(traceback.format_exception_only(error)).strip(), retry=True)


def _claim(bench: Workbench, job_id: int) -> Attempt | None:
    lease = timedelta(seconds=bench.settings.job_lease_seconds)
    with bench.database.write() as session:
        claim = jobs.claim(session, bench.clock(), job_id, owner=bench.owner, lease=lease)
        if claim is None:
            return None
        return Attempt(bench, claim, JobFacts.of(session.get_one(Job, job_id)))


def _fail(attempt: Attempt, reason: str, *, retry: bool) -> JobState | None:
    bench = attempt.bench
    try:
        with bench.database.write() as session:
            now = bench.clock()
            state = jobs.fail(session, now, attempt.claim, reason, retry=retry)
            if state == JobState.FAILED:
                show_failure(session, now, session.get_one(Job, attempt.facts.id))
            return state
    except LeaseLostError as error:
        logger.warning("job %d stops: %s", attempt.facts.id, error)
        return None


def give_up_exhausted(session: Session, now: datetime) -> int:
    """Fail the jobs that killed their worker in every allowed attempt; returns how many."""
    given_up = jobs.give_up_exhausted(session, now)
    for job in given_up:
        show_failure(session, now, job)
    return len(given_up)


def show_failure(session: Session, now: datetime, job: Job) -> None:
    """Carry a failed job over to its round or its pair, and tell the browsers."""
    if job.round_id is not None:
        state = session.get_one(Round, job.round_id).state
        if RoundState(state) not in rounds.FINAL_STATES:
            reason = f"{job.kind}: {job.error}"
            rounds.move(session, now, job.round_id, RoundState.FAILED, error=reason)
    if job.kind == JobKind.REPLAY and job.pair_id is not None:
        session.get_one(Pair, job.pair_id).state = PairState.FAILED
    add_event(
        session,
        now,
        campaign_id=job.campaign_id,
        round_id=job.round_id,
        job_id=job.id,
        kind="job",
        data={"job_id": job.id, "kind": job.kind, "state": job.state, "error": job.error},
    )
