"""The functions behind the names in `server.queue`, as thin as can be."""

from __future__ import annotations

import functools
from datetime import timedelta

from server import rounds
from server.queue import RUN_JOB, TICK_RESEND, TICK_ROUNDS, make_sender
from server.settings import Settings
from server.store import jobs
from server.store.beats import BEAT, record_beat
from worker import running
from worker.app import app
from worker.workbench import Workbench


@functools.cache
def _bench() -> Workbench:
    """The workbench of this process, made on first use: after the fork."""
    settings = Settings()
    return Workbench.of(settings, make_sender(settings.broker_url))


@app.task(name=RUN_JOB)  # type: ignore[untyped-decorator]
def run_job(job_id: int) -> None:
    """Run a job if it is still to be run."""
    running.run_job(_bench(), job_id)


@app.task(name=TICK_RESEND)  # type: ignore[untyped-decorator]
def tick_resend() -> None:
    """Send stuck jobs again, give up hopeless ones, show that beat and tick worker live."""
    resend(_bench())


@app.task(name=TICK_ROUNDS)  # type: ignore[untyped-decorator]
def tick_rounds() -> None:
    """Start the rounds that are due."""
    start_due_rounds(_bench())


def resend(bench: Workbench) -> None:
    """Idempotent: a job is sent again only when its last message is `resend_seconds` old."""
    patience = timedelta(seconds=bench.settings.resend_seconds)
    with bench.database.write() as session:
        now = bench.clock()
        running.give_up_exhausted(session, now)
        jobs.stuck_jobs(session, now, patience=patience)
        record_beat(session, now, BEAT)


def start_due_rounds(bench: Workbench) -> list[int]:
    """Ids of the started rounds; idempotent, because a started round is no longer due."""
    with bench.database.read() as session:
        campaign_ids = rounds.active_campaign_ids(session)
    started = []
    for campaign_id in campaign_ids:
        with bench.database.write() as session:
            new = rounds.launch_due(session, bench.clock(), campaign_id)
            if new is not None:
                started.append(new.id)
    return started
