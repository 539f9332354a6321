"""One claimed attempt at a job: fenced transactions, a heart-beat, progress, cancellation."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from server.errors import LeaseLostError
from server.states import JobKind
from server.store import jobs
from server.store.events import add_event
from server.store.tables import Event, Job
from worker.workbench import Workbench

logger = logging.getLogger(__name__)

PROGRESS_SECONDS = 0.5  # at most two progress writes a second
BEATS_PER_LEASE = 3


@dataclass(frozen=True)
class JobFacts:
    """The job's row as it was claimed; nothing in it changes during the attempt."""

    id: int
    kind: JobKind
    campaign_id: int
    round_id: int | None
    pair_id: int | None
    payload: dict[str, Any]
    started_at: datetime  # of the first attempt

    @classmethod
    def of(cls, job: Job) -> JobFacts:
        """Copy a claimed row out of its session."""
        assert job.started_at is not None
        return cls(
            id=job.id,
            kind=JobKind(job.kind),
            campaign_id=job.campaign_id,
            round_id=job.round_id,
            pair_id=job.pair_id,
            payload=dict(job.payload),
            started_at=job.started_at,
        )


class Attempt:
    """The right to work on a job, for as long as the lease is renewed.

    As a context manager it renews the lease from a thread. When the job was cancelled or has
    passed to another worker, the next `step` or `progress` raises LeaseLostError.
    """

    def __init__(self, bench: Workbench, claim: jobs.Claim, facts: JobFacts) -> None:
        self.bench, self.claim, self.facts = bench, claim, facts
        self._lease = timedelta(seconds=bench.settings.job_lease_seconds)
        self._ended = threading.Event()
        self._lost: LeaseLostError | None = None
        self._thread = threading.Thread(target=self._keep, name="heart-beat", daemon=True)
        self._shown_at = float("-inf")  # monotonic clock of the last progress write
        self._shown_stage = ""
        self._curve: list[dict[str, Any]] = []  # points not stored yet
        self._shown_points: dict[str, tuple[int, float]] | None = None

    def __enter__(self) -> Attempt:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    @contextlib.contextmanager
    def step(self) -> Iterator[Session]:
        """One transaction of the job, which commits only while the claim holds.

        Renewing first also locks the job's row, so nobody can take the job over in between.
        """
        self._check()
        with self.bench.database.write() as session:
            jobs.renew(session, self.bench.clock(), self.claim, lease=self._lease)
            yield session

    def finish(self, session: Session, result: dict[str, Any]) -> None:
        """End the job in the transaction of its last effects; `result` is stored with it."""
        self._write_curve(session)
        jobs.finish(session, self.bench.clock(), self.claim, result)
        self._tell(session, 1.0, "done")

    def seconds(self) -> float:
        """Wall time since the first attempt began."""
        return round((self.bench.clock() - self.facts.started_at).total_seconds(), 2)

    def progress(
        self, stage: str, fraction: float, metrics: dict[str, float] | None = None
    ) -> None:
        """Show how far the stage is (0 … 1); `metrics` become one point of the round's curves.

        Writes at most every half second, and at once when the stage changes.
        """
        self._check()
        if metrics:
            self._add_point(stage, fraction, metrics)
        now = time.monotonic()
        if stage == self._shown_stage and now - self._shown_at < PROGRESS_SECONDS:
            return
        self._shown_at, self._shown_stage = now, stage
        with self.bench.database.write() as session:
            jobs.renew(
                session,
                self.bench.clock(),
                self.claim,
                lease=self._lease,
                progress=fraction,
                stage=stage,
            )
            self._write_curve(session)
            self._tell(session, fraction, stage)
        self._curve = []

    def _add_point(self, stage: str, fraction: float, metrics: dict[str, float]) -> None:
        """Next point of a stage's curve, unless an earlier attempt has shown it already."""
        if self._shown_points is None:
            self._shown_points = self._points_of_earlier_attempts()
        step, reached = self._shown_points.get(stage, (0, -1.0))
        if fraction > reached:
            self._shown_points[stage] = (step + 1, fraction)
            point = {"stage": stage, "step": step + 1, "fraction": fraction}
            self._curve.append(point | metrics)

    def _points_of_earlier_attempts(self) -> dict[str, tuple[int, float]]:
        """Step and fraction of the last stored point of each stage."""
        query = select(Event.data).where(Event.job_id == self.facts.id, Event.kind == "curve")
        with self.bench.database.read() as session:
            points = session.scalars(query.order_by(Event.id)).all()
        return {point["stage"]: (point["step"], point["fraction"]) for point in points}

    def event(self, session: Session, kind: str, data: dict[str, Any]) -> None:
        """Append an event of this job to the stream that browsers follow."""
        add_event(
            session,
            self.bench.clock(),
            campaign_id=self.facts.campaign_id,
            round_id=self.facts.round_id,
            job_id=self.facts.id,
            kind=kind,
            data=data,
        )

    def _tell(self, session: Session, fraction: float, stage: str) -> None:
        data = {"job_id": self.facts.id, "kind": self.facts.kind.value}
        self.event(session, "job", data | {"progress": fraction, "stage": stage})

    def _write_curve(self, session: Session) -> None:
        for point in self._curve:
            self.event(session, "curve", point)

    def _check(self) -> None:
        if self._lost is not None:
            raise LeaseLostError(str(self._lost))

    def _keep(self) -> None:
        """The heart-beat: renew until the attempt ends or the claim is lost."""
        while not self._ended.wait(self._lease.total_seconds() / BEATS_PER_LEASE):
            try:
                with self.bench.database.write() as session:
                    jobs.renew(session, self.bench.clock(), self.claim, lease=self._lease)
            except LeaseLostError as error:
                self._lost = error
                return
            except SQLAlchemyError:
                # The next beat may work; when none does, the lease runs out and fencing holds.
                logger.warning("job %d: lease not renewed", self.facts.id, exc_info=True)
