"""Tasks, campaigns, their figures, collecting, publishing, the audit trail."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Response, status
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from sqlalchemy import select

from server import campaigns, checkpoints, publications
from server.api.access import Admin, Anyone, ReadSession, Staff, UseServices, WriteSession
from server.api.params import Cursor, Limit, PathId
from server.errors import NotAllowedError
from server.schemas.campaigns import (
    CampaignCreate,
    CampaignOut,
    CampaignPatch,
    CampaignSettings,
    CampaignToLabel,
    CollectRequest,
    PublicationOut,
    PublishRequest,
    RollbackRequest,
    StatsOut,
)
from server.schemas.common import Page
from server.schemas.rounds import AuditOut, JobOut, TaskOut
from server.sign_in import Me
from server.states import Role
from server.store.campaigns import lock_campaign
from server.store.paging import page
from server.store.tables import AuditEntry, Campaign, Publication

router = APIRouter(tags=["campaigns"])


@router.get("/tasks")
def list_tasks(_me: Staff, session: ReadSession) -> list[TaskOut]:
    """Robot tasks that there is a pretrained checkpoint for."""
    return [TaskOut.model_validate(task) for task in checkpoints.list_tasks(session)]


def _shown(campaign: Campaign, me: Me) -> CampaignOut | CampaignToLabel:
    """Annotators are not told which policy they look at, nor how pairs are chosen."""
    if me.role == Role.ANNOTATOR:
        return CampaignToLabel.model_validate(campaign)
    return CampaignOut.model_validate(campaign)


@router.get("/campaigns")
def list_campaigns(
    me: Anyone, session: ReadSession, archived: bool = False
) -> list[CampaignOut | CampaignToLabel]:
    """Campaigns; archived ones on request."""
    query = select(Campaign).order_by(Campaign.id)
    if not archived:
        query = query.where(Campaign.archived.is_(False))
    return [_shown(row, me) for row in session.scalars(query)]


@router.post("/campaigns", status_code=status.HTTP_201_CREATED)
def create_campaign(
    body: CampaignCreate, me: Staff, session: WriteSession, services: UseServices
) -> CampaignOut:
    """Start a campaign."""
    campaign = campaigns.create_campaign(
        session,
        services.clock(),
        name=body.name,
        task=body.task,
        criterion=body.criterion,
        start_checkpoint_id=body.start_checkpoint_id,
        settings=body.settings.model_dump(mode="json"),
        by=me.id,
    )
    return CampaignOut.model_validate(campaign)


@router.get("/campaigns/{campaign_id}")
def get_campaign(
    campaign_id: PathId, me: Anyone, session: ReadSession
) -> CampaignOut | CampaignToLabel:
    """One campaign."""
    return _shown(campaigns.get_campaign(session, campaign_id), me)


@router.patch("/campaigns/{campaign_id}")
def change_campaign(
    campaign_id: PathId,
    body: CampaignPatch,
    me: Staff,
    session: WriteSession,
    services: UseServices,
) -> CampaignOut:
    """Rename, archive, or change settings (partly); the publish rule as an admin only."""
    settings = None
    if body.settings is not None:
        # Locked before they are read: what somebody else changes meanwhile is kept.
        before = lock_campaign(session, campaign_id).settings
        settings = _merge_settings(before, body.settings)
        _refuse_another_rule(before["publish_rule"], settings["publish_rule"], me)
    campaign = campaigns.change_campaign(
        session,
        services.clock(),
        campaign_id,
        name=body.name,
        criterion=body.criterion,
        settings=settings,
        archived=body.archived,
        by=me.id,
    )
    return CampaignOut.model_validate(campaign)


def _refuse_another_rule(before: str, after: str, me: Me) -> None:
    """Publishing is for admins, and so is the rule by which rounds publish."""
    if after != before and me.role != Role.ADMIN:
        raise NotAllowedError(
            f"publish_rule {after!r} instead of {before!r} needs role 'admin';"
            f" {me.name!r} has {me.role.value!r}"
        )


def _merge_settings(before: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    merged = before | change
    if isinstance(change.get("collect"), dict):
        merged["collect"] = before["collect"] | change["collect"]
    try:
        return CampaignSettings.model_validate(merged).model_dump(mode="json")
    except ValidationError as error:
        found = [item | {"loc": ("body", "settings", *item["loc"])} for item in error.errors()]
        raise RequestValidationError(found) from None


@router.get("/campaigns/{campaign_id}/stats")
def campaign_stats(campaign_id: PathId, _me: Staff, session: ReadSession) -> StatsOut:
    """Where the campaign stands."""
    return StatsOut.model_validate(campaigns.campaign_stats(session, campaign_id))


@router.post("/campaigns/{campaign_id}/collect", status_code=status.HTTP_202_ACCEPTED)
def collect(
    campaign_id: PathId,
    body: CollectRequest,
    me: Staff,
    session: WriteSession,
    services: UseServices,
    response: Response,
) -> JobOut:
    """Roll out the published policy and make pairs; follow the job at `Location`."""
    overrides = body.model_dump(mode="json", exclude_none=True)
    job = campaigns.start_collect(session, services.clock(), campaign_id, overrides, by=me.id)
    response.headers["Location"] = f"/api/v1/jobs/{job.id}"
    return JobOut.model_validate(job)


@router.post("/campaigns/{campaign_id}/publish", status_code=status.HTTP_201_CREATED)
def publish(
    campaign_id: PathId,
    body: PublishRequest,
    me: Admin,
    session: WriteSession,
    services: UseServices,
) -> PublicationOut:
    """Publish a checkpoint by hand."""
    moved = publications.publish(
        session,
        services.clock(),
        campaign_id=campaign_id,
        checkpoint_id=body.checkpoint_id,
        reason=body.reason,
        by=me.id,
    )
    return PublicationOut.model_validate(moved)


@router.post("/campaigns/{campaign_id}/rollback", status_code=status.HTTP_201_CREATED)
def rollback(
    campaign_id: PathId,
    body: RollbackRequest,
    me: Admin,
    session: WriteSession,
    services: UseServices,
) -> PublicationOut:
    """Publish again what was published before."""
    moved = publications.rollback(
        session,
        services.clock(),
        campaign_id=campaign_id,
        checkpoint_id=body.checkpoint_id,
        reason=body.reason,
        by=me.id,
    )
    return PublicationOut.model_validate(moved)


@router.get("/campaigns/{campaign_id}/publications")
def list_publications(
    campaign_id: PathId,
    _me: Admin,
    session: ReadSession,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[PublicationOut]:
    """All moves of the published alias, newest first."""
    campaigns.get_campaign(session, campaign_id)
    query = select(Publication).where(Publication.campaign_id == campaign_id)
    rows, next_cursor = page(
        session, query, Publication.id, limit=limit, cursor=cursor, newest_first=True
    )
    items = [PublicationOut.model_validate(row) for row in rows]
    return Page[PublicationOut](items=items, next_cursor=next_cursor)


@router.get("/audit")
def list_audit(
    _me: Admin, session: ReadSession, limit: Limit = 100, cursor: Cursor = None
) -> Page[AuditOut]:
    """Who did what, newest first."""
    rows, next_cursor = page(
        session, select(AuditEntry), AuditEntry.id, limit=limit, cursor=cursor, newest_first=True
    )
    items = [AuditOut.model_validate(row) for row in rows]
    return Page[AuditOut](items=items, next_cursor=next_cursor)
