"""Signs of life of the long-running processes."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from server.store.tables import ServiceBeat

WORKER = "worker"
BEAT = "beat"


def record_beat(
    session: Session, now: datetime, name: str, details: dict[str, Any] | None = None
) -> None:
    """Note that the process `name` ("worker@host", "beat") is alive.

    A worker tells in `details` which queues it serves.
    """
    insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
    values = {"at": now, "details": details or {}}
    statement = insert(ServiceBeat).values(name=name, **values)
    session.execute(statement.on_conflict_do_update(index_elements=["name"], set_=values))


def last_beat(session: Session, name: str) -> datetime | None:
    """Newest sign of life of the process `name`."""
    row = session.get(ServiceBeat, name)
    return None if row is None else row.at


def last_beats_by_queue(session: Session) -> dict[str, datetime]:
    """Newest sign of life of the workers of each queue; each worker says which queues it serves."""
    rows = session.scalars(
        select(ServiceBeat).where(ServiceBeat.name.startswith(f"{WORKER}@", autoescape=True))
    )
    newest: dict[str, datetime] = {}
    for row in rows:
        for queue in row.details.get("queues", ()):
            newest[queue] = max(row.at, newest.get(queue, row.at))
    return newest
