"""Make a state folder or a database ready to run: tables, admin account, shipped policies.

Everything here can be done again without harm. Reading a checkpoint needs torch, which must not
live in a process that starts others for days, so a child process does that.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.exc import ArgumentError, OperationalError

from rodif_core.errors import RodifError
from rodif_core.shipped import shipped_checkpoint, shipped_tasks
from rodif_core.spec import TaskName
from server.bootstrap import ensure_admin, register_checkpoint
from server.campaigns import create_campaign
from server.schemas.campaigns import CampaignSettings
from server.settings import Settings
from server.store.artifacts import ArtifactStore
from server.store.migrate import upgrade
from server.store.session import Database
from server.store.tables import Annotator, Campaign, Checkpoint
from worker.workbench import utc_now

ADMIN = "admin"


@dataclass(frozen=True)
class Prepared:
    """What `prepare` found or made."""

    admin: str
    password: str | None  # shown once: set when it was set now
    campaigns: int
    active: bool = True  # whether the admin account can sign in


def prepare(
    settings: Settings,
    *,
    admin_password: str | None = None,
    first_campaign: TaskName = TaskName.AVOID,
) -> Prepared:
    """Bring the database to head; ensure admin account, shipped checkpoints, a first campaign.

    `admin_password` None keeps the present password, or makes a random one for a new account.
    Where there is no campaign yet, one on the task `first_campaign` is made, named like it.
    Raises RodifError for a database that cannot be used.
    """
    try:
        upgrade(settings.database_url)
    except (ArgumentError, OperationalError) as error:
        # The URL is not told: it may hold a password.
        reason = getattr(error, "orig", None) or error
        raise RodifError(
            f"the database of RODIF_DATABASE_URL cannot be used: {reason}; legal are"
            " sqlite:///FILE and postgresql+psycopg://USER:PASSWORD@HOST/NAME"
        ) from error
    database = Database(settings.database_url)
    try:
        with database.write() as session:
            password = ensure_admin(
                session, utc_now(), ADMIN, admin_password, cheap=settings.argon2_cheap
            )
            active = session.scalars(select(Annotator.active).where(Annotator.name == ADMIN)).one()
        register_shipped(settings, database)
        return Prepared(ADMIN, password, _ensure_campaign(database, first_campaign), active)
    finally:
        database.dispose()


def register_shipped(settings: Settings, database: Database) -> None:
    """Make the shipped checkpoints known to the database; those that it has stay as they are."""
    assert settings.artifact_dir is not None
    store = ArtifactStore(settings.artifact_dir)
    blobs = {task: shipped_checkpoint(task) for task in shipped_tasks()}
    hashes = {task: hashlib.sha256(blob).hexdigest() for task, blob in blobs.items()}
    with database.read() as session:
        known = set(session.scalars(select(Checkpoint.artifact_sha256)))
    missing = [
        task for task, sha256 in hashes.items() if sha256 not in known or not store.exists(sha256)
    ]
    if not missing:
        return
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        facts = list(pool.map(checkpoint_facts, [blobs[task] for task in missing]))
    for task, found in zip(missing, facts, strict=True):
        store.put(blobs[task])
        with database.write() as session:
            register_checkpoint(
                session,
                utc_now(),
                store,
                task=task.value,
                name=f"{task}-pretrained-{found['digest'][:8]}",
                blob=blobs[task],
                code_version=importlib.metadata.version("rodif-studio"),
                **found,
            )


def checkpoint_facts(blob: bytes) -> dict[str, Any]:
    """Digest, configuration and measurements of a checkpoint file; imports torch and mujoco."""
    from rodif_core.policies.checkpoint import load_checkpoint
    from rodif_core.tasks import get_task

    checkpoint = load_checkpoint(blob)
    task = get_task(checkpoint.task)
    task_facts = {
        "modes": list(task.modes),
        "groups": list(task.groups),
        "preferred_group": task.preferred_group,
        "criterion": task.criterion,
        "scene": task.scene_shapes(),
        "control_dt": task.control_dt,
        "max_steps": task.max_steps,
    }
    return {
        "digest": checkpoint.digest,
        "config": checkpoint.policy.config.to_json() | {"task_facts": task_facts},
        "metrics": checkpoint.card,
    }


def _ensure_campaign(database: Database, task: TaskName) -> int:
    """A first campaign on that task when there is none; returns how many there are."""
    with database.write() as session:
        present = len(session.scalars(select(Campaign.id)).all())
        if present:
            return present
        admin = session.scalars(select(Annotator).where(Annotator.name == ADMIN)).one()
        create_campaign(
            session,
            utc_now(),
            name=task.value,
            task=task,
            criterion=None,
            start_checkpoint_id=None,
            settings=CampaignSettings().model_dump(mode="json"),
            by=admin.id,
        )
        return 1
