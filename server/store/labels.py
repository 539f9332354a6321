"""Reading labels. Rows are only ever added, so "what holds now" is a question of who supersedes."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from typing import Any

from sqlalchemy import ColumnElement, Row, func, select
from sqlalchemy.orm import InstrumentedAttribute, Session, aliased

from server.errors import NotFoundError
from server.states import DECISIVE, TELLING
from server.store.tables import Label, LabelSnapshot

_Newer = aliased(Label)


def is_newest() -> ColumnElement[bool]:
    """Condition on Label: no later row supersedes it."""
    return ~select(_Newer.id).where(_Newer.supersedes_id == Label.id).exists()


def is_effective() -> ColumnElement[bool]:
    """Condition on Label: the annotator's last word on the pair, and not taken back."""
    return is_newest() & Label.retracted.is_(False)


def effective_label_ids(session: Session, campaign_id: int) -> list[int]:
    """Ids of the labels that hold now, ascending."""
    query = select(Label.id).where(Label.campaign_id == campaign_id, is_effective())
    return list(session.scalars(query.order_by(Label.id)))


def effective_among(session: Session, label_ids: Sequence[int]) -> set[int]:
    """Those of the labels that hold now."""
    return set(session.scalars(select(Label.id).where(Label.id.in_(label_ids), is_effective())))


def count_effective(session: Session, campaign_id: int) -> int:
    """Number of labels that hold now."""
    query = select(func.count()).where(Label.campaign_id == campaign_id, is_effective())
    return session.execute(query).scalar_one()


def telling_label_ids(session: Session, campaign_id: int) -> list[int]:
    """Ids of the labels that hold now and that a round learns from, ascending."""
    query = select(Label.id).where(
        Label.campaign_id == campaign_id, Label.choice.in_(TELLING), is_effective()
    )
    return list(session.scalars(query.order_by(Label.id)))


def has_decisive_label(session: Session, campaign_id: int) -> bool:
    """Whether a label that holds now says which episode is better."""
    query = select(Label.id).where(
        Label.campaign_id == campaign_id, Label.choice.in_(DECISIVE), is_effective()
    )
    return session.scalar(select(query.exists())) is True


def newest_label(session: Session, pair_id: int, annotator_id: int) -> Label | None:
    """The annotator's last row on the pair (perhaps a retraction), or None."""
    query = select(Label).where(
        Label.pair_id == pair_id, Label.annotator_id == annotator_id, is_newest()
    )
    return session.scalars(query.order_by(Label.id.desc()).limit(1)).one_or_none()


def get_snapshot(session: Session, digest: str) -> LabelSnapshot:
    """The frozen snapshot; raises NotFoundError for an unknown digest."""
    snapshot = session.get(LabelSnapshot, digest)
    if snapshot is None:
        raise NotFoundError("label snapshot", digest)
    return snapshot


def snapshot_labels(
    session: Session, digest: str, *columns: InstrumentedAttribute[Any]
) -> list[Row[*tuple[Any, ...]]]:
    """Id and `columns` of the labels of a frozen snapshot, in its order.

    Whole rows are wide: they hold all that was replayed. Raises NotFoundError for an unknown one.
    """
    snapshot = get_snapshot(session, digest)
    if not snapshot.label_ids:
        return []
    first, last = snapshot.label_ids[0], snapshot.label_ids[-1]  # ascending
    query = select(Label.id, *columns).where(
        Label.campaign_id == snapshot.campaign_id, Label.id.between(first, last)
    )
    by_id = {row.id: row for row in session.execute(query)}
    return [by_id[label_id] for label_id in snapshot.label_ids]


def snapshot_is_decisive(session: Session, digest: str) -> bool:
    """Whether a label of a frozen snapshot says which episode is better."""
    return any(row.choice in DECISIVE for row in snapshot_labels(session, digest, Label.choice))


def snapshot_annotators(session: Session, digest: str) -> Counter[int]:
    """Number of labels of a frozen snapshot by annotator id."""
    return Counter(row.annotator_id for row in snapshot_labels(session, digest, Label.annotator_id))


def snapshot_page(
    session: Session, digest: str, *, limit: int, cursor: int | None
) -> tuple[Sequence[Row[int, int, int]], int | None]:
    """Id, pair and annotator of at most `limit` labels after `cursor`, and the next cursor."""
    ids = get_snapshot(session, digest).label_ids
    start = bisect_right(ids, cursor or 0)
    shown = ids[start : start + limit]
    query = select(Label.id, Label.pair_id, Label.annotator_id).where(Label.id.in_(shown))
    rows = session.execute(query.order_by(Label.id)).all()
    return rows, shown[-1] if start + limit < len(ids) else None
