"""Server-sent events: progress of rounds and campaigns, resumable by Last-Event-ID."""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any, Literal

from fastapi import APIRouter, Request
from fastapi.responses import StreamingResponse
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from server.api.access import ReadSession, Staff, UseServices
from server.api.params import EventsAfter, LastEventId, PathId
from server.campaigns import get_campaign
from server.errors import NotFoundError
from server.rounds import FINAL_STATES
from server.store.events import STREAM_NAMES, events_after, newest_event_id
from server.store.tables import Event, Round

router = APIRouter(tags=["events"])

POLL_SECONDS = 0.5
KEEP_ALIVE_SECONDS = 15.0  # a comment now and then, so that proxies keep the connection
MAX_STREAM_SECONDS = 600.0  # then the browser reconnects and shows its cookie again
# On PostgreSQL a smaller id can be committed after a larger one; look back this far for it.
LOOK_BACK = 50

Fetch = Callable[[int], tuple[Sequence[Event], bool]]
_STREAM: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/event-stream": {}}, "description": "server-sent events"}
}


@router.get("/rounds/{round_id}/events", response_class=StreamingResponse, responses=_STREAM)
def round_events(
    round_id: PathId,
    request: Request,
    _me: Staff,
    session: ReadSession,
    services: UseServices,
    after: EventsAfter = 0,
    last_event_id: LastEventId = None,
) -> StreamingResponse:
    """progress | curve | state events of one round; ends after its final state."""
    if session.get(Round, round_id) is None:
        raise NotFoundError("round", round_id)
    start = _start(session, after, last_event_id)

    def fetch(after: int) -> tuple[Sequence[Event], bool]:
        with services.database.read() as own:
            # The state first: the event of the final state is committed together with it.
            ended = own.get_one(Round, round_id).state in FINAL_STATES
            return events_after(own, after, round_id=round_id), ended

    return _answer(request, fetch, start)


@router.get("/campaigns/{campaign_id}/events", response_class=StreamingResponse, responses=_STREAM)
def campaign_events(
    campaign_id: PathId,
    request: Request,
    _me: Staff,
    session: ReadSession,
    services: UseServices,
    after: EventsAfter = 0,
    last_event_id: LastEventId = None,
) -> StreamingResponse:
    """All events of a campaign: progress | curve | state | label | publication."""
    get_campaign(session, campaign_id)
    start = _start(session, after, last_event_id)

    def fetch(after: int) -> tuple[Sequence[Event], bool]:
        with services.database.read() as own:
            return events_after(own, after, campaign_id=campaign_id), False

    return _answer(request, fetch, start)


def _start(session: Session, after: int | Literal["now"], last_event_id: int | None) -> int:
    """The id after which the stream begins: a browser that reconnects says what it has."""
    if last_event_id is not None:
        return last_event_id
    return newest_event_id(session) if after == "now" else after


def _answer(request: Request, fetch: Fetch, start: int) -> StreamingResponse:
    return StreamingResponse(
        _stream(request, fetch, start),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


async def _stream(request: Request, fetch: Fetch, last_id: int) -> AsyncIterator[str]:
    """Poll the database; it is what all processes share, and one query per client is cheap."""
    clock = asyncio.get_running_loop().time
    opened = spoken = clock()
    first_id = last_id
    sent: deque[int] = deque(maxlen=4 * LOOK_BACK)
    # The id lets a browser resume here, too, when the connection breaks before the first event.
    yield f"retry: 1000\nid: {last_id}\n\n"
    while clock() - opened < MAX_STREAM_SECONDS and not await request.is_disconnected():
        events, ended = await run_in_threadpool(fetch, max(first_id, last_id - LOOK_BACK))
        fresh = [event for event in events if event.id not in sent]
        for event in fresh:
            last_id = max(last_id, event.id)
            sent.append(event.id)
            yield _message(event, last_id)
        if fresh:
            spoken = clock()
            continue
        if ended:
            return
        if clock() - spoken > KEEP_ALIVE_SECONDS:
            spoken = clock()
            yield ": still here\n\n"
        await asyncio.sleep(POLL_SECONDS)


def _message(event: Event, last_id: int) -> str:
    data = json.dumps(event.data | {"at": event.at.isoformat()}, separators=(",", ":"))
    return f"id: {last_id}\nevent: {STREAM_NAMES[event.kind]}\ndata: {data}\n\n"
