"""Sessions that send after the commit, artifacts, pages, signs of life."""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import select, text
from sqlalchemy.exc import DatabaseError, StatementError

from server.errors import ArtifactError
from server.states import JobKind
from server.store import jobs
from server.store.artifacts import ArtifactStore
from server.store.beats import last_beat, last_beats_by_queue, record_beat
from server.store.events import add_event, events_after
from server.store.paging import page
from server.store.session import Database
from server.store.tables import Annotator, Job
from tests import factories
from tests.factories import NOW
from tests.server.threads import at_once


def test_a_commit_on_sqlite_reaches_the_disk_before_it_is_acknowledged(tmp_path: Path) -> None:
    database = Database(f"sqlite:///{tmp_path / 'studio.db'}")
    with database.write() as session:
        assert session.execute(text("PRAGMA synchronous")).scalar_one() == 2  # FULL
    database.dispose()


def _enqueue(database: Database, campaign_id: int, *, fail: bool = False) -> None:
    with database.write() as session:
        jobs.enqueue(session, NOW, kind=JobKind.COLLECT, campaign_id=campaign_id, payload={})
        if fail:
            raise RuntimeError("after the insert")


def test_jobs_are_sent_after_the_commit_and_never_after_a_rollback(database_url: str) -> None:
    seen: list[tuple[int, int]] = []
    reader = Database(database_url)

    def send(job_id: int, _kind: JobKind) -> None:
        with reader.read() as session:  # another connection: sees committed rows only
            seen.append((job_id, len(session.scalars(select(Job)).all())))

    database = Database(database_url, send)
    with database.write() as session:
        campaign_id = factories.add_campaign(session).id
    _enqueue(database, campaign_id)
    with pytest.raises(RuntimeError):
        _enqueue(database, campaign_id, fail=True)
    assert seen == [(1, 1)]
    database.dispose()
    reader.dispose()


