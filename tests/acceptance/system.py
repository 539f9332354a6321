"""A real running system for acceptance tests: its own processes, a client that is signed in."""

from __future__ import annotations

import contextlib
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from server.settings import Settings
from server.store.session import Database
from worker.cli.client import Client
from worker.supervisor import System, running_system

PASSWORD = "correct horse battery"


@dataclass
class Site:
    """A system, its database for looking at rows, and an admin's client."""

    system: System
    database: Database
    api: Client
    campaign_id: int

    def rows(self, table: type[Any], **where: Any) -> list[Any]:
        """Rows of a table, by id."""
        with self.database.read() as session:
            return list(session.query(table).filter_by(**where).order_by(table.id))

    def post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        """POST below the campaign."""
        answer: dict[str, Any] = self.api.post(f"/campaigns/{self.campaign_id}{path}", body)
        return answer

    def label_pairs(self, count: int) -> None:
        """Lease and label `count` pairs: left, right, left …"""
        for i in range(count):
            leased = self.post("/next", {})
            body = {
                "pair_id": leased["pair"]["id"],
                "lease_id": leased["lease_id"],
                "choice": ("left", "right")[i % 2],
                "ui_version": "acceptance",
            }
            key = {"Idempotency-Key": uuid.uuid4().hex}
            self.api.request("POST", "/labels", body, headers=key)


@contextlib.contextmanager
def running_site(state: Path, **settings: Any) -> Iterator[Site]:
    """Start everything; short leases, so that what dies is noticed soon."""
    chosen: dict[str, Any] = {
        "state_dir": state,
        "port": 0,
        "argon2_cheap": True,
        "job_lease_seconds": 4.0,
        "resend_seconds": 0.5,
    }
    given = Settings(_env_file=None, **(chosen | settings))
    with running_system(given, workers=1, admin_password=PASSWORD, ready_seconds=180) as system:
        database = Database(system.settings.database_url)
        try:
            with Client(system.url) as api:
                api.sign_in(system.prepared.admin, PASSWORD)
                yield Site(system, database, api, api.find_campaign(None)["id"])
        finally:
            database.dispose()


def kill_tree(pid: int) -> None:
    """SIGKILL a process and all below it, as a machine does that runs out of memory."""
    process = psutil.Process(pid)
    family = [process, *process.children(recursive=True)]
    for member in family:
        with contextlib.suppress(psutil.NoSuchProcess):
            member.kill()
    psutil.wait_procs(family[1:], timeout=10)


def wait_for(condition: Callable[[], bool], what: str, seconds: float = 180.0) -> None:
    """Poll until the condition holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"not within {seconds:.0f} s: {what}"
        time.sleep(0.05)
