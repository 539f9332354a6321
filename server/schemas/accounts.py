"""Accounts, tokens and signing in."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field

from server.schemas.common import Id, In, Out, ShortText, Text
from server.states import AnnotatorKind, Role

RoleIn = Annotated[Role, Field(strict=False)]  # JSON has no enums, only their text
KindIn = Annotated[AnnotatorKind, Field(strict=False)]
Password = Annotated[Text, Field(min_length=8, max_length=256)]


class SessionCreate(In):
    """Name and password."""

    name: Annotated[Text, Field(max_length=64)]
    password: Annotated[Text, Field(max_length=256)]


class MeOut(Out):
    """The signed-in account."""

    id: int
    name: str
    role: Role
    kind: AnnotatorKind


class SessionOut(Out):
    """Answer to a sign-in; the cookie comes with it."""

    annotator: MeOut


class OwnPassword(In):
    """A new password for the own account, and the one it has."""

    current: Annotated[Text, Field(max_length=256)]
    password: Password


class AnnotatorCreate(In):
    """A new account; without a password it can only use tokens."""

    name: ShortText
    role: RoleIn
    kind: KindIn = AnnotatorKind.PERSON
    password: Password | None = None


class AnnotatorPatch(In):
    """What to change; null or absent means leave it."""

    active: bool | None = None
    password: Password | None = None
    role: RoleIn | None = None


class AnnotatorOut(Out):
    """An account with its number of labels in force."""

    id: int
    name: str
    role: Role
    kind: AnnotatorKind
    active: bool
    created_at: datetime
    labels: int


class TokenCreate(In):
    """A new token; `annotator_id` defaults to the own account."""

    annotator_id: Id | None = None
    name: ShortText
    days: Annotated[float, Field(gt=0, le=3650)] = 90.0


class TokenIssued(Out):
    """The only time that the token itself is shown."""

    id: int
    token: str
    expires_at: datetime


class TokenOut(Out):
    """A token without its secret."""

    id: int
    annotator_id: int
    name: str
    created_at: datetime
    expires_at: datetime
    last_used_at: datetime | None
    revoked_at: datetime | None
