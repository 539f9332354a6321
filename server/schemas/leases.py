"""Leases that are given back."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field

from server.schemas.common import In, Out
from server.states import ReleaseReason


class ReleaseIn(In):
    """Why the pair is not judged."""

    reason: Annotated[ReleaseReason, Field(strict=False)]


class LeaseOut(Out):
    """A lease after it was given back."""

    id: int
    pair_id: int
    closed_at: datetime


class ReleaseOut(Out):
    """One pair that somebody gave back, and why."""

    id: int
    pair_id: int
    lease_id: int
    annotator_id: int
    reason: ReleaseReason
    at: datetime
