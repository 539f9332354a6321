"""Rounds: frozen snapshots, legal steps, one publishing round at a time."""

from __future__ import annotations

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import select

from server import rounds
from server.errors import ConflictError, NotFoundError
from server.rounds import RoundRequest
from server.snapshots import freeze_snapshot
from server.states import (
    Choice,
    JobKind,
    JobState,
    PairState,
    RoundState,
)
from server.store import jobs
from server.store.labels import snapshot_labels
from server.store.session import Database
from server.store.tables import Campaign, Event, Job, Label, LabelSnapshot, Pair, Round
from tests import factories
from tests.factories import NOW, PUBLISHED_PATH
from tests.server.threads import at_once
from tests.server.world import World


def _labelled(world: World, count: int = 2, **settings: Any) -> int:
    """A campaign with `count` labels by ann."""
    campaign_id, pair_ids = world.add_campaign(pairs=count + 2, **settings)
    with world.database.write() as session:
        for pair_id in pair_ids[:count]:
            pair = session.get_one(Pair, pair_id)
            factories.add_label(session, pair, world.ids["ann"])
    return campaign_id


def _launch(world: World, campaign_id: int, **body: Any) -> Any:
    return world.client("ada").post(f"/campaigns/{campaign_id}/rounds", json=body)


def test_a_launched_round_is_frozen_queued_and_can_be_followed(world: World) -> None:
    campaign_id = _labelled(world)
    answer = _launch(world, campaign_id, config={"updates": 5}, seed=3)
    assert answer.status_code == 202
    found = answer.json()
    assert answer.headers["location"] == f"/api/v1/rounds/{found['id']}"
    assert (found["state"], found["trigger"], found["publish_rule"]) == ("queued", "manual", "auto")
    assert found["config"]["method"] == "rodif_guided"
    assert (found["config"]["updates"], found["config"]["seed"]) == (5, 3)
    assert found["evaluation"] == {"episodes": 200, "seed": rounds.EVALUATION_SEED}
    assert (found["labels"], found["candidate_checkpoint_id"]) == (2, None)
    assert found["started_by"] == world.ids["ada"] and found["parent_checkpoint_id"] == 1
    with world.database.read() as session:
        job = session.scalars(select(Job).where(Job.round_id == found["id"])).one()
    assert job.dedupe_key == f"finetune:{found['id']}"
    assert world.sent == [(job.id, JobKind.FINETUNE)]
    assert world.client("ada").get(f"/rounds/{found['id']}").json() == found
    assert world.client("ada").get(f"/campaigns/{campaign_id}/rounds").json()["items"] == [found]


def test_a_round_has_its_tasks_own_settings_where_none_are_given(sqlite_world: World) -> None:
    campaign_id = _labelled(sqlite_world)
    with sqlite_world.database.write() as session:
        session.get_one(Campaign, campaign_id).task = "stacking"
    given = {"guide": {"self_training_rollouts": 50}}
    guide = _launch(sqlite_world, campaign_id, config=given).json()["config"]["guide"]
    assert (guide["self_training_rollouts"], guide["self_training_noise"]) == (50, 0.5)
    assert guide["scales"] == [1.0, 2.0]


def test_a_snapshot_holds_the_last_word_of_each_annotator_on_each_pair(database: Database) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session)
        pairs = factories.add_pairs(session, campaign, 3)
        ann, bob = factories.add_me(session, "ann").id, factories.add_me(session, "bob").id
        old = factories.add_label(session, pairs[0], ann)
        edit = factories.add_label(session, pairs[0], ann, Choice.EQUAL, supersedes_id=old.id)
        other = factories.add_label(session, pairs[0], bob)
        gone = factories.add_label(session, pairs[1], ann)
        undo = factories.add_label(session, pairs[1], ann, supersedes_id=gone.id, retracted=True)
        again = factories.add_label(session, pairs[1], ann, supersedes_id=undo.id, key="again")
        lone = factories.add_label(session, pairs[2], bob)
        factories.add_label(session, pairs[2], bob, supersedes_id=lone.id, retracted=True)
        snapshot = freeze_snapshot(session, NOW, campaign.id)
        expected = [edit.id, other.id, again.id]
        assert snapshot.label_ids == expected and snapshot.size == 3
        held = snapshot_labels(session, snapshot.digest)
        assert [label.id for label in held] == expected
    content = f'{{"campaign_id":{campaign.id},"label_ids":{json.dumps(expected)}}}'.replace(" ", "")
    assert snapshot.digest == hashlib.sha256(content.encode()).hexdigest()


