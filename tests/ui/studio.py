"""A running studio for browser tests: the real API on a real port, with real replays.

No worker runs here. Episodes come from the real physics, replays and thumbnails are made by
the functions that the worker calls, and jobs stay rows.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import uvicorn
from sqlalchemy import select

from labeling_ui.replay import make_replay, make_thumbnail
from rodif_core.evaluate import thin_path
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory
from server.accounts import create_annotator
from server.app import create_app
from server.bootstrap import ensure_admin, register_checkpoint
from server.campaigns import create_campaign
from server.passwords import hash_password
from server.schemas.campaigns import CampaignSettings
from server.settings import Settings
from server.states import AnnotatorKind, JobKind, JobState, PairState, Role
from server.store.artifacts import ArtifactStore
from server.store.migrate import upgrade
from server.store.session import Database
from server.store.tables import Annotator, Campaign, Episode, Job, Label, Pair
from tests.ui.episodes import COLLIDING_WAY, LEFT_WAY, RIGHT_WAY, scripted_episode

PASSWORD = "correct horse battery"
TASK = "avoid"


@functools.cache
def episodes() -> tuple[Trajectory, ...]:
    """Left, right, colliding: real runs, made once."""
    return tuple(scripted_episode(way) for way in (LEFT_WAY, RIGHT_WAY, COLLIDING_WAY))


@functools.cache
def replay_of(left: int, right: int) -> tuple[bytes, bytes]:
    """Recording and thumbnail of two of `episodes()`."""
    pair = episodes()[left], episodes()[right]
    return make_replay(get_task(TASK), *pair), make_thumbnail(get_task(TASK), *pair)


@dataclass
class Studio:
    """Where it answers, and rows to look at."""

    url: str
    settings: Settings
    database: Database
    artifacts: ArtifactStore
    names: int = 0

    def new_name(self, prefix: str) -> str:
        """A name that no test has used."""
        self.names += 1
        return f"{prefix}-{self.names}"

    def add_annotator(self, role: Role = Role.ANNOTATOR) -> str:
        """A person with PASSWORD; returns the name."""
        name = self.new_name("person")
        with self.database.write() as session:
            create_annotator(
                session,
                datetime.now(UTC),
                name=name,
                role=role,
                kind=AnnotatorKind.PERSON,
                password_hash=hash_password(PASSWORD, cheap=True),
                by=None,
            )
        return name

    def add_campaign(self, sides: Sequence[bool] = (), *, replays: bool = True) -> int:
        """A campaign with one pair for each of `sides` (its `first_is_left`); returns its id.

        The first episode of every pair goes left, the second one right or into a cylinder.
        """
        now = datetime.now(UTC)
        with self.database.write() as session:
            admin = session.scalars(select(Annotator).where(Annotator.role == Role.ADMIN)).first()
            assert admin is not None
            campaign = create_campaign(
                session,
                now,
                name=self.new_name("campaign"),
                task=TASK,
                criterion=None,
                start_checkpoint_id=None,
                settings=CampaignSettings().model_dump(mode="json"),
                by=admin.id,
            )
            job = Job(
                kind=JobKind.COLLECT,
                campaign_id=campaign.id,
                payload={
                    "checkpoint_id": campaign.start_checkpoint_id,
                    "episodes": 2 * len(sides),
                    "seed": 0,
                },
                state=JobState.DONE,
                created_at=now,
            )
            session.add(job)
            session.flush()
            for index, first_is_left in enumerate(sides):
                others = (0, 1 + index % 2)
                rows = [
                    _episode_row(campaign, job, episodes()[which], 2 * index + side)
                    for side, which in enumerate(others)
                ]
                session.add_all(rows)
                session.flush()
                pair = Pair(
                    campaign_id=campaign.id,
                    first_episode_id=rows[0].id,
                    second_episode_id=rows[1].id,
                    first_is_left=first_is_left,
                    reason="cross_group",
                    created_at=now,
                )
                if replays:
                    self._make_ready(pair, others)
                session.add(pair)
            return campaign.id

    def make_replays(self, campaign_id: int) -> None:
        """Do what the replay jobs of a campaign's pairs do."""
        with self.database.write() as session:
            query = select(Pair).where(Pair.campaign_id == campaign_id).order_by(Pair.id)
            for index, pair in enumerate(session.scalars(query)):
                self._make_ready(pair, (0, 1 + index % 2))

    def _make_ready(self, pair: Pair, which: tuple[int, int]) -> None:
        left, right = which if pair.first_is_left else which[::-1]
        recording, picture = replay_of(left, right)
        pair.replay_sha256 = self.artifacts.put(recording)
        pair.thumbnail_sha256 = self.artifacts.put(picture)
        pair.state = PairState.READY

    def labels(self, campaign_id: int) -> list[Label]:
        """All label rows of a campaign, oldest first."""
        with self.database.read() as session:
            query = select(Label).where(Label.campaign_id == campaign_id).order_by(Label.id)
            return list(session.scalars(query))

    def wait_for_labels(self, campaign_id: int, count: int, seconds: float = 20.0) -> list[Label]:
        """The rows, as soon as there are `count`; fails when that takes too long."""
        deadline = time.monotonic() + seconds
        while len(rows := self.labels(campaign_id)) < count:
            assert time.monotonic() < deadline, f"{len(rows)} labels, expected {count}"
            time.sleep(0.05)
        return rows


def _episode_row(campaign: Campaign, job: Job, run: Trajectory, seed: int) -> Episode:
    return Episode(
        campaign_id=campaign.id,
        checkpoint_id=campaign.published_checkpoint_id,
        job_id=job.id,
        seed=seed,
        artifact_sha256="0" * 64,
        steps=len(run.actions),
        success=run.success,
        mode=run.outcome["mode"],
        group=run.outcome["group"],
        outcome=run.outcome,
        path=thin_path(run),
        mujoco_version="4.0.0",
        created_at=datetime.now(UTC),
    )


def task_facts() -> dict[str, object]:
    """What a registered checkpoint tells the pages about its task."""
    task = get_task(TASK)
    return {
        "modes": list(task.modes),
        "groups": list(task.groups),
        "preferred_group": task.preferred_group,
        "criterion": task.criterion,
        "scene": task.scene_shapes(),
        "control_dt": task.control_dt,
        "max_steps": task.max_steps,
    }


@contextmanager
def running_studio(folder: Path) -> Iterator[Studio]:
    """Migrate, register an admin and a checkpoint, serve until the block ends."""
    settings = Settings(_env_file=None, state_dir=folder, argon2_cheap=True)
    upgrade(settings.database_url)
    assert settings.artifact_dir is not None
    artifacts = ArtifactStore(settings.artifact_dir)

    def leave(job_id: int, kind: JobKind) -> None:
        """Without a broker the job's row simply waits."""

    database = Database(settings.database_url, leave)
    with database.write() as session:
        now = datetime.now(UTC)
        ensure_admin(session, now, password=PASSWORD, cheap=True)
        register_checkpoint(
            session,
            now,
            artifacts,
            task=TASK,
            name="avoid-pretrained",
            blob=b"weights",
            digest="1" * 64,
            config={"task_facts": task_facts()},
            metrics={},
            code_version="test",
        )
    app = create_app(settings, send_job=leave)
    # Open event streams would hold the shutdown up for ever.
    config = uvicorn.Config(app, port=0, log_level="warning", timeout_graceful_shutdown=1)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive(), "the API did not start"
            time.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        yield Studio(f"http://127.0.0.1:{port}", settings, database, artifacts)
    finally:
        server.should_exit = True
        thread.join()
        database.dispose()
