"""The published policy of a campaign is an alias that moves; every move is a row."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from server.errors import ConflictError, NotFoundError
from server.states import PublishRule
from server.store.campaigns import lock_campaign
from server.store.events import add_event, audit
from server.store.tables import Campaign, Checkpoint, Episode, Publication, Round


def publish(
    session: Session,
    now: datetime,
    *,
    campaign_id: int,
    checkpoint_id: int,
    reason: str,
    by: int | None,
) -> Publication:
    """Move the alias to `checkpoint_id`; `by` None means that the gate of a round did it.

    Raises NotFoundError, or ConflictError for a checkpoint of another task, of another pretrained
    policy than the campaign's runs, of a comparison round, or one that is published already.
    """
    campaign = lock_campaign(session, campaign_id)
    checkpoint = session.get(Checkpoint, checkpoint_id)
    if checkpoint is None:
        raise NotFoundError("checkpoint", checkpoint_id)
    if checkpoint.task != campaign.task:
        raise ConflictError(
            f"checkpoint {checkpoint_id} is for task {checkpoint.task!r},"
            f" campaign {campaign_id} for {campaign.task!r}"
        )
    if checkpoint.id == campaign.published_checkpoint_id:
        raise ConflictError(f"checkpoint {checkpoint_id} is published already")
    _refuse_another_family(session, campaign, checkpoint)
    if checkpoint.round_id is not None:
        parent_round = session.get_one(Round, checkpoint.round_id)
        if parent_round.publish_rule == PublishRule.NEVER:
            raise ConflictError(
                f"checkpoint {checkpoint_id} comes from comparison round {parent_round.id}"
                " (publish_rule 'never'), which is never published"
            )
    return _move(session, now, campaign, checkpoint.id, action="publish", reason=reason, by=by)


def rollback(
    session: Session,
    now: datetime,
    *,
    campaign_id: int,
    reason: str,
    by: int | None,
    checkpoint_id: int | None = None,
) -> Publication:
    """Move the alias back to what was published before.

    `checkpoint_id` is what the caller expects that to be. Raises NotFoundError; ConflictError at
    the start, and when it is another checkpoint by now.
    """
    campaign = lock_campaign(session, campaign_id)
    before = rollback_target(session, campaign_id)
    if before is None:
        raise ConflictError(
            f"campaign {campaign_id} is at its starting checkpoint; there is nothing to roll back"
        )
    if checkpoint_id not in (None, before):
        raise ConflictError(
            f"a rollback of campaign {campaign_id} would now publish checkpoint {before},"
            f" not {checkpoint_id}; look again, then roll back to {before}"
        )
    return _move(session, now, campaign, before, action="rollback", reason=reason, by=by)


def rollback_target(session: Session, campaign_id: int) -> int | None:
    """The checkpoint that a rollback would publish again; None when there is nothing before."""
    history = session.scalars(
        select(Publication).where(Publication.campaign_id == campaign_id).order_by(Publication.id)
    )
    stack: list[int] = []
    for row in history:
        if row.action == "rollback":
            stack.pop()
        else:
            stack.append(row.checkpoint_id)
    return stack[-2] if len(stack) > 1 else None


def record_start(session: Session, now: datetime, campaign: Campaign, *, by: int | None) -> None:
    """First row of a new campaign's history."""
    session.add(
        Publication(
            campaign_id=campaign.id,
            checkpoint_id=campaign.published_checkpoint_id,
            previous_checkpoint_id=None,
            action="start",
            reason="campaign created",
            by_annotator_id=by,
            at=now,
        )
    )


def _refuse_another_family(session: Session, campaign: Campaign, checkpoint: Checkpoint) -> None:
    """Rounds learn from all runs of a campaign, so all of its policies must have scaled what they
    saw and did alike. They do when they descend from one pretrained policy."""
    published = session.get_one(Checkpoint, campaign.published_checkpoint_id)
    theirs, ours = _pretrained(session, checkpoint), _pretrained(session, published)
    has_runs = session.scalars(
        select(Episode.id).where(Episode.campaign_id == campaign.id).limit(1)
    ).first()
    if theirs.id != ours.id and has_runs is not None:
        raise ConflictError(
            f"checkpoint {checkpoint.id} descends from {theirs.name!r} (checkpoint {theirs.id}),"
            f" the runs of campaign {campaign.id} from {ours.name!r} (checkpoint {ours.id}):"
            " one round cannot learn from both; start a new campaign"
        )


def _pretrained(session: Session, checkpoint: Checkpoint) -> Checkpoint:
    while checkpoint.parent_id is not None:
        checkpoint = session.get_one(Checkpoint, checkpoint.parent_id)
    return checkpoint


def _move(
    session: Session,
    now: datetime,
    campaign: Campaign,
    checkpoint_id: int,
    *,
    action: str,
    reason: str,
    by: int | None,
) -> Publication:
    publication = Publication(
        campaign_id=campaign.id,
        checkpoint_id=checkpoint_id,
        previous_checkpoint_id=campaign.published_checkpoint_id,
        action=action,
        reason=reason,
        by_annotator_id=by,
        at=now,
    )
    moved = {"from": campaign.published_checkpoint_id, "to": checkpoint_id, "reason": reason}
    campaign.published_checkpoint_id = checkpoint_id
    session.add(publication)
    audit(
        session,
        now,
        actor_id=by,
        action=f"campaign.{action}",
        subject=f"campaign/{campaign.id}",
        details=moved,
    )
    add_event(
        session,
        now,
        campaign_id=campaign.id,
        kind="publication",
        data={"action": action, "checkpoint_id": checkpoint_id, "reason": reason},
    )
    session.flush()
    return publication
