"""Pairs, leases, labels, and what a simulated annotator may know."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, AwareDatetime, Field

from server.handout import MAX_HOLD
from server.labeling import ScreenChoice
from server.schemas.common import Id, In, JsonItem, LongText, Out, Text
from server.states import AnnotatorKind, Choice, PairState

MAX_REPLAY_EVENTS = 1000
ChoiceIn = Annotated[ScreenChoice, Field(strict=False)]
Milliseconds = Annotated[int, Field(ge=0, le=2**31 - 1)]


def _plausible(moment: datetime) -> datetime:
    if not 2000 <= moment.year < 3000:
        raise ValueError(f"year {moment.year} is not in 2000 … 2999")
    return moment


ClientTime = Annotated[AwareDatetime, AfterValidator(_plausible), Field(strict=False)]


class NextRequest(In):
    """`hold`: how many pairs to hold at once; `prefetch_after_pair_id`: the one on screen."""

    prefetch_after_pair_id: Id | None = None
    hold: Annotated[int, Field(ge=1, le=MAX_HOLD)] = 1


class LeasedPair(Out):
    """A pair as the annotator sees it: A on the left, B on the right, and nothing else."""

    id: int
    replay_url: str
    thumbnail_url: str | None
    left_label: Literal["A"] = "A"
    right_label: Literal["B"] = "B"
    duration_s: float | None
    step_s: float | None  # of one control step, which is one frame of the replay


class Progress(Out):
    """How far this annotator is in this campaign."""

    done: int
    remaining: int


class NextOut(Out):
    """A pair to label, under a lease."""

    lease_id: int
    expires_at: datetime
    pair: LeasedPair
    criterion: str
    progress: Progress


class LabelCreate(In):
    """One answer. Times are the client's; the server notes its own."""

    pair_id: Id
    lease_id: Id | None = None
    choice: ChoiceIn
    client_time: ClientTime | None = None
    duration_ms: Milliseconds | None = None
    active_ms: Milliseconds | None = None
    replay_events: Annotated[list[JsonItem], Field(max_length=MAX_REPLAY_EVENTS)] = []
    ui_version: Annotated[Text, Field(max_length=32)]


class LabelOut(Out):
    """A stored answer. `choice` names the episode, `side` what was clicked."""

    id: int
    pair_id: int
    choice: Choice
    side: ScreenChoice
    retracted: bool
    late: bool
    supersedes_id: int | None
    created_at: datetime


class UndoOut(Out):
    """The row that takes the label back, and the same pair again.

    `next` is null when a repeated request comes after the pair has been judged anew.
    """

    label: LabelOut
    next: NextOut | None


class RawLabel(Out):
    """A label row with everything on record.

    `in_force`: nothing supersedes it, and it takes nothing back.
    """

    id: int
    campaign_id: int
    pair_id: int
    annotator_id: int
    choice: Choice
    retracted: bool
    supersedes_id: int | None
    in_force: bool
    left_episode_id: int
    right_episode_id: int
    first_checkpoint_id: int
    second_checkpoint_id: int
    pair_reason: str
    lease_id: int | None
    late: bool
    source: AnnotatorKind
    idempotency_key: str
    created_at: datetime
    client_time: datetime | None
    duration_ms: int | None
    active_ms: int | None
    replay_events: list[Any]
    ui_version: str


class TruthIn(In):
    """What a simulated annotator really preferred."""

    true_choice: ChoiceIn
    corruption: Literal["none", "flip"]
    criterion: LongText


class TruthOut(Out):
    """The stored truth, free of screen sides."""

    label_id: int
    true_choice: Choice
    corrupted: bool
    corruption: str
    criterion: str


class TruthCounts(Out):
    """How many labels with known truth there are, and how many of them contradict it."""

    total: int
    flipped: int


class EpisodeOut(Out):
    """A rollout."""

    id: int
    campaign_id: int
    checkpoint_id: int
    job_id: int
    seed: int
    steps: int
    success: bool
    mode: str | None
    group: str | None
    outcome: dict[str, Any]
    path: list[Any]
    mujoco_version: str
    created_at: datetime


class PairOut(Out):
    """A pair as admins and scripts see it."""

    id: int
    campaign_id: int
    first_episode_id: int
    second_episode_id: int
    first_is_left: bool
    reason: str
    state: PairState
    replay_url: str | None
    thumbnail_url: str | None
    created_at: datetime


class EpisodesOfPair(Out):
    """Ground truth for simulated annotators."""

    pair_id: int
    first_is_left: bool
    first: EpisodeOut
    second: EpisodeOut
