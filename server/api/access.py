"""Who may do what: credentials of a request, roles, database sessions per request."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated

from fastapi import Depends
from fastapi.security import APIKeyCookie, HTTPAuthorizationCredentials, HTTPBearer
from sqlalchemy.orm import Session

from server import sign_in
from server.api.params import ExpectedAnnotator
from server.api.services import Services, services_of
from server.errors import NotAllowedError, NotSignedInError
from server.sign_in import Me
from server.states import Role

COOKIE = "rodif_session"

_bearer = HTTPBearer(auto_error=False, description="a token from POST /tokens")
_cookie = APIKeyCookie(name=COOKIE, auto_error=False, description="from POST /session")

UseServices = Annotated[Services, Depends(services_of)]


def who(services: Services, *, token: str | None, cookie: str | None) -> Me:
    """The account of a token (first) or of a cookie; raises NotSignedInError."""
    now = services.clock()
    if token is not None:
        with services.database.read() as session:
            me, stale = sign_in.by_token(session, now, token)
        if stale:
            with services.database.write() as session:
                sign_in.note_use(session, now, token)
        return me
    if cookie is not None:
        with services.database.read() as session:
            return sign_in.by_cookie(session, now, cookie)
    raise NotSignedInError("sign in, or send `Authorization: Bearer <token>`")


def current(
    services: UseServices,
    bearer: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
    cookie: Annotated[str | None, Depends(_cookie)],
    expected: ExpectedAnnotator = None,
) -> Me:
    """Any signed-in account; the one that the sender means, if it says so.

    A page stays open while the session of its browser ends and somebody else signs in: what it
    sends then must not be stored under that person's name.
    """
    me = who(services, token=bearer.credentials if bearer else None, cookie=cookie)
    if expected is not None and expected != me.id:
        raise NotSignedInError(
            f"this request is meant for annotator {expected}, but annotator {me.id} is signed in;"
            f" sign in as annotator {expected}"
        )
    return me


def _require(*roles: Role) -> Callable[[Me], Me]:
    def check(me: Annotated[Me, Depends(current)]) -> Me:
        if me.role not in roles:
            needed = " or ".join(repr(role.value) for role in roles)
            raise NotAllowedError(f"this needs role {needed}; {me.name!r} has {me.role.value!r}")
        return me

    return check


Anyone = Annotated[Me, Depends(current)]
Admin = Annotated[Me, Depends(_require(Role.ADMIN))]
Staff = Annotated[Me, Depends(_require(Role.ADMIN, Role.SERVICE))]  # runs campaigns
Service = Annotated[Me, Depends(_require(Role.SERVICE))]


def _read(services: UseServices, _me: Anyone) -> Iterator[Session]:
    with services.database.read() as session:
        yield session


def _write(services: UseServices, _me: Anyone) -> Iterator[Session]:
    # Signed in first: `who` writes by itself now and then, and SQLite has one writer at a time.
    with services.database.write() as session:
        yield session


# Function scope: the commit comes before the answer, so what is acknowledged is stored.
ReadSession = Annotated[Session, Depends(_read, scope="function")]
WriteSession = Annotated[Session, Depends(_write, scope="function")]
