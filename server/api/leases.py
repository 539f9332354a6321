"""Giving leased pairs back, and reading why that was done."""

from __future__ import annotations

from fastapi import APIRouter

from server import leases
from server.api.access import Anyone, ReadSession, Staff, UseServices, WriteSession
from server.api.params import Cursor, Limit, PathId
from server.campaigns import get_campaign
from server.schemas.common import Page
from server.schemas.leases import LeaseOut, ReleaseIn, ReleaseOut
from server.store.leases import releases
from server.store.paging import page
from server.store.tables import Event

router = APIRouter(tags=["labels"])


@router.post("/leases/{lease_id}/release")
def release_lease(
    lease_id: PathId, body: ReleaseIn, me: Anyone, session: WriteSession, services: UseServices
) -> LeaseOut:
    """Give an own lease back without a label; the pair goes to others."""
    lease = leases.release_lease(session, services.clock(), me, lease_id, body.reason)
    return LeaseOut.model_validate(lease)


@router.get("/campaigns/{campaign_id}/releases")
def list_releases(
    campaign_id: PathId,
    _me: Staff,
    session: ReadSession,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[ReleaseOut]:
    """Pairs that were given back, newest first: which replays do not play?"""
    get_campaign(session, campaign_id)
    rows, next_cursor = page(
        session, releases(campaign_id), Event.id, limit=limit, cursor=cursor, newest_first=True
    )
    items = [ReleaseOut(id=row.id, at=row.at, **row.data) for row in rows]
    return Page[ReleaseOut](items=items, next_cursor=next_cursor)
