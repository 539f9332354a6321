"""Label snapshots: what a round learns from, frozen and reproducible."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import ColumnElement, case, func, select
from sqlalchemy.orm import Session

from server.errors import ConflictError, NotFoundError
from server.states import PublishRule, RoundState
from server.store.labels import (
    count_effective,
    effective_label_ids,
    has_decisive_label,
    snapshot_is_decisive,
    telling_label_ids,
)
from server.store.tables import Campaign, LabelSnapshot, Round


def freeze_snapshot(session: Session, now: datetime, campaign_id: int) -> LabelSnapshot:
    """Freeze the labels that hold now; equal sets share one row. May be empty."""
    label_ids = effective_label_ids(session, campaign_id)
    digest = snapshot_digest(campaign_id, label_ids)
    snapshot = session.get(LabelSnapshot, digest)
    if snapshot is None:
        snapshot = LabelSnapshot(
            digest=digest,
            campaign_id=campaign_id,
            label_ids=label_ids,
            size=len(label_ids),
            created_at=now,
        )
        session.add(snapshot)
        session.flush()
    return snapshot


def snapshot_digest(campaign_id: int, label_ids: Sequence[int]) -> str:
    """SHA-256 of the canonical JSON of campaign and ordered label ids."""
    content = {"campaign_id": campaign_id, "label_ids": list(label_ids)}
    return hashlib.sha256(
        json.dumps(content, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


def snapshot_to_learn_from(
    session: Session, now: datetime, campaign_id: int, digest: str | None
) -> LabelSnapshot:
    """A fresh snapshot, or the one that `digest` names.

    Raises NotFoundError for a digest that is not of this campaign, ConflictError when no label in
    it says which episode is better.
    """
    if digest is None:
        if not has_decisive_label(session, campaign_id):
            raise _undecided(campaign_id, count_effective(session, campaign_id))
        return freeze_snapshot(session, now, campaign_id)
    snapshot = session.get(LabelSnapshot, digest)
    if snapshot is None or snapshot.campaign_id != campaign_id:
        raise NotFoundError(f"label snapshot of campaign {campaign_id}", digest)
    if not snapshot_is_decisive(session, digest):
        raise _undecided(campaign_id, snapshot.size)
    return snapshot


def _undecided(campaign_id: int, labels: int) -> ConflictError:
    return ConflictError(
        f"campaign {campaign_id} has {labels} labels in force, but none says which"
        " episode is better; collect labels first"
    )


def may_learn(campaign: Campaign) -> ColumnElement[bool]:
    """Condition on Round: of this campaign, and of the rounds that make its labels old.

    A comparison round leaves them to the rounds that publish. In a campaign that only compares no
    such round comes, so there comparisons count: else its labels were new for ever, and rounds on
    the same ones would start without end.
    """
    own = Round.campaign_id == campaign.id
    if campaign.settings["publish_rule"] == PublishRule.NEVER:
        return own
    return own & (Round.publish_rule != PublishRule.NEVER)


def new_labels_since_round(session: Session, campaign: Campaign) -> int:
    """Labels in force that say something and that no round has learned from (`may_learn`).

    Nothing can be learned from "cannot tell", so it neither is new nor makes a round due.
    What a round learned is lost when it fails or is cancelled: its labels are new again.
    """
    telling = telling_label_ids(session, campaign.id)
    digest = _newest_learned(session, campaign)
    if digest is None:
        return len(telling)
    used = set(session.get_one(LabelSnapshot, digest).label_ids)
    return sum(label_id not in used for label_id in telling)


def _newest_learned(session: Session, campaign: Campaign) -> str | None:
    """Of the snapshots that rounds have learned from, the one that was frozen last.

    A label that is in force now was in force ever since it was given. So this one holds all labels
    in force that the earlier ones hold, and no other need be read. The first round of a snapshot
    froze it, so the rounds' ids tell which is the last.
    """
    learned = may_learn(campaign) & Round.state.not_in((RoundState.FAILED, RoundState.CANCELLED))
    query = (
        select(Round.snapshot_digest)
        .where(Round.campaign_id == campaign.id)
        .group_by(Round.snapshot_digest)
        .having(func.sum(case((learned, 1), else_=0)) > 0)
        .order_by(func.min(Round.id).desc())
    )
    return session.scalars(query.limit(1)).first()
