"""A label once acknowledged is never lost, overwritten or made anonymous."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import select

from server.labeling import ScreenChoice, choice_of, side_of
from server.states import Choice
from server.store.labels import effective_label_ids
from server.store.tables import Event, Label, Lease, SimulatedTruth
from tests.server.threads import at_once
from tests.server.world import World


def _handed(world: World, name: str, campaign_id: int) -> dict[str, Any]:
    answer = world.client(name).post(f"/campaigns/{campaign_id}/next", json={})
    assert answer.status_code == 200
    found: dict[str, Any] = answer.json()
    return found


def _body(handed: dict[str, Any], choice: str = "left", **more: Any) -> dict[str, Any]:
    return {
        "pair_id": handed["pair"]["id"],
        "lease_id": handed["lease_id"],
        "choice": choice,
        "ui_version": "test",
    } | more


def _post(world: World, name: str, body: dict[str, Any], key: str = "k1") -> Any:
    return world.client(name).post("/labels", json=body, headers={"Idempotency-Key": key})


def _undo(world: World, name: str, label_id: int, key: str = "u1") -> Any:
    headers = {"Idempotency-Key": key}
    return world.client(name).post(f"/labels/{label_id}/undo", headers=headers)


def _rows(world: World) -> list[Label]:
    with world.database.read() as session:
        return list(session.scalars(select(Label).order_by(Label.id)))


@pytest.mark.parametrize("first_is_left", [True, False])
@pytest.mark.parametrize("side", list(ScreenChoice))
def test_sides_and_episodes_translate_there_and_back(
    side: ScreenChoice, first_is_left: bool
) -> None:
    choice = choice_of(side, first_is_left=first_is_left)
    assert side_of(choice, first_is_left=first_is_left) is side
    if side is ScreenChoice.LEFT:
        assert choice is (Choice.FIRST if first_is_left else Choice.SECOND)


@pytest.mark.parametrize("first_is_left", [True, False])
def test_a_label_names_the_episode_that_was_on_the_chosen_side(
    world: World, first_is_left: bool
) -> None:
    campaign_id, _ = world.add_campaign(pairs=1, first_is_left=first_is_left)
    handed = _handed(world, "ann", campaign_id)
    pair = world.client("ada").get(f"/pairs/{handed['pair']['id']}").json()
    stored = _post(
        world,
        "ann",
        _body(
            handed,
            "right",
            client_time="2026-11-22T12:00:03.5+00:00",
            duration_ms=3500,
            active_ms=3000,
            replay_events=[{"t": 0.1, "kind": "play"}],
        ),
    ).json()
    assert stored["choice"] == ("second" if first_is_left else "first")
    assert (stored["side"], stored["late"], stored["supersedes_id"]) == ("right", False, None)
    (row,) = _rows(world)
    left, right = pair["first_episode_id"], pair["second_episode_id"]
    left, right = (left, right) if first_is_left else (right, left)
    assert (row.left_episode_id, row.right_episode_id) == (left, right)
    assert row.annotator_id == world.ids["ann"] and row.source == "person"
    assert row.first_checkpoint_id == row.second_checkpoint_id == 1
    assert (row.pair_reason, row.lease_id) == ("cross_group", handed["lease_id"])
    assert (row.duration_ms, row.active_ms) == (3500, 3000)
    assert row.replay_events == [{"t": 0.1, "kind": "play"}]
    assert row.created_at == world.clock.now and row.client_time is not None


@pytest.mark.parametrize("choice", ["equal", "cannot_tell"])
def test_equal_and_cannot_tell_are_labels_too(sqlite_world: World, choice: str) -> None:
    campaign_id, _ = sqlite_world.add_campaign(pairs=1)
    body = _body(_handed(sqlite_world, "ann", campaign_id), choice)
    stored = _post(sqlite_world, "ann", body).json()
    assert (stored["choice"], stored["side"]) == (choice, choice)


def test_the_same_key_and_request_store_one_row(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    body = _body(_handed(world, "ann", campaign_id))
    first, again = _post(world, "ann", body), _post(world, "ann", body)
    assert (first.status_code, again.status_code) == (201, 200)
    assert first.json() == again.json()
    assert len(_rows(world)) == 1


def test_the_same_key_with_another_request_is_refused(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    handed = _handed(world, "ann", campaign_id)
    _post(world, "ann", _body(handed, "left"))
    answer = _post(world, "ann", _body(handed, "right"))
    assert answer.status_code == 409
    assert "'k1' was used for label 1 with another request" in answer.json()["detail"]
    assert [row.choice for row in _rows(world)] == ["first"]


def test_equal_keys_of_different_annotators_do_not_meet(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=2)
    for name in ("ann", "bob"):
        answer = _post(world, name, _body(_handed(world, name, campaign_id)), key="same")
        assert answer.status_code == 201
    assert len(_rows(world)) == 2


def test_two_tabs_that_send_the_same_key_at_once_store_one_row(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    body = _body(_handed(world, "ann", campaign_id))
    answers = at_once([lambda: _post(world, "ann", body)] * 6)
    assert sorted(answer.status_code for answer in answers) == [200] * 5 + [201]
    assert len({answer.json()["id"] for answer in answers}) == 1
    assert len(_rows(world)) == 1


def test_the_same_key_for_two_pairs_at_once_stores_one_and_refuses_the_other(
    world: World,
) -> None:
    campaign_id, _ = world.add_campaign(pairs=2)
    first = _handed(world, "ann", campaign_id)
    body = {"prefetch_after_pair_id": first["pair"]["id"]}
    second = world.client("ann").post(f"/campaigns/{campaign_id}/next", json=body).json()
    calls = [lambda h=h: _post(world, "ann", _body(h)).status_code for h in (first, second)]
    assert sorted(at_once(calls)) == [201, 409]
    assert len(_rows(world)) == 1


def test_two_answers_to_one_pair_at_once_make_a_chain(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    handed = _handed(world, "ann", campaign_id)
    calls = [
        lambda key=key, choice=choice: _post(world, "ann", _body(handed, choice), key=key)
        for key, choice in (("a", "left"), ("b", "right"), ("c", "equal"), ("d", "cannot_tell"))
    ]
    assert {answer.status_code for answer in at_once(calls)} == {201}
    rows = _rows(world)
    assert [row.supersedes_id for row in rows] == [None, 1, 2, 3]
    with world.database.read() as session:
        assert effective_label_ids(session, campaign_id) == [4]


def test_a_second_answer_supersedes_the_first_which_stays(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    handed = _handed(world, "ann", campaign_id)
    _post(world, "ann", _body(handed, "left"))
    second = _post(world, "ann", _body(handed, "equal"), key="k2").json()
    assert second["supersedes_id"] == 1
    assert [(row.choice, row.retracted) for row in _rows(world)] == [
        ("first", False),
        ("equal", False),
    ]


def test_a_late_label_is_kept_and_marked(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    handed = _handed(world, "ann", campaign_id)
    world.clock.advance(minutes=10, seconds=1)
    bobs = _handed(world, "bob", campaign_id)  # the pair has passed on
    assert bobs["pair"]["id"] == handed["pair"]["id"]
    answer = _post(world, "ann", _body(handed))
    assert answer.status_code == 201 and answer.json()["late"] is True
    assert _post(world, "bob", _body(bobs), key="b").json()["late"] is False
    assert [row.annotator_id for row in _rows(world)] == [world.ids["ann"], world.ids["bob"]]


def test_a_label_for_a_pair_that_was_never_handed_out_to_one_is_refused(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=2)
    handed = _handed(world, "bob", campaign_id)
    body = {"pair_id": handed["pair"]["id"], "choice": "left", "ui_version": "t"}
    answer = _post(world, "ann", body)
    assert answer.status_code == 403
    assert f"pair {pair_ids[0]} was never handed to you" in answer.json()["detail"]
    stolen = _post(world, "ann", _body(handed))
    assert stolen.status_code == 403 and "under lease 1" in stolen.json()["detail"]
    unknown = _post(world, "ann", body | {"pair_id": 4711})
    assert unknown.status_code == 404 and unknown.json()["detail"] == "no pair 4711"
    assert _rows(world) == []


def test_a_lease_of_another_pair_does_not_count(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    other_id, _ = world.add_campaign(pairs=1)
    handed, other = _handed(world, "ann", campaign_id), _handed(world, "ann", other_id)
    assert _post(world, "ann", _body(handed) | {"lease_id": other["lease_id"]}).status_code == 403


def test_what_is_meant_for_another_annotator_is_refused_before_anything_is_stored(
    world: World,
) -> None:
    campaign_id, _ = world.add_campaign(pairs=1, labels_per_pair=2)
    body = _body(_handed(world, "ann", campaign_id)) | {"lease_id": None}
    _handed(world, "bob", campaign_id)  # he holds the pair, too: only the header tells them apart
    ann, bob = world.ids["ann"], world.ids["bob"]
    headers = {"Idempotency-Key": "k", "X-Annotator-Id": str(ann)}
    browser = world.signed_in("bob")
    for path, sent in (("labels", body), (f"campaigns/{campaign_id}/next", {})):
        answer = browser.post(f"/api/v1/{path}", json=sent, headers=headers)
        assert answer.status_code == 401
        assert answer.headers["content-type"] == "application/problem+json"
        assert f"meant for annotator {ann}, but annotator {bob}" in answer.json()["detail"]
    assert _rows(world) == []
    answer = world.signed_in("ann").post("/api/v1/labels", json=body, headers=headers)
    assert answer.status_code == 201
    assert [row.annotator_id for row in _rows(world)] == [ann]
    wrong = browser.post("/api/v1/labels", json=body, headers=headers | {"X-Annotator-Id": "ann"})
    assert wrong.status_code == 422 and "X-Annotator-Id" in wrong.json()["detail"]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"choice": "A"}, "choice"),
        ({"choice": "first"}, "choice"),
        ({"pair_id": "1"}, "pair_id"),
        ({"pair_id": True}, "pair_id"),
        ({"duration_ms": -1}, "duration_ms"),
        ({"duration_ms": 1.5}, "duration_ms"),
        ({"client_time": "2026-11-22T12:00:00"}, "client_time"),
        ({"client_time": "0001-01-01T00:00:00+14:00"}, "client_time"),
        ({"ui_version": "x" * 33}, "ui_version"),
        ({"ui_version": "a\x00b"}, "ui_version"),
        ({"annotator_id": 2}, "annotator_id"),
        ({"replay_events": [0] * 1001}, "replay_events"),
    ],
)
def test_a_wrong_field_is_named_with_what_is_legal(
    sqlite_world: World, change: dict[str, Any], field: str
) -> None:
    campaign_id, _ = sqlite_world.add_campaign(pairs=1)
    answer = _post(sqlite_world, "ann", _body(_handed(sqlite_world, "ann", campaign_id)) | change)
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert f"body.{field}" in [error["field"] for error in answer.json()["errors"]]
    if field == "choice":
        assert "'left', 'right', 'equal' or 'cannot_tell'" in answer.json()["detail"]


@pytest.mark.parametrize("key", [None, "", "x" * 65, "with space"])
def test_a_label_needs_a_usable_idempotency_key(sqlite_world: World, key: str | None) -> None:
    campaign_id, _ = sqlite_world.add_campaign(pairs=1)
    body = _body(_handed(sqlite_world, "ann", campaign_id))
    headers = {} if key is None else {"Idempotency-Key": key}
    answer = sqlite_world.client("ann").post("/labels", json=body, headers=headers)
    assert answer.status_code == 422
    assert "Idempotency-Key" in answer.json()["detail"]


def test_undo_adds_a_row_and_hands_the_same_pair_out_again(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=2)
    handed = _handed(world, "ann", campaign_id)
    _post(world, "ann", _body(handed, "left"))
    answer = _undo(world, "ann", 1)
    assert answer.status_code == 201
    row, again = answer.json()["label"], answer.json()["next"]
    assert (row["id"], row["retracted"], row["supersedes_id"], row["side"]) == (2, True, 1, "left")
    assert again["pair"] == handed["pair"] and again["lease_id"] != handed["lease_id"]
    assert again["progress"] == {"done": 0, "remaining": 2}
    with world.database.read() as session:
        assert effective_label_ids(session, campaign_id) == []
    relabelled = _post(world, "ann", _body(again, "right"), key="k2").json()
    assert relabelled["supersedes_id"] == 2
    with world.database.read() as session:
        assert effective_label_ids(session, campaign_id) == [3]
    assert [(r.choice, r.retracted) for r in _rows(world)] == [
        ("first", False),
        ("first", True),
        ("second", False),
    ]


def test_undo_of_an_edit_takes_back_everything_on_the_pair(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    handed = _handed(world, "ann", campaign_id)
    _post(world, "ann", _body(handed, "left"))
    _post(world, "ann", _body(handed, "right"), key="k2")
    assert _undo(world, "ann", 1).status_code == 409  # superseded
    assert _undo(world, "ann", 2, key="u2").status_code == 201
    assert _undo(world, "ann", 2, key="u3").status_code == 409  # taken back already
    answer = _undo(world, "ann", 3, key="u4")  # an undo cannot be undone, only labelled again
    assert answer.status_code == 409
    assert "label 3 is not in force" in answer.json()["detail"]
    with world.database.read() as session:
        assert effective_label_ids(session, campaign_id) == []


def test_undo_is_idempotent_even_at_once(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    _post(world, "ann", _body(_handed(world, "ann", campaign_id)))
    answers = at_once([lambda: _undo(world, "ann", 1)] * 4)
    assert sorted(answer.status_code for answer in answers) == [200] * 3 + [201]
    assert {answer.json()["label"]["id"] for answer in answers} == {2}
    assert len({answer.json()["next"]["lease_id"] for answer in answers}) == 1
    assert len(_rows(world)) == 2
    with world.database.read() as session:
        open_leases = session.scalars(select(Lease).where(Lease.closed_at.is_(None))).all()
    assert len(open_leases) == 1


def test_a_late_repeat_of_an_undo_does_not_hand_out_a_pair_that_was_judged_anew(
    world: World,
) -> None:
    campaign_id, _ = world.add_campaign(pairs=2)
    _post(world, "ann", _body(_handed(world, "ann", campaign_id)))
    first = _undo(world, "ann", 1)
    _post(world, "ann", _body(first.json()["next"], "right"), key="k2")
    again = _undo(world, "ann", 1)
    assert (first.status_code, again.status_code) == (201, 200)
    assert again.json() == {"label": first.json()["label"], "next": None}
    with world.database.read() as session:
        assert session.scalars(select(Lease).where(Lease.closed_at.is_(None))).all() == []
        assert effective_label_ids(session, campaign_id) == [3]


def test_nobody_takes_the_pair_between_undo_and_the_new_answer(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    _post(world, "ann", _body(_handed(world, "ann", campaign_id)))
    _undo(world, "ann", 1)
    answer = world.client("bob").post(f"/campaigns/{campaign_id}/next", json={})
    assert answer.status_code == 204


def test_only_the_own_label_can_be_taken_back(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    _post(world, "ann", _body(_handed(world, "ann", campaign_id)))
    assert _undo(world, "bob", 1).status_code == 403
    assert _undo(world, "ada", 1).status_code == 403  # not even by an admin
    assert _undo(world, "ann", 99).json()["detail"] == "no label 99"


def test_the_key_of_a_label_cannot_be_used_for_an_undo(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    _post(world, "ann", _body(_handed(world, "ann", campaign_id)), key="k1")
    assert _undo(world, "ann", 1, key="k1").status_code == 409


def test_admins_read_raw_rows_page_by_page(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=3)
    for key in ("a", "b", "c"):
        _post(world, "ann", _body(_handed(world, "ann", campaign_id)), key=key)
    admin = world.client("ada")
    first = admin.get(f"/campaigns/{campaign_id}/labels?limit=2").json()
    assert [row["id"] for row in first["items"]] == [1, 2] and first["next_cursor"] == 2
    last = admin.get(f"/campaigns/{campaign_id}/labels?limit=2&cursor=2").json()
    assert [row["idempotency_key"] for row in last["items"]] == ["c"]
    assert last["next_cursor"] is None
    assert first["items"][0]["annotator_id"] == world.ids["ann"]


def test_rows_tell_whether_they_are_in_force_and_can_be_asked_for_by_it(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=3)
    handed = [_handed(world, "ann", campaign_id)]
    _post(world, "ann", _body(handed[0]), key="edited")
    _post(world, "ann", _body(handed[0], "right"), key="edit")  # supersedes row 1
    _post(world, "ann", _body(_handed(world, "ann", campaign_id)), key="undone")
    _undo(world, "ann", 3)  # row 4
    _post(world, "bob", _body(_handed(world, "bob", campaign_id)), key="kept")
    path = f"/campaigns/{campaign_id}/labels"
    admin = world.client("ada")
    told = {row["id"]: row["in_force"] for row in admin.get(path).json()["items"]}
    assert told == {1: False, 2: True, 3: False, 4: False, 5: True}
    with world.database.read() as session:
        assert effective_label_ids(session, campaign_id) == [2, 5]
    first = admin.get(f"{path}?in_force=true&limit=1").json()
    assert [row["id"] for row in first["items"]] == [2] and first["next_cursor"] == 2
    last = admin.get(f"{path}?in_force=true&limit=1&cursor=2").json()
    assert [row["id"] for row in last["items"]] == [5] and last["next_cursor"] is None
    rest = admin.get(f"{path}?in_force=false").json()["items"]
    assert [row["id"] for row in rest] == [1, 3, 4]
    assert admin.get(f"{path}?in_force=perhaps").status_code == 422
    pair_id = handed[0]["pair"]["id"]
    of_pair = admin.get(f"{path}?pair_id={pair_id}").json()["items"]
    assert [row["id"] for row in of_pair if row["annotator_id"] == world.ids["ann"]] == [1, 2]
    assert {row["pair_id"] for row in of_pair} == {pair_id}
    assert admin.get(f"{path}?pair_id=0").status_code == 422


def test_truth_of_simulated_annotators_is_kept_apart(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=2, first_is_left=False)
    handed = _handed(world, "sam", campaign_id)
    pair_path = f"/pairs/{handed['pair']['id']}/episodes"
    known = world.client("sam").get(pair_path).json()
    assert {known["first"]["group"], known["second"]["group"]} == {"left", "right"}
    assert known["first_is_left"] is False
    label = _post(world, "sam", _body(handed, "left")).json()
    truth = {"true_choice": "right", "corruption": "flip", "criterion": "left group"}
    path = f"/labels/{label['id']}/truth"
    stored = world.client("sam").put(path, json=truth)
    assert stored.status_code == 201
    assert stored.json()["true_choice"] == "first" and stored.json()["corrupted"] is True
    assert world.client("sam").put(path, json=truth).status_code == 200
    other = truth | {"true_choice": "left"}
    assert world.client("sam").put(path, json=other).status_code == 409
    counts = world.client("sam").get(f"/campaigns/{campaign_id}/truth").json()
    assert counts == {"total": 1, "flipped": 1}
    raw = world.client("ada").get(f"/campaigns/{campaign_id}/labels").json()["items"][0]
    assert raw["source"] == "simulated" and "true_choice" not in raw


def test_the_truth_told_twice_at_once_is_stored_once(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=2)
    label = _post(world, "sam", _body(_handed(world, "sam", campaign_id))).json()
    truth = {"true_choice": "left", "corruption": "none", "criterion": "x"}
    path = f"/labels/{label['id']}/truth"
    answers = at_once([lambda: world.client("sam").put(path, json=truth)] * 6)
    assert sorted(answer.status_code for answer in answers) == [200] * 5 + [201]

    label = _post(world, "sam", _body(_handed(world, "sam", campaign_id)), key="k2").json()
    path = f"/labels/{label['id']}/truth"
    other = truth | {"true_choice": "right"}
    answers = at_once(
        [
            lambda: world.client("sam").put(path, json=truth),
            lambda: world.client("sam").put(path, json=other),
        ]
    )
    assert sorted(answer.status_code for answer in answers) == [201, 409]


def test_people_have_no_truth_to_tell_and_cannot_see_it(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=2)
    handed = _handed(world, "ann", campaign_id)
    label = _post(world, "ann", _body(handed)).json()
    truth = {"true_choice": "left", "corruption": "none", "criterion": "x"}
    answer = world.client("sam").put(f"/labels/{label['id']}/truth", json=truth)
    assert answer.status_code == 403 and "simulated annotator who gave it" in answer.text
    assert world.client("ann").get(f"/pairs/{handed['pair']['id']}/episodes").status_code == 403
    with world.database.read() as session:
        assert session.scalars(select(SimulatedTruth)).all() == []


def test_followers_learn_that_somebody_labelled_but_not_what(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    _post(world, "ann", _body(_handed(world, "ann", campaign_id)))
    _undo(world, "ann", 1)
    with world.database.read() as session:
        data = [event.data for event in session.scalars(select(Event).order_by(Event.id))]
    ann = world.ids["ann"]
    assert data == [
        {"label_id": 1, "pair_id": 1, "annotator_id": ann, "retracted": False},
        {"label_id": 2, "pair_id": 1, "annotator_id": ann, "retracted": True},
    ]
