"""Signs of life: `/health` of this process, `/ready` of the whole system."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse
from sqlalchemy.exc import SQLAlchemyError

from server.api.services import Services, services_of
from server.errors import DatabaseVersionError
from server.queue import ping_broker
from server.store.beats import BEAT, WORKER, last_beat
from server.store.migrate import check_at_head

router = APIRouter(tags=["health"])


@router.get("/health")
def health() -> dict[str, str]:
    """This process answers."""
    return {"status": "ok"}


@router.get("/ready", responses={503: {"description": "some part is not ready"}})
def ready(request: Request) -> JSONResponse:
    """Whether database, broker, worker and beat all work; 503 names the one that does not."""
    services = services_of(request)
    checks = {"database": _database(services), "broker": _broker(services)}
    if checks["database"] == "ok":
        checks |= _processes(services)
    is_ready = all(value == "ok" for value in checks.values())
    body: dict[str, Any] = {"status": "ready" if is_ready else "not ready", "checks": checks}
    return JSONResponse(body, status_code=200 if is_ready else 503)


def _database(services: Services) -> str:
    try:
        check_at_head(services.settings.database_url)
    except (DatabaseVersionError, SQLAlchemyError) as error:
        return str(error)
    return "ok"


def _broker(services: Services) -> str:
    try:
        ping_broker(services.settings.broker_url)
    except OSError as error:
        return str(error)
    return "ok"


def _processes(services: Services) -> dict[str, str]:
    """Both signs of life are written by ticks that go through the queue, so they come together."""
    patience = timedelta(seconds=max(30.0, 4 * services.settings.resend_seconds))
    answers = {}
    now = services.clock()
    with services.database.read() as session:
        for name in (WORKER, BEAT):
            at = last_beat(session, name)
            if at is None:
                answers[name] = "no sign of life yet"
            elif now - at > patience:
                answers[name] = f"last sign of life at {at.isoformat()}"
            else:
                answers[name] = "ok"
    return answers
