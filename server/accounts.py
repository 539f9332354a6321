"""Accounts and bearer tokens."""

from __future__ import annotations

from datetime import datetime, timedelta

from sqlalchemy import func, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from server.errors import ConflictError, NotAllowedError, NotFoundError
from server.passwords import digest, new_token
from server.sign_in import Me
from server.states import AnnotatorKind, Role
from server.store.events import audit
from server.store.labels import is_effective
from server.store.tables import Annotator, ApiToken, BrowserSession, Label


def create_annotator(
    session: Session,
    now: datetime,
    *,
    name: str,
    role: Role,
    kind: AnnotatorKind,
    password_hash: str | None,
    by: int | None,
) -> Annotator:
    """Add an account; without a password it can only use tokens. ConflictError: name is taken.

    `password_hash` comes from `hash_password`, made before the transaction: it is slow on purpose.
    """
    account = Annotator(
        name=name,
        role=role,
        kind=kind,
        password_hash=password_hash,
        created_at=now,
    )
    try:
        with session.begin_nested():
            session.add(account)
    except IntegrityError:
        raise ConflictError(f"there is an account named {name!r} already") from None
    audit(
        session,
        now,
        actor_id=by,
        action="annotator.create",
        subject=f"annotator/{account.id}",
        details={"name": name, "role": role, "kind": kind},
    )
    return account


def change_annotator(
    session: Session,
    now: datetime,
    annotator_id: int,
    *,
    active: bool | None,
    password_hash: str | None,
    role: Role | None,
    by: int,
) -> Annotator:
    """Change what is not None. A new password or a deactivation ends all sessions and tokens.

    Whoever gets the account back, or a new password, may not be the one who has its old tokens.
    Raises NotFoundError, or ConflictError when no active admin would be left.
    """
    account = session.get(Annotator, annotator_id)
    if account is None:
        raise NotFoundError("annotator", annotator_id)
    loses_admin = active is False or role not in (None, Role.ADMIN)
    if account.role == Role.ADMIN and account.active and loses_admin:
        _refuse_last_admin(session, account)
    if active is not None:
        account.active = active
    if role is not None:
        account.role = role
    if password_hash is not None:
        account.password_hash = password_hash
    if active is False or password_hash is not None:
        _sign_out_everywhere(session, now, account.id)
    audit(
        session,
        now,
        actor_id=by,
        action="annotator.change",
        subject=f"annotator/{account.id}",
        details={"active": active, "role": role, "password": password_hash is not None},
    )
    return account


def _sign_out_everywhere(session: Session, now: datetime, annotator_id: int) -> None:
    for table in (BrowserSession, ApiToken):
        session.execute(
            update(table)
            .where(table.annotator_id == annotator_id, table.revoked_at.is_(None))
            .values(revoked_at=now)
        )


def _refuse_last_admin(session: Session, account: Annotator) -> None:
    # Lock all admins, so that two admins cannot deactivate each other at the same time.
    admins = session.scalars(
        select(Annotator)
        .where(Annotator.role == Role.ADMIN, Annotator.active)
        .order_by(Annotator.id)
        .with_for_update()
    ).all()
    if [admin.id for admin in admins] == [account.id]:
        raise ConflictError(f"account {account.name!r} is the last active admin")


def labels_per_annotator(session: Session) -> dict[int, int]:
    """Labels in force by annotator id."""
    query = select(Label.annotator_id, func.count()).where(is_effective())
    return dict(session.execute(query.group_by(Label.annotator_id)).all())


def issue_token(
    session: Session, now: datetime, *, annotator_id: int, name: str, days: float, by: int | None
) -> tuple[ApiToken, str]:
    """A new bearer token of the account; the text is returned once and never stored."""
    account = session.get(Annotator, annotator_id)
    if account is None:
        raise NotFoundError("annotator", annotator_id)
    if not account.active:
        raise ConflictError(f"account {account.name!r} is not active")
    text = new_token()
    token = ApiToken(
        annotator_id=annotator_id,
        name=name,
        token_sha256=digest(text),
        created_at=now,
        expires_at=now + timedelta(days=days),
    )
    session.add(token)
    session.flush()
    audit(
        session,
        now,
        actor_id=by,
        action="token.issue",
        subject=f"token/{token.id}",
        details={"annotator_id": annotator_id, "name": name},
    )
    return token, text


def revoke_token(session: Session, now: datetime, token_id: int, *, me: Me) -> None:
    """Revoke an own token, or any as an admin; a second time is no change."""
    token = session.get(ApiToken, token_id)
    if token is None:
        raise NotFoundError("token", token_id)
    if me.role != Role.ADMIN and token.annotator_id != me.id:
        raise NotAllowedError(f"token {token_id} belongs to another account")
    if token.revoked_at is None:
        token.revoked_at = now
        audit(session, now, actor_id=me.id, action="token.revoke", subject=f"token/{token_id}")
