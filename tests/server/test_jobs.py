"""Jobs as rows: exactly one worker at a time, and a stale one changes nothing."""

from __future__ import annotations

from datetime import datetime, timedelta

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy.orm import Session

from server.errors import ConflictError, LeaseLostError, NotFoundError
from server.states import JobKind, JobState
from server.store import jobs
from server.store.jobs import Claim
from server.store.session import Database
from server.store.tables import Job
from tests import factories
from tests.factories import NOW
from tests.server.threads import at_once
from tests.server.world import World

LEASE = timedelta(seconds=60)
LATER = NOW + LEASE + timedelta(seconds=1)


@pytest.fixture
def job_id(database: Database) -> int:
    with database.write() as session:
        return _enqueue(session).id


def _enqueue(session: Session, dedupe_key: str | None = None, max_attempts: int = 5) -> Job:
    campaign = factories.add_campaign(session)
    return jobs.enqueue(
        session,
        NOW,
        kind=JobKind.COLLECT,
        campaign_id=campaign.id,
        payload={"episodes": 2},
        dedupe_key=dedupe_key,
        max_attempts=max_attempts,
    )


def _claim(database: Database, job_id: int, owner: str = "w1", now: datetime = NOW) -> Claim | None:
    with database.write() as session:
        return jobs.claim(session, now, job_id, owner=owner, lease=LEASE)


def _get(database: Database, job_id: int) -> Job:
    with database.read() as session:
        return session.get_one(Job, job_id)


def _must(claim: Claim | None) -> Claim:
    assert claim is not None
    return claim


def test_a_claimed_job_runs_and_ends_with_its_result(database: Database, job_id: int) -> None:
    claim = _must(_claim(database, job_id))
    running = _get(database, job_id)
    assert (running.state, running.attempt, running.owner) == (JobState.RUNNING, 1, "w1")
    assert running.started_at == NOW and running.lease_expires_at == NOW + LEASE
    with database.write() as session:
        jobs.renew(session, NOW + LEASE / 2, claim, lease=LEASE, progress=0.5, stage="rolling")
    half = _get(database, job_id)
    assert (half.progress, half.stage) == (0.5, "rolling")
    assert half.lease_expires_at == NOW + 1.5 * LEASE
    with database.write() as session:
        jobs.finish(session, LATER, claim, {"episodes": 2})
    done = _get(database, job_id)
    assert (done.state, done.result, done.progress) == (JobState.DONE, {"episodes": 2}, 1.0)
    assert done.finished_at == LATER and done.lease_expires_at is None
    assert _claim(database, job_id, "w2", LATER + LEASE) is None


def test_exactly_one_of_many_workers_gets_the_job(database: Database, job_id: int) -> None:
    calls = [lambda owner=f"w{i}": _claim(database, job_id, owner) for i in range(8)]
    winners = [claim for claim in at_once(calls) if claim is not None]
    assert len(winners) == 1
    assert winners[0].attempt == 1
    assert _get(database, job_id).owner == winners[0].owner


def test_many_workers_share_many_jobs_without_a_double(database: Database) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session)
        ids = [
            jobs.enqueue(session, NOW, kind=JobKind.REPLAY, campaign_id=campaign.id, payload={}).id
            for _ in range(12)
        ]

    def work(owner: str) -> list[int]:
        return [job_id for job_id in ids if _claim(database, job_id, owner) is not None]

    taken = at_once([lambda owner=f"w{i}": work(owner) for i in range(4)])
    assert sorted(job_id for share in taken for job_id in share) == ids


def test_a_live_lease_keeps_others_out_and_an_expired_one_does_not(
    database: Database, job_id: int
) -> None:
    _must(_claim(database, job_id))
    assert _claim(database, job_id, "w2", NOW + LEASE) is None
    second = _must(_claim(database, job_id, "w2", LATER))
    assert second.attempt == 2
    assert _get(database, job_id).started_at == NOW  # of the first attempt


