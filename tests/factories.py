"""Rows for tests, complete and plausible, with as little said as possible."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from sqlalchemy.orm import Session

from server.accounts import create_annotator, issue_token
from server.campaigns import create_campaign
from server.passwords import hash_password
from server.schemas.campaigns import CampaignSettings
from server.sign_in import Me, me_of
from server.states import AnnotatorKind, Choice, JobKind, PairState, Role, RoundState
from server.store import jobs
from server.store.tables import Annotator, Campaign, Checkpoint, Episode, Label, Pair

NOW = datetime(2026, 11, 22, 12, 0, tzinfo=UTC)
# The states of a round that is published, after "queued".
PUBLISHED_PATH = [
    RoundState.FINETUNING,
    RoundState.EVALUATING,
    RoundState.GATING,
    RoundState.PUBLISHED,
]
PASSWORD = "correct horse battery"
TASK_FACTS = {
    "criterion": "Pass the first obstacle on its left side.",
    "modes": ["L-11", "R-11"],
    "groups": ["left", "right"],
    "preferred_group": "left",
    "scene": [],
    "control_dt": 0.035,
    "max_steps": 150,
}


class Clock:
    """A clock that stands still until it is told to go on."""

    def __init__(self, now: datetime = NOW) -> None:
        self.now = now

    def __call__(self) -> datetime:
        return self.now

    def advance(self, **parts: float) -> None:
        """Go on by `timedelta(**parts)`."""
        self.now += timedelta(**parts)


def add_account(
    session: Session,
    name: str,
    role: Role = Role.ANNOTATOR,
    kind: AnnotatorKind = AnnotatorKind.PERSON,
) -> Annotator:
    """An account with PASSWORD."""
    password_hash = hash_password(PASSWORD, cheap=True)
    return create_annotator(
        session, NOW, name=name, role=role, kind=kind, password_hash=password_hash, by=None
    )


def add_me(session: Session, name: str, kind: AnnotatorKind = AnnotatorKind.PERSON) -> Me:
    """An annotator as the use cases see it."""
    return me_of(add_account(session, name, kind=kind))


def add_token(session: Session, annotator_id: int, days: float = 30) -> str:
    """A bearer token of the account."""
    return issue_token(session, NOW, annotator_id=annotator_id, name="test", days=days, by=None)[1]


def add_checkpoint(
    session: Session,
    name: str = "avoid-pretrained",
    *,
    task: str = "avoid",
    parent_id: int | None = None,
    round_id: int | None = None,
    snapshot_digest: str | None = None,
) -> Checkpoint:
    """A checkpoint whose weights nobody reads."""
    checkpoint = Checkpoint(
        task=task,
        name=name,
        digest="d" * 64,
        artifact_sha256="a" * 64,
        parent_id=parent_id,
        round_id=round_id,
        snapshot_digest=snapshot_digest,
        config={"task_facts": TASK_FACTS},
        metrics={"success": 0.9},
        code_version="0.1.0",
        created_at=NOW,
    )
    session.add(checkpoint)
    session.flush()
    return checkpoint


def add_campaign(session: Session, name: str = "left please", **settings: object) -> Campaign:
    """A campaign on `avoid`; makes account and checkpoint when there are none."""
    owner = session.query(Annotator).order_by(Annotator.id).first()
    if owner is None:
        owner = add_account(session, "owner", Role.ADMIN)
    if session.query(Checkpoint).first() is None:
        add_checkpoint(session)
    return create_campaign(
        session,
        NOW,
        name=name,
        task="avoid",
        criterion=None,
        start_checkpoint_id=None,
        settings=CampaignSettings.model_validate(settings).model_dump(mode="json"),
        by=owner.id,
    )


def add_pairs(
    session: Session,
    campaign: Campaign,
    count: int,
    *,
    state: PairState = PairState.READY,
    first_is_left: bool | None = None,
) -> list[Pair]:
    """Pairs of two fresh episodes each; sides alternate unless said."""
    job = jobs.enqueue(
        session, NOW, kind=JobKind.COLLECT, campaign_id=campaign.id, payload=_collect(count)
    )
    start = session.query(Episode).count()
    episodes = [_episode(campaign, job.id, seed=start + i) for i in range(2 * count)]
    session.add_all(episodes)
    session.flush()
    pairs = [
        Pair(
            campaign_id=campaign.id,
            first_episode_id=episodes[2 * i].id,
            second_episode_id=episodes[2 * i + 1].id,
            first_is_left=(i % 2 == 0) if first_is_left is None else first_is_left,
            reason="cross_group",
            state=state,
            replay_sha256="b" * 64 if state is PairState.READY else None,
            thumbnail_sha256="c" * 64 if state is PairState.READY else None,
            created_at=NOW,
        )
        for i in range(count)
    ]
    session.add_all(pairs)
    session.flush()
    return pairs


def _collect(count: int) -> dict[str, object]:
    return {"episodes": 2 * count, "pairs": count, "seed": 0, "checkpoint_id": 1}


def _episode(campaign: Campaign, job_id: int, *, seed: int) -> Episode:
    group = "left" if seed % 2 else "right"
    return Episode(
        campaign_id=campaign.id,
        checkpoint_id=campaign.published_checkpoint_id,
        job_id=job_id,
        seed=seed,
        artifact_sha256="e" * 64,
        steps=80 + seed % 20,
        success=True,
        mode="L-11" if seed % 2 else "R-11",
        group=group,
        outcome={"success": True, "group": group},
        path=[[0.5, 0.0, 0.1], [0.5, 0.3, 0.1]],
        mujoco_version="4.0.0",
        created_at=NOW,
    )


def add_label(
    session: Session,
    pair: Pair,
    annotator_id: int,
    choice: Choice = Choice.FIRST,
    *,
    key: str | None = None,
    supersedes_id: int | None = None,
    retracted: bool = False,
    duration_ms: int | None = 1500,
) -> Label:
    """A label row, past the rules of the hand-out."""
    first = session.get_one(Episode, pair.first_episode_id)
    second = session.get_one(Episode, pair.second_episode_id)
    left, right = (first, second) if pair.first_is_left else (second, first)
    label = Label(
        campaign_id=pair.campaign_id,
        pair_id=pair.id,
        annotator_id=annotator_id,
        choice=choice,
        retracted=retracted,
        supersedes_id=supersedes_id,
        left_episode_id=left.id,
        right_episode_id=right.id,
        first_checkpoint_id=first.checkpoint_id,
        second_checkpoint_id=second.checkpoint_id,
        pair_reason=pair.reason,
        lease_id=None,
        late=False,
        source=AnnotatorKind.PERSON,
        idempotency_key=key or f"{pair.id}-{annotator_id}-{supersedes_id}-{retracted}",
        request_sha256="f" * 64,
        created_at=NOW,
        client_time=None,
        duration_ms=duration_ms,
        active_ms=1200,
        replay_events=[],
        ui_version="test",
    )
    session.add(label)
    session.flush()
    return label
