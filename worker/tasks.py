"""The functions behind the names in `server.queue`, as thin as can be."""

from __future__ import annotations

import functools
from collections.abc import Collection
from datetime import timedelta
from typing import Any

from kombu.exceptions import ChannelError

from server import rounds
from server.queue import (
    QUEUE_OF_KIND,
    QUEUES,
    RUN_JOB,
    TICK_RESEND,
    TICK_ROUNDS,
    make_sender,
)
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
    resend(_bench(), busy_queues())


@app.task(name=TICK_ROUNDS)  # type: ignore[untyped-decorator]
def tick_rounds() -> None:
    """Start the rounds that are due."""
    start_due_rounds(_bench())


def busy_queues() -> set[str]:
    """Queues in which messages wait for a worker."""
    with app.connection_for_read() as connection:
        channel = connection.default_channel
        return {name for name in QUEUES if _waiting_messages(channel, name) > 0}


def _waiting_messages(channel: Any, name: str) -> int:
    try:
        return int(channel.queue_declare(queue=name, passive=True).message_count)
    except ChannelError:
        return 0  # no worker has declared the queue yet, so nothing was ever sent to it


def resend(bench: Workbench, busy: Collection[str] = ()) -> None:
    """Idempotent: a job is sent again only when its last message is `resend_seconds` old.

    `busy` names the queues that still hold messages: their jobs wait for a worker, not for us.
    """
    patience = timedelta(seconds=bench.settings.resend_seconds)
    busy_kinds = [kind for kind, queue in QUEUE_OF_KIND.items() if queue in busy]
    with bench.database.write() as session:
        now = bench.clock()
        running.give_up_exhausted(session, now)
        jobs.stuck_jobs(session, now, patience=patience, busy_kinds=busy_kinds)
        record_beat(session, now, BEAT)


def start_due_rounds(bench: Workbench) -> list[int]:
    """Ids of the started rounds; idempotent, because a started round is no longer due."""
    # Whether a round is due takes counting: only for those that are does a writer's turn come.
    with bench.database.read() as session:
        due = rounds.due_campaign_ids(session, bench.clock())
    started = []
    for campaign_id in due:
        with bench.database.write() as session:
            new = rounds.launch_due(session, bench.clock(), campaign_id)
            if new is not None:
                started.append(new.id)
    return started
