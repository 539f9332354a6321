"""Claims, fencing, retries and progress of job attempts, with jobs that only a test would make."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from rodif_core.errors import SimulationDivergedError
from server.errors import LeaseLostError
from server.states import JobKind, JobState, PairState, RoundState
from server.store import jobs
from server.store.tables import Event, Job, Pair, Round
from tests.worker.rows import World, make_world
from worker import running
from worker.attempt import Attempt
from worker.running import run_job


@pytest.fixture
def world(tmp_path: Path) -> World:
    return make_world(tmp_path, job_lease_seconds=60)


Runner = Callable[[Attempt], None]


@pytest.fixture
def job_does(monkeypatch: pytest.MonkeyPatch) -> Callable[[Runner], None]:
    """Let collect jobs do something else."""

    def install(runner: Runner) -> None:
        module = ModuleType("worker.jobs.collect")
        module.run = runner  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "worker.jobs.collect", module)

    return install


def _finish(attempt: Attempt) -> None:
    with attempt.step() as session:
        attempt.finish(session, {"by": attempt.bench.owner})


def test_job_ends_with_the_message_when_a_known_error_stops_it(
    world: World, job_does: Callable[[Runner], None]
) -> None:
    def diverge(_: Attempt) -> None:
        raise SimulationDivergedError("simulation 3 blew up at step 17")

    job_does(diverge)
    job_id = world.enqueue_collect()
    assert run_job(world.bench, job_id) == JobState.FAILED
    job = world.job_of(JobKind.COLLECT)
    assert (job.state, job.error, job.attempt) == (
        JobState.FAILED,
        "simulation 3 blew up at step 17",
        1,
    )


def test_job_is_tried_again_until_its_attempts_are_used_up(
    world: World, job_does: Callable[[Runner], None], caplog: pytest.LogCaptureFixture
) -> None:
    def crash(_: Attempt) -> None:
        raise ZeroDivisionError("a bug")

    job_does(crash)
    job_id = world.enqueue_collect()
    seen = [run_job(world.bench, job_id) for _ in range(6)]
    assert seen == [JobState.QUEUED] * 4 + [JobState.FAILED, None]
    assert world.job_of(JobKind.COLLECT).error == "ZeroDivisionError: a bug"
    assert "Traceback" in caplog.text


def test_job_that_kills_its_worker_is_given_up_with_its_round(world: World) -> None:
    run_job(world.bench, world.enqueue_collect(episodes=3, pairs=1))
    world.label_all(("first",))
    round_id = world.launch()
    job_id = world.job_of(JobKind.FINETUNE).id
    for _ in range(jobs.DEFAULT_MAX_ATTEMPTS):
        assert running._claim(world.bench, job_id) is not None  # and then nothing more is heard
        world.clock.advance(61)
    assert run_job(world.bench, job_id) is None
    with world.bench.database.write() as session:
        assert running.give_up_exhausted(session, world.clock()) == 1
    with world.bench.database.write() as session:
        assert running.give_up_exhausted(session, world.clock()) == 0
    (row,) = world.rows(Round)
    assert (row.id, row.state) == (round_id, RoundState.FAILED)
    assert "died" in (row.error or "")


def test_given_up_replay_marks_its_pair(world: World) -> None:
    run_job(world.bench, world.enqueue_collect(episodes=3, pairs=1))
    job_id = world.job_of(JobKind.REPLAY).id
    for _ in range(jobs.DEFAULT_MAX_ATTEMPTS):
        running._claim(world.bench, job_id)
        world.clock.advance(61)
    with world.bench.database.write() as session:
        running.give_up_exhausted(session, world.clock())
    assert world.rows(Pair)[0].state == PairState.FAILED


def test_job_is_left_alone_while_another_worker_holds_it(world: World) -> None:
    job_id = world.enqueue_collect()
    assert running._claim(world.bench, job_id) is not None
    assert run_job(world.workbench("worker-2"), job_id) is None


def test_stale_attempt_cannot_write(world: World) -> None:
    job_id = world.enqueue_collect()
    stale = running._claim(world.bench, job_id)
    assert stale is not None
    world.clock.advance(61)
    fresh = running._claim(world.workbench("worker-2"), job_id)
    assert fresh is not None
    with pytest.raises(LeaseLostError, match="attempt 1"), stale.step() as session:
        stale.event(session, "job", {"from": "the dead"})
    with pytest.raises(LeaseLostError):
        stale.progress("rollouts", 0.9)
    _finish(fresh)
    job = world.job_of(JobKind.COLLECT)
    assert (job.state, job.result) == (JobState.DONE, {"by": "worker-2"})
    assert not [event for event in world.rows(Event) if event.data.get("from")]


def test_stale_attempt_writes_nothing_when_it_is_overtaken_inside_its_step(world: World) -> None:
    job_id = world.enqueue_collect()
    stale = running._claim(world.bench, job_id)
    assert stale is not None
    with stale.step() as session:
        stale.event(session, "job", {"step": 1})
    world.clock.advance(61)
    assert running._claim(world.workbench("worker-2"), job_id) is not None
    with pytest.raises(LeaseLostError), stale.step() as session:
        stale.finish(session, {})
    assert world.job_of(JobKind.COLLECT).state == JobState.RUNNING


def test_attempt_whose_lease_ran_out_goes_on_when_nobody_took_over(world: World) -> None:
    attempt = running._claim(world.bench, world.enqueue_collect())
    assert attempt is not None
    world.clock.advance(3600)
    _finish(attempt)
    assert world.job_of(JobKind.COLLECT).state == JobState.DONE


def test_heart_beat_keeps_the_lease_alive(tmp_path: Path) -> None:
    world = make_world(tmp_path, job_lease_seconds=0.3)
    attempt = running._claim(world.bench, world.enqueue_collect())
    assert attempt is not None
    start = world.job_of(JobKind.COLLECT).lease_expires_at
    assert start is not None
    world.clock.advance(100)
    with attempt:
        deadline = time.monotonic() + 20
        while world.job_of(JobKind.COLLECT).lease_expires_at == start:
            assert time.monotonic() < deadline, "no heart-beat"
            time.sleep(0.02)
    assert not any(thread.name == "heart-beat" for thread in threading.enumerate())


def test_progress_stops_the_job_when_the_heart_beat_lost_the_lease(tmp_path: Path) -> None:
    world = make_world(tmp_path, job_lease_seconds=0.3)
    job_id = world.enqueue_collect()
    attempt = running._claim(world.bench, job_id)
    assert attempt is not None
    with attempt:
        with world.bench.database.write() as session:
            jobs.cancel(session, world.clock(), job_id)
        deadline = time.monotonic() + 20
        with pytest.raises(LeaseLostError):
            while time.monotonic() < deadline:
                attempt._check()
                time.sleep(0.02)


def test_progress_writes_at_most_every_half_second_and_keeps_every_curve_point(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("worker.attempt.time.monotonic", lambda: now)
    attempt = running._claim(world.bench, world.enqueue_collect())
    assert attempt is not None
    for update in range(101):
        now = update / 100  # a second of updates
        attempt.progress("updates", update / 100, {"loss": float(update)})
    with attempt.step() as session:
        attempt.finish(session, {})
    events = world.rows(Event)
    shown = [e.data["progress"] for e in events if e.kind == "job"]
    assert shown == [0.0, 0.5, 1.0, 1.0]
    points = [e.data for e in events if e.kind == "curve"]
    assert [(p["step"], p["loss"]) for p in points] == [(i + 1, float(i)) for i in range(101)]
    job = world.rows(Job)[0]
    assert (job.progress, job.state) == (1.0, JobState.DONE)


def test_curve_goes_on_without_repeats_when_an_attempt_is_taken_up_again(world: World) -> None:
    job_id = world.enqueue_collect()
    first = running._claim(world.bench, job_id)
    assert first is not None
    for update in (1, 2, 3):
        first.progress("updates", update / 6, {"loss": 1 / update})
        first._shown_at = float("-inf")  # let every point be written at once
    world.clock.advance(61)
    second = running._claim(world.bench, job_id)
    assert second is not None
    for update in (2, 3, 4, 5):  # from the last saved state on
        second.progress("updates", update / 6, {"loss": 1 / update})
    with second.step() as session:
        second.finish(session, {})
    points = [e.data for e in world.rows(Event) if e.kind == "curve"]
    assert [(p["step"], p["loss"]) for p in points] == [
        (1, 1.0),
        (2, 0.5),
        (3, 1 / 3),
        (4, 0.25),
        (5, 0.2),
    ]
