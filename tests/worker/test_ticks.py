"""The beat's ticks: stuck jobs are sent again, due rounds start, and two beats do no harm."""

from __future__ import annotations

from pathlib import Path

import pytest

from server.queue import TICK_QUEUE, TICK_RESEND, TICK_ROUNDS
from server.settings import Settings
from server.states import JobKind, RoundState, RoundTrigger
from server.store.beats import BEAT, last_beat
from server.store.tables import Campaign, Round
from tests.worker.rows import SETTINGS, World, make_world
from worker import running
from worker.running import run_job
from worker.schedule import beat_schedule
from worker.tasks import resend, start_due_rounds


@pytest.fixture
def world(tmp_path: Path) -> World:
    return make_world(tmp_path, resend_seconds=10, job_lease_seconds=60)


def test_queued_job_is_sent_again_once_per_period_even_by_two_beats(world: World) -> None:
    job_id = world.enqueue_collect()
    world.sent.clear()
    resend(world.bench)
    assert world.sent == []  # its message is fresh
    world.clock.advance(11)
    resend(world.bench)
    resend(world.workbench("ticker-2"))
    assert world.sent == [(job_id, JobKind.COLLECT)]
    world.clock.advance(11)
    resend(world.bench)
    assert world.sent == [(job_id, JobKind.COLLECT)] * 2


def test_running_job_is_sent_again_only_when_its_lease_has_run_out(world: World) -> None:
    job_id = world.enqueue_collect()
    running._claim(world.bench, job_id)
    world.sent.clear()
    world.clock.advance(59)
    resend(world.bench)
    assert world.sent == []
    world.clock.advance(2)
    resend(world.bench)
    assert world.sent == [(job_id, JobKind.COLLECT)]


def test_jobs_that_wait_in_a_busy_queue_are_not_sent_again_and_again(world: World) -> None:
    waiting, dead = world.enqueue_collect(), world.enqueue_collect(seed=1000)
    running._claim(world.bench, dead)
    world.sent.clear()
    world.clock.advance(61)
    resend(world.bench, busy={"rollout"})
    assert world.sent == [(dead, JobKind.COLLECT)]  # its worker is gone, whatever waits
    world.sent.clear()
    resend(world.bench, busy={"replay", "finetune"})
    assert world.sent == [(waiting, JobKind.COLLECT)]


def test_message_that_was_lost_while_others_wait_comes_late_but_comes(world: World) -> None:
    job_id = world.enqueue_collect()
    world.sent.clear()
    world.clock.advance(15 * 60 + 1)
    resend(world.bench, busy={"rollout"})
    assert world.sent == [(job_id, JobKind.COLLECT)]


def test_tick_shows_that_the_beat_lives(world: World) -> None:
    resend(world.bench)
    with world.bench.database.read() as session:
        assert last_beat(session, BEAT) == world.clock()


def _labelled(world: World, **settings: float) -> None:
    run_job(world.bench, world.enqueue_collect(episodes=4, pairs=3))
    with world.bench.database.write() as session:
        session.get_one(Campaign, world.campaign_id).settings = SETTINGS | settings
    world.label_all()


def test_round_starts_once_when_enough_new_labels_are_in(world: World) -> None:
    _labelled(world, round_after_labels=3)
    assert len(start_due_rounds(world.bench)) == 1
    assert start_due_rounds(world.workbench("ticker-2")) == []
    (row,) = world.rows(Round)
    assert (row.trigger, row.state) == (RoundTrigger.LABELS, RoundState.QUEUED)
    assert world.sent[-1] == (world.job_of(JobKind.FINETUNE).id, JobKind.FINETUNE)


def test_no_round_starts_when_labels_are_missing_or_rounds_are_off(world: World) -> None:
    _labelled(world, round_after_labels=4)
    assert start_due_rounds(world.bench) == []
    with world.bench.database.write() as session:
        session.get_one(Campaign, world.campaign_id).settings = SETTINGS
    world.clock.advance(1e6)
    assert start_due_rounds(world.bench) == []


def test_round_starts_after_its_minutes_when_there_are_new_labels(world: World) -> None:
    _labelled(world, round_every_minutes=5)
    assert start_due_rounds(world.bench) == []
    world.clock.advance(301)
    assert len(start_due_rounds(world.bench)) == 1
    assert world.rows(Round)[0].trigger == RoundTrigger.PERIODIC


def test_schedule_has_the_periods_of_the_settings_and_ticks_expire(tmp_path: Path) -> None:
    settings = Settings(
        _env_file=None, state_dir=tmp_path, resend_seconds=7, round_tick_seconds=0.5
    )
    schedule = beat_schedule(settings)
    assert {name: entry["schedule"] for name, entry in schedule.items()} == {
        TICK_RESEND: 7,
        TICK_ROUNDS: 0.5,
    }
    assert all(entry["options"]["queue"] == TICK_QUEUE for entry in schedule.values())
    assert [entry["options"]["expires"] for entry in schedule.values()] == [7, 1.0]
