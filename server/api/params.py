"""Parameters that many endpoints share."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import Header, Path, Query
from pydantic import Field

from server.schemas.common import MAX_ID

PathId = Annotated[int, Path(ge=1, le=MAX_ID)]
Limit = Annotated[int, Query(ge=1, le=1000, description="items on the page")]
Cursor = Annotated[
    int | None, Query(ge=0, le=MAX_ID, description="`next_cursor` of the page before")
]
IdempotencyKey = Annotated[
    str,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=64,
        pattern="^[!-~]+$",
        description="made by the client for each answer, such as a UUID",
    ),
]
ExpectedAnnotator = Annotated[
    int | None,
    Header(
        alias="X-Annotator-Id",
        ge=1,
        le=MAX_ID,
        description="the account that the sender means to act for; 401 under another one's session",
    ),
]
LastEventId = Annotated[int | None, Header(alias="Last-Event-ID", ge=0, le=MAX_ID)]
EventsAfter = Annotated[
    Annotated[int, Field(ge=0, le=MAX_ID)] | Literal["now"],
    Query(description="events after this id, or from now on; Last-Event-ID has precedence"),
]
