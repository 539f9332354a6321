"""Which pairs an annotator can get: the queries behind the hand-out of work."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import ColumnElement, ScalarSelect, Select, func, select
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


def taken_by_others(now: datetime, annotator_id: int) -> ScalarSelect[int]:
    """Correlated count: labels in force on Pair by others plus leases that others hold."""
    labels = (
        select(func.count())
        .select_from(Label)
        .where(Label.pair_id == Pair.id, Label.annotator_id != annotator_id, is_effective())
        .correlate(Pair)
        .scalar_subquery()
    )
    leases = (
        select(func.count())
        .select_from(Lease)
        .where(Lease.pair_id == Pair.id, Lease.annotator_id != annotator_id, _is_live(now))
        .correlate(Pair)
        .scalar_subquery()
    )
    return labels + leases  # type: ignore[return-value]  # a sum of scalars is a scalar


def open_pairs(
    now: datetime, campaign_id: int, annotator_id: int, *, labels_per_pair: int
) -> Select[Pair]:
    """Ready pairs with room for one more label, which this annotator has neither done nor got."""
    done = (
        select(Label.id)
        .where(Label.pair_id == Pair.id, Label.annotator_id == annotator_id, is_effective())
        .correlate(Pair)
    )
    held = (
        select(Lease.id)
        .where(Lease.pair_id == Pair.id, Lease.annotator_id == annotator_id, _is_live(now))
        .correlate(Pair)
    )
    return select(Pair).where(
        Pair.campaign_id == campaign_id,
        Pair.state == PairState.READY,
        ~done.exists(),
        ~held.exists(),
        taken_by_others(now, annotator_id) < labels_per_pair,
    )


def count_taken(session: Session, now: datetime, pair_id: int, annotator_id: int) -> int:
    """`taken_by_others` of one pair, in a statement of its own (and so with fresh eyes)."""
    query = select(taken_by_others(now, annotator_id)).select_from(Pair).where(Pair.id == pair_id)
    return session.execute(query).scalar_one()


def count_by_state(session: Session, campaign_id: int) -> dict[PairState, int]:
    """Number of pairs in each state."""
    query = select(Pair.state, func.count()).where(Pair.campaign_id == campaign_id)
    counts = dict(session.execute(query.group_by(Pair.state)).all())
    return {state: counts.get(state.value, 0) for state in PairState}
