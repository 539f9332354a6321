"""Append-only events that browsers follow, and the audit trail."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from server.store.tables import AuditEntry, Event

# Event.kind → name of the server-sent event
STREAM_NAMES = {
    "job": "progress",
    "round": "state",
    "curve": "curve",
    "label": "label",
    "release": "release",
    "publication": "publication",
}


def add_event(
    session: Session,
    now: datetime,
    *,
    campaign_id: int,
    kind: str,
    data: dict[str, Any],
    round_id: int | None = None,
    job_id: int | None = None,
) -> Event:
    """Append one event; `kind` is a key of STREAM_NAMES, `data` plain JSON for the page."""
    if kind not in STREAM_NAMES:
        raise ValueError(f"unknown event kind {kind!r}; legal kinds are {sorted(STREAM_NAMES)}")
    event = Event(
        campaign_id=campaign_id, round_id=round_id, job_id=job_id, kind=kind, data=data, at=now
    )
    session.add(event)
    return event


def newest_event_id(session: Session) -> int:
    """Id of the newest event of all, or 0."""
    return session.scalar(select(func.max(Event.id))) or 0


def events_after(
    session: Session,
    last_id: int,
    *,
    campaign_id: int | None = None,
    round_id: int | None = None,
    limit: int = 200,
) -> Sequence[Event]:
    """Events with larger ids, oldest first, of one campaign or one round."""
    query = select(Event).where(Event.id > last_id)
    if campaign_id is not None:
        query = query.where(Event.campaign_id == campaign_id)
    if round_id is not None:
        query = query.where(Event.round_id == round_id)
    return session.scalars(query.order_by(Event.id).limit(limit)).all()


def audit(
    session: Session,
    now: datetime,
    *,
    actor_id: int | None,
    action: str,
    subject: str,
    details: dict[str, Any] | None = None,
) -> None:
    """Append who did what; `actor_id` None means the system itself."""
    session.add(
        AuditEntry(actor_id=actor_id, action=action, subject=subject, details=details or {}, at=now)
    )
