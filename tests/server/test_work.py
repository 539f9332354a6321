"""Collections and replays that somebody calls off."""

from __future__ import annotations

from datetime import timedelta

import pytest
from sqlalchemy import select

from server.states import Choice, JobKind, JobState, PairState
from server.store import jobs
from server.store.tables import AuditEntry, Event, Job, Pair
from tests import factories
from tests.factories import NOW
from tests.server.world import World

COLLECT = {"episodes": 4, "pairs": 1}


def collecting(world: World) -> int:
    """A queued collection; gives its job's id."""
    campaign_id, _ = world.add_campaign()
    answer = world.client("sam").post(f"/campaigns/{campaign_id}/collect", json=COLLECT)
    assert answer.status_code == 202
    return int(answer.json()["id"])


def test_a_queued_job_is_cancelled_once_and_told_of(world: World) -> None:
    job_id = collecting(world)
    admin = world.client("ada")
    answer = admin.post(f"/jobs/{job_id}/cancel")
    assert (answer.status_code, answer.json()["state"]) == (200, "cancelled")
    assert answer.json()["finished_at"] is not None
    assert admin.post(f"/jobs/{job_id}/cancel").json() == answer.json()
    with world.database.read() as session:
        told = [e.data for e in session.scalars(select(Event)) if e.job_id == job_id]
        audited = select(AuditEntry).where(AuditEntry.action == "job.cancel")
        (entry,) = session.scalars(audited)
    assert told == [{"job_id": job_id, "kind": "collect", "state": "cancelled", "error": None}]
    assert (entry.actor_id, entry.subject) == (world.ids["ada"], f"job/{job_id}")


def test_no_worker_takes_a_cancelled_job_and_no_tick_sends_it_again(world: World) -> None:
    job_id = collecting(world)
    world.client("ada").post(f"/jobs/{job_id}/cancel")
    late = NOW + timedelta(days=1)
    with world.database.write() as session:
        claim = jobs.claim(session, late, job_id, owner="w", lease=timedelta(seconds=60))
        assert claim is None
        assert jobs.stuck_jobs(session, late, patience=timedelta(seconds=1)) == []


@pytest.mark.parametrize("state", [JobState.DONE, JobState.FAILED])
def test_a_job_that_has_ended_is_not_cancelled(sqlite_world: World, state: JobState) -> None:
    job_id = collecting(sqlite_world)
    with sqlite_world.database.write() as session:
        session.get_one(Job, job_id).state = state
    answer = sqlite_world.client("ada").post(f"/jobs/{job_id}/cancel")
    assert answer.status_code == 409
    assert f"job {job_id} is '{state}'; only jobs in state 'queued'" in answer.json()["detail"]
    assert sqlite_world.client("ada").post("/jobs/999/cancel").status_code == 404


def test_a_job_of_a_round_ends_with_its_round_alone(world: World) -> None:
    campaign_id, (pair_id,) = world.add_campaign(pairs=1)
    with world.database.write() as session:
        factories.add_label(session, session.get_one(Pair, pair_id), world.ids["ann"], Choice.FIRST)
    client = world.client("ada")
    round_id = client.post(f"/campaigns/{campaign_id}/rounds", json={}).json()["id"]
    with world.database.read() as session:
        job_id = session.scalars(select(Job.id).where(Job.round_id == round_id)).one()
    answer = client.post(f"/jobs/{job_id}/cancel")
    assert answer.status_code == 409
    assert f"job {job_id} belongs to round {round_id}; cancel the round" in answer.json()["detail"]
    client.post(f"/rounds/{round_id}/cancel")
    assert client.post(f"/jobs/{job_id}/retry").status_code == 409


@pytest.mark.parametrize("before", [PairState.WAITING, PairState.READY])
def test_a_pair_without_a_replay_fails_and_one_that_has_one_stays(
    world: World, before: PairState
) -> None:
    campaign_id, (pair_id,) = world.add_campaign(pairs=1)
    with world.database.write() as session:
        session.get_one(Pair, pair_id).state = before
        job = jobs.enqueue(
            session,
            NOW,
            kind=JobKind.REPLAY,
            campaign_id=campaign_id,
            pair_id=pair_id,
            payload={},
        )
    client = world.client("ada")
    assert client.post(f"/jobs/{job.id}/cancel").json()["state"] == "cancelled"
    expected = "failed" if before is PairState.WAITING else "ready"
    assert client.get(f"/pairs/{pair_id}").json()["state"] == expected
    assert client.post(f"/jobs/{job.id}/retry").json()["state"] == "queued"
    expected = "waiting" if before is PairState.WAITING else "ready"
    assert client.get(f"/pairs/{pair_id}").json()["state"] == expected
