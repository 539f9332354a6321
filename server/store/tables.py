"""All SQL tables. Rows are the truth; files hold only what SQL points to by SHA-256.

Timestamps are aware and in UTC. JSON columns hold plain JSON types. Labels, simulated truth,
publications, events and audit rows are append-only: triggers in the migrations refuse UPDATE and
DELETE.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    CheckConstraint,
    DateTime,
    Dialect,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Text,
    TypeDecorator,
    UniqueConstraint,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from server.states import JobState, PairState, RoundState

_NAMING = {
    "ix": "ix_%(column_0_label)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "ck": "ck_%(table_name)s_%(constraint_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
    "pk": "pk_%(table_name)s",
}


class UtcDateTime(TypeDecorator[datetime]):
    """Aware UTC datetimes on every engine (SQLite itself keeps no time zone)."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        """Refuse naive datetimes: they would silently mean local time."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"naive datetime {value!r}; pass an aware one")
        return value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        """Give back an aware datetime in UTC."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class Base(DeclarativeBase):
    """Common base; column types by annotation."""

    metadata = MetaData(naming_convention=_NAMING)
    type_annotation_map = {
        datetime: UtcDateTime,
        dict[str, Any]: JSON,
        list[Any]: JSON,
        str: Text,
    }


class Annotator(Base):
    """An account: a person or a program. Never deleted, only deactivated."""

    __tablename__ = "annotator"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    role: Mapped[str] = mapped_column(String(16))  # Role
    kind: Mapped[str] = mapped_column(String(16))  # AnnotatorKind
    password_hash: Mapped[str | None]
    active: Mapped[bool] = mapped_column(Boolean, default=True)
    created_at: Mapped[datetime]


class BrowserSession(Base):
    """A signed-in browser; only the SHA-256 of the cookie value is stored."""

    __tablename__ = "browser_session"
    id: Mapped[int] = mapped_column(primary_key=True)
    annotator_id: Mapped[int] = mapped_column(ForeignKey("annotator.id"))
    token_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime]
    revoked_at: Mapped[datetime | None]


class ApiToken(Base):
    """A bearer token for scripts; shown once, only its SHA-256 is stored."""

    __tablename__ = "api_token"
    id: Mapped[int] = mapped_column(primary_key=True)
    annotator_id: Mapped[int] = mapped_column(ForeignKey("annotator.id"))
    name: Mapped[str] = mapped_column(String(64))
    token_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime]
    last_used_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]


class SignInAttempt(Base):
    """One failed sign-in, for throttling by name and address (`sign_in.source_of`)."""

    __tablename__ = "sign_in_attempt"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), index=True)
    address: Mapped[str] = mapped_column(String(64), index=True)
    at: Mapped[datetime]


class Checkpoint(Base):
    """Immutable weights with their parents. `parent_id` is None for a pretrained one."""

    __tablename__ = "checkpoint"
    id: Mapped[int] = mapped_column(primary_key=True)
    task: Mapped[str] = mapped_column(String(32))
    name: Mapped[str] = mapped_column(String(128), unique=True)
    digest: Mapped[str] = mapped_column(String(64))  # rodif_core checkpoint digest
    artifact_sha256: Mapped[str] = mapped_column(String(64))
    parent_id: Mapped[int | None] = mapped_column(ForeignKey("checkpoint.id"))
    round_id: Mapped[int | None] = mapped_column(
        ForeignKey("round.id", use_alter=True), unique=True
    )
    snapshot_digest: Mapped[str | None] = mapped_column(
        ForeignKey("label_snapshot.digest", use_alter=True)
    )
    config: Mapped[dict[str, Any]]
    metrics: Mapped[dict[str, Any]]
    code_version: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[datetime]


class Campaign(Base):
    """A task, a starting policy, the criterion text that annotators read, and settings."""

    __tablename__ = "campaign"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(128), unique=True)
    task: Mapped[str] = mapped_column(String(32))
    criterion: Mapped[str]
    settings: Mapped[dict[str, Any]]  # server.schemas.campaigns.CampaignSettings
    start_checkpoint_id: Mapped[int] = mapped_column(ForeignKey("checkpoint.id"))
    published_checkpoint_id: Mapped[int] = mapped_column(ForeignKey("checkpoint.id"))
    archived: Mapped[bool] = mapped_column(Boolean, default=False)
    created_by: Mapped[int] = mapped_column(ForeignKey("annotator.id"))
    created_at: Mapped[datetime]


class Publication(Base):
    """Append-only history of the published alias of a campaign."""

    __tablename__ = "publication"
    id: Mapped[int] = mapped_column(primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaign.id"), index=True)
    checkpoint_id: Mapped[int] = mapped_column(ForeignKey("checkpoint.id"))
    previous_checkpoint_id: Mapped[int | None] = mapped_column(ForeignKey("checkpoint.id"))
    action: Mapped[str] = mapped_column(String(16))  # start | publish | rollback
    reason: Mapped[str]
    by_annotator_id: Mapped[int | None] = mapped_column(ForeignKey("annotator.id"))  # None: gate
    at: Mapped[datetime]


class Episode(Base):
    """One rollout of one checkpoint; the arrays lie in the artifact."""

    __tablename__ = "episode"
    __table_args__ = (UniqueConstraint("campaign_id", "checkpoint_id", "seed"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaign.id"), index=True)
    checkpoint_id: Mapped[int] = mapped_column(ForeignKey("checkpoint.id"), index=True)
    job_id: Mapped[int] = mapped_column(ForeignKey("job.id"))
    seed: Mapped[int] = mapped_column(BigInteger)
    artifact_sha256: Mapped[str] = mapped_column(String(64))
    steps: Mapped[int]  # control steps
    success: Mapped[bool]
    mode: Mapped[str | None] = mapped_column(String(64))
    group: Mapped[str | None] = mapped_column("behaviour_group", String(64))
    outcome: Mapped[dict[str, Any]]
    path: Mapped[list[Any]]  # end-effector [[x, y, z], …] in metres, thinned for plots
    mujoco_version: Mapped[str] = mapped_column(String(16))
    created_at: Mapped[datetime]


class Pair(Base):
    """Two episodes to compare. The screen side is fixed when the replay is made, and stored."""

    __tablename__ = "pair"
    __table_args__ = (
        UniqueConstraint("campaign_id", "first_episode_id", "second_episode_id"),
        CheckConstraint("first_episode_id <> second_episode_id", name="two_episodes"),
        Index("ix_pair_campaign_id_state", "campaign_id", "state"),
    )
    id: Mapped[int] = mapped_column(primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaign.id"))
    first_episode_id: Mapped[int] = mapped_column(ForeignKey("episode.id"))
    second_episode_id: Mapped[int] = mapped_column(ForeignKey("episode.id"))
    first_is_left: Mapped[bool]
    reason: Mapped[str] = mapped_column(String(64))  # why this pair was chosen
    state: Mapped[str] = mapped_column(String(16), default=PairState.WAITING)
    replay_sha256: Mapped[str | None] = mapped_column(String(64))
    thumbnail_sha256: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[datetime]


class Lease(Base):
    """A pair handed to an annotator for a while. A late label is kept all the same."""

    __tablename__ = "lease"
    __table_args__ = (
        Index("ix_lease_pair_id_expires_at", "pair_id", "expires_at"),
        Index("ix_lease_of_annotator", "annotator_id", "closed_at", "expires_at", "pair_id"),
        Index(  # those that may still be live: few, however many there ever were
            "ix_lease_open",
            "pair_id",
            "annotator_id",
            "expires_at",
            sqlite_where=text("closed_at IS NULL"),
            postgresql_where=text("closed_at IS NULL"),
        ),
    )
    id: Mapped[int] = mapped_column(primary_key=True)
    pair_id: Mapped[int] = mapped_column(ForeignKey("pair.id"))
    annotator_id: Mapped[int] = mapped_column(ForeignKey("annotator.id"))
    issued_at: Mapped[datetime]
    expires_at: Mapped[datetime]
    closed_at: Mapped[datetime | None]  # labelled, or given back: then it is expires_at


class Label(Base):
    """One click, for ever. Undo and edit are new rows that point at what they supersede."""

    __tablename__ = "label"
    __table_args__ = (
        UniqueConstraint("annotator_id", "idempotency_key"),
        # All that the hand-out and the figures ask of a label: the rows themselves are wide.
        Index(
            "ix_label_of_campaign",
            "campaign_id",
            "pair_id",
            "annotator_id",
            "choice",
            "retracted",
            "duration_ms",
        ),
        Index("ix_label_of_annotator", "annotator_id", "campaign_id", "pair_id", "retracted"),
    )
    id: Mapped[int] = mapped_column(primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaign.id"))
    pair_id: Mapped[int] = mapped_column(ForeignKey("pair.id"), index=True)
    annotator_id: Mapped[int] = mapped_column(ForeignKey("annotator.id"))
    choice: Mapped[str] = mapped_column(String(16))  # Choice; the superseded one's for a retraction
    retracted: Mapped[bool] = mapped_column(Boolean, default=False)  # True: an undo row
    supersedes_id: Mapped[int | None] = mapped_column(ForeignKey("label.id"), unique=True)
    left_episode_id: Mapped[int] = mapped_column(ForeignKey("episode.id"))
    right_episode_id: Mapped[int] = mapped_column(ForeignKey("episode.id"))
    first_checkpoint_id: Mapped[int] = mapped_column(ForeignKey("checkpoint.id"))
    second_checkpoint_id: Mapped[int] = mapped_column(ForeignKey("checkpoint.id"))
    pair_reason: Mapped[str] = mapped_column(String(64))
    lease_id: Mapped[int | None] = mapped_column(ForeignKey("lease.id"))
    late: Mapped[bool] = mapped_column(Boolean, default=False)  # the lease was gone
    source: Mapped[str] = mapped_column(String(16))  # AnnotatorKind of the annotator
    idempotency_key: Mapped[str] = mapped_column(String(64))
    request_sha256: Mapped[str] = mapped_column(String(64))  # same key, other body → 409
    created_at: Mapped[datetime]  # server clock
    client_time: Mapped[datetime | None]
    duration_ms: Mapped[int | None]  # shown → chosen, client clock
    active_ms: Mapped[int | None]  # of that, page visible and in use
    replay_events: Mapped[list[Any]]  # what was played, sought and watched
    ui_version: Mapped[str] = mapped_column(String(32))


class SimulatedTruth(Base):
    """What a simulated annotator really preferred. Never read by learner or noise estimate."""

    __tablename__ = "simulated_truth"
    label_id: Mapped[int] = mapped_column(ForeignKey("label.id"), primary_key=True)
    true_choice: Mapped[str] = mapped_column(String(16))
    corrupted: Mapped[bool]
    corruption: Mapped[str] = mapped_column(String(32))  # none | flip
    criterion: Mapped[str]


class LabelSnapshot(Base):
    """A frozen, ordered set of label ids; the digest is the SHA-256 of its canonical JSON."""

    __tablename__ = "label_snapshot"
    digest: Mapped[str] = mapped_column(String(64), primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaign.id"), index=True)
    label_ids: Mapped[list[Any]]
    size: Mapped[int]
    created_at: Mapped[datetime]


class Round(Base):
    """snapshot → noise → fine-tune → evaluate → gate."""

    __tablename__ = "round"
    id: Mapped[int] = mapped_column(primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaign.id"), index=True)
    parent_checkpoint_id: Mapped[int] = mapped_column(ForeignKey("checkpoint.id", use_alter=True))
    snapshot_digest: Mapped[str] = mapped_column(ForeignKey("label_snapshot.digest"))
    state: Mapped[str] = mapped_column(String(16), default=RoundState.QUEUED)
    trigger: Mapped[str] = mapped_column(String(16))  # RoundTrigger
    publish_rule: Mapped[str] = mapped_column(String(16))  # PublishRule
    config: Mapped[dict[str, Any]]  # rodif_core.spec.FinetuneConfig
    evaluation: Mapped[dict[str, Any]]  # {"episodes": n, "seed": s}
    noise: Mapped[dict[str, Any] | None] = mapped_column(JSON)  # how γ was found
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON)  # before / after / gate / seconds
    error: Mapped[str | None]
    started_by: Mapped[int | None] = mapped_column(ForeignKey("annotator.id"))
    created_at: Mapped[datetime]
    finished_at: Mapped[datetime | None]


class Job(Base):
    """One queued unit of work. The queue's message is only a hint; this row is the truth.

    Claimed with a lease and a fencing token (`attempt`); finished by compare-and-set on both.
    """

    __tablename__ = "job"
    __table_args__ = (Index("ix_job_state_lease", "state", "lease_expires_at"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    kind: Mapped[str] = mapped_column(String(16))  # JobKind
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaign.id"), index=True)
    round_id: Mapped[int | None] = mapped_column(ForeignKey("round.id"), index=True)
    pair_id: Mapped[int | None] = mapped_column(ForeignKey("pair.id", use_alter=True))
    payload: Mapped[dict[str, Any]]
    dedupe_key: Mapped[str | None] = mapped_column(String(128), unique=True)
    state: Mapped[str] = mapped_column(String(16), default=JobState.QUEUED)
    attempt: Mapped[int] = mapped_column(Integer, default=0)
    max_attempts: Mapped[int] = mapped_column(Integer, default=5)
    owner: Mapped[str | None] = mapped_column(String(128))
    lease_expires_at: Mapped[datetime | None]
    sent_at: Mapped[datetime | None]  # last message to the queue
    progress: Mapped[float] = mapped_column(Float, default=0.0)  # 0 … 1
    stage: Mapped[str] = mapped_column(String(64), default="")
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    error: Mapped[str | None]
    created_by: Mapped[int | None] = mapped_column(ForeignKey("annotator.id"))
    created_at: Mapped[datetime]
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]


class Event(Base):
    """Append-only progress of jobs and rounds, streamed to browsers (server-sent events).

    kind: job | round | curve | label | release | publication; `data` is what the page draws.
    """

    __tablename__ = "event"
    __table_args__ = (Index("ix_event_campaign_id_kind", "campaign_id", "kind"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaign.id"), index=True)
    round_id: Mapped[int | None] = mapped_column(ForeignKey("round.id"), index=True)
    job_id: Mapped[int | None] = mapped_column(ForeignKey("job.id"))
    kind: Mapped[str] = mapped_column(String(16))
    data: Mapped[dict[str, Any]]
    at: Mapped[datetime]


class AuditEntry(Base):
    """Who did what that changes the state of the system (append-only)."""

    __tablename__ = "audit_entry"
    id: Mapped[int] = mapped_column(primary_key=True)
    actor_id: Mapped[int | None] = mapped_column(ForeignKey("annotator.id"))
    action: Mapped[str] = mapped_column(String(64))
    subject: Mapped[str] = mapped_column(String(128))
    details: Mapped[dict[str, Any]]
    at: Mapped[datetime]


class ServiceBeat(Base):
    """Last sign of life of each long-running process, for `/ready` and the admin page."""

    __tablename__ = "service_beat"
    name: Mapped[str] = mapped_column(String(128), primary_key=True)  # e.g. "worker", "beat"
    at: Mapped[datetime]
    details: Mapped[dict[str, Any]]
