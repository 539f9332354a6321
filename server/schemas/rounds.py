"""Rounds, jobs, checkpoints."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from pydantic import Field

from rodif_core.spec import LARGEST_SEED
from server.schemas.campaigns import PublishRuleIn
from server.schemas.common import MAX_SEED, In, Out
from server.states import JobKind, JobState, PublishRule, RoundState, RoundTrigger

Seed = Annotated[int, Field(ge=0, le=MAX_SEED)]
FinetuneSeed = Annotated[int, Field(ge=0, le=LARGEST_SEED)]
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class EvaluationRequest(In):
    """How the candidate and its parent are evaluated."""

    episodes: Annotated[int, Field(ge=10, le=10_000)] | None = None
    seed: Seed | None = None


class RoundCreate(In):
    """What is absent comes from the campaign's settings; `config` is a partial FinetuneConfig."""

    config: dict[str, Any] | None = None
    publish_rule: PublishRuleIn | None = None
    evaluation: EvaluationRequest | None = None
    snapshot_digest: Digest | None = None
    seed: FinetuneSeed | None = None


class RoundOut(Out):
    """A round; `labels` is the size of its snapshot, `stopped` why a literal method made no more
    updates. In lists `result` has no paths."""

    id: int
    campaign_id: int
    state: RoundState
    trigger: RoundTrigger
    publish_rule: PublishRule
    config: dict[str, Any]
    evaluation: dict[str, Any]
    parent_checkpoint_id: int
    candidate_checkpoint_id: int | None
    snapshot_digest: str
    labels: int
    noise: dict[str, Any] | None
    stopped: str | None
    result: dict[str, Any] | None
    error: str | None
    created_at: datetime
    finished_at: datetime | None
    started_by: int | None


class JobOut(Out):
    """A unit of queued work."""

    id: int
    kind: JobKind
    campaign_id: int
    round_id: int | None
    pair_id: int | None
    state: JobState
    progress: float
    stage: str
    attempt: int
    error: str | None
    result: dict[str, Any] | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None


class TaskOut(Out):
    """A robot task that campaigns can be about."""

    name: str
    criterion: str
    modes: list[str]
    groups: list[str]
    preferred_group: str | None
    scene: list[Any]
    newest_checkpoint: dict[str, Any]
    checkpoints: int


class CheckpointOut(Out):
    """Immutable weights; `metrics` hold what was measured."""

    id: int
    task: str
    name: str
    digest: str
    artifact_sha256: str
    parent_id: int | None
    round_id: int | None
    snapshot_digest: str | None
    comparison: bool  # of a round that is never published
    config: dict[str, Any]
    metrics: dict[str, Any]
    code_version: str
    created_at: datetime


class LabelsOfAnnotator(Out):
    """How many labels of a snapshot one annotator gave."""

    annotator_id: int
    name: str
    labels: int


class LabelBehind(Out):
    """One label that a checkpoint learned from."""

    id: int
    pair_id: int
    annotator_id: int


class LineageStep(Out):
    """One checkpoint of the chain, with what made it."""

    checkpoint: CheckpointOut
    round_id: int | None
    config: dict[str, Any] | None
    config_digest: str | None
    snapshot_digest: str | None
    labels: int
    labels_by_annotator: list[LabelsOfAnnotator]
    code_version: str


class AuditOut(Out):
    """Who did what; `actor_id` null is the system itself."""

    id: int
    actor_id: int | None
    action: str
    subject: str
    details: dict[str, Any]
    at: datetime