@pytest.mark.parametrize("step", ["renew", "finish", "fail"])
def test_a_worker_that_lost_its_lease_changes_nothing(
    database: Database, job_id: int, step: str
) -> None:
    stale = _must(_claim(database, job_id))
    fresh = _must(_claim(database, job_id, "w2", LATER))
    with (
        pytest.raises(LeaseLostError, match=f"job {job_id}, attempt 1 of 'w1'"),
        database.write() as session,
    ):
        factories.add_account(session, "an effect of the stale step")
        if step == "renew":
            jobs.renew(session, LATER, stale, lease=LEASE, progress=0.9)
        elif step == "finish":
            jobs.finish(session, LATER, stale, {"episodes": 99})
        else:
            jobs.fail(session, LATER, stale, "stale", retry=False)
    row = _get(database, job_id)
    assert (row.state, row.owner, row.result) == (JobState.RUNNING, "w2", None)
    with database.write() as session:
        factories.add_account(session, "an effect of the stale step")  # it had been rolled back
        jobs.finish(session, LATER, fresh, {"episodes": 2})
    assert _get(database, job_id).result == {"episodes": 2}


def test_the_same_owner_with_an_old_attempt_is_stale_too(database: Database, job_id: int) -> None:
    old = _must(_claim(database, job_id, "w1"))
    _must(_claim(database, job_id, "w1", LATER))
    with pytest.raises(LeaseLostError), database.write() as session:
        jobs.finish(session, LATER, old, {})


def test_a_failed_attempt_is_tried_again_until_the_cap(database: Database, job_id: int) -> None:
    states = []
    for _ in range(5):
        claim = _must(_claim(database, job_id))
        with database.write() as session:
            states.append(jobs.fail(session, NOW, claim, "out of luck", retry=True))
    assert states == [JobState.QUEUED] * 4 + [JobState.FAILED]
    row = _get(database, job_id)
    assert (row.state, row.error, row.attempt) == (JobState.FAILED, "out of luck", 5)
    assert _claim(database, job_id) is None


def test_an_error_that_no_retry_can_cure_fails_at_once(database: Database, job_id: int) -> None:
    claim = _must(_claim(database, job_id))
    with database.write() as session:
        assert jobs.fail(session, NOW, claim, "no labels", retry=False) is JobState.FAILED


def test_a_job_that_kills_every_worker_is_given_up(database: Database) -> None:
    with database.write() as session:
        job_id = _enqueue(session, max_attempts=2).id
    _must(_claim(database, job_id, "w1"))
    _must(_claim(database, job_id, "w2", LATER))
    much_later = LATER + 2 * LEASE
    assert _claim(database, job_id, "w3", much_later) is None
    with database.write() as session:
        assert jobs.stuck_jobs(session, much_later, patience=timedelta(0)) == []
        assert jobs.give_up_exhausted(session, LATER) == []  # the second attempt still runs
        given_up = jobs.give_up_exhausted(session, much_later)
        assert [(job.id, job.state) for job in given_up] == [(job_id, JobState.FAILED)]
        assert "died in every one" in str(given_up[0].error)


def test_a_job_of_a_stopped_worker_goes_back_without_losing_an_attempt(database: Database) -> None:
    with database.write() as session:
        job_id = _enqueue(session, max_attempts=2).id
    for cycle in range(4):
        claim = _must(_claim(database, job_id, f"w{cycle}"))
        with database.write() as session:
            assert jobs.running_claims(session) == [claim]
            assert jobs.hand_back(session, claim)
            assert not jobs.hand_back(session, claim)  # it is gone
            assert jobs.running_claims(session) == []
        with pytest.raises(LeaseLostError), database.write() as session:
            jobs.finish(session, NOW, claim, {})
        with database.write() as session:
            sent = jobs.stuck_jobs(session, NOW, patience=LEASE, busy_kinds=[JobKind.COLLECT])
            assert sent == [(job_id, JobKind.COLLECT)]  # at once
            assert jobs.give_up_exhausted(session, NOW) == []
    for _ in range(2):  # attempts that die count as ever
        now = _get(database, job_id).lease_expires_at or NOW
        _must(_claim(database, job_id, "dying", now + timedelta(seconds=1)))
    with database.write() as session:
        given_up = jobs.give_up_exhausted(session, NOW + 10 * LEASE)
        assert [job.id for job in given_up] == [job_id]


