"""What a job works with: settings, database, artifacts, and who and when it is."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from server.queue import SendJob
from server.settings import Settings
from server.store.artifacts import ArtifactStore
from server.store.session import Database


def utc_now() -> datetime:
    """The clock of the running system."""
    return datetime.now(UTC)


@dataclass(frozen=True)
class Workbench:
    """Made once per process, after the fork; tests pass their own clock, sender and owner."""

    settings: Settings
    database: Database
    artifacts: ArtifactStore
    owner: str  # differs between processes; stands in `job.owner`
    clock: Callable[[], datetime] = utc_now

    @classmethod
    def of(cls, settings: Settings, send_job: SendJob | None) -> Workbench:
        """The workbench of this process."""
        assert settings.artifact_dir is not None
        return cls(
            settings,
            Database(settings.database_url, send_job),
            ArtifactStore(settings.artifact_dir),
            owner=f"{socket.gethostname()}:{os.getpid()}",
        )

    def scratch(self, name: str) -> Path:
        """A folder for partial results that survives the death of the process."""
        return self.settings.state_dir / "work" / name
