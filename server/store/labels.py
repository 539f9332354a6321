"""Reading labels. Rows are only ever added, so "what holds now" is a question of who supersedes."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session, aliased

from server.errors import NotFoundError
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


def newest_label(session: Session, pair_id: int, annotator_id: int) -> Label | None:
    """The annotator's last row on the pair (perhaps a retraction), or None."""
    query = select(Label).where(
        Label.pair_id == pair_id, Label.annotator_id == annotator_id, is_newest()
    )
    return session.scalars(query.order_by(Label.id.desc()).limit(1)).one_or_none()


def snapshot_labels(session: Session, digest: str) -> Sequence[Label]:
    """Labels of a frozen snapshot in its order; raises NotFoundError for an unknown digest."""
    snapshot = session.get(LabelSnapshot, digest)
    if snapshot is None:
        raise NotFoundError("label snapshot", digest)
    by_id: dict[int, Label] = {}
    for start in range(0, len(snapshot.label_ids), 500):  # below the engines' parameter limits
        ids = snapshot.label_ids[start : start + 500]
        by_id |= {row.id: row for row in session.scalars(select(Label).where(Label.id.in_(ids)))}
    return [by_id[label_id] for label_id in snapshot.label_ids]
