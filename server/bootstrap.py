"""First rows of a new installation: an admin account and the shipped checkpoints."""

from __future__ import annotations

import secrets
from datetime import datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from server.errors import ConflictError
from server.passwords import hash_password
from server.states import AnnotatorKind, Role
from server.store.artifacts import ArtifactStore
from server.store.events import audit
from server.store.tables import Annotator, Checkpoint


def ensure_admin(
    session: Session,
    now: datetime,
    name: str = "admin",
    password: str | None = None,
    *,
    cheap: bool = False,
) -> str | None:
    """Make sure that an admin account `name` exists; a given password also activates it again.

    Returns its password when it was set now (the given one, or a new random one), and None when
    the account exists and no password was given. Raises ConflictError for an account of that name
    with another role.
    """
    account = session.scalars(select(Annotator).where(Annotator.name == name)).one_or_none()
    if account is not None and account.role != Role.ADMIN:
        raise ConflictError(f"account {name!r} has role {account.role!r}, not 'admin'")
    if account is not None and password is None:
        return None
    secret = password if password is not None else secrets.token_urlsafe(12)
    if account is None:
        account = Annotator(name=name, role=Role.ADMIN, kind=AnnotatorKind.PERSON, created_at=now)
        session.add(account)
    account.password_hash = hash_password(secret, cheap=cheap)
    account.active = True
    session.flush()
    audit(session, now, actor_id=None, action="admin.ensure", subject=f"annotator/{account.id}")
    return secret


def register_checkpoint(
    session: Session,
    now: datetime,
    store: ArtifactStore,
    *,
    task: str,
    name: str,
    blob: bytes,
    digest: str,
    config: dict[str, Any],
    metrics: dict[str, Any],
    code_version: str,
) -> Checkpoint:
    """Store a pretrained checkpoint (no parent) under its name; a second time is no change.

    `config["task_facts"]` holds what the torch-free side shows of the task: modes, groups,
    preferred_group, criterion, scene, control_dt, max_steps. Raises ConflictError when the name
    belongs to other weights.
    """
    existing = session.scalars(select(Checkpoint).where(Checkpoint.name == name)).one_or_none()
    if existing is not None:
        if existing.digest != digest:
            raise ConflictError(
                f"checkpoint {name!r} exists with digest {existing.digest}, not {digest};"
                " checkpoints are immutable, choose another name"
            )
        return existing
    checkpoint = Checkpoint(
        task=task,
        name=name,
        digest=digest,
        artifact_sha256=store.put(blob),
        config=config,
        metrics=metrics,
        code_version=code_version,
        created_at=now,
    )
    session.add(checkpoint)
    session.flush()
    return checkpoint
