"""Which pairs an annotator can get: the queries behind the hand-out of work."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import CTE, ColumnElement, Select, Subquery, case, func, select, union_all
from sqlalchemy.orm import Session, aliased

from server.states import DECISIVE, PairState
from server.store.labels import is_effective
from server.store.tables import Episode, Label, Lease, Pair


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
    now: datetime,
    campaign_id: int,
    annotator_id: int,
    *,
    labels_per_pair: int,
    published_checkpoint_id: int,
    telling_first: bool = False,
) -> Select[Pair, int]:
    """Ready pairs with room for one more label, which this annotator has neither done nor got.

    Beside each stands how many labels in force and live leases it has.

    Those of the published policy come first: what its predecessors did matters less. Among them
    those with most room, then the oldest, or with `telling_first` those of which the labels so far
    say that people will prefer one side. Sets instead of a look-up per pair: with thousands of
    pairs that is many times faster on both engines.
    """
    mine = select(Label.pair_id).where(
        Label.campaign_id == campaign_id, Label.annotator_id == annotator_id, is_effective()
    )
    leases = select(Lease.pair_id).where(_is_live(now))
    labelled = _labels_by_pair(campaign_id)
    held = leases.add_columns(func.count().label("count")).group_by(Lease.pair_id).subquery()
    published = select(Episode.id).where(
        Episode.campaign_id == campaign_id, Episode.checkpoint_id == published_checkpoint_id
    )
    # All that is taken is taken by others, because the annotator's own pairs are left out.
    count = func.coalesce(labelled.c.total, 0) + func.coalesce(held.c["count"], 0)
    query = (
        select(Pair, count.label("taken"))
        .outerjoin(labelled, labelled.c.pair_id == Pair.id)
        .outerjoin(held, held.c.pair_id == Pair.id)
        .where(
            Pair.campaign_id == campaign_id,
            Pair.state == PairState.READY,
            Pair.id.not_in(mine),
            Pair.id.not_in(leases.where(Lease.annotator_id == annotator_id)),
            count < labels_per_pair,
        )
        .order_by(case((Pair.first_episode_id.in_(published), 0), else_=1), count)
    )
    if telling_first:
        kinds = _with_kinds(query)
        told = _told_by_kinds(labelled)
        known = (told.c.one == kinds.one) & (told.c.other == kinds.other)
        # The mean of a rate after `total` labels, if nothing was known of it before: what nobody
        # has seen yet stands in the middle, and so is tried before what tells nothing.
        rate = func.coalesce((told.c.decided + 1.0) / (told.c.total + 2.0), 0.5)
        query = kinds.query.outerjoin(told, known).order_by(rate.desc())
    return query.order_by(Pair.id)


def _labels_by_pair(campaign_id: int) -> CTE:
    """For each pair with labels in force how many it has, and how many of these prefer a side."""
    decisive = case((Label.choice.in_(DECISIVE), 1), else_=0)
    return (
        select(
            Label.pair_id,
            func.count().label("total"),
            func.sum(decisive).label("decided"),
        )
        .where(Label.campaign_id == campaign_id, is_effective())
        .group_by(Label.pair_id)
        .cte("labelled")
    )


@dataclass(frozen=True)
class _Kinds:
    """A query over pairs that knows the kinds of their two episodes, in alphabetical order."""

    query: Select[Any]
    one: ColumnElement[str]
    other: ColumnElement[str]


def _with_kinds(query: Select[Any]) -> _Kinds:
    """An episode's kind is its behaviour group and whether it succeeded."""
    first, second = aliased(Episode), aliased(Episode)
    kinds = [
        func.coalesce(episode.group, "") + case((episode.success, "+"), else_="-")
        for episode in (first, second)
    ]
    ordered = kinds[0] <= kinds[1]
    return _Kinds(
        query.join(first, first.id == Pair.first_episode_id).join(
            second, second.id == Pair.second_episode_id
        ),
        case((ordered, kinds[0]), else_=kinds[1]),
        case((ordered, kinds[1]), else_=kinds[0]),
    )


def _told_by_kinds(labelled: CTE) -> Subquery:
    """How many labels in force compared two kinds of episodes, and how many preferred a side."""
    kinds = _with_kinds(select(labelled).join(Pair, Pair.id == labelled.c.pair_id))
    return (
        kinds.query.with_only_columns(
            kinds.one.label("one"),
            kinds.other.label("other"),
            func.sum(labelled.c.total).label("total"),
            func.sum(labelled.c.decided).label("decided"),
        )
        .group_by(kinds.one, kinds.other)
        .subquery()
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


def has_labelled(session: Session, pair_id: int, annotator_id: int) -> bool:
    """Whether a label of the annotator on the pair is in force."""
    mine = select(Label.id).where(
        Label.pair_id == pair_id, Label.annotator_id == annotator_id, is_effective()
    )
    return session.scalars(mine.limit(1)).first() is not None


def count_by_state(session: Session, campaign_id: int) -> dict[PairState, int]:
    """Number of pairs in each state."""
    query = select(Pair.state, func.count()).where(Pair.campaign_id == campaign_id)
    counts = dict(session.execute(query.group_by(Pair.state)).all())
    return {state: counts.get(state.value, 0) for state in PairState}