def test_a_snapshot_is_the_same_until_a_label_comes_and_never_changes(database: Database) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session)
        pairs = factories.add_pairs(session, campaign, 2)
        ann = factories.add_me(session, "ann").id
        label = factories.add_label(session, pairs[0], ann)
        first = freeze_snapshot(session, NOW, campaign.id).digest
    with database.write() as session:
        later = NOW + timedelta(days=1)
        assert freeze_snapshot(session, later, campaign.id).digest == first
        factories.add_label(session, pairs[0], ann, supersedes_id=label.id, retracted=True)
        factories.add_label(session, pairs[1], ann)
        second = freeze_snapshot(session, later, campaign.id)
        assert second.digest != first
        held = snapshot_labels(session, first, Label.choice, Label.annotator_id)
        assert [tuple(row) for row in held] == [(label.id, "first", ann)]
        with pytest.raises(NotFoundError, match="no label snapshot 'zzz'"):
            snapshot_labels(session, "zzz")


def test_a_comparison_round_can_reuse_the_snapshot_of_another(world: World) -> None:
    campaign_id = _labelled(world)
    digest = _launch(world, campaign_id).json()["snapshot_digest"]
    with world.database.write() as session:
        pair = session.scalars(select(Pair).order_by(Pair.id.desc())).first()
        assert pair is not None
        factories.add_label(session, pair, world.ids["bob"])
    body = {"publish_rule": "never", "snapshot_digest": digest, "config": {"method": "dp_dpo"}}
    for _ in range(2):  # any number of them may run beside each other
        again = _launch(world, campaign_id, **body)
        assert again.status_code == 202
        assert (again.json()["snapshot_digest"], again.json()["labels"]) == (digest, 2)
    other_id = _labelled(world)
    foreign = _launch(world, other_id, snapshot_digest=digest)
    assert foreign.status_code == 404 and digest in foreign.json()["detail"]


def test_a_second_publishing_round_is_refused_while_one_runs(world: World) -> None:
    campaign_id = _labelled(world)
    first = _launch(world, campaign_id).json()["id"]
    answer = _launch(world, campaign_id, publish_rule="manual")
    assert answer.status_code == 409
    assert f"round {first} of campaign {campaign_id} is 'queued'" in answer.json()["detail"]
    with world.database.write() as session:
        rounds.move(session, NOW, first, RoundState.FAILED, error="x")
    assert _launch(world, campaign_id).status_code == 202


@pytest.mark.parametrize(
    ("usual", "legal"),
    [
        ("auto", ["auto", "manual", "never"]),
        ("manual", ["manual", "never"]),
        ("never", ["never"]),
    ],
)
@pytest.mark.parametrize("wanted", ["auto", "manual", "never"])
def test_only_admins_start_rounds_that_publish_more_easily_than_the_campaign_says(
    sqlite_world: World, usual: str, legal: list[str], wanted: str
) -> None:
    campaign_id = _labelled(sqlite_world, publish_rule=usual)
    path = f"/campaigns/{campaign_id}/rounds"
    answer = sqlite_world.client("sam").post(path, json={"publish_rule": wanted})
    if wanted in legal:
        assert (answer.status_code, answer.json()["publish_rule"]) == (202, wanted)
        return
    assert answer.status_code == 403
    told = answer.json()["detail"]
    assert f"publish_rule '{wanted}' is looser than '{usual}' of campaign {campaign_id}" in told
    assert told.endswith("legal values are " + ", ".join(f"'{rule}'" for rule in legal))
    assert sqlite_world.sent == []
    assert _launch(sqlite_world, campaign_id, publish_rule=wanted).status_code == 202


