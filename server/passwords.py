"""Password hashes (argon2) and random secrets."""

from __future__ import annotations

import hashlib
import secrets
from functools import cache

from pwdlib import PasswordHash
from pwdlib.exceptions import UnknownHashError
from pwdlib.hashers.argon2 import Argon2Hasher

TOKEN_PREFIX = "rdf_"
_SECRET_BYTES = 32  # 256 bit


@cache
def _hasher(cheap: bool) -> PasswordHash:
    if cheap:  # tests: 8 KiB and one pass instead of 64 MiB and three
        return PasswordHash((Argon2Hasher(time_cost=1, memory_cost=8, parallelism=1),))
    return PasswordHash((Argon2Hasher(),))


def hash_password(password: str, *, cheap: bool = False) -> str:
    """Argon2id hash with its own salt and parameters."""
    return _hasher(cheap).hash(password)


@cache
def _nobody(cheap: bool) -> str:
    return hash_password(secrets.token_urlsafe(), cheap=cheap)


def verify_password(password: str, stored: str | None, *, cheap: bool = False) -> bool:
    """Whether the password fits. Takes as long when there is no account (`stored` is None)."""
    try:
        fits = _hasher(cheap).verify(password, stored or _nobody(cheap))
    except UnknownHashError:
        return False
    return fits and stored is not None


def new_secret() -> str:
    """256 random bits as URL-safe text."""
    return secrets.token_urlsafe(_SECRET_BYTES)


def new_token() -> str:
    """A bearer token for scripts."""
    return TOKEN_PREFIX + new_secret()


def digest(secret: str) -> str:
    """What SQL keeps of a cookie or token. They have 256 random bits, so a fast hash is enough."""
    return hashlib.sha256(secret.encode()).hexdigest()
