"""Server-sent events over a real HTTP server: delivered, resumed, ended."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import httpx2
import pytest

from server import rounds
from server.rounds import RoundRequest
from server.states import RoundState
from server.store.events import add_event
from server.store.tables import Pair
from tests import factories
from tests.factories import NOW
from tests.server.postgres import PostgresMaker
from tests.server.serving import Message, read_events, serving
from tests.server.world import World, make_world


@pytest.fixture
def address(world: World) -> Iterator[str]:
    with serving(world.app) as url:
        yield f"{url}/api/v1"


@pytest.fixture
def round_id(world: World) -> int:
    campaign_id, (pair_id,) = world.add_campaign(pairs=1)
    with world.database.write() as session:
        factories.add_label(session, session.get_one(Pair, pair_id), world.ids["ann"])
        return rounds.launch(session, NOW, campaign_id, RoundRequest()).id


def _stream(world: World, url: str, *, after: int | None = None) -> httpx2.Client:
    headers = {"Authorization": f"Bearer {world.tokens['sam']}"}
    if after is not None:
        headers["Last-Event-ID"] = str(after)
    return httpx2.Client(base_url=url, headers=headers, timeout=30)


def _curve(world: World, round_id: int, step: int) -> None:
    with world.database.write() as session:
        data = {"stage": "score", "step": step, "loss": 0.5}
        add_event(session, NOW, campaign_id=1, round_id=round_id, kind="curve", data=data)


def _finish(world: World, round_id: int) -> None:
    with world.database.write() as session:
        for state in ("finetuning", "evaluating", "gating", "kept"):
            rounds.move(session, NOW, round_id, RoundState(state))


def _brief(messages: list[Message]) -> list[tuple[str, object]]:
    return [(m.event, m.data.get("state", m.data.get("step"))) for m in messages]


def test_a_follower_sees_what_happens_and_the_stream_ends_with_the_round(
    world: World, address: str, round_id: int
) -> None:
    with (
        _stream(world, address) as client,
        client.stream("GET", f"/rounds/{round_id}/events") as response,
    ):
        assert response.headers["content-type"].startswith("text/event-stream")
        messages = read_events(response)
        first = next(messages)
        assert (first.event, first.data["state"]) == ("state", "queued")
        assert first.data["at"] == "2026-11-22T12:00:00+00:00"
        _curve(world, round_id, 0)  # while the stream is open
        assert _brief([next(messages)]) == [("curve", 0)]
        _finish(world, round_id)
        rest = list(messages)  # ends by itself
    assert _brief(rest) == [("state", s) for s in ("finetuning", "evaluating", "gating", "kept")]


def test_a_follower_who_comes_back_misses_nothing_and_sees_nothing_twice(
    world: World, address: str, round_id: int
) -> None:
    for step in range(3):
        _curve(world, round_id, step)
    with (
        _stream(world, address) as client,
        client.stream("GET", f"/rounds/{round_id}/events") as response,
    ):
        seen = list(islice(read_events(response), 3))
    _curve(world, round_id, 3)
    _finish(world, round_id)
    with (
        _stream(world, address, after=seen[-1].id) as client,
        client.stream("GET", f"/rounds/{round_id}/events") as response,
    ):
        rest = list(read_events(response))
    assert _brief(seen) == [("state", "queued"), ("curve", 0), ("curve", 1)]
    assert _brief(rest)[:2] == [("curve", 2), ("curve", 3)]
    assert _brief(rest)[-1] == ("state", "kept")
    ids = [message.id for message in seen + rest]
    assert ids == sorted(set(ids))


def _url_of(address: str, round_id: int, after: object) -> str:
    return f"{address}/rounds/{round_id}/events?after={after}"


def test_a_follower_from_now_on_is_not_told_the_history(
    world: World, address: str, round_id: int
) -> None:
    for step in range(3):
        _curve(world, round_id, step)
    with (
        _stream(world, address) as client,
        client.stream("GET", _url_of(address, round_id, "now")) as response,
    ):
        lines = response.iter_lines()
        opening = list(islice(lines, 3))  # sent at once, so what follows is not missed
        _curve(world, round_id, 3)
        _finish(world, round_id)
        rest = [line for line in lines if line.startswith("data: ") and '"step"' in line]
    assert opening[0] == "retry: 1000" and opening[2] == ""
    newest = int(opening[1].removeprefix("id: "))
    assert [json.loads(line.removeprefix("data: "))["step"] for line in rest] == [3]
    for after, header in ((newest, None), ("now", newest), (0, newest)):
        with (
            _stream(world, address, after=header) as client,
            client.stream("GET", _url_of(address, round_id, after)) as response,
        ):
            assert _brief(list(read_events(response)))[0] == ("curve", 3)


def test_a_campaign_tells_everything_of_its_own_and_nothing_else(
    world: World, address: str, round_id: int
) -> None:
    other_id, (pair_id,) = world.add_campaign(pairs=1)
    with world.database.write() as session:
        add_event(session, NOW, campaign_id=other_id, kind="job", data={"progress": 0.5})
        session.flush()
        add_event(session, NOW, campaign_id=1, kind="job", data={"progress": 0.7})
    del pair_id, round_id
    with (
        _stream(world, address) as client,
        client.stream("GET", "/campaigns/1/events") as response,
    ):
        found = list(islice(read_events(response), 2))
    assert [message.event for message in found] == ["state", "progress"]
    assert found[1].data["progress"] == 0.7


def test_long_histories_come_complete(world: World, address: str, round_id: int) -> None:
    with world.database.write() as session:
        for step in range(450):  # more than one query brings
            data = {"step": step}
            add_event(session, NOW, campaign_id=1, round_id=round_id, kind="curve", data=data)
            session.flush()
    _finish(world, round_id)
    with (
        _stream(world, address) as client,
        client.stream("GET", f"/rounds/{round_id}/events") as response,
    ):
        messages = list(read_events(response))
    assert [m.data["step"] for m in messages if m.event == "curve"] == list(range(450))


def test_an_event_that_is_committed_late_is_not_missed(
    postgres: PostgresMaker, postgres_migrated: str, tmp_path: Path
) -> None:
    """On PostgreSQL a smaller id can become visible after a larger one."""
    postgres.empty(postgres_migrated)
    with make_world(postgres.address(postgres_migrated), tmp_path) as world:
        world.add_campaign()
        slow = world.database.write()
        session = slow.__enter__()
        add_event(session, NOW, campaign_id=1, kind="job", data={"id": "small"})
        session.flush()
        with world.database.write() as fast:
            add_event(fast, NOW, campaign_id=1, kind="job", data={"id": "large"})
        with (
            serving(world.app) as url,
            _stream(world, f"{url}/api/v1") as client,
            client.stream("GET", "/campaigns/1/events") as response,
        ):
            messages = read_events(response)
            first = next(messages)
            slow.__exit__(None, None, None)
            second = next(messages)
    assert [first.data["id"], second.data["id"]] == ["large", "small"]
    assert second.id == first.id  # to resume after the larger one


def test_unknown_rounds_and_annotators_get_an_answer_and_no_stream(
    world: World, address: str, round_id: int
) -> None:
    with _stream(world, address) as client:
        assert client.get("/rounds/99/events").status_code == 404
        assert client.get("/campaigns/99/events").status_code == 404
        ann = {"Authorization": f"Bearer {world.tokens['ann']}"}
        assert client.get(f"/rounds/{round_id}/events", headers=ann).status_code == 403
        assert client.get(f"/rounds/{round_id}/events?after=then").status_code == 422
        odd = {"Last-Event-ID": "yesterday"}
        assert client.get(f"/rounds/{round_id}/events", headers=odd).status_code == 422
