"""The database: SQLite (write-ahead log) or PostgreSQL behind one small class.

The only place that commits. `write()` is one transaction; the jobs that were put in the queue in
it (`server.store.jobs.enqueue`) are sent after the commit, never before.
"""

from __future__ import annotations

import logging
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine import make_url
from sqlalchemy.orm import Session, sessionmaker

from server.queue import SendJob
from server.states import JobKind

logger = logging.getLogger(__name__)

# Row lock for `with_for_update`: keeps other writers of the row away, but not inserts of rows that
# refer to it (FOR NO KEY UPDATE on PostgreSQL; SQLite has one writer at a time anyway).
LOCK = {"key_share": True}
CONNECTIONS = 40  # as many as the API has threads for requests
JOBS_TO_SEND = "jobs_to_send"  # key of Session.info: list[tuple[int, JobKind]]
_BUSY_TIMEOUT_MS = 15_000  # how long a SQLite writer waits for the one before it


def make_engine(url: str, *, foreign_keys: bool = True, connections: int = CONNECTIONS) -> Engine:
    """Engine for `sqlite:///…` or `postgresql+psycopg://…`, with at most so many connections.

    `foreign_keys=False` is for migrations on SQLite, which rebuild tables.
    """
    parsed = make_url(url)
    kept = (connections + 1) // 2  # the others are closed when they are no longer used
    pool = {"pool_size": kept, "max_overflow": connections - kept}
    if parsed.get_backend_name() != "sqlite":
        return create_engine(parsed, **pool, pool_pre_ping=True)
    if parsed.database:
        Path(parsed.database).parent.mkdir(parents=True, exist_ok=True)
    engine = create_engine(parsed, **pool)

    @event.listens_for(engine, "connect")
    def _configure(connection: Any, _record: Any) -> None:
        connection.isolation_level = None  # the driver must not begin transactions by itself
        connection.execute(f"PRAGMA busy_timeout={_BUSY_TIMEOUT_MS}")
        _use_write_ahead_log(connection)
        # A label that was acknowledged must outlive a power cut: NORMAL syncs at checkpoints only.
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute(f"PRAGMA foreign_keys={'ON' if foreign_keys else 'OFF'}")

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        # A deferred BEGIN that reads and then writes fails at once with "database is locked" when
        # another writer came between; IMMEDIATE queues up instead.
        read_only = connection.get_execution_options().get("read_only", False)
        connection.exec_driver_sql("BEGIN" if read_only else "BEGIN IMMEDIATE")

    return engine


def _use_write_ahead_log(connection: sqlite3.Connection) -> None:
    """Switch a new file to WAL; two processes may try at once, and SQLite does not wait then."""
    deadline = time.monotonic() + _BUSY_TIMEOUT_MS / 1000
    while connection.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
        try:
            connection.execute("PRAGMA journal_mode=WAL")
        except sqlite3.OperationalError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)


class Database:
    """Sessions of one database. Make one per process, after any fork."""

    def __init__(
        self, url: str, send_job: SendJob | None = None, *, connections: int = CONNECTIONS
    ) -> None:
        self.url = url
        self.engine = make_engine(url, connections=connections)
        self._send_job = send_job
        self._write = sessionmaker(self.engine, expire_on_commit=False)
        reader = self.engine.execution_options(read_only=True)
        if self.engine.dialect.name == "postgresql":
            reader = reader.execution_options(postgresql_readonly=True)
        self._read = sessionmaker(reader, expire_on_commit=False)

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A session for reading; it does not wait for writers and never commits."""
        with self._read() as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """One transaction: commit at the end, roll back on any exception, then send its jobs."""
        with self._write() as session:
            with session.begin():
                yield session
            jobs = session.info.pop(JOBS_TO_SEND, [])
        self._send(jobs)

    def _send(self, jobs: list[tuple[int, JobKind]]) -> None:
        """Tell the queue. A broken broker costs time, not work: the beat's tick sends again."""
        if self._send_job is None:
            return
        for index, (job_id, kind) in enumerate(jobs):
            try:
                self._send_job(job_id, kind)
            except OSError:
                left = [job for job, _ in jobs[index:]]
                logger.exception("broker away; jobs %s wait for the tick", left)
                return

    def dispose(self) -> None:
        """Close all connections."""
        self.engine.dispose()
