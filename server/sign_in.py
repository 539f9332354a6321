"""Who is it? Passwords, browser sessions and bearer tokens, with throttled sign-ins."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from ipaddress import IPv4Address, ip_address, ip_network

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from server.errors import NotSignedInError, ThrottledError
from server.passwords import digest, new_secret, verify_password
from server.states import AnnotatorKind, Role
from server.store.tables import Annotator, ApiToken, BrowserSession, SignInAttempt

THROTTLE_WINDOW = timedelta(minutes=15)
# Within the window. Not by name alone: anybody could then lock anybody out.
MAX_FAILURES_PER_NAME_AND_ADDRESS = 10
MAX_FAILURES_PER_ADDRESS = 40  # an office behind one address is not one attacker
TOKEN_USE_NOTED_EVERY = timedelta(minutes=5)


@dataclass(frozen=True)
class Me:
    """The account behind a request."""

    id: int
    name: str
    role: Role
    kind: AnnotatorKind


def me_of(account: Annotator) -> Me:
    """The account as a value that outlives its database session."""
    return Me(account.id, account.name, Role(account.role), AnnotatorKind(account.kind))


def source_of(host: str | None) -> str:
    """What attempts are counted by: the address, or the network (/64) that one IPv6 host has."""
    if host is None:
        return "unknown"
    try:
        address = ip_address(host)
    except ValueError:  # a unix socket has no address
        return host[:64]
    if isinstance(address, IPv4Address):
        return str(address)
    return str(address.ipv4_mapped or ip_network((int(address), 64), strict=False))


def note_attempt(session: Session, now: datetime, *, name: str, source: str) -> None:
    """Count an attempt before its password is looked at, so that parallel guesses count too.

    Raises ThrottledError when there are too many failures from `source`, with this name or in all.
    Commit this before calling `check_password`; a success clears the name again.
    """
    since = now - THROTTLE_WINDOW
    session.execute(delete(SignInAttempt).where(SignInAttempt.at < since))
    from_here = select(func.count(), func.min(SignInAttempt.at)).where(
        SignInAttempt.address == source
    )
    for query, limit in (
        (from_here.where(SignInAttempt.name == name), MAX_FAILURES_PER_NAME_AND_ADDRESS),
        (from_here, MAX_FAILURES_PER_ADDRESS),
    ):
        count, oldest = session.execute(query).one()
        if count >= limit:
            wait = int((oldest + THROTTLE_WINDOW - now).total_seconds()) + 1
            raise ThrottledError(
                f"{count} failed sign-ins within {THROTTLE_WINDOW.seconds // 60} minutes;"
                f" try again in {wait} s",
                retry_after=wait,
            )
    session.add(SignInAttempt(name=name, address=source, at=now))


def check_password(session: Session, name: str, password: str, *, cheap: bool) -> Me:
    """The account; raises NotSignedInError. Slow on purpose: call it outside a write."""
    account = session.scalars(select(Annotator).where(Annotator.name == name)).one_or_none()
    stored = account.password_hash if account is not None and account.active else None
    if not verify_password(password, stored, cheap=cheap) or account is None:
        raise NotSignedInError("name or password is wrong, or the account is not active")
    return me_of(account)


def open_session(
    session: Session, now: datetime, me: Me, *, source: str, lifetime: timedelta
) -> str:
    """Start a browser session, forget failures of this name from here; returns the cookie value."""
    mine = (SignInAttempt.name == me.name, SignInAttempt.address == source)
    session.execute(delete(SignInAttempt).where(*mine))
    secret = new_secret()
    session.add(
        BrowserSession(
            annotator_id=me.id,
            token_sha256=digest(secret),
            created_at=now,
            expires_at=now + lifetime,
        )
    )
    return secret


def close_session(session: Session, now: datetime, secret: str) -> None:
    """Revoke a browser session; an unknown one is no error."""
    row = session.scalars(
        select(BrowserSession).where(BrowserSession.token_sha256 == digest(secret))
    ).one_or_none()
    if row is not None and row.revoked_at is None:
        row.revoked_at = now


def by_cookie(session: Session, now: datetime, secret: str) -> Me:
    """The account of a browser session; raises NotSignedInError."""
    found = session.execute(
        select(BrowserSession, Annotator)
        .join(Annotator, Annotator.id == BrowserSession.annotator_id)
        .where(BrowserSession.token_sha256 == digest(secret))
    ).one_or_none()
    if found is None:
        raise NotSignedInError("this session is not known; sign in again")
    row, account = found
    _check(now, "session", account, row.expires_at, row.revoked_at)
    return me_of(account)


def by_token(session: Session, now: datetime, token: str) -> tuple[Me, bool]:
    """The account of a bearer token, and whether its use should be noted (`note_use`).

    Raises NotSignedInError.
    """
    found = session.execute(
        select(ApiToken, Annotator)
        .join(Annotator, Annotator.id == ApiToken.annotator_id)
        .where(ApiToken.token_sha256 == digest(token))
    ).one_or_none()
    if found is None:
        raise NotSignedInError("this token is not known")
    row, account = found
    _check(now, "token", account, row.expires_at, row.revoked_at)
    stale = row.last_used_at is None or now - row.last_used_at > TOKEN_USE_NOTED_EVERY
    return me_of(account), stale


def note_use(session: Session, now: datetime, token: str) -> None:
    """Store when the token was last used (to a few minutes)."""
    row = session.scalars(select(ApiToken).where(ApiToken.token_sha256 == digest(token))).one()
    row.last_used_at = now


def _check(
    now: datetime,
    what: str,
    account: Annotator,
    expires_at: datetime,
    revoked_at: datetime | None,
) -> None:
    if revoked_at is not None:
        raise NotSignedInError(f"this {what} was revoked at {revoked_at.isoformat()}")
    if expires_at <= now:
        raise NotSignedInError(f"this {what} expired at {expires_at.isoformat()}")
    if not account.active:
        raise NotSignedInError(f"account {account.name!r} is not active")
