"""The real API on a real port, with a campaign whose episodes and pairs are plain rows.

No worker runs: what is tested here is what commands say to the API, and what it keeps.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import uvicorn

from server.app import create_app
from server.bootstrap import ensure_admin, register_checkpoint
from server.settings import Settings
from server.states import JobKind, JobState, PairState
from server.store.artifacts import ArtifactStore
from server.store.migrate import upgrade
from server.store.session import Database
from server.store.tables import Episode, Job, Pair
from worker.cli.client import Client

PASSWORD = "correct horse battery"
TASK_FACTS = {
    "modes": ["L", "R"],
    "groups": ["left", "right"],
    "preferred_group": "left",
    "criterion": "pass on the left",
    "scene": [],
    "control_dt": 0.035,
    "max_steps": 150,
}


@dataclass
class RunningApi:
    """Where the API answers and what it was asked to send to the queue."""

    url: str
    settings: Settings
    database: Database
    token: str = ""
    sent: list[tuple[int, JobKind]] = field(default_factory=list)

    def admin(self) -> Client:
        """A client of the admin account."""
        return Client(self.url, self.token)

    def make_campaign(self, outcomes: Sequence[tuple[bool, str]], name: str = "one") -> Any:
        """A campaign with an episode per (success, group), and a ready pair of each two
        neighbours; sides alternate."""
        with self.admin() as api:
            campaign = api.post("/campaigns", {"name": name, "task": "avoid"})
        now = datetime.now(UTC)
        with self.database.write() as session:
            job = Job(
                kind=JobKind.COLLECT,
                campaign_id=campaign["id"],
                payload={},
                state=JobState.DONE,
                created_at=now,
            )
            session.add(job)
            session.flush()
            episodes = [
                Episode(
                    campaign_id=campaign["id"],
                    checkpoint_id=campaign["start_checkpoint_id"],
                    job_id=job.id,
                    seed=seed,
                    artifact_sha256="0" * 64,
                    steps=100,
                    success=success,
                    mode=None,
                    group=group,
                    outcome={"success": success, "group": group},
                    path=[],
                    mujoco_version="4.0.0",
                    created_at=now,
                )
                for seed, (success, group) in enumerate(outcomes)
            ]
            session.add_all(episodes)
            session.flush()
            session.add_all(
                Pair(
                    campaign_id=campaign["id"],
                    first_episode_id=first.id,
                    second_episode_id=second.id,
                    first_is_left=index % 2 == 0,
                    reason="random",
                    state=PairState.READY,
                    replay_sha256="0" * 64,
                    created_at=now,
                )
                for index, (first, second) in enumerate(zip(episodes, episodes[1:], strict=False))
            )
        return campaign


@contextmanager
def running_api(folder: Path) -> Iterator[RunningApi]:
    """Migrate, register an account and a checkpoint, serve until the block ends."""
    settings = Settings(_env_file=None, state_dir=folder, argon2_cheap=True)
    upgrade(settings.database_url)
    sent: list[tuple[int, JobKind]] = []
    database = Database(settings.database_url, lambda job_id, kind: sent.append((job_id, kind)))
    assert settings.artifact_dir is not None
    with database.write() as session:
        now = datetime.now(UTC)
        ensure_admin(session, now, password=PASSWORD, cheap=True)
        register_checkpoint(
            session,
            now,
            ArtifactStore(settings.artifact_dir),
            task="avoid",
            name="start",
            blob=b"weights",
            digest="1" * 64,
            config={"task_facts": TASK_FACTS},
            metrics={},
            code_version="test",
        )
    app = create_app(settings, send_job=lambda job_id, kind: sent.append((job_id, kind)))
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="warning"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive(), "the API did not start"
            time.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        running = RunningApi(f"http://127.0.0.1:{port}", settings, database, sent=sent)
        with Client(running.url) as browser:
            browser.sign_in("admin", PASSWORD)
            running.token = browser.post("/tokens", {"name": "test", "days": 1})["token"]
        yield running
    finally:
        server.should_exit = True
        thread.join()
        database.dispose()
