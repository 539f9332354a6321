"""Which pairs an annotator can get: the queries behind the hand-out of work."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import ColumnElement, Select, func, select, union_all
from sqlalchemy.orm import Session

from server.states import PairState
from server.store.labels import is_effective
from server.store.tables import Label, Lease, Pair


def live_leases(
    session: Session, now: datetime, campaign_id: int, annotator_id: int
) -> Sequence[Lease]:
    """What the annotator holds in this campaign now, oldest first."""
    query = (
        select(Lease)
        .join(Pair, Pair.id == Lease.pair_id)
        .where(Pair.campaign_id == campaign_id, Lease.annotator_id == annotator_id, _is_live(now))
    )
    return session.scalars(query.order_by(Lease.id)).all()


def _is_live(now: datetime) -> ColumnElement[bool]:
    return Lease.closed_at.is_(None) & (Lease.expires_at > now)


def open_pairs(
    now: datetime, campaign_id: int, annotator_id: int, *, labels_per_pair: int
) -> Select[Pair]:
    """Ready pairs with room for one more label, which this annotator has neither done nor got.

    Those with most room come first. Sets instead of a look-up per pair: with thousands of pairs
    that is many times faster on both engines.
    """
    labels = select(Label.pair_id).where(Label.campaign_id == campaign_id, is_effective())
    leases = select(Lease.pair_id).where(_is_live(now))
    others = union_all(
        labels.where(Label.annotator_id != annotator_id),
        leases.where(Lease.annotator_id != annotator_id),
    ).subquery()
    taken = (
        select(others.c.pair_id, func.count().label("count")).group_by(others.c.pair_id).subquery()
    )
    count = func.coalesce(taken.c["count"], 0)
    return (
        select(Pair)
        .outerjoin(taken, taken.c.pair_id == Pair.id)
        .where(
            Pair.campaign_id == campaign_id,
            Pair.state == PairState.READY,
            Pair.id.not_in(labels.where(Label.annotator_id == annotator_id)),
            Pair.id.not_in(leases.where(Lease.annotator_id == annotator_id)),
            count < labels_per_pair,
        )
        .order_by(count, Pair.id)
    )


def count_taken(session: Session, now: datetime, pair_id: int, annotator_id: int) -> int:
    """Labels in force on the pair by others plus leases that others hold, as of this statement."""
    labels = select(Label.id).where(
        Label.pair_id == pair_id, Label.annotator_id != annotator_id, is_effective()
    )
    leases = select(Lease.id).where(
        Lease.pair_id == pair_id, Lease.annotator_id != annotator_id, _is_live(now)
    )
    both = union_all(labels, leases).subquery()
    return session.execute(select(func.count()).select_from(both)).scalar_one()


def count_by_state(session: Session, campaign_id: int) -> dict[PairState, int]:
    """Number of pairs in each state."""
    query = select(Pair.state, func.count()).where(Pair.campaign_id == campaign_id)
    counts = dict(session.execute(query.group_by(Pair.state)).all())
    return {state: counts.get(state.value, 0) for state in PairState}
