"""Label snapshots: what a round learns from, frozen and reproducible."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from server.errors import ConflictError, NotFoundError
from server.states import DECISIVE, PublishRule
from server.store.labels import effective_label_ids, snapshot_labels
from server.store.tables import LabelSnapshot, Round


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
        snapshot = freeze_snapshot(session, now, campaign_id)
    else:
        found = session.get(LabelSnapshot, digest)
        if found is None or found.campaign_id != campaign_id:
            raise NotFoundError(f"label snapshot of campaign {campaign_id}", digest)
        snapshot = found
    if not any(row.choice in DECISIVE for row in snapshot_labels(session, snapshot.digest)):
        raise ConflictError(
            f"campaign {campaign_id} has {snapshot.size} labels in force, but none says which"
            " episode is better; collect labels first"
        )
    return snapshot


def new_labels_since_round(session: Session, campaign_id: int) -> int:
    """Labels in force that no earlier publishing round has learned from."""
    used: set[int] = set()
    snapshots = (
        select(LabelSnapshot.label_ids)
        .join(Round, Round.snapshot_digest == LabelSnapshot.digest)
        .where(Round.campaign_id == campaign_id, Round.publish_rule != PublishRule.NEVER)
        .order_by(Round.id.desc())
        .limit(1)
    )
    for label_ids in session.scalars(snapshots):
        used.update(label_ids)
    return sum(label_id not in used for label_id in effective_label_ids(session, campaign_id))
