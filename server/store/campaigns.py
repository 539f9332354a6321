"""The campaign's row, for whoever changes it or what hangs on it."""

from __future__ import annotations

from sqlalchemy.orm import Session

from server.errors import NotFoundError
from server.store.session import LOCK
from server.store.tables import Campaign


def lock_campaign(session: Session, campaign_id: int) -> Campaign:
    """The row as it is now, which nobody else changes before the commit; raises NotFoundError."""
    campaign = session.get(Campaign, campaign_id, with_for_update=LOCK, populate_existing=True)
    if campaign is None:
        raise NotFoundError("campaign", campaign_id)
    return campaign
