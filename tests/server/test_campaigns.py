"""Campaigns: create, change, collect, figures, and what the lists show."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from sqlalchemy import select

from server.states import Choice, JobKind, JobState
from server.store.campaigns import lock_campaign
from server.store.tables import Job
from tests import factories
from tests.server.threads import at_once
from tests.server.world import World

DEFAULTS = {
    "labels_per_pair": 1,
    "round_after_labels": 0,
    "round_every_minutes": 0.0,
    "method": "rodif_guided",
    "publish_rule": "auto",
    "evaluation_episodes": 200,
    "collect": {"episodes": 60, "pairs": 150, "strategy": "cross_group", "random_share": 0.2},
}


@pytest.fixture
def checkpoint_id(world: World) -> int:
    with world.database.write() as session:
        return factories.add_checkpoint(session).id


def test_a_campaign_takes_its_defaults_from_the_task(world: World, checkpoint_id: int) -> None:
    answer = world.client("ada").post("/campaigns", json={"name": "first", "task": "avoid"})
    assert answer.status_code == 201
    assert answer.json() == {
        "id": 1,
        "name": "first",
        "task": "avoid",
        "criterion": factories.TASK_FACTS["criterion"],
        "settings": DEFAULTS,
        "start_checkpoint_id": checkpoint_id,
        "published_checkpoint_id": checkpoint_id,
        "archived": False,
        "created_at": "2026-11-22T12:00:00Z",
    }
    history = world.client("ada").get("/campaigns/1/publications").json()["items"]
    assert [(row["action"], row["checkpoint_id"]) for row in history] == [("start", checkpoint_id)]
    (task,) = world.client("sam").get("/tasks").json()
    assert (task["name"], task["preferred_group"], task["checkpoints"]) == ("avoid", "left", 1)


def test_annotators_are_told_of_no_policy_and_no_preferred_behaviour(sqlite_world: World) -> None:
    campaign_id, _ = sqlite_world.add_campaign(pairs=1)
    ann = sqlite_world.client("ann")
    told = {
        "id": campaign_id,
        "name": "campaign 0",
        "task": "avoid",
        "criterion": factories.TASK_FACTS["criterion"],
        "archived": False,
        "created_at": "2026-11-22T12:00:00Z",
    }
    assert ann.get("/campaigns").json() == [told]
    assert ann.get(f"/campaigns/{campaign_id}").json() == told
    assert ann.get("/tasks").status_code == 403
    pair = ann.post(f"/campaigns/{campaign_id}/next", json={}).json()["pair"]
    assert set(pair) == {
        *("id", "replay_url", "thumbnail_url", "left_label", "right_label", "duration_s", "step_s")
    }


@pytest.mark.parametrize(
    ("change", "status", "words"),
    [
        ({"task": "juggling"}, 422, ["'juggling'", "'avoid'"]),
        ({"start_checkpoint_id": 99}, 404, ["no checkpoint 99"]),
        ({"name": ""}, 422, ["body.name"]),
        (
            {"settings": {"method": "magic"}},
            422,
            ["'rodif_guided', 'rodif', 'dp_dpo', 'ipo', 'cpo' or 'simpo'"],
        ),
        ({"settings": {"labels_per_pair": 0}}, 422, ["greater than or equal to 1"]),
        ({"settings": {"collect": {"strategy": "best"}}}, 422, ["'cross_group' or 'random'"]),
        ({"settings": {"publish_rule": "maybe"}}, 422, ["'auto', 'manual' or 'never'"]),
        ({"colour": "blue"}, 422, ["body.colour"]),
    ],
)
def test_a_wrong_campaign_is_refused_with_the_legal_values(
    sqlite_world: World, change: dict[str, Any], status: int, words: list[str]
) -> None:
    with sqlite_world.database.write() as session:
        factories.add_checkpoint(session)
    body = {"name": "c", "task": "avoid"} | change
    answer = sqlite_world.client("ada").post("/campaigns", json=body)
    assert answer.status_code == status
    for word in words:
        assert word in answer.json()["detail"]


def test_names_of_campaigns_are_unique_even_at_once(world: World, checkpoint_id: int) -> None:
    del checkpoint_id
    body = {"name": "same", "task": "avoid"}
    answers = at_once([lambda: world.client("ada").post("/campaigns", json=body)] * 4)
    assert sorted(answer.status_code for answer in answers) == [201, 409, 409, 409]


def test_settings_change_partly_and_are_checked(world: World) -> None:
    campaign_id, _ = world.add_campaign()
    admin, path = world.client("ada"), f"/campaigns/{campaign_id}"
    change = {"settings": {"round_after_labels": 50, "collect": {"pairs": 10}}, "name": "renamed"}
    changed = admin.patch(path, json=change).json()
    assert changed["name"] == "renamed"
    assert changed["settings"] == DEFAULTS | {
        "round_after_labels": 50,
        "collect": DEFAULTS["collect"] | {"pairs": 10},  # type: ignore[operator]
    }
    wrong = admin.patch(path, json={"settings": {"labels_per_pair": 99}})
    assert wrong.status_code == 422
    assert wrong.json()["errors"][0]["field"] == "body.settings.labels_per_pair"
    assert admin.patch(path, json={"settings": {"unknown": 1}}).status_code == 422
    assert admin.patch(path, json={"settings": {"collect": 5}}).status_code == 422
    other_id, _ = world.add_campaign()
    taken = admin.patch(f"/campaigns/{other_id}", json={"name": "renamed"})
    assert taken.status_code == 409


def test_the_publish_rule_is_changed_by_admins_only(sqlite_world: World) -> None:
    campaign_id, _ = sqlite_world.add_campaign(publish_rule="manual")
    script, path = sqlite_world.client("sam"), f"/campaigns/{campaign_id}"
    for rule in ("auto", "never"):
        answer = script.patch(path, json={"name": "x", "settings": {"publish_rule": rule}})
        assert answer.status_code == 403
        assert answer.json()["detail"] == (
            f"publish_rule '{rule}' instead of 'manual' needs role 'admin'; 'sam' has 'service'"
        )
    same = {"settings": {"publish_rule": "manual", "round_after_labels": 5}}
    kept = script.patch(path, json=same).json()
    assert (kept["name"], kept["settings"]["round_after_labels"]) == ("campaign 0", 5)
    changed = sqlite_world.client("ada").patch(path, json={"settings": {"publish_rule": "auto"}})
    assert changed.json()["settings"]["publish_rule"] == "auto"


def test_settings_that_two_change_at_once_are_both_kept(world: World) -> None:
    campaign_id, _ = world.add_campaign()
    admin, path = world.client("ada"), f"/campaigns/{campaign_id}"
    with ThreadPoolExecutor(1) as pool:
        with world.database.write() as session:
            campaign = lock_campaign(session, campaign_id)
            campaign.settings = campaign.settings | {"labels_per_pair": 2}
            session.flush()
            other = pool.submit(lambda: admin.patch(path, json={"settings": {"method": "rodif"}}))
            with pytest.raises(TimeoutError):
                other.result(timeout=0.5)  # what it merges into is not known before
        answer = other.result(timeout=30)
    assert answer.json()["settings"] == DEFAULTS | {"labels_per_pair": 2, "method": "rodif"}


def test_the_criterion_cannot_change_under_given_labels(world: World) -> None:
    campaign_id, (pair_id,) = world.add_campaign(pairs=1)
    admin, path = world.client("ada"), f"/campaigns/{campaign_id}"
    assert admin.patch(path, json={"criterion": "Go right."}).json()["criterion"] == "Go right."
    with world.database.write() as session:
        pair = session.get_one(factories.Pair, pair_id)
        factories.add_label(session, pair, world.ids["ann"])
    answer = admin.patch(path, json={"criterion": "Go left."})
    assert answer.status_code == 409 and "start a new campaign" in answer.json()["detail"]


def test_white_space_around_a_criterion_is_neither_stored_nor_a_change(world: World) -> None:
    campaign_id, (pair_id,) = world.add_campaign(pairs=1)
    admin, path = world.client("ada"), f"/campaigns/{campaign_id}"
    assert admin.patch(path, json={"criterion": " Go right.\n"}).json()["criterion"] == "Go right."
    assert admin.patch(path, json={"criterion": " \n"}).status_code == 422
    with world.database.write() as session:
        session.get_one(
            factories.Campaign, campaign_id
        ).criterion = "Go right.\n"  # of an earlier version
        factories.add_label(session, session.get_one(factories.Pair, pair_id), world.ids["ann"])
    answer = admin.patch(path, json={"criterion": "Go right."})
    assert (answer.status_code, answer.json()["criterion"]) == (200, "Go right.\n")


def test_archived_campaigns_leave_the_list_and_take_no_work(world: World) -> None:
    campaign_id, _ = world.add_campaign()
    admin = world.client("ada")
    admin.patch(f"/campaigns/{campaign_id}", json={"archived": True})
    assert admin.get("/campaigns").json() == []
    assert [row["id"] for row in admin.get("/campaigns?archived=true").json()] == [campaign_id]
    assert admin.post(f"/campaigns/{campaign_id}/collect", json={}).status_code == 409
    assert admin.post(f"/campaigns/{campaign_id}/rounds", json={}).status_code == 409


def test_collecting_queues_a_job_and_tells_where_to_follow_it(world: World) -> None:
    campaign_id, _ = world.add_campaign()
    answer = world.client("sam").post(
        f"/campaigns/{campaign_id}/collect", json={"episodes": 20, "pairs": 30}
    )
    assert answer.status_code == 202
    job_id = answer.json()["id"]
    assert answer.headers["location"] == f"/api/v1/jobs/{job_id}"
    assert world.sent == [(job_id, JobKind.COLLECT)]
    with world.database.read() as session:
        payload = session.get_one(Job, job_id).payload
    assert payload == {
        "episodes": 20,
        "pairs": 30,
        "strategy": "cross_group",
        "random_share": 0.2,
        "checkpoint_id": 1,
        "seed": 0,
    }
    found = world.client("sam").get(answer.headers["location"].removeprefix("/api/v1")).json()
    assert (found["kind"], found["state"], found["progress"]) == ("collect", "queued", 0.0)


@pytest.mark.parametrize(
    ("asked", "pairs"),
    [
        ({"episodes": 10}, 45),  # 10 · 9 / 2
        ({"episodes": 18}, 150),  # of 153; the campaign's number
        ({}, 150),
        ({"episodes": 10, "pairs": 45}, 45),
    ],
)
def test_collecting_few_episodes_makes_the_pairs_that_there_are(
    sqlite_world: World, asked: dict[str, int], pairs: int
) -> None:
    campaign_id, _ = sqlite_world.add_campaign()
    answer = sqlite_world.client("ada").post(f"/campaigns/{campaign_id}/collect", json=asked)
    assert answer.status_code == 202
    with sqlite_world.database.read() as session:
        assert session.get_one(Job, answer.json()["id"]).payload["pairs"] == pairs


def test_collects_never_plan_the_same_seeds_even_at_once(world: World) -> None:
    campaign_id, _ = world.add_campaign()
    path = f"/campaigns/{campaign_id}/collect"
    body = {"episodes": 25, "pairs": 5}
    answers = at_once([lambda: world.client("ada").post(path, json=body)] * 4)
    assert {answer.status_code for answer in answers} == {202}
    with world.database.read() as session:
        seeds = [job.payload["seed"] for job in session.scalars(select(Job))]
    assert sorted(seeds) == [0, 25, 50, 75]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"episodes": 3, "pairs": 4}, "pairs is 4, but must be at most 3, the pairs of 3 episodes"),
        ({"pairs": 1771}, "pairs is 1771, but must be at most 1770, the pairs of 60 episodes"),
        ({"episodes": 1}, "greater than or equal to 2"),
        ({"random_share": 1.5}, "less than or equal to 1"),
        ({"random_share": "0.5"}, "valid number"),
        ({"seed": -1}, "greater than or equal to 0"),
        ({"strategy": "clever"}, "'cross_group' or 'random'"),
    ],
)
def test_a_wrong_collect_is_refused(sqlite_world: World, body: dict[str, Any], words: str) -> None:
    campaign_id, _ = sqlite_world.add_campaign()
    answer = sqlite_world.client("ada").post(f"/campaigns/{campaign_id}/collect", json=body)
    assert answer.status_code == 422
    assert words in answer.json()["detail"]
    assert sqlite_world.sent == []


def test_stats_count_what_is_in_force(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=4, labels_per_pair=3)
    ann, bob = world.ids["ann"], world.ids["bob"]
    with world.database.write() as session:
        pairs = [session.get_one(factories.Pair, pair_id) for pair_id in pair_ids]
        first = factories.add_label(session, pairs[0], ann, Choice.FIRST)
        factories.add_label(session, pairs[0], ann, Choice.SECOND, supersedes_id=first.id)
        factories.add_label(session, pairs[1], ann, Choice.EQUAL)
        factories.add_label(session, pairs[0], bob, Choice.FIRST)
        taken = factories.add_label(session, pairs[2], bob, Choice.FIRST)
        factories.add_label(
            session, pairs[2], bob, Choice.FIRST, supersedes_id=taken.id, retracted=True
        )
        pairs[3].state = "failed"
        session.scalars(select(Job)).one().state = JobState.FAILED
    stats = world.client("ada").get(f"/campaigns/{campaign_id}/stats").json()
    assert stats == {
        "episodes": 8,
        "pairs": {"ready": 3, "waiting": 0, "failed": 1, "labelled": 2, "reported": 0},
        "labels": {
            "total": 6,
            "effective": 3,
            "by_choice": {"first": 1, "second": 1, "equal": 1, "cannot_tell": 0},
            "new_since_round": 3,
        },
        "annotators": [
            {
                "id": ann,
                "name": "ann",
                "kind": "person",
                "labels": 2,
                "median_duration_ms": 1500.0,
                "left_share": 0.0,  # of pair 0, whose first episode was on the left
            },
            {
                "id": bob,
                "name": "bob",
                "kind": "person",
                "labels": 1,
                "median_duration_ms": 1500.0,
                "left_share": 1.0,
            },
        ],
        "jobs": {"queued": 0, "running": 0, "failed": 1},
        "rollback_checkpoint_id": None,
    }
    accounts = world.client("ada").get("/annotators").json()["items"]
    assert {row["name"]: row["labels"] for row in accounts}["ann"] == 2


@pytest.mark.parametrize(
    ("durations", "median"),
    [([], None), ([None], None), ([7], 7.0), ([9, 1, 5], 5.0), ([4, 100, 1, 2, None], 3.0)],
)
def test_the_median_is_that_of_the_durations_that_are_known(
    world: World, durations: list[int | None], median: float | None
) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=6)
    with world.database.write() as session:
        pairs = [session.get_one(factories.Pair, pair_id) for pair_id in pair_ids]
        for pair, duration in zip(pairs, durations, strict=False):
            factories.add_label(session, pair, world.ids["ann"], duration_ms=duration)
        factories.add_label(session, pairs[-1], world.ids["bob"], duration_ms=50)
    stats = world.client("ada").get(f"/campaigns/{campaign_id}/stats").json()
    found = {row["name"]: row["median_duration_ms"] for row in stats["annotators"]}
    assert found == ({"ann": median} if durations else {}) | {"bob": 50.0}


def test_episodes_and_pairs_are_listed_by_pages_and_filters(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=3)
    client = world.client("sam")
    first = client.get(f"/campaigns/{campaign_id}/episodes?limit=4").json()
    assert len(first["items"]) == 4 and first["next_cursor"] == 4
    assert {"path", "success", "mode", "group"} <= set(first["items"][0])
    rest = client.get(f"/campaigns/{campaign_id}/episodes?limit=4&cursor=4").json()
    assert len(rest["items"]) == 2 and rest["next_cursor"] is None
    none = client.get(f"/campaigns/{campaign_id}/episodes?checkpoint_id=77").json()
    assert none["items"] == []
    ready = client.get(f"/campaigns/{campaign_id}/pairs?state=ready").json()["items"]
    assert [pair["id"] for pair in ready] == pair_ids
    assert client.get(f"/campaigns/{campaign_id}/pairs?state=failed").json()["items"] == []
    wrong = client.get(f"/campaigns/{campaign_id}/pairs?state=odd")
    assert wrong.status_code == 422 and "'waiting', 'ready' or 'failed'" in wrong.text
    assert client.get("/campaigns/99/pairs").status_code == 404
