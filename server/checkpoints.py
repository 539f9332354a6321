"""Checkpoints: which tasks there are, and where a policy comes from."""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Row, select
from sqlalchemy.orm import Session

from server.errors import NotFoundError
from server.states import PublishRule
from server.store.labels import snapshot_annotators, snapshot_page
from server.store.tables import Annotator, Checkpoint, Round


def get_checkpoint(session: Session, checkpoint_id: int) -> Checkpoint:
    """The row; raises NotFoundError."""
    checkpoint = session.get(Checkpoint, checkpoint_id)
    if checkpoint is None:
        raise NotFoundError("checkpoint", checkpoint_id)
    return checkpoint


def from_comparison_rounds(session: Session, rows: Sequence[Checkpoint]) -> set[int]:
    """Ids of those that come from a comparison round, of whichever campaign: never published."""
    rounds = {row.round_id for row in rows} - {None}
    query = select(Round.id).where(Round.id.in_(rounds), Round.publish_rule == PublishRule.NEVER)
    compared = set(session.scalars(query))
    return {row.id for row in rows if row.round_id in compared}


def task_facts(checkpoint: Checkpoint) -> dict[str, Any]:
    """What the checkpoint says about its task: modes, groups, preferred_group, criterion …"""
    facts: dict[str, Any] = checkpoint.config["task_facts"]
    return facts


def pretrained_by_task(session: Session) -> dict[str, list[Checkpoint]]:
    """Pretrained checkpoints (no parent) by task, oldest first: these are the tasks we have."""
    by_task: dict[str, list[Checkpoint]] = defaultdict(list)
    query = select(Checkpoint).where(Checkpoint.parent_id.is_(None)).order_by(Checkpoint.id)
    for checkpoint in session.scalars(query):
        by_task[checkpoint.task].append(checkpoint)
    return dict(by_task)


def list_tasks(session: Session) -> list[dict[str, Any]]:
    """The tasks, with the facts of their newest pretrained checkpoint, ordered by name."""
    names = ("criterion", "modes", "groups", "preferred_group")
    tasks = []
    for task, checkpoints in sorted(pretrained_by_task(session).items()):
        facts = task_facts(checkpoints[-1])
        shown = {"id": checkpoints[-1].id, "name": checkpoints[-1].name}
        tasks.append(
            {"name": task}
            | {name: facts[name] for name in names}
            | {
                "scene": facts.get("scene", []),
                "newest_checkpoint": shown,
                "checkpoints": len(checkpoints),
            }
        )
    return tasks


def lineage(session: Session, checkpoint_id: int) -> list[dict[str, Any]]:
    """The checkpoint and its parents up to the pretrained one, down to the clicks behind each."""
    chain = []
    step: Checkpoint | None = get_checkpoint(session, checkpoint_id)
    while step is not None:
        chain.append(_origin(session, step))
        step = None if step.parent_id is None else session.get_one(Checkpoint, step.parent_id)
    return chain


def labels_behind(
    session: Session, checkpoint_id: int, *, limit: int, cursor: int | None
) -> tuple[Sequence[Row[int, int, int]], int | None]:
    """A page of the labels that the checkpoint learned from: id, pair and annotator of each.

    Raises NotFoundError. There are none behind a pretrained checkpoint.
    """
    digest = get_checkpoint(session, checkpoint_id).snapshot_digest
    if digest is None:
        return [], None
    return snapshot_page(session, digest, limit=limit, cursor=cursor)


def _origin(session: Session, checkpoint: Checkpoint) -> dict[str, Any]:
    made_by = None if checkpoint.round_id is None else session.get_one(Round, checkpoint.round_id)
    counts: Counter[int] = Counter()
    if checkpoint.snapshot_digest is not None:
        counts = snapshot_annotators(session, checkpoint.snapshot_digest)
    names = {
        account.id: account.name
        for account in session.scalars(select(Annotator).where(Annotator.id.in_(counts)))
    }
    return {
        "checkpoint": checkpoint,
        "round_id": checkpoint.round_id,
        "config": None if made_by is None else made_by.config,
        "config_digest": None if made_by is None else config_digest(made_by.config),
        "snapshot_digest": checkpoint.snapshot_digest,
        "labels": counts.total(),
        "labels_by_annotator": [
            {"annotator_id": key, "name": names[key], "labels": counts[key]}
            for key in sorted(counts)
        ],
        "code_version": checkpoint.code_version,
    }


def config_digest(config: dict[str, Any]) -> str:
    """SHA-256 of the canonical JSON of a configuration."""
    text = json.dumps(config, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
