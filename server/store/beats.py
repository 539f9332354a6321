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
    """Note that the process `name` ("worker", "worker@host", "beat") is alive."""
    insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
    values = {"at": now, "details": details or {}}
    statement = insert(ServiceBeat).values(name=name, **values)
    session.execute(statement.on_conflict_do_update(index_elements=["name"], set_=values))


def last_beat(session: Session, name: str) -> datetime | None:
    """Newest sign of life of `name` or of any `name@…`."""
    rows = session.scalars(
        select(ServiceBeat).where(
            (ServiceBeat.name == name) | ServiceBeat.name.startswith(f"{name}@", autoescape=True)
        )
    )
    return max((row.at for row in rows), default=None)
