"""Collections and replays that are called off while a worker has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rodif_core.trajectory import Trajectory
from server import rounds, work
from server.states import JobKind, JobState, PairState
from server.store.tables import Event, Pair
from tests.worker.rows import World, make_world
from worker.jobs import collect, replay
from worker.running import run_job


@pytest.fixture
def world(tmp_path: Path) -> World:
    return make_world(tmp_path)


def cancel(world: World, job_id: int) -> None:
    """As the endpoint does, beside the worker that has the job."""
    with world.workbench("api").database.write() as session:
        work.cancel_job(session, world.clock(), job_id, by=world.annotator_id)


def test_cancelled_collect_stops_at_its_next_step_and_keeps_what_is_stored(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collect, "BATCH", 3)
    job_id = world.enqueue_collect(episodes=7)
    store = collect._store

    def store_and_cancel(*args: Any) -> None:
        store(*args)
        cancel(world, job_id)

    with monkeypatch.context() as patch:
        patch.setattr(collect, "_store", store_and_cancel)
        assert run_job(world.bench, job_id) is None
    job = world.job_of(JobKind.COLLECT)
    assert (job.state, job.error, job.attempt) == (JobState.CANCELLED, None, 1)
    assert world.episode_seeds() == [10, 11, 12]
    assert world.rows(Pair) == []
    told = [event.data for event in world.rows(Event) if event.data.get("state")]
    assert [one["state"] for one in told] == ["cancelled"]
    assert run_job(world.bench, job_id) is None  # its message comes once more
    assert world.episode_seeds() == [10, 11, 12]
    with world.bench.database.write() as session:
        rounds.retry_job(session, world.clock(), job_id, by=None)
    assert run_job(world.bench, job_id) == JobState.DONE
    assert world.episode_seeds() == list(range(10, 17))
    assert len(world.rows(Pair)) == 4


def test_collect_cancelled_while_a_batch_rolls_out_stores_nothing_of_it(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = world.enqueue_collect(episodes=3, pairs=1)
    roll_out = collect.rollout

    def roll_out_and_cancel(*args: Any, **kwargs: Any) -> list[Trajectory]:
        cancel(world, job_id)
        return roll_out(*args, **kwargs)

    monkeypatch.setattr(collect, "rollout", roll_out_and_cancel)
    assert run_job(world.bench, job_id) is None
    assert world.job_of(JobKind.COLLECT).state == JobState.CANCELLED
    assert world.episode_seeds() == []


def test_pair_of_a_cancelled_replay_is_failed_until_it_is_retried(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_job(world.bench, world.enqueue_collect(episodes=3, pairs=1))
    job_id = world.job_of(JobKind.REPLAY).id
    draw = replay.make_thumbnail

    def draw_and_cancel(*args: Any) -> bytes:
        cancel(world, job_id)
        return draw(*args)

    with monkeypatch.context() as patch:
        patch.setattr(replay, "make_thumbnail", draw_and_cancel)
        assert run_job(world.bench, job_id) is None
    (pair,) = world.rows(Pair)
    assert (pair.state, pair.replay_sha256) == (PairState.FAILED, None)
    with world.bench.database.write() as session:
        rounds.retry_job(session, world.clock(), job_id, by=None)
    assert world.rows(Pair)[0].state == PairState.WAITING
    assert run_job(world.bench, job_id) == JobState.DONE
    assert world.rows(Pair)[0].state == PairState.READY
