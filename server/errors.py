"""Errors of the service, below RodifError.

RodifError
├── NotFoundError            no such row, or not visible to this account
├── NotSignedInError         no, unknown, expired or revoked credentials
├── NotAllowedError          signed in, but the role or the owner does not fit
├── ConflictError            the request contradicts the state of the system
├── ThrottledError           too many failed sign-ins
├── LeaseLostError           a job step whose claim has passed to somebody else
├── ArtifactError            a stored file that is missing or damaged
└── DatabaseVersionError     a database that is not at the newest migration
"""

from __future__ import annotations

from rodif_core.errors import RodifError


class NotFoundError(RodifError):
    """No such row; `what` is the noun, `key` the value that was asked for."""

    def __init__(self, what: str, key: object) -> None:
        super().__init__(f"no {what} {key!r}")


class NotSignedInError(RodifError):
    """No, unknown, expired or revoked credentials."""


class NotAllowedError(RodifError):
    """Signed in, but the role or the owner does not fit."""


class ConflictError(RodifError):
    """The request contradicts the state of the system; the message names both."""


class ThrottledError(RodifError):
    """Too many failed sign-ins; try again after `retry_after` seconds."""

    def __init__(self, message: str, retry_after: int) -> None:
        self.retry_after = retry_after
        super().__init__(message)


class LeaseLostError(RodifError):
    """The claim of a job has run out or passed on: roll back, somebody else works on it."""


class ArtifactError(RodifError):
    """A stored file that is missing, or whose content does not have the hash in its name."""


class DatabaseVersionError(RodifError):
    """The database is not at the newest migration; the message says what to run."""
