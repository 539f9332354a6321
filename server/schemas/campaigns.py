"""Campaigns, their settings and figures, publications."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from pydantic import Field

from rodif_core.spec import FinetuneMethod
from server.schemas.common import MAX_SEED, Criterion, Id, In, LongText, Name, Out, ShortText
from server.states import AnnotatorKind, PairStrategy, PublishRule

Episodes = Annotated[int, Field(ge=2, le=5000)]
Pairs = Annotated[int, Field(ge=1, le=20_000)]
Share = Annotated[float, Field(ge=0, le=1)]
StrategyIn = Annotated[PairStrategy, Field(strict=False)]
PublishRuleIn = Annotated[PublishRule, Field(strict=False)]
MethodIn = Annotated[FinetuneMethod, Field(strict=False)]


class CollectSettings(In):
    """How much a collect job rolls out, and how it chooses pairs."""

    episodes: Episodes = 60
    pairs: Pairs = 150
    strategy: StrategyIn = PairStrategy.CROSS_GROUP
    random_share: Share = 0.2


class CampaignSettings(In):
    """What an admin can tune; stored with the campaign."""

    labels_per_pair: Annotated[int, Field(ge=1, le=20)] = 1
    round_after_labels: Annotated[int, Field(ge=0, le=1_000_000)] = 0  # 0: off
    round_every_minutes: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0  # 0: off
    method: MethodIn = FinetuneMethod.RODIF_GUIDED
    publish_rule: PublishRuleIn = PublishRule.AUTO
    evaluation_episodes: Annotated[int, Field(ge=10, le=10_000)] = 200
    collect: CollectSettings = CollectSettings()


class CampaignCreate(In):
    """A new campaign; what is absent comes from the task and its newest pretrained checkpoint."""

    name: Name
    task: ShortText
    criterion: Criterion | None = None
    start_checkpoint_id: Id | None = None
    settings: CampaignSettings = CampaignSettings()


class CampaignPatch(In):
    """What to change; `settings` may be partial."""

    name: Name | None = None
    criterion: Criterion | None = None
    settings: dict[str, Any] | None = None
    archived: bool | None = None


class CampaignToLabel(Out):
    """What annotators may know of a campaign."""

    id: int
    name: str
    task: str
    criterion: str
    archived: bool
    created_at: datetime


class CampaignOut(CampaignToLabel):
    """A campaign."""

    settings: CampaignSettings
    start_checkpoint_id: int
    published_checkpoint_id: int


class CollectRequest(In):
    """Overrides of the campaign's collect settings."""

    episodes: Episodes | None = None
    pairs: Pairs | None = None
    strategy: StrategyIn | None = None
    random_share: Share | None = None
    seed: Annotated[int, Field(ge=0, le=MAX_SEED)] | None = None


class PairCounts(Out):
    """Pairs by state; `labelled` have at least one label in force.

    `reported`: without one, and an annotator gave them back because the replay does not play.
    """

    ready: int
    waiting: int
    failed: int
    labelled: int
    reported: int


class LabelCounts(Out):
    """`total` counts all rows, `effective` those in force."""

    total: int
    effective: int
    by_choice: dict[str, int]
    new_since_round: int


class AnnotatorCounts(Out):
    """One annotator's labels in force in this campaign."""

    id: int
    name: str
    kind: AnnotatorKind
    labels: int
    median_duration_ms: float | None
    left_share: float | None  # among answers that chose a side


class JobCounts(Out):
    """Jobs of the campaign that are not finished well."""

    queued: int
    running: int
    failed: int


class StatsOut(Out):
    """Where a campaign stands."""

    episodes: int
    pairs: PairCounts
    labels: LabelCounts
    annotators: list[AnnotatorCounts]
    jobs: JobCounts
    rollback_checkpoint_id: int | None  # what a rollback would publish


class PublishRequest(In):
    """Which checkpoint to publish, and why."""

    checkpoint_id: Id
    reason: LongText = ""


class RollbackRequest(In):
    """Why, and the checkpoint that is expected to be published by it."""

    checkpoint_id: Id | None = None
    reason: LongText = ""


class PublicationOut(Out):
    """One move of the published alias."""

    id: int
    campaign_id: int
    checkpoint_id: int
    previous_checkpoint_id: int | None
    action: str
    reason: str
    by_annotator_id: int | None
    at: datetime
