"""Campaigns: create, change, collect, and their figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.spec import EVALUATION_SEED
from server.checkpoints import pretrained_by_task, task_facts
from server.errors import ConflictError, NotFoundError
from server.publications import record_start, rollback_target
from server.snapshots import new_labels_since_round
from server.states import DECISIVE, Choice, JobKind, JobState, PairState
from server.store import jobs
from server.store.campaigns import lock_campaign
from server.store.events import audit
from server.store.labels import is_effective
from server.store.leases import count_reported
from server.store.pairs import count_by_state
from server.store.tables import Annotator, Campaign, Checkpoint, Episode, Job, Label, Pair


def get_campaign(session: Session, campaign_id: int) -> Campaign:
    """The row; raises NotFoundError."""
    campaign = session.get(Campaign, campaign_id)
    if campaign is None:
        raise NotFoundError("campaign", campaign_id)
    return campaign


def create_campaign(
    session: Session,
    now: datetime,
    *,
    name: str,
    task: str,
    criterion: str | None,
    start_checkpoint_id: int | None,
    settings: dict[str, Any],
    by: int,
) -> Campaign:
    """A new campaign that publishes its starting checkpoint.

    Raises UnknownNameError for a task without checkpoints, NotFoundError for the checkpoint,
    ConflictError when the checkpoint is for another task or the name is taken.
    """
    start = _start_checkpoint(session, task, start_checkpoint_id)
    campaign = Campaign(
        name=name,
        task=task,
        criterion=criterion or str(task_facts(start)["criterion"]),
        settings=settings,
        start_checkpoint_id=start.id,
        published_checkpoint_id=start.id,
        created_by=by,
        created_at=now,
    )
    _insert_or_refuse(session, campaign, name)
    record_start(session, now, campaign, by=by)
    audit(
        session,
        now,
        actor_id=by,
        action="campaign.create",
        subject=f"campaign/{campaign.id}",
        details={"name": name, "task": task, "start_checkpoint_id": start.id},
    )
    return campaign


def _start_checkpoint(session: Session, task: str, checkpoint_id: int | None) -> Checkpoint:
    by_task = pretrained_by_task(session)
    if task not in by_task:
        raise UnknownNameError("task", task, sorted(by_task))
    if checkpoint_id is None:
        return by_task[task][-1]
    checkpoint = session.get(Checkpoint, checkpoint_id)
    if checkpoint is None:
        raise NotFoundError("checkpoint", checkpoint_id)
    if checkpoint.task != task:
        raise ConflictError(
            f"checkpoint {checkpoint_id} is for task {checkpoint.task!r}, not for {task!r}"
        )
    return checkpoint


def _insert_or_refuse(session: Session, campaign: Campaign, name: str) -> None:
    try:
        with session.begin_nested():
            session.add(campaign)
    except IntegrityError:
        raise ConflictError(f"there is a campaign named {name!r} already") from None


def change_campaign(
    session: Session,
    now: datetime,
    campaign_id: int,
    *,
    name: str | None,
    criterion: str | None,
    settings: dict[str, Any] | None,
    archived: bool | None,
    by: int,
) -> Campaign:
    """Change what is not None; `settings` are complete and checked.

    A criterion that differs in the white space around it only is no change. Raises NotFoundError;
    ConflictError for a taken name, or for another criterion once there are labels, because they
    were given under the old one.
    """
    campaign = lock_campaign(session, campaign_id)
    changed: dict[str, Any] = {}
    if criterion is not None and criterion.strip() != campaign.criterion.strip():
        labels = select(Label.id).where(Label.campaign_id == campaign_id).limit(1)
        if session.scalar(labels) is not None:
            raise ConflictError(
                f"campaign {campaign_id} has labels under its criterion; start a new campaign"
            )
        changed["criterion"] = criterion
    if name is not None:
        taken = select(Campaign.id).where(Campaign.name == name, Campaign.id != campaign_id)
        if session.scalar(taken) is not None:
            raise ConflictError(f"there is a campaign named {name!r} already")
        changed["name"] = name
    if settings is not None:
        changed["settings"] = settings
    if archived is not None:
        changed["archived"] = archived
    for key, value in changed.items():
        setattr(campaign, key, value)
    audit(
        session,
        now,
        actor_id=by,
        action="campaign.change",
        subject=f"campaign/{campaign_id}",
        details=changed,
    )
    session.flush()
    return campaign


def start_collect(
    session: Session, now: datetime, campaign_id: int, overrides: Mapping[str, Any], *, by: int
) -> Job:
    """Queue rollouts of the published policy; `overrides` are checked settings without None.

    Without a seed the episodes follow those of the collect jobs before, so that none is repeated.
    Without a number of pairs it is the campaign's, or as many as the episodes can form. Raises
    NotFoundError, ConflictError for an archived campaign, ValueOutOfRangeError for more pairs than
    the episodes can form.
    """
    campaign = lock_campaign(session, campaign_id)
    if campaign.archived:
        raise ConflictError(f"campaign {campaign_id} is archived")
    payload: dict[str, Any] = campaign.settings["collect"] | dict(overrides)
    payload["pairs"] = _possible_pairs(payload["episodes"], payload["pairs"], "pairs" in overrides)
    payload["checkpoint_id"] = campaign.published_checkpoint_id
    if "seed" not in payload:
        payload["seed"] = _next_seed(session, campaign)
    job = jobs.enqueue(
        session,
        now,
        kind=JobKind.COLLECT,
        campaign_id=campaign_id,
        payload=payload,
        created_by=by,
    )
    audit(
        session,
        now,
        actor_id=by,
        action="campaign.collect",
        subject=f"campaign/{campaign_id}",
        details={"job_id": job.id} | payload,
    )
    session.flush()
    return job


def _possible_pairs(episodes: int, pairs: int, asked_for: bool) -> int:
    """`pairs`, or fewer where the campaign's usual number is more than the episodes can form."""
    possible = episodes * (episodes - 1) // 2
    if asked_for and pairs > possible:
        legal = f"at most {possible}, the pairs of {episodes} episodes"
        raise ValueOutOfRangeError("pairs", pairs, legal)
    return min(pairs, possible)


