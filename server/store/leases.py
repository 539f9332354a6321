"""Leases that were given back, and why: the lease ends at once, an event keeps the reason."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from server.states import ReleaseReason
from server.store.labels import is_effective
from server.store.tables import Event, Label, Lease

RELEASE = "release"  # kind of the event


def end(lease: Lease, now: datetime) -> None:
    """Close a lease that is given back. It ends where it is closed: that tells it from others."""
    lease.closed_at = lease.expires_at = now


def is_given_back(lease: Lease) -> bool:
    """Whether the lease was given back, and not closed by a label."""
    return lease.closed_at is not None and lease.closed_at == lease.expires_at


def pairs_given_back(annotator_id: int, *, since: datetime) -> Select[int]:
    """Ids of the pairs that the annotator has given back after `since`."""
    return select(Lease.pair_id).where(
        Lease.annotator_id == annotator_id,
        Lease.closed_at == Lease.expires_at,
        Lease.closed_at > since,
    )


def releases(campaign_id: int) -> Select[Event]:
    """The events that tell what was given back in a campaign."""
    return select(Event).where(Event.campaign_id == campaign_id, Event.kind == RELEASE)


def count_reported(session: Session, campaign_id: int) -> int:
    """Pairs reported for a replay that does not play, and that nobody could label since."""
    pair_id = Event.data["pair_id"].as_integer()
    labelled = select(Label.pair_id).where(Label.campaign_id == campaign_id, is_effective())
    reported = releases(campaign_id).where(
        Event.data["reason"].as_string() == ReleaseReason.REPLAY_FAILED, pair_id.not_in(labelled)
    )
    return session.scalars(reported.with_only_columns(func.count(pair_id.distinct()))).one()
