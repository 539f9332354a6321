"""Collect and replay jobs: delivered twice, interrupted, or given bad input."""

from __future__ import annotations

from pathlib import Path

import pytest

from rodif_core.trajectory import Trajectory
from server.states import JobKind, JobState, PairState
from server.store.tables import Episode, Event, Job, Pair
from tests.worker.rows import World, failing_once, make_world
from worker.jobs import collect
from worker.running import run_job


@pytest.fixture
def world(tmp_path: Path) -> World:
    return make_world(tmp_path)


def test_collect_stores_episodes_pairs_and_one_replay_job_per_pair(world: World) -> None:
    job_id = world.enqueue_collect(episodes=6, pairs=4)
    world.sent.clear()
    assert run_job(world.bench, job_id) == JobState.DONE
    assert world.episode_seeds() == [10, 11, 12, 13, 14, 15]
    episode = world.rows(Episode)[0]
    trajectory = Trajectory.from_bytes(world.bench.artifacts.get(episode.artifact_sha256))
    assert (trajectory.info["seed"], len(trajectory.actions)) == (10, episode.steps)
    assert len(trajectory.chains) > 0
    pairs = world.rows(Pair)
    assert len(pairs) == 4
    replay_jobs = [job for job in world.rows(Job) if job.kind == JobKind.REPLAY]
    assert [job.pair_id for job in replay_jobs] == [pair.id for pair in pairs]
    assert world.sent == [(job.id, JobKind.REPLAY) for job in replay_jobs]
    result = world.job_of(JobKind.COLLECT).result
    assert result is not None
    assert (result["episodes"], result["pairs"]) == (6, 4)
    assert sum(result["groups"].values()) == 6


def test_collect_changes_nothing_when_delivered_twice(world: World) -> None:
    job_id = world.enqueue_collect()
    run_job(world.bench, job_id)
    before = (world.episode_seeds(), [p.id for p in world.rows(Pair)], len(world.rows(Job)))
    assert run_job(world.bench, job_id) is None
    after = (world.episode_seeds(), [p.id for p in world.rows(Pair)], len(world.rows(Job)))
    assert after == before


def test_collect_goes_on_without_duplicates_when_an_attempt_died(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collect, "BATCH", 3)
    job_id = world.enqueue_collect(episodes=7)
    with monkeypatch.context() as patch:
        patch.setattr(collect, "_store", failing_once(collect._store, 1))
        assert run_job(world.bench, job_id) == JobState.QUEUED
    assert world.episode_seeds() == [10, 11, 12]
    assert "lightning strike" in (world.job_of(JobKind.COLLECT).error or "")
    assert run_job(world.bench, job_id) == JobState.DONE
    assert world.episode_seeds() == list(range(10, 17))


def test_interrupted_collect_ends_with_the_same_files_as_an_undisturbed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calm, stormy = make_world(tmp_path / "calm"), make_world(tmp_path / "stormy")
    monkeypatch.setattr(collect, "BATCH", 2)
    run_job(calm.bench, calm.enqueue_collect(episodes=5))
    monkeypatch.setattr(collect, "_store", failing_once(collect._store, 1))
    job_id = stormy.enqueue_collect(episodes=5)
    assert run_job(stormy.bench, job_id) == JobState.QUEUED
    assert run_job(stormy.bench, job_id) == JobState.DONE

    def essence(world: World) -> list[tuple[object, ...]]:
        episodes = [(e.seed, e.artifact_sha256) for e in world.rows(Episode)]
        return episodes + [
            (p.first_episode_id, p.second_episode_id, p.first_is_left) for p in world.rows(Pair)
        ]

    assert essence(calm) == essence(stormy)


def test_collect_interrupted_between_its_pairs_stores_each_of_them_once(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pairs come in portions, so that annotators' answers never wait for thousands of them."""
    monkeypatch.setattr(collect, "PAIR_BATCH", 2)
    job_id = world.enqueue_collect(episodes=5, pairs=7)
    with monkeypatch.context() as patch:
        patch.setattr(collect, "_add_pairs", failing_once(collect._add_pairs, 2))
        assert run_job(world.bench, job_id) == JobState.QUEUED
    assert len(world.rows(Pair)) == 4
    assert run_job(world.bench, job_id) == JobState.DONE
    ends = {frozenset((p.first_episode_id, p.second_episode_id)) for p in world.rows(Pair)}
    assert len(ends) == len(world.rows(Pair)) == 7
    replays = [job.pair_id for job in world.rows(Job) if job.kind == JobKind.REPLAY]
    assert sorted(replays) == [pair.id for pair in world.rows(Pair)]
    result = world.job_of(JobKind.COLLECT).result
    assert result is not None and result["pairs"] == 7


def test_collect_fails_with_the_legal_range_when_more_pairs_are_asked_than_exist(
    world: World,
) -> None:
    job_id = world.enqueue_collect(episodes=3, pairs=50)
    assert run_job(world.bench, job_id) == JobState.FAILED
    error = world.job_of(JobKind.COLLECT).error or ""
    assert "50" in error and "0 … 3" in error


def test_replay_makes_the_pair_ready_and_is_the_same_when_made_again(world: World) -> None:
    run_job(world.bench, world.enqueue_collect(episodes=3, pairs=1))
    job_id = world.job_of(JobKind.REPLAY).id
    assert run_job(world.bench, job_id) == JobState.DONE
    pair = world.rows(Pair)[0]
    assert pair.state == PairState.READY
    replay = world.bench.artifacts.get(pair.replay_sha256)
    thumbnail = world.bench.artifacts.get(pair.thumbnail_sha256)
    assert len(replay) > 1000
    assert thumbnail[:4] == b"RIFF" and thumbnail[8:12] == b"WEBP"
    assert run_job(world.bench, job_id) is None
    again = world.enqueue(JobKind.REPLAY, pair_id=pair.id)
    assert run_job(world.bench, again) == JobState.DONE
    twice = world.rows(Pair)[0]
    assert (twice.replay_sha256, twice.thumbnail_sha256) == (
        pair.replay_sha256,
        pair.thumbnail_sha256,
    )


def test_replay_fails_with_the_file_named_when_an_episode_file_is_damaged(world: World) -> None:
    run_job(world.bench, world.enqueue_collect(episodes=3, pairs=1))
    pair = world.rows(Pair)[0]
    episode = next(e for e in world.rows(Episode) if e.id == pair.first_episode_id)
    path = world.bench.artifacts.path(episode.artifact_sha256)
    path.write_bytes(path.read_bytes()[:-100])
    assert run_job(world.bench, world.job_of(JobKind.REPLAY).id) == JobState.FAILED
    assert world.rows(Pair)[0].state == PairState.FAILED
    assert episode.artifact_sha256 in (world.job_of(JobKind.REPLAY).error or "")
    failures = [e for e in world.rows(Event) if e.data.get("state") == JobState.FAILED]
    assert len(failures) == 1
