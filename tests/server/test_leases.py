"""A leased pair can be given back: others get it, and the reason is on record."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import select

from server.handout import GIVEN_BACK_FOR
from server.store.tables import Event, Label
from tests.server.threads import at_once
from tests.server.world import World


def _next(world: World, name: str, campaign_id: int, **body: Any) -> Any:
    return world.client(name).post(f"/campaigns/{campaign_id}/next", json=body)


def _release(world: World, name: str, lease_id: int, reason: str = "replay_failed") -> Any:
    return world.client(name).post(f"/leases/{lease_id}/release", json={"reason": reason})


def _label(world: World, name: str, handed: dict[str, Any], key: str = "k") -> Any:
    body = {"pair_id": handed["pair"]["id"], "lease_id": handed["lease_id"], "choice": "left"}
    headers = {"Idempotency-Key": key}
    return world.client(name).post("/labels", json=body | {"ui_version": "t"}, headers=headers)


def test_a_pair_given_back_goes_to_others_and_not_straight_back(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=2)
    first = _next(world, "ann", campaign_id).json()
    answer = _release(world, "ann", first["lease_id"])
    assert answer.status_code == 200
    assert answer.json() == {"id": 1, "pair_id": pair_ids[0], "closed_at": "2026-11-22T12:00:00Z"}
    second = _next(world, "ann", campaign_id).json()
    assert second["pair"]["id"] == pair_ids[1]
    assert second["progress"] == {"done": 0, "remaining": 1}
    assert _next(world, "bob", campaign_id).json()["pair"]["id"] == pair_ids[0]


def test_the_last_pair_given_back_leaves_nothing_until_the_next_day(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    _release(world, "ann", _next(world, "ann", campaign_id).json()["lease_id"])
    nothing = _next(world, "ann", campaign_id)
    assert (nothing.status_code, nothing.headers["x-reason"]) == (204, "all_done")
    world.clock.advance(seconds=GIVEN_BACK_FOR.total_seconds())
    assert _next(world, "ann", campaign_id).status_code == 200


def test_giving_back_twice_notes_it_once_even_at_once(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    lease_id = _next(world, "ann", campaign_id).json()["lease_id"]
    answers = at_once([lambda: _release(world, "ann", lease_id)] * 4)
    assert {answer.status_code for answer in answers} == {200}
    world.clock.advance(minutes=1)
    assert _release(world, "ann", lease_id, "skipped").json() == answers[0].json()
    with world.database.read() as session:
        (event,) = session.scalars(select(Event))
    assert event.kind == "release"
    ann = world.ids["ann"]
    assert event.data == {
        "lease_id": lease_id,
        "pair_id": 1,
        "annotator_id": ann,
        "reason": "replay_failed",
    }


def test_only_the_holder_gives_a_lease_back_and_only_without_a_label(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=2)
    handed = _next(world, "ann", campaign_id).json()
    for name in ("bob", "ada"):  # not even an admin
        assert _release(world, name, handed["lease_id"]).status_code == 403
    assert _release(world, "ann", 99).json()["detail"] == "no lease 99"
    wrong = _release(world, "ann", handed["lease_id"], "boring")
    assert wrong.status_code == 422 and "'replay_failed' or 'skipped'" in wrong.json()["detail"]
    assert _next(world, "ann", campaign_id).json()["lease_id"] == handed["lease_id"]
    assert _label(world, "ann", handed).status_code == 201
    late = _release(world, "ann", handed["lease_id"])
    assert late.status_code == 409 and "pair 1 was labelled under it" in late.json()["detail"]


def test_a_lease_that_has_run_out_can_be_given_back(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=2)
    lease_id = _next(world, "ann", campaign_id).json()["lease_id"]
    world.clock.advance(minutes=11)
    assert _release(world, "ann", lease_id).status_code == 200
    assert _next(world, "ann", campaign_id).json()["pair"]["id"] == pair_ids[1]


def test_a_label_for_a_pair_that_was_given_back_is_kept_and_marked_late(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    handed = _next(world, "ann", campaign_id).json()
    _release(world, "ann", handed["lease_id"])
    answer = _label(world, "ann", handed)
    assert answer.status_code == 201 and answer.json()["late"] is True


def test_a_pair_taken_back_and_left_alone_is_not_taken_for_given_back(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    _label(world, "ann", _next(world, "ann", campaign_id).json())
    world.client("ann").post("/labels/1/undo", headers={"Idempotency-Key": "u"})
    world.clock.advance(minutes=11)
    assert _next(world, "ann", campaign_id).status_code == 200


@pytest.mark.parametrize("reader", ["ada", "sam"])
def test_staff_reads_what_was_given_back_and_counts_broken_replays(
    world: World, reader: str
) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=3, labels_per_pair=2)
    other_id, _ = world.add_campaign(pairs=1)
    _release(world, "ann", _next(world, "ann", other_id).json()["lease_id"])
    given = [_next(world, name, campaign_id).json() for name in ("ann", "bob")]
    _release(world, "ann", given[0]["lease_id"])
    _release(world, "bob", given[1]["lease_id"], "skipped")
    path = f"/campaigns/{campaign_id}"
    first = world.client(reader).get(f"{path}/releases?limit=1").json()
    (newest,) = first["items"]
    assert (newest["annotator_id"], newest["reason"]) == (world.ids["bob"], "skipped")
    older = world.client(reader).get(f"{path}/releases?cursor={first['next_cursor']}").json()
    assert older == {
        "items": [
            {
                "id": 2,
                "pair_id": pair_ids[0],
                "lease_id": given[0]["lease_id"],
                "annotator_id": world.ids["ann"],
                "reason": "replay_failed",
                "at": "2026-11-22T12:00:00Z",
            }
        ],
        "next_cursor": None,
    }
    assert world.client(reader).get(f"{path}/stats").json()["pairs"]["reported"] == 1
    with world.database.read() as session:
        assert session.scalars(select(Label)).all() == []
    shown = _next(world, "bob", campaign_id).json()  # he sees it well
    while shown["pair"]["id"] != pair_ids[0]:
        _label(world, "bob", shown, key=str(shown["lease_id"]))
        shown = _next(world, "bob", campaign_id).json()
    _label(world, "bob", shown, key="last")
    assert world.client(reader).get(f"{path}/stats").json()["pairs"]["reported"] == 0
