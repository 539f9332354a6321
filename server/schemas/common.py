"""Building blocks of the wire format."""

from __future__ import annotations

import math
from typing import Annotated, Any, Generic, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints

MAX_ID = 2**31 - 1  # the integer columns of PostgreSQL
MAX_SEED = 2**62 - 1
MAX_DEPTH = 8  # of free JSON


def _storable(text: str) -> str:
    if "\x00" in text:
        raise ValueError("text must not contain NUL characters")
    text.encode()  # JSON can spell half a surrogate pair; UnicodeEncodeError is a ValueError
    return text


def _storable_json(value: Any, depth: int = 0) -> Any:
    """PostgreSQL knows neither NaN nor Infinity; and nothing of ours is nested deeply."""
    if depth > MAX_DEPTH:
        raise ValueError(f"nested more than {MAX_DEPTH} levels deep")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{value} is not a finite number")
    if isinstance(value, str):
        _storable(value)
    for item in value if isinstance(value, list) else ():
        _storable_json(item, depth + 1)
    for key, item in value.items() if isinstance(value, dict) else ():
        _storable(key)
        _storable_json(item, depth + 1)
    return value


Text = Annotated[str, AfterValidator(_storable)]
JsonItem = Annotated[Any, AfterValidator(_storable_json)]
ShortText = Annotated[str, Field(min_length=1, max_length=64), AfterValidator(_storable)]
Name = Annotated[str, Field(min_length=1, max_length=128), AfterValidator(_storable)]
LongText = Annotated[str, Field(max_length=10_000), AfterValidator(_storable)]
# What annotators read: white space around it says nothing, and forms add and take it away.
Criterion = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=10_000),
    AfterValidator(_storable),
]
Id = Annotated[int, Field(ge=1, le=MAX_ID)]


class In(BaseModel):
    """A request body: exact JSON types, no unknown fields."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class Out(BaseModel):
    """A response body, readable from rows."""

    model_config = ConfigDict(from_attributes=True)


ItemT = TypeVar("ItemT")


class Page(BaseModel, Generic[ItemT]):
    """One page of a long list; ask again with `cursor=next_cursor` until it is null."""

    items: list[ItemT]
    next_cursor: int | None


class Problem(BaseModel):
    """An error (RFC 9457)."""

    type: str
    title: str
    status: int
    detail: str
    errors: list[dict[str, Any]] | None = None