def test_of_many_launches_at_once_one_wins(world: World) -> None:
    campaign_id = _labelled(world)
    answers = at_once([lambda: _launch(world, campaign_id)] * 4)
    assert sorted(answer.status_code for answer in answers) == [202, 409, 409, 409]
    assert len(world.sent) == 1


@pytest.mark.parametrize("choice", [None, Choice.EQUAL, Choice.CANNOT_TELL])
def test_a_round_needs_a_label_that_says_which_is_better(
    world: World, choice: Choice | None
) -> None:
    campaign_id, (pair_id,) = world.add_campaign(pairs=1)
    if choice is not None:
        with world.database.write() as session:
            pair = session.get_one(Pair, pair_id)
            factories.add_label(session, pair, world.ids["ann"], choice)
    answer = _launch(world, campaign_id)
    assert answer.status_code == 409
    assert "none says which episode is better" in answer.json()["detail"]
    with world.database.read() as session:
        assert session.scalars(select(Round)).all() == []
        assert session.scalars(select(LabelSnapshot)).all() == []


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"conservativeness": 1.0}, "conservativeness is 1.0, but must be in [0, 1)"),
        ({"conservativeness": -0.1}, "conservativeness is -0.1, but must be in [0, 1)"),
        ({"conservativeness": "0.5"}, "conservativeness is '0.5', but must be a finite number"),
        ({"conservativeness": True}, "conservativeness is True, but must be a finite number"),
        ({"method": "magic"}, "unknown method 'magic'; legal values are 'rodif_guided', 'rodif'"),
        ({"method": 7}, "method is 7, but must be text"),
        ({"reduction": "max"}, "unknown reduction 'max'; legal values are 'sum', 'mean', 'group'"),
        ({"gamma": 0.5}, "unknown FinetuneConfig field 'gamma'; legal values are 'method'"),
        ({"updates": 2.5}, "updates is 2.5, but must be a whole number"),
        ({"updates": 0}, "updates is 0, but must be at least 1"),
        ({"executed_only": 1}, "executed_only is 1, but must be true or false"),
        ({"guide": {"scales": [1, "2"]}}, "scales is [1, '2'], but must be a list of finite"),
        ({"guide": {"scales": []}}, "scales is (), but must be one or more numbers"),
        ({"guide": {"colour": 1}}, "unknown GuideConfig field 'colour'"),
        ({"guide": 3}, "guide is 3, but must be an object"),
        ({"seed": 10**30}, "seed is 1000000000000000000000000000000, but must be a whole number"),
    ],
)
def test_a_wrong_configuration_is_refused_with_the_legal_values(
    sqlite_world: World, config: dict[str, Any], words: str
) -> None:
    answer = _launch(sqlite_world, _labelled(sqlite_world), config=config)
    assert answer.status_code == 422
    assert words in answer.json()["detail"]
    assert answer.json()["errors"][0]["field"] in words
    assert sqlite_world.sent == []


def test_not_a_number_is_refused(sqlite_world: World) -> None:
    campaign_id = _labelled(sqlite_world)
    answer = sqlite_world.client("ada").post(
        f"/campaigns/{campaign_id}/rounds",
        content='{"config": {"kl_coef": NaN}}',
        headers={"Content-Type": "application/json"},
    )
    assert answer.status_code == 422
    assert "kl_coef is nan, but must be a finite number" in answer.json()["detail"]


@pytest.fixture
def round_id(database: Database) -> int:
    with database.write() as session:
        campaign = factories.add_campaign(session)
        pair = factories.add_pairs(session, campaign, 1)[0]
        factories.add_label(session, pair, campaign.created_by)
        return rounds.launch(session, NOW, campaign.id, RoundRequest()).id


