"""Pages of long lists by id: stable while rows are added."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from sqlalchemy import Select
from sqlalchemy.orm import InstrumentedAttribute, Session

RowT = TypeVar("RowT")


def page(
    session: Session,
    query: Select[RowT],
    column: InstrumentedAttribute[int],
    *,
    limit: int,
    cursor: int | None,
    newest_first: bool = False,
) -> tuple[Sequence[Any], int | None]:
    """Rows after `cursor` (an id), at most `limit`, and the cursor of the next page or None."""
    if newest_first:
        query = query.order_by(column.desc())
        query = query if cursor is None else query.where(column < cursor)
    else:
        query = query.order_by(column).where(column > (cursor or 0))
    rows = session.scalars(query.limit(limit + 1)).all()
    if len(rows) <= limit:
        return rows, None
    shown = rows[:limit]
    return shown, getattr(shown[-1], column.key)