def _next_seed(session: Session, campaign: Campaign) -> int:
    """First seed that no collect job has planned and no episode of the campaign has used."""
    used = session.scalar(
        select(func.max(Episode.seed)).where(
            Episode.campaign_id == campaign.id, Episode.seed < EVALUATION_SEED
        )
    )
    first = 0 if used is None else used + 1
    planned = select(Job.payload).where(Job.campaign_id == campaign.id, Job.kind == JobKind.COLLECT)
    for payload in session.scalars(planned):
        end = int(payload["seed"]) + int(payload["episodes"])
        if end <= EVALUATION_SEED:
            first = max(first, end)
    return first


def campaign_stats(session: Session, campaign_id: int) -> dict[str, Any]:
    """Figures of the campaign, as `StatsOut` shows them; raises NotFoundError."""
    campaign = get_campaign(session, campaign_id)
    pairs = count_by_state(session, campaign_id)
    answers = _answers(session, campaign_id)
    episodes = select(func.count()).where(Episode.campaign_id == campaign_id)
    return {
        "episodes": session.scalar(episodes),
        "pairs": {
            "ready": pairs[PairState.READY],
            "waiting": pairs[PairState.WAITING],
            "failed": pairs[PairState.FAILED],
            "labelled": session.scalar(
                select(func.count(Label.pair_id.distinct())).where(
                    Label.campaign_id == campaign_id, is_effective()
                )
            ),
            "reported": count_reported(session, campaign_id),
        },
        "labels": _label_counts(session, campaign, answers),
        "annotators": _annotator_counts(session, campaign_id, answers),
        "jobs": _job_counts(session, campaign_id),
        "rollback_checkpoint_id": rollback_target(session, campaign_id),
    }


@dataclass(frozen=True)
class _Answers:
    """How many labels in force one annotator gave, of one choice, on pairs shown one way round."""

    annotator_id: int
    choice: str
    first_is_left: bool
    count: int


def _answers(session: Session, campaign_id: int) -> list[_Answers]:
    """All labels in force, counted: some rows for each annotator."""
    keys = (Label.annotator_id, Label.choice, Pair.first_is_left)
    query = (
        select(*keys, func.count())
        .join(Pair, Pair.id == Label.pair_id)
        .where(Label.campaign_id == campaign_id, is_effective())
        .group_by(*keys)
    )
    return [_Answers(*row) for row in session.execute(query)]


def _label_counts(session: Session, campaign: Campaign, answers: list[_Answers]) -> dict[str, Any]:
    total = session.scalar(select(func.count()).where(Label.campaign_id == campaign.id))
    found: Counter[str] = Counter()
    for answer in answers:
        found[answer.choice] += answer.count
    by_choice = {choice.value: found[choice.value] for choice in Choice}
    return {
        "total": total,
        "effective": sum(by_choice.values()),
        "by_choice": by_choice,
        "new_since_round": new_labels_since_round(session, campaign),
    }


def _annotator_counts(
    session: Session, campaign_id: int, answers: list[_Answers]
) -> list[dict[str, Any]]:
    labels: Counter[int] = Counter()
    left: Counter[int] = Counter()
    right: Counter[int] = Counter()
    for answer in answers:
        labels[answer.annotator_id] += answer.count
        if answer.choice in DECISIVE:
            is_left = (answer.choice == Choice.FIRST) == answer.first_is_left
            (left if is_left else right)[answer.annotator_id] += answer.count
    medians = _median_durations(session, campaign_id)
    accounts = session.scalars(select(Annotator).where(Annotator.id.in_(labels)))
    return [
        {
            "id": account.id,
            "name": account.name,
            "kind": account.kind,
            "labels": labels[account.id],
            "median_duration_ms": medians.get(account.id),
            "left_share": _share(left[account.id], right[account.id]),
        }
        for account in sorted(accounts, key=lambda account: account.id)
    ]


def _median_durations(session: Session, campaign_id: int) -> dict[int, float]:
    """By annotator the median in milliseconds of the labels in force that have a duration."""
    own, duration = Label.annotator_id, Label.duration_ms
    ranked = (
        select(
            own,
            duration,
            func.row_number().over(partition_by=own, order_by=duration).label("rank"),
            func.count().over(partition_by=own).label("count"),
        )
        .where(Label.campaign_id == campaign_id, duration.is_not(None), is_effective())
        .subquery()
    )
    # The one in the middle, or the two: twice the rank is count + 1, or count and count + 2.
    middle = (2 * ranked.c.rank).between(ranked.c["count"], ranked.c["count"] + 2)
    query = select(ranked.c.annotator_id, func.avg(ranked.c.duration_ms)).where(middle)
    found = session.execute(query.group_by(ranked.c.annotator_id))
    return {annotator_id: float(median) for annotator_id, median in found}


def _share(one: int, other: int) -> float | None:
    return one / (one + other) if one + other else None


def _job_counts(session: Session, campaign_id: int) -> dict[str, int]:
    query = select(Job.state, func.count()).where(Job.campaign_id == campaign_id)
    found = dict(session.execute(query.group_by(Job.state)).all())
    shown = (JobState.QUEUED, JobState.RUNNING, JobState.FAILED)
    return {state.value: found.get(state.value, 0) for state in shown}
