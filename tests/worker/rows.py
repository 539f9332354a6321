"""A workbench with a movable clock, and the rows that jobs need, for tests of the worker."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from rodif_core.policies.checkpoint import save_checkpoint
from server import rounds
from server.settings import Settings
from server.states import AnnotatorKind, JobKind, PairStrategy, PublishRule, Role
from server.store import jobs
from server.store.migrate import upgrade
from server.store.tables import Annotator, Campaign, Checkpoint, Episode, Job, Label, Pair
from tests.core.learning import tiny_checkpoint
from worker.workbench import Workbench

SETTINGS = {
    "labels_per_pair": 1,
    "round_after_labels": 0,
    "round_every_minutes": 0,
    "method": "rodif",
    "publish_rule": "auto",
    "evaluation_episodes": 4,
    "collect": {"episodes": 6, "pairs": 4, "strategy": "random", "random_share": 0.2},
}
SHORT_CONFIG = {"method": "rodif", "updates": 2, "conservativeness": 0.3, "learning_rate": 1e-4}


@dataclass
class Clock:
    """Aware datetimes that move when a test says so."""

    now: datetime = datetime(2030, 1, 1, tzinfo=UTC)

    def __call__(self) -> datetime:
        return self.now

    def advance(self, seconds: float) -> None:
        self.now += timedelta(seconds=seconds)


@dataclass
class World:
    """A migrated database with one campaign of a tiny policy, and what was sent to the queue."""

    settings: Settings
    clock: Clock = field(default_factory=Clock)
    sent: list[tuple[int, JobKind]] = field(default_factory=list)

    def __post_init__(self) -> None:
        upgrade(self.settings.database_url)
        self.bench = self.workbench("worker-1")
        blob = save_checkpoint(tiny_checkpoint())
        with self.bench.database.write() as session:
            admin = Annotator(
                name="admin", role=Role.ADMIN, kind=AnnotatorKind.PERSON, created_at=self.clock()
            )
            checkpoint = Checkpoint(
                task="avoid",
                name="tiny",
                digest=tiny_checkpoint().digest,
                artifact_sha256=self.bench.artifacts.put(blob),
                config={"task_facts": {}},
                metrics={},
                code_version="test",
                created_at=self.clock(),
            )
            session.add_all([admin, checkpoint])
            session.flush()
            campaign = Campaign(
                name="avoid",
                task="avoid",
                criterion="go left",
                settings=SETTINGS,
                start_checkpoint_id=checkpoint.id,
                published_checkpoint_id=checkpoint.id,
                created_by=admin.id,
                created_at=self.clock(),
            )
            session.add(campaign)
            session.flush()
            self.campaign_id, self.checkpoint_id = campaign.id, checkpoint.id
            self.annotator_id = admin.id

    def workbench(self, owner: str) -> Workbench:
        """A workbench of another process."""
        made = Workbench.of(self.settings, lambda job_id, kind: self.sent.append((job_id, kind)))
        return Workbench(self.settings, made.database, made.artifacts, owner, self.clock)

    def enqueue(self, kind: JobKind, payload: dict[str, Any] | None = None, **more: Any) -> int:
        """Put a job in the queue."""
        with self.bench.database.write() as session:
            job = jobs.enqueue(
                session,
                self.clock(),
                kind=kind,
                campaign_id=self.campaign_id,
                payload=payload or {},
                **more,
            )
            return job.id

    def enqueue_collect(self, *, episodes: int = 6, pairs: int = 4, seed: int = 10) -> int:
        """A small collect job."""
        return self.enqueue(
            JobKind.COLLECT,
            {
                "episodes": episodes,
                "seed": seed,
                "checkpoint_id": self.checkpoint_id,
                "pairs": pairs,
                "strategy": PairStrategy.RANDOM.value,
                "random_share": 0.2,
            },
        )

    def label_all(self, choices: Sequence[str] = ("first", "second")) -> list[int]:
        """One label on every pair, choices in turn."""
        with self.bench.database.write() as session:
            pairs = session.query(Pair).order_by(Pair.id).all()
            labels = [self._label(pair, choices[i % len(choices)]) for i, pair in enumerate(pairs)]
            session.add_all(labels)
            session.flush()
            return [label.id for label in labels]

    def _label(self, pair: Pair, choice: str) -> Label:
        shown = (pair.first_episode_id, pair.second_episode_id)
        left, right = shown if pair.first_is_left else shown[::-1]
        return Label(
            campaign_id=pair.campaign_id,
            pair_id=pair.id,
            annotator_id=self.annotator_id,
            choice=choice,
            left_episode_id=left,
            right_episode_id=right,
            first_checkpoint_id=self.checkpoint_id,
            second_checkpoint_id=self.checkpoint_id,
            pair_reason=pair.reason,
            source=AnnotatorKind.PERSON,
            idempotency_key=f"key-{pair.id}-{choice}",
            request_sha256=hashlib.sha256(choice.encode()).hexdigest(),
            created_at=self.clock(),
            replay_events=[],
            ui_version="test",
        )

    def launch(self, publish_rule: PublishRule = PublishRule.AUTO, **config: Any) -> int:
        """Start a short round on the labels there are; returns its id."""
        request = rounds.RoundRequest(
            config=SHORT_CONFIG | config,
            publish_rule=publish_rule,
            evaluation={"episodes": 4, "seed": 500},
        )
        with self.bench.database.write() as session:
            return rounds.launch(session, self.clock(), self.campaign_id, request).id

    def job_of(self, kind: JobKind, **where: Any) -> Job:
        """The newest job of a kind."""
        with self.bench.database.read() as session:
            query = session.query(Job).filter_by(kind=kind, **where).order_by(Job.id.desc())
            job = query.first()
            assert job is not None, f"no {kind} job"
            return job

    def rows(self, table: type[Any]) -> list[Any]:
        """All rows of a table, by id."""
        with self.bench.database.read() as session:
            return list(session.query(table).order_by(table.id))

    def episode_seeds(self) -> list[int]:
        """Seeds of all stored episodes."""
        return sorted(episode.seed for episode in self.rows(Episode))


def make_world(folder: Path, **settings: Any) -> World:
    """A world in a folder of its own."""
    given: dict[str, Any] = {"state_dir": folder, "argon2_cheap": True} | settings
    return World(Settings(_env_file=None, **given))


def failing_once(original: Callable[..., Any], calls_before: int) -> Callable[..., Any]:
    """`original`, except that the call after `calls_before` others raises as a bug would."""
    calls = 0

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == calls_before + 1:
            raise RuntimeError("lightning strike")
        return original(*args, **kwargs)

    return wrapped
