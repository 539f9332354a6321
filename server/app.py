"""The web application: `create_app` wires settings, database, queue and endpoints together."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime

from fastapi import FastAPI

from server import pages
from server.api import (
    accounts,
    campaigns,
    errors,
    events,
    files,
    health,
    jobs,
    labels,
    leases,
    rounds,
)
from server.api.guards import CarefulBrowsers, SameOriginGuard
from server.api.services import Services
from server.queue import SendJob, make_sender
from server.schemas.common import Problem
from server.settings import Settings
from server.store.artifacts import ArtifactStore
from server.store.migrate import check_at_head
from server.store.session import Database

API_PREFIX = "/api/v1"
VERSION = "0.1.0"
MAX_BODY_BYTES = 2 * 1024 * 1024  # far above any legal request
PROBLEM_STATUSES = (400, 401, 403, 404, 409, 413, 422, 429)  # any endpoint may answer these


def _utc_now() -> datetime:
    return datetime.now(UTC)


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    services: Services = app.state.services
    check_at_head(services.settings.database_url)
    yield
    services.database.dispose()


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
    database = Database(
        settings.database_url,
        send_job or make_sender(settings.broker_url),
        connections=settings.database_connections,
    )

    app = FastAPI(
        title="RoDiF Studio",
        version=VERSION,
        lifespan=_lifespan,
        max_body_size=MAX_BODY_BYTES,
        openapi_url=f"{API_PREFIX}/openapi.json",
        docs_url=None,  # the usual pages load scripts from other hosts; docs/api.md stands in
        redoc_url=None,
        responses={code: {"model": Problem} for code in PROBLEM_STATUSES},
    )
    app.state.services = Services(
        settings=settings,
        database=database,
        artifacts=ArtifactStore(settings.artifact_dir),
        clock=clock or _utc_now,
    )
    errors.install(app)
    for module in (accounts, campaigns, labels, leases, rounds, jobs, files, events, health):
        app.include_router(module.router, prefix=API_PREFIX)
    pages.install(app)
    app.add_middleware(SameOriginGuard)
    app.add_middleware(CarefulBrowsers)
    return app
