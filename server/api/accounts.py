"""Signing in and out, accounts, tokens."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response, status
from sqlalchemy import select

from rodif_core.errors import ValueOutOfRangeError
from server import accounts, sign_in
from server.api.access import COOKIE, Admin, Anyone, ReadSession, UseServices, WriteSession
from server.api.params import Cursor, Limit, PathId
from server.api.services import Services
from server.errors import NotAllowedError, NotSignedInError
from server.passwords import hash_password
from server.schemas.accounts import (
    AnnotatorCreate,
    AnnotatorOut,
    AnnotatorPatch,
    MeOut,
    OwnPassword,
    SessionCreate,
    SessionOut,
    TokenCreate,
    TokenIssued,
    TokenOut,
)
from server.schemas.common import Page
from server.sign_in import Me
from server.states import Role
from server.store.paging import page
from server.store.tables import Annotator, ApiToken

router = APIRouter(tags=["accounts"])

MAX_OWN_TOKEN_DAYS = 90  # of those who are no admins; nobody looks after their scripts for years


@router.post("/session")
def open_session(
    body: SessionCreate, request: Request, response: Response, services: UseServices
) -> SessionOut:
    """Sign in; the answer sets the session cookie."""
    now, settings = services.clock(), services.settings
    source = sign_in.source_of(request.client.host if request.client else None)
    # Three short transactions: the failure must be stored although the answer is an error, and
    # no writer may wait for the slow hash.
    with services.database.write() as session:
        sign_in.note_attempt(session, now, name=body.name, source=source)
    with services.database.read() as session:
        me = sign_in.check_password(session, body.name, body.password, cheap=settings.argon2_cheap)
    lifetime = timedelta(hours=settings.session_hours)
    with services.database.write() as session:
        secret = sign_in.open_session(session, now, me, source=source, lifetime=lifetime)
    _set_cookie(response, secret, services)
    return SessionOut(annotator=MeOut.model_validate(me))


def _set_cookie(response: Response, secret: str, services: Services) -> None:
    response.set_cookie(
        COOKIE,
        secret,
        max_age=int(timedelta(hours=services.settings.session_hours).total_seconds()),
        httponly=True,
        samesite="lax",
        secure=services.settings.secure_cookies,
    )


@router.delete("/session", status_code=status.HTTP_204_NO_CONTENT)
def close_session(request: Request, response: Response, services: UseServices) -> None:
    """Sign out: revoke the session of the cookie. Without one there is nothing to do."""
    secret = request.cookies.get(COOKIE)
    if secret is not None:
        with services.database.write() as session:
            sign_in.close_session(session, services.clock(), secret)
    response.delete_cookie(COOKIE)


@router.get("/me")
def me(me: Anyone) -> MeOut:
    """The signed-in account."""
    return MeOut.model_validate(me)


@router.put("/me/password", status_code=status.HTTP_204_NO_CONTENT)
def change_own_password(
    body: OwnPassword, me: Anyone, request: Request, response: Response, services: UseServices
) -> None:
    """Set the own password. Ends all sessions and tokens; this browser gets a new session."""
    now, settings = services.clock(), services.settings
    source = sign_in.source_of(request.client.host if request.client else None)
    # As for signing in: who found an open browser must not guess passwords without end.
    with services.database.write() as session:
        sign_in.note_attempt(session, now, name=me.name, source=source)
    try:
        with services.database.read() as session:
            sign_in.check_password(session, me.name, body.current, cheap=settings.argon2_cheap)
    except NotSignedInError as error:
        raise NotAllowedError("the current password is not the one of this account") from error
    password_hash = _hashed(body.password, services)
    lifetime = timedelta(hours=settings.session_hours)
    with services.database.write() as session:
        accounts.change_annotator(
            session, now, me.id, active=None, password_hash=password_hash, role=None, by=me.id
        )
        secret = sign_in.open_session(session, now, me, source=source, lifetime=lifetime)
    _set_cookie(response, secret, services)


def _out(account: Annotator, labels: int) -> AnnotatorOut:
    return AnnotatorOut(
        id=account.id,
        name=account.name,
        role=Role(account.role),
        kind=sign_in.me_of(account).kind,
        active=account.active,
        created_at=account.created_at,
        labels=labels,
    )


@router.get("/annotators")
def list_annotators(
    _me: Admin, session: ReadSession, limit: Limit = 100, cursor: Cursor = None
) -> Page[AnnotatorOut]:
    """All accounts, oldest first."""
    labels = accounts.labels_per_annotator(session)
    rows, next_cursor = page(session, select(Annotator), Annotator.id, limit=limit, cursor=cursor)
    items = [_out(row, labels.get(row.id, 0)) for row in rows]
    return Page[AnnotatorOut](items=items, next_cursor=next_cursor)


@router.post("/annotators", status_code=status.HTTP_201_CREATED)
def create_annotator(body: AnnotatorCreate, me: Admin, services: UseServices) -> AnnotatorOut:
    """Add an account."""
    password_hash = _hashed(body.password, services)
    with services.database.write() as session:
        account = accounts.create_annotator(
            session,
            services.clock(),
            name=body.name,
            role=body.role,
            kind=body.kind,
            password_hash=password_hash,
            by=me.id,
        )
    return _out(account, 0)


def _hashed(password: str | None, services: Services) -> str | None:
    """Slow on purpose, so the transaction that stores it must not have begun."""
    return (
        None if password is None else hash_password(password, cheap=services.settings.argon2_cheap)
    )


@router.patch("/annotators/{annotator_id}")
def change_annotator(
    annotator_id: PathId, body: AnnotatorPatch, me: Admin, services: UseServices
) -> AnnotatorOut:
    """Activate, deactivate, set a password or a role."""
    password_hash = _hashed(body.password, services)
    with services.database.write() as session:
        account = accounts.change_annotator(
            session,
            services.clock(),
            annotator_id,
            active=body.active,
            password_hash=password_hash,
            role=body.role,
            by=me.id,
        )
        labels = accounts.labels_per_annotator(session).get(account.id, 0)
    return _out(account, labels)


@router.get("/tokens")
def list_tokens(
    me: Anyone,
    session: ReadSession,
    mine: Annotated[bool, Query(description="only the own tokens")] = False,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[TokenOut]:
    """Own tokens, newest first; all of them for admins without `mine`."""
    query = select(ApiToken)
    if mine or me.role != Role.ADMIN:
        query = query.where(ApiToken.annotator_id == me.id)
    rows, next_cursor = page(
        session, query, ApiToken.id, limit=limit, cursor=cursor, newest_first=True
    )
    items = [TokenOut.model_validate(row) for row in rows]
    return Page[TokenOut](items=items, next_cursor=next_cursor)


@router.post("/tokens", status_code=status.HTTP_201_CREATED)
def issue_token(
    body: TokenCreate, me: Anyone, session: WriteSession, services: UseServices
) -> TokenIssued:
    """A new bearer token for the own account, or for any as an admin. It is shown only here."""
    annotator_id = body.annotator_id or me.id
    _check_owner(me, annotator_id)
    if me.role != Role.ADMIN and body.days > MAX_OWN_TOKEN_DAYS:
        raise ValueOutOfRangeError("days", body.days, f"at most {MAX_OWN_TOKEN_DAYS}")
    token, text = accounts.issue_token(
        session,
        services.clock(),
        annotator_id=annotator_id,
        name=body.name,
        days=body.days,
        by=me.id,
    )
    return TokenIssued(id=token.id, token=text, expires_at=token.expires_at)


def _check_owner(me: Me, annotator_id: int) -> None:
    if me.role != Role.ADMIN and annotator_id != me.id:
        raise NotAllowedError(f"only admins make tokens for other accounts ({annotator_id})")


@router.delete("/tokens/{token_id}", status_code=status.HTTP_204_NO_CONTENT)
def revoke_token(
    token_id: PathId, me: Anyone, session: WriteSession, services: UseServices
) -> None:
    """Revoke an own token, or any as an admin."""
    accounts.revoke_token(session, services.clock(), token_id, me=me)