def test_a_broken_broker_fails_no_transaction_and_the_tick_finds_the_job(
    database_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    def send(_job_id: int, _kind: JobKind) -> None:
        raise ConnectionError("broker away")

    database = Database(database_url, send)
    with database.write() as session:
        campaign_id = factories.add_campaign(session).id
    _enqueue(database, campaign_id)
    assert "jobs [1] wait for the tick" in caplog.text
    patience = timedelta(seconds=10)
    with database.write() as session:
        assert jobs.stuck_jobs(session, NOW + timedelta(seconds=9), patience=patience) == []
        later = NOW + timedelta(seconds=10)
        assert jobs.stuck_jobs(session, later, patience=patience) == [(1, JobKind.COLLECT)]
    database.dispose()


def test_reading_does_not_wait_for_a_writer(database: Database) -> None:
    with database.write() as writer:
        factories.add_account(writer, "new")
        writer.flush()
        with database.read() as reader:
            assert reader.scalars(select(Annotator)).all() == []


def test_many_threads_that_read_and_then_write_all_succeed(database: Database) -> None:
    def read_then_write(index: int) -> None:
        for step in range(5):
            with database.write() as session:
                session.scalars(select(Annotator)).all()
                factories.add_account(session, f"{index}-{step}")

    at_once([lambda index=index: read_then_write(index) for index in range(8)])
    with database.read() as session:
        assert len(session.scalars(select(Annotator)).all()) == 40


def test_times_come_back_aware_and_naive_ones_are_refused(database: Database) -> None:
    tokyo = datetime.fromisoformat("2026-11-22T21:00:00.123456+09:00")
    with database.write() as session:
        record_beat(session, tokyo, "beat")
    with database.read() as session:
        found = last_beat(session, "beat")
    assert found == tokyo and found is not None and found.tzinfo == UTC
    with pytest.raises(StatementError, match="naive datetime"), database.write() as session:
        record_beat(session, datetime(2026, 1, 1), "worker")


def test_the_newest_sign_of_life_of_the_workers_of_each_queue_counts(database: Database) -> None:
    with database.write() as session:
        both, one = {"queues": ["replay", "rollout"]}, {"queues": ["replay"]}
        record_beat(session, NOW, "worker@one", one)
        record_beat(session, NOW + timedelta(seconds=5), "worker@two", one)
        record_beat(session, NOW + timedelta(seconds=9), "workerless", both)
        record_beat(session, NOW + timedelta(seconds=1), "worker@one", both)
        record_beat(session, NOW + timedelta(seconds=9), "worker@three")
    with database.read() as session:
        assert last_beats_by_queue(session) == {
            "replay": NOW + timedelta(seconds=5),
            "rollout": NOW + timedelta(seconds=1),
        }
        assert last_beat(session, "beat") is None


def test_foreign_keys_are_enforced(database: Database) -> None:
    with pytest.raises(DatabaseError, match=r"(?i)foreign key"), database.write() as session:
        jobs.enqueue(session, NOW, kind=JobKind.COLLECT, campaign_id=77, payload={})


def test_events_come_in_order_and_unknown_kinds_are_refused(database: Database) -> None:
    with database.write() as session:
        campaign_id = factories.add_campaign(session).id
        for step in range(3):
            add_event(session, NOW, campaign_id=campaign_id, kind="curve", data={"step": step})
            session.flush()
        with pytest.raises(ValueError, match="unknown event kind 'gossip'"):
            add_event(session, NOW, campaign_id=campaign_id, kind="gossip", data={})
    with database.read() as session:
        found = events_after(session, 1, campaign_id=campaign_id)
        assert [(event.id, event.data) for event in found] == [(2, {"step": 1}), (3, {"step": 2})]


@pytest.mark.parametrize("newest_first", [False, True])
def test_pages_follow_each_other_without_gap_or_repetition(
    database: Database, newest_first: bool
) -> None:
    with database.write() as session:
        for index in range(7):
            factories.add_account(session, f"a{index}")
    seen: list[int] = []
    cursor: int | None = None
    with database.read() as session:
        for _ in range(3):
            rows, cursor = page(
                session,
                select(Annotator),
                Annotator.id,
                limit=3,
                cursor=cursor,
                newest_first=newest_first,
            )
            seen += [row.id for row in rows]
    assert cursor is None
    assert seen == sorted(range(1, 8), reverse=newest_first)


def test_an_artifact_is_found_by_its_content(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path / "artifacts")
    data = b"\x00recording" * 1000
    sha256 = store.put(data)
    assert sha256 == hashlib.sha256(data).hexdigest()
    assert store.put(data) == sha256  # the same again is no change
    assert store.get(sha256) == data
    assert store.exists(sha256) and not store.exists("0" * 64)
    assert store.path(sha256).relative_to(tmp_path).parts[1:4] == (
        "sha256",
        sha256[:2],
        sha256[2:4],
    )
    assert [p.name for p in store.path(sha256).parent.iterdir()] == [sha256]  # no leftovers


def test_a_damaged_or_missing_artifact_is_named(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path)
    sha256 = store.put(b"whole")
    store.path(sha256).write_bytes(b"hol")
    with pytest.raises(ArtifactError, match=f"artifact {sha256} is damaged: its 3 bytes"):
        store.get(sha256)
    with pytest.raises(ArtifactError, match=f"artifact {'1' * 64} is missing"):
        store.get("1" * 64)


@pytest.mark.parametrize("name", ["../../etc/passwd", "A" * 64, "1" * 63, ""])
def test_only_hashes_are_paths(tmp_path: Path, name: str) -> None:
    with pytest.raises(ArtifactError, match="is not a SHA-256"):
        ArtifactStore(tmp_path).path(name)


def test_an_interrupted_write_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_descriptor: int) -> None:
        raise OSError("disk full")

    store = ArtifactStore(tmp_path)
    monkeypatch.setattr("server.store.artifacts.os.fsync", broken)
    with pytest.raises(OSError, match="disk full"):
        store.put(b"half")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_database_opens_no_more_connections_than_it_may(database_url: str) -> None:
    limited = Database(database_url, connections=3)

    def ask() -> int | None:
        with limited.read() as session:
            return session.scalar(select(1))

    with ThreadPoolExecutor(1) as pool:
        with limited.read() as one, limited.read() as two, limited.read() as three:
            assert [session.scalar(select(1)) for session in (one, two, three)] == [1, 1, 1]
            fourth = pool.submit(ask)
            with pytest.raises(TimeoutError):
                fourth.result(timeout=0.5)
        assert fourth.result(timeout=30) == 1
    limited.dispose()