def test_a_round_goes_through_its_states_and_tells_each(database: Database, round_id: int) -> None:
    for step, state in enumerate(PUBLISHED_PATH):
        with database.write() as session:
            at = NOW + timedelta(minutes=step)
            assert rounds.move(session, at, round_id, state).state == state
            rounds.move(session, at, round_id, state)  # a job that runs twice changes nothing
    with database.read() as session:
        ended = session.get_one(Round, round_id)
        told = session.scalars(select(Event.data).where(Event.round_id == round_id))
        assert [data["state"] for data in told] == ["queued", *PUBLISHED_PATH]
    assert ended.finished_at == NOW + timedelta(minutes=3)


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        ([], RoundState.EVALUATING),
        ([], RoundState.PUBLISHED),
        (PUBLISHED_PATH[:1], RoundState.QUEUED),
        (PUBLISHED_PATH[:2], RoundState.PUBLISHED),
        (PUBLISHED_PATH, RoundState.FAILED),
        (PUBLISHED_PATH, RoundState.CANCELLED),
        ([RoundState.CANCELLED], RoundState.FINETUNING),
        ([RoundState.FAILED], RoundState.FINETUNING),
    ],
)
def test_illegal_steps_are_refused(
    database: Database, round_id: int, path: list[RoundState], wrong: RoundState
) -> None:
    with database.write() as session:
        for state in path:
            rounds.move(session, NOW, round_id, state)
        with pytest.raises(ConflictError, match=f"cannot become '{wrong.value}'; legal are"):
            rounds.move(session, NOW, round_id, wrong)


def test_cancelling_stops_the_jobs_and_is_refused_afterwards(world: World) -> None:
    campaign_id = _labelled(world)
    round_id = _launch(world, campaign_id).json()["id"]
    answer = world.client("sam").post(f"/rounds/{round_id}/cancel")
    assert answer.status_code == 200 and answer.json()["state"] == "cancelled"
    with world.database.read() as session:
        job = session.scalars(select(Job).where(Job.round_id == round_id)).one()
    assert job.state == JobState.CANCELLED
    assert world.client("sam").post(f"/rounds/{round_id}/cancel").status_code == 200  # no change
    with world.database.write() as session:
        other = rounds.launch(session, NOW, campaign_id, RoundRequest()).id
        for state in PUBLISHED_PATH:
            rounds.move(session, NOW, other, state)
    refused = world.client("sam").post(f"/rounds/{other}/cancel")
    assert refused.status_code == 409 and "'published'" in refused.json()["detail"]
    assert world.client("sam").post("/rounds/99/cancel").status_code == 404


def test_retrying_a_failed_job_takes_up_its_round(world: World) -> None:
    round_id = _launch(world, _labelled(world)).json()["id"]
    lease = timedelta(seconds=60)
    with world.database.write() as session:
        job = session.scalars(select(Job).where(Job.round_id == round_id)).one()
        claim = jobs.claim(session, NOW, job.id, owner="w", lease=lease)
        assert claim is not None
        rounds.move(session, NOW, round_id, RoundState.FINETUNING)
        jobs.fail(session, NOW, claim, "disk full", retry=False)
        rounds.move(session, NOW, round_id, RoundState.FAILED, error="disk full")
    client = world.client("sam")
    assert client.get(f"/rounds/{round_id}").json()["error"] == "disk full"
    answer = client.post(f"/jobs/{job.id}/retry")
    assert answer.status_code == 200 and answer.json()["state"] == "queued"
    found = client.get(f"/rounds/{round_id}").json()
    assert (found["state"], found["error"], found["finished_at"]) == ("queued", None, None)
    assert world.sent[-1] == (job.id, JobKind.FINETUNE)
    assert client.post(f"/jobs/{job.id}/retry").status_code == 409
    states = [row["state"] for row in client.get("/jobs?state=queued").json()]
    assert states and set(states) == {"queued"}


def test_a_retry_waits_for_a_launch_and_is_refused_beside_it(world: World) -> None:
    campaign_id = _labelled(world)
    round_id = _launch(world, campaign_id).json()["id"]
    with world.database.write() as session:
        job = session.scalars(select(Job).where(Job.round_id == round_id)).one()
        job.state = JobState.FAILED
        rounds.move(session, NOW, round_id, RoundState.FAILED, error="disk full")
    with ThreadPoolExecutor(1) as pool:
        with world.database.write() as session:
            launched = rounds.launch(session, NOW, campaign_id, RoundRequest())
            retry = pool.submit(lambda: world.client("sam").post(f"/jobs/{job.id}/retry"))
            with pytest.raises(TimeoutError):
                retry.result(timeout=0.5)  # until the launch is stored, nobody knows of it
        answer = retry.result(timeout=30)
    assert answer.status_code == 409
    assert f"round {launched.id} of campaign {campaign_id}" in answer.json()["detail"]
    assert world.client("sam").get(f"/jobs/{job.id}").json()["state"] == "failed"