def test_stuck_jobs_are_queued_or_expired_ones_sent_long_ago(database: Database) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session)
        queued, running, expired, done = (
            jobs.enqueue(
                session, NOW, kind=JobKind.EVALUATE, campaign_id=campaign.id, payload={}
            ).id
            for _ in range(4)
        )
    _must(_claim(database, expired))
    _must(_claim(database, running, "w2", NOW + LEASE))
    finished = _must(_claim(database, done))
    with database.write() as session:
        jobs.finish(session, NOW, finished, {})
    expected = [(queued, JobKind.EVALUATE), (expired, JobKind.EVALUATE)]
    with database.write() as session:
        assert jobs.stuck_jobs(session, LATER, patience=LEASE) == expected
        assert jobs.stuck_jobs(session, LATER, patience=LEASE) == []  # just sent


def test_two_ticks_at_once_do_no_harm(database: Database, job_id: int) -> None:
    def tick() -> list[tuple[int, JobKind]]:
        with database.write() as session:
            return jobs.stuck_jobs(session, LATER, patience=LEASE)

    found = at_once([tick, tick])
    assert sorted(found, key=len) == [[], [(job_id, JobKind.COLLECT)]]


def test_an_equal_dedupe_key_gives_one_job_even_at_once(database: Database) -> None:
    with database.write() as session:
        campaign_id = factories.add_campaign(session).id

    def put() -> int:
        with database.write() as session:
            return jobs.enqueue(
                session,
                NOW,
                kind=JobKind.EVALUATE,
                campaign_id=campaign_id,
                payload={},
                dedupe_key="evaluate:7",
            ).id

    assert set(at_once([put] * 6)) == {1}


def test_a_cancelled_job_is_lost_for_its_worker_and_cannot_be_claimed(
    database: Database, job_id: int
) -> None:
    claim = _must(_claim(database, job_id))
    with database.write() as session:
        assert jobs.cancel(session, NOW, job_id)
        assert not jobs.cancel(session, NOW, job_id)
    with pytest.raises(LeaseLostError), database.write() as session:
        jobs.renew(session, NOW, claim, lease=LEASE)
    assert _claim(database, job_id, "w2", LATER) is None


def test_only_failed_jobs_can_be_retried_and_old_claims_stay_dead(
    database: Database, job_id: int
) -> None:
    refused = pytest.raises(ConflictError, match="only jobs in state 'failed'")
    with refused, database.write() as session:
        jobs.retry(session, NOW, job_id)
    claim = _must(_claim(database, job_id))
    with database.write() as session:
        jobs.fail(session, NOW, claim, "broken", retry=False)
        job = jobs.retry(session, NOW, job_id)
        assert (job.state, job.error, job.attempt) == (JobState.QUEUED, None, 1)
    assert _must(_claim(database, job_id, "w1")).attempt == 2
    with pytest.raises(LeaseLostError), database.write() as session:
        jobs.finish(session, NOW, claim, {})
    with pytest.raises(NotFoundError, match="no job 999"), database.write() as session:
        jobs.retry(session, NOW, 999)


@given(steps=st.lists(st.sampled_from(["claim", "expire", "finish", "fail", "stale"]), max_size=12))
@settings(
    max_examples=30,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_a_job_ends_at_most_once_whatever_happens(sqlite_world: World, steps: list[str]) -> None:
    """Random schedules of claims, expiries, ends and late ends; attempts only rise."""
    database = sqlite_world.database
    campaign_id, _ = sqlite_world.add_campaign()
    with database.write() as session:
        job_id = jobs.enqueue(
            session, NOW, kind=JobKind.COLLECT, campaign_id=campaign_id, payload={}
        ).id
    now, ends = NOW, 0
    claims: list[Claim] = []
    for step in steps:
        if step == "expire":
            now += LEASE + timedelta(seconds=1)
        elif step == "claim":
            claim = _claim(database, job_id, f"w{len(claims)}", now)
            claims += [claim] if claim else []
        elif claims:
            ends += _end(database, claims[0] if step == "stale" else claims[-1], step, now)
    assert ends <= 1
    assert [claim.attempt for claim in claims] == list(range(1, len(claims) + 1))
    assert (_get(database, job_id).state == JobState.DONE) == (ends == 1)


def _end(database: Database, claim: Claim, step: str, now: datetime) -> int:
    """1 when the job was finished by this claim."""
    try:
        with database.write() as session:
            if step == "fail":
                jobs.fail(session, now, claim, "x", retry=True)
                return 0
            jobs.finish(session, now, claim, {})
            return 1
    except LeaseLostError:
        return 0
