"""The web application: `create_app` wires settings, database, queue and endpoints together."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime

from fastapi import FastAPI

from server.api import errors, health
from server.api.services import Services
from server.queue import SendJob, make_sender
from server.settings import Settings
from server.store.artifacts import ArtifactStore
from server.store.migrate import check_at_head
from server.store.session import Database

API_PREFIX = "/api/v1"


def _utc_now() -> datetime:
    return datetime.now(UTC)


def create_app(
    settings: Settings | None = None,
    send_job: SendJob | None = None,
    clock: Callable[[], datetime] | None = None,
) -> FastAPI:
    """Make the application. Defaults: settings from the environment, Celery, the system clock.

    Start-up raises DatabaseVersionError when the database is not at the newest migration.
    """
    settings = settings or Settings()
    assert settings.artifact_dir is not None
    database = Database(settings.database_url, send_job or make_sender(settings.broker_url))

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        check_at_head(settings.database_url)
        yield
        database.dispose()

    app = FastAPI(title="RoDiF Studio", version="0.1.0", lifespan=lifespan)
    app.state.services = Services(
        settings=settings,
        database=database,
        artifacts=ArtifactStore(settings.artifact_dir),
        clock=clock or _utc_now,
    )
    errors.install(app)
    app.include_router(health.router, prefix=API_PREFIX)
    return app