def test_retrying_a_failed_replay_makes_its_pair_wait_again(world: World) -> None:
    campaign_id, (pair_id,) = world.add_campaign(pairs=1)
    with world.database.write() as session:
        session.get_one(Pair, pair_id).state = PairState.FAILED
        job = jobs.enqueue(
            session,
            NOW,
            kind=JobKind.REPLAY,
            campaign_id=campaign_id,
            pair_id=pair_id,
            payload={},
        )
        job.state = JobState.FAILED
    assert world.client("sam").post(f"/jobs/{job.id}/retry").status_code == 200
    assert world.client("sam").get(f"/pairs/{pair_id}").json()["state"] == "waiting"


def test_curves_are_the_points_of_the_round_in_order(world: World) -> None:
    round_id = _launch(world, _labelled(world)).json()["id"]
    with world.database.write() as session:
        campaign_id = session.get_one(Round, round_id).campaign_id
        for step in range(3):
            session.add(
                Event(
                    campaign_id=campaign_id,
                    round_id=round_id,
                    kind="curve",
                    data={"stage": "score", "step": step, "loss": 1.0 / (step + 1)},
                    at=NOW,
                )
            )
            session.flush()
    points = world.client("sam").get(f"/rounds/{round_id}/curves").json()
    assert [point["step"] for point in points] == [0, 1, 2]
    assert points[1] == {"stage": "score", "step": 1, "loss": 0.5}


@pytest.mark.parametrize(
    ("metrics", "told"),
    [
        ({"finetune": {"stopped": "the gate shut at update 0", "curve": []}}, "the gate shut at"),
        ({"finetune": {"chosen": {}}}, None),
        ({}, None),
    ],
)
def test_a_round_tells_why_its_fine_tuning_stopped(
    world: World, metrics: dict[str, Any], told: str | None
) -> None:
    campaign_id = _labelled(world)
    round_id = _launch(world, campaign_id).json()["id"]
    client = world.client("sam")
    assert client.get(f"/rounds/{round_id}").json()["stopped"] is None  # it goes on
    with world.database.write() as session:
        made = factories.add_checkpoint(session, "candidate", parent_id=1, round_id=round_id)
        made.metrics = metrics
    one = client.get(f"/rounds/{round_id}").json()
    assert one["stopped"] is None if told is None else one["stopped"].startswith(told)
    assert client.get(f"/campaigns/{campaign_id}/rounds").json()["items"] == [one]


def test_rounds_are_listed_newest_first_without_what_their_evaluations_draw(world: World) -> None:
    campaign_id = _labelled(world)
    ids = [_launch(world, campaign_id, publish_rule="never").json()["id"] for _ in range(3)]
    evaluation = {"success": 0.5, "n": 2, "paths": [[[0, 1]]], "path_groups": ["left"]}
    result = {"before": evaluation, "after": evaluation, "gate": {"passed": True}, "seconds": {}}
    with world.database.write() as session:
        session.get_one(Round, ids[2]).result = result
    client = world.client("sam")
    first = client.get(f"/campaigns/{campaign_id}/rounds?limit=2").json()
    assert [row["id"] for row in first["items"]] == [ids[2], ids[1]]
    short = {"success": 0.5, "n": 2}
    assert first["items"][0]["result"] == result | {"before": short, "after": short}
    rest = client.get(f"/campaigns/{campaign_id}/rounds?cursor={first['next_cursor']}").json()
    assert [row["id"] for row in rest["items"]] == [ids[0]] and rest["next_cursor"] is None
    assert client.get(f"/rounds/{ids[2]}").json()["result"] == result
