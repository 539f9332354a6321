"""What every endpoint may use, made once by `create_app`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta

from fastapi import Request

from server.settings import Settings
from server.store.artifacts import ArtifactStore
from server.store.session import Database


@dataclass(frozen=True)
class Services:
    """Settings, database, files and the clock (aware datetimes)."""

    settings: Settings
    database: Database
    artifacts: ArtifactStore
    clock: Callable[[], datetime]

    @property
    def lease_for(self) -> timedelta:
        """How long a pair is handed out."""
        return timedelta(seconds=self.settings.lease_seconds)


def services_of(request: Request) -> Services:
    """The services of the application that serves this request."""
    services = request.app.state.services
    assert isinstance(services, Services)
    return services
