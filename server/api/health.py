"""Signs of life: `/health` of this process, `/ready` of the whole system."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse
from sqlalchemy.exc import SQLAlchemyError

from server.api.services import Services, services_of
from server.errors import DatabaseVersionError
from server.queue import JOB_QUEUES, ping_broker
from server.store.beats import BEAT, last_beat, last_beats_by_queue
from server.store.migrate import check_at_head

router = APIRouter(tags=["health"])


@router.get("/health")
def health() -> dict[str, str]:
    """This process answers."""
    return {"status": "ok"}


@router.get("/ready", responses={503: {"description": "some part is not ready"}})
def ready(request: Request) -> JSONResponse:
    """Whether database, broker, a worker for each queue and beat work; 503 names what does not."""
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
    """Signs of life: of a worker for each queue of jobs, and of the beat.

    The beat's is written by a tick that goes through the queue, so it speaks for the tick worker
    as well.
    """
    with services.database.read() as session:
        by_queue = last_beats_by_queue(session)
        beat = last_beat(session, BEAT)
    silent = {queue: _silence(services, by_queue.get(queue)) for queue in JOB_QUEUES}
    missing = [f"no worker for queue {queue!r}: {why}" for queue, why in silent.items() if why]
    return {"worker": "; ".join(missing) or "ok", "beat": _silence(services, beat) or "ok"}


def _silence(services: Services, at: datetime | None) -> str | None:
    """What is wrong with the last sign of life, or None."""
    patience = timedelta(seconds=max(30.0, 4 * services.settings.resend_seconds))
    if at is None:
        return "no sign of life yet"
    return f"last sign of life at {at.isoformat()}" if services.clock() - at > patience else None
