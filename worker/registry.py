"""Checkpoint files that somebody trained become policies that campaigns can start from."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import select
from sqlalchemy.engine import make_url

from rodif_core.errors import CheckpointFileError, ValueOutOfRangeError
from rodif_core.fit import check_fit
from rodif_core.policies.checkpoint import load_checkpoint
from server.bootstrap import register_checkpoint
from server.errors import DatabaseVersionError
from server.settings import Settings
from server.store.artifacts import ArtifactStore
from server.store.events import audit
from server.store.migrate import check_at_head
from server.store.session import Database
from server.store.tables import Checkpoint
from worker.prepare import checkpoint_facts
from worker.workbench import utc_now

MAX_NAME = 128  # characters, as the column has


@dataclass(frozen=True)
class Registered:
    """A checkpoint of the database; `added` is False when it had been there already."""

    id: int
    name: str
    task: str
    digest: str
    added: bool


def add_checkpoint(settings: Settings, file: Path, name: str | None = None) -> Registered:
    """Register a checkpoint file in the database of `settings`, also while the system runs.

    The same policy a second time is no change, whatever its name. Without a name it is called
    after the file and its digest. Raises CheckpointFileError for a file that is no checkpoint or
    whose policy does not fit its task, ConflictError for a name of another policy,
    ValueOutOfRangeError for a name of no or too many letters, and DatabaseVersionError where there
    is no database of this version.
    """
    try:
        blob = file.read_bytes()
    except OSError as error:
        raise CheckpointFileError(f"cannot read {file}: {error.strerror}") from error
    facts = _facts(blob, file)
    name = f"{file.stem}-{facts['digest'][:8]}" if name is None else name
    if not 1 <= len(name) <= MAX_NAME:
        raise ValueOutOfRangeError("name", name, f"1 … {MAX_NAME} characters")
    _check_database(settings)
    database = Database(settings.database_url)
    try:
        return _add(settings, database, blob, name, facts)
    finally:
        database.dispose()


def _facts(blob: bytes, file: Path) -> dict[str, Any]:
    """What the database keeps of a file; raises CheckpointFileError."""
    try:
        checkpoint = load_checkpoint(blob)
        check_fit(checkpoint)
        json.dumps(checkpoint.card, allow_nan=False)
    except CheckpointFileError as error:
        raise CheckpointFileError(f"{file}: {error}") from error
    except ValueError as error:
        # Neither PostgreSQL nor the pages can read it.
        raise CheckpointFileError(f"{file}: its card has a number that is none: {error}") from error
    if not isinstance(checkpoint.card, dict):
        raise CheckpointFileError(f"{file}: its card is {checkpoint.card!r}, not an object")
    return {"task": checkpoint.task.value} | checkpoint_facts(blob)


def _check_database(settings: Settings) -> None:
    """Before anything opens it: SQLite makes a new file where there is none."""
    place = make_url(settings.database_url)
    if place.get_backend_name() == "sqlite" and not Path(str(place.database)).is_file():
        raise DatabaseVersionError(
            f"there is no database {place.database}; name the state folder of a system with"
            " --state, or make one with `rodif up` or `rodif migrate`"
        )
    check_at_head(settings.database_url)


def _add(
    settings: Settings, database: Database, blob: bytes, name: str, facts: dict[str, Any]
) -> Registered:
    assert settings.artifact_dir is not None
    store, digest = ArtifactStore(settings.artifact_dir), facts["digest"]
    same = select(Checkpoint).where(Checkpoint.digest == digest).order_by(Checkpoint.id)
    with database.write() as session:
        row = session.scalars(same).first()
        added = row is None
        if row is None:
            row = register_checkpoint(
                session,
                utc_now(),
                store,
                name=name,
                blob=blob,
                code_version=importlib.metadata.version("rodif-studio"),
                **facts,
            )
            subject, details = f"checkpoint/{row.id}", {"name": name, "digest": digest}
            audit(
                session,
                utc_now(),
                actor_id=None,
                action="checkpoint.add",
                subject=subject,
                details=details,
            )
        elif row.artifact_sha256 == hashlib.sha256(blob).hexdigest():
            store.put(blob)  # no change, unless the stored file was lost
        return Registered(row.id, row.name, row.task, digest, added)
