"""Giving a leased pair back: somebody else gets it, and an admin can see why."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy.orm import Session

from server.errors import ConflictError, NotAllowedError, NotFoundError
from server.sign_in import Me
from server.states import ReleaseReason
from server.store import leases
from server.store.events import add_event
from server.store.session import LOCK
from server.store.tables import Lease, Pair


def release_lease(
    session: Session, now: datetime, me: Me, lease_id: int, reason: ReleaseReason
) -> Lease:
    """End an own lease without a label, and note why; again, it changes nothing.

    A lease that has run out can be given back, too: the reason is worth keeping. Raises
    NotFoundError, NotAllowedError for somebody else's lease, ConflictError for one under which
    the pair was labelled.
    """
    lease = session.get(Lease, lease_id)
    if lease is None:
        raise NotFoundError("lease", lease_id)
    if lease.annotator_id != me.id:
        raise NotAllowedError(f"lease {lease_id} is held by another annotator")
    # Labels lock the pair, too: one of the two sees what the other has done.
    pair = session.get_one(Pair, lease.pair_id, with_for_update=LOCK)
    session.refresh(lease)
    if lease.closed_at is None:
        leases.end(lease, now)
        data = {
            "lease_id": lease.id,
            "pair_id": pair.id,
            "annotator_id": me.id,
            "reason": reason.value,
        }
        add_event(session, now, campaign_id=pair.campaign_id, kind=leases.RELEASE, data=data)
    elif not leases.is_given_back(lease):
        raise ConflictError(f"lease {lease_id} is closed: pair {pair.id} was labelled under it")
    return lease
