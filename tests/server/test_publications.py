"""The published alias moves, moves back, and every move stays on record."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import select

from server import publications, rounds
from server.rounds import RoundRequest
from server.states import PublishRule
from server.store.tables import AuditEntry, Event, Pair
from tests import factories
from tests.factories import NOW
from tests.server.threads import at_once
from tests.server.world import World


def _published(world: World, campaign_id: int) -> int:
    answer = world.client("sam").get(f"/campaigns/{campaign_id}")
    return int(answer.json()["published_checkpoint_id"])


def _publish(world: World, campaign_id: int, checkpoint_id: int) -> Any:
    body = {"checkpoint_id": checkpoint_id, "reason": "looks good"}
    return world.client("ada").post(f"/campaigns/{campaign_id}/publish", json=body)


def _roll_back(world: World, campaign_id: int, **expected: int) -> Any:
    path = f"/campaigns/{campaign_id}/rollback"
    return world.client("ada").post(path, json={"reason": "worse"} | expected)


@pytest.fixture
def campaign_id(world: World) -> int:
    made, _ = world.add_campaign(pairs=2)
    with world.database.write() as session:
        factories.add_checkpoint(session, "second", parent_id=1)
        factories.add_checkpoint(session, "third", parent_id=2)
    return made


def test_publishing_and_rolling_back_walk_through_the_history(
    world: World, campaign_id: int
) -> None:
    assert _publish(world, campaign_id, 2).status_code == 201
    assert _publish(world, campaign_id, 3).json()["previous_checkpoint_id"] == 2
    assert _published(world, campaign_id) == 3
    walked = []
    for _ in range(2):
        assert _roll_back(world, campaign_id).status_code == 201
        walked.append(_published(world, campaign_id))
    assert walked == [2, 1]
    end = _roll_back(world, campaign_id)
    assert end.status_code == 409 and "nothing to roll back" in end.json()["detail"]
    assert _publish(world, campaign_id, 3).status_code == 201
    history = world.client("ada").get(f"/campaigns/{campaign_id}/publications").json()["items"]
    assert [(row["action"], row["checkpoint_id"]) for row in reversed(history)] == [
        ("start", 1),
        ("publish", 2),
        ("publish", 3),
        ("rollback", 2),
        ("rollback", 1),
        ("publish", 3),
    ]
    assert {row["by_annotator_id"] for row in history} == {world.ids["ada"]}


def test_a_rollback_to_another_checkpoint_than_expected_is_refused(
    world: World, campaign_id: int
) -> None:
    _publish(world, campaign_id, 2)
    _publish(world, campaign_id, 3)  # after somebody looked
    refused = _roll_back(world, campaign_id, checkpoint_id=1)
    assert refused.status_code == 409
    assert "would now publish checkpoint 2, not 1" in refused.json()["detail"]
    assert _published(world, campaign_id) == 3
    assert _roll_back(world, campaign_id, checkpoint_id=2).json()["checkpoint_id"] == 2


def test_of_two_rollbacks_at_once_that_expect_the_same_one_is_refused(
    world: World, campaign_id: int
) -> None:
    _publish(world, campaign_id, 2)
    _publish(world, campaign_id, 3)
    answers = at_once([lambda: _roll_back(world, campaign_id, checkpoint_id=2)] * 3)
    assert sorted(answer.status_code for answer in answers) == [201, 409, 409]
    assert _published(world, campaign_id) == 2


def test_every_move_is_audited_and_told(world: World, campaign_id: int) -> None:
    _publish(world, campaign_id, 2)
    with world.database.read() as session:
        entry = session.scalars(select(AuditEntry).order_by(AuditEntry.id.desc())).first()
        event = session.scalars(select(Event)).one()
    assert entry is not None
    assert (entry.action, entry.subject) == ("campaign.publish", f"campaign/{campaign_id}")
    assert entry.details == {"from": 1, "to": 2, "reason": "looks good"}
    assert (event.kind, event.data["checkpoint_id"]) == ("publication", 2)


def test_what_cannot_be_published_is_refused_with_the_reason(
    world: World, campaign_id: int
) -> None:
    with world.database.write() as session:
        factories.add_checkpoint(session, "other task", task="stacking")
        factories.add_label(session, session.get_one(Pair, 1), world.ids["ann"])
        request = RoundRequest(publish_rule=PublishRule.NEVER)
        compared = rounds.launch(session, NOW, campaign_id, request)
        factories.add_checkpoint(session, "compared", parent_id=1, round_id=compared.id)
        factories.add_checkpoint(session, "pretrained anew")
    for checkpoint_id, status, words in (
        (99, 404, "no checkpoint 99"),
        (1, 409, "checkpoint 1 is published already"),
        (4, 409, "is for task 'stacking'"),
        (5, 409, "comes from comparison round 1"),
        (6, 409, "descends from 'pretrained anew' (checkpoint 6)"),
    ):
        answer = _publish(world, campaign_id, checkpoint_id)
        assert answer.status_code == status and words in answer.json()["detail"]
    assert _published(world, campaign_id) == 1
    listed = world.client("ada").get("/checkpoints?limit=3").json()
    assert [(row["id"], row["comparison"]) for row in listed["items"]] == [
        (6, False),
        (5, True),
        (4, False),
    ]
    assert listed["next_cursor"] == 4


def test_figures_tell_what_a_rollback_would_publish(world: World, campaign_id: int) -> None:
    def told() -> int | None:
        stats = world.client("ada").get(f"/campaigns/{campaign_id}/stats").json()
        target: int | None = stats["rollback_checkpoint_id"]
        return target

    assert told() is None
    _publish(world, campaign_id, 2)
    assert told() == 1
    _publish(world, campaign_id, 1)  # the start again, but not at the start of its history
    assert told() == 2
    assert _roll_back(world, campaign_id).status_code == 201
    assert (_published(world, campaign_id), told()) == (2, 1)


def test_another_pretrained_policy_can_be_published_before_there_are_runs(world: World) -> None:
    made, _ = world.add_campaign(pairs=0)
    with world.database.write() as session:
        anew = factories.add_checkpoint(session, "pretrained anew").id
    assert _publish(world, made, anew).status_code == 201


def test_the_gate_publishes_without_an_account(world: World, campaign_id: int) -> None:
    with world.database.write() as session:
        publications.publish(
            session, NOW, campaign_id=campaign_id, checkpoint_id=2, reason="passed", by=None
        )
    history = world.client("ada").get(f"/campaigns/{campaign_id}/publications").json()["items"]
    assert (history[0]["reason"], history[0]["by_annotator_id"]) == ("passed", None)


def test_of_two_equal_moves_at_once_one_is_refused(world: World, campaign_id: int) -> None:
    answers = at_once([lambda: _publish(world, campaign_id, 2)] * 3)
    assert sorted(answer.status_code for answer in answers) == [201, 409, 409]


def test_lineage_leads_from_the_policy_to_the_clicks(world: World, campaign_id: int) -> None:
    with world.database.write() as session:
        label = factories.add_label(session, session.get_one(Pair, 1), world.ids["ann"])
        other = factories.add_label(session, session.get_one(Pair, 2), world.ids["bob"])
        made_by = rounds.launch(session, NOW, campaign_id, RoundRequest())
        candidate = factories.add_checkpoint(
            session,
            "candidate",
            parent_id=1,
            round_id=made_by.id,
            snapshot_digest=made_by.snapshot_digest,
        )
    client = world.client("sam")
    newest, oldest = client.get(f"/checkpoints/{candidate.id}/lineage").json()
    assert newest["checkpoint"]["name"] == "candidate"
    assert newest["round_id"] == made_by.id
    assert newest["config"] == client.get(f"/rounds/{made_by.id}").json()["config"]
    assert len(newest["config_digest"]) == 64
    assert newest["snapshot_digest"] == made_by.snapshot_digest
    assert newest["labels"] == 2
    assert newest["labels_by_annotator"] == [
        {"annotator_id": world.ids["ann"], "name": "ann", "labels": 1},
        {"annotator_id": world.ids["bob"], "name": "bob", "labels": 1},
    ]
    assert (oldest["checkpoint"]["id"], oldest["labels"]) == (1, 0)
    assert oldest["labels_by_annotator"] == []
    clicks = [
        {"id": label.id, "pair_id": 1, "annotator_id": world.ids["ann"]},
        {"id": other.id, "pair_id": 2, "annotator_id": world.ids["bob"]},
    ]
    path = f"/checkpoints/{candidate.id}/labels"
    assert client.get(path).json() == {"items": clicks, "next_cursor": None}
    assert client.get(f"{path}?limit=1").json() == {"items": clicks[:1], "next_cursor": label.id}
    rest = client.get(f"{path}?limit=1&cursor={label.id}").json()
    assert rest == {"items": clicks[1:], "next_cursor": None}
    assert client.get("/checkpoints/1/labels").json() == {"items": [], "next_cursor": None}
    assert client.get("/checkpoints/77/labels").status_code == 404
    assert (oldest["config_digest"], oldest["code_version"]) == (None, "0.1.0")
    assert client.get(f"/rounds/{made_by.id}").json()["candidate_checkpoint_id"] == candidate.id
    assert client.get("/checkpoints?task=avoid").json()["items"][0]["id"] == candidate.id
    assert client.get("/checkpoints?task=other").json()["items"] == []
    assert client.get("/checkpoints/77/lineage").status_code == 404
