"""Rounds: freeze a label snapshot, launch, move through the states, cancel, and what is due.

queued → finetuning → evaluating → gating → published | rejected | kept
any state before the last three → failed | cancelled; a failed one can be taken up again
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from rodif_core.spec import EVALUATION_SEED, FinetuneConfig, settings_for_task
from server.errors import ConflictError, NotAllowedError, NotFoundError
from server.snapshots import may_learn, new_labels_since_round, snapshot_to_learn_from
from server.states import (
    JobKind,
    JobState,
    PairState,
    PublishRule,
    RoundState,
    RoundTrigger,
)
from server.store import jobs
from server.store.campaigns import lock_campaign
from server.store.events import add_event, audit
from server.store.labels import has_decisive_label
from server.store.tables import Campaign, Job, Pair, Round

FINAL_STATES = frozenset(
    {
        RoundState.PUBLISHED,
        RoundState.REJECTED,
        RoundState.KEPT,
        RoundState.FAILED,
        RoundState.CANCELLED,
    }
)
_ENDINGS = frozenset({RoundState.FAILED, RoundState.CANCELLED})
_TRANSITIONS: dict[RoundState, frozenset[RoundState]] = {
    RoundState.QUEUED: _ENDINGS | {RoundState.FINETUNING},
    RoundState.FINETUNING: _ENDINGS | {RoundState.EVALUATING},
    RoundState.EVALUATING: _ENDINGS | {RoundState.GATING},
    RoundState.GATING: _ENDINGS | {RoundState.PUBLISHED, RoundState.REJECTED, RoundState.KEPT},
}
# Where a failed round goes on when the failed job is retried.
_STATE_OF_RETRIED: dict[JobKind, RoundState] = {
    JobKind.FINETUNE: RoundState.QUEUED,
    JobKind.EVALUATE: RoundState.EVALUATING,
    JobKind.PUBLISH: RoundState.GATING,
}
# No round starts by itself so soon after one that failed or was cancelled; twice as long after the
# second in a row, and so on. Time to look what was wrong, or to change the settings.
RETRY_AFTER = timedelta(minutes=10)


@dataclass(frozen=True)
class RoundRequest:
    """What a client or the tick asks for; None means the campaign's setting."""

    config: dict[str, Any] | None = None  # partial FinetuneConfig; the task's own settings fill it
    publish_rule: PublishRule | None = None
    evaluation: dict[str, int] | None = None  # {"episodes": n, "seed": s}, each optional
    snapshot_digest: str | None = None  # reuse a frozen snapshot
    seed: int | None = None  # of the fine-tuning


def launch(
    session: Session,
    now: datetime,
    campaign_id: int,
    request: RoundRequest,
    *,
    trigger: RoundTrigger = RoundTrigger.MANUAL,
    started_by: int | None = None,
    may_loosen: bool = False,
) -> Round:
    """Freeze the snapshot, store the round, queue its fine-tuning.

    `may_loosen`: the round's publish rule may be looser than the campaign's. Raises NotFoundError;
    NotAllowedError for such a rule without it; ConflictError when no label says which one is
    better, or when another round of the campaign may still publish; UnknownNameError or
    ValueOutOfRangeError for a wrong configuration.
    """
    campaign = lock_campaign(session, campaign_id)
    if campaign.archived:
        raise ConflictError(f"campaign {campaign_id} is archived")
    settings = campaign.settings
    publish_rule = PublishRule(request.publish_rule or settings["publish_rule"])
    if not may_loosen:
        _refuse_looser(campaign, publish_rule)
    config = _config(request, campaign.task, method=settings["method"])
    if publish_rule != PublishRule.NEVER:
        _refuse_second_publishing_round(session, campaign_id)
    snapshot = snapshot_to_learn_from(session, now, campaign_id, request.snapshot_digest)
    # Evaluations share their seeds, so that a parent is evaluated once and compared like with like;
    # collect jobs count up from 0 and stay far below.
    evaluation = {"episodes": settings["evaluation_episodes"], "seed": EVALUATION_SEED}
    new_round = Round(
        campaign_id=campaign_id,
        parent_checkpoint_id=campaign.published_checkpoint_id,
        snapshot_digest=snapshot.digest,
        trigger=trigger,
        publish_rule=publish_rule,
        config=config.to_json(),
        evaluation=evaluation | (request.evaluation or {}),
        started_by=started_by,
        created_at=now,
    )
    session.add(new_round)
    session.flush()
    _queue(session, now, new_round)
    return new_round


def _refuse_looser(campaign: Campaign, wanted: PublishRule) -> None:
    """Whoever may not publish may not have a round do it either."""
    usual = PublishRule(campaign.settings["publish_rule"])
    if not usual.allows(wanted):
        legal = ", ".join(repr(rule.value) for rule in PublishRule if usual.allows(rule))
        raise NotAllowedError(
            f"publish_rule {wanted.value!r} is looser than {usual.value!r} of campaign"
            f" {campaign.id}, which needs role 'admin'; without it legal values are {legal}"
        )


def _queue(session: Session, now: datetime, new_round: Round) -> None:
    jobs.enqueue(
        session,
        now,
        kind=JobKind.FINETUNE,
        campaign_id=new_round.campaign_id,
        round_id=new_round.id,
        payload={},
        dedupe_key=f"finetune:{new_round.id}",
        created_by=new_round.started_by,
    )
    _tell(session, now, new_round)
    audit(
        session,
        now,
        actor_id=new_round.started_by,
        action="round.launch",
        subject=f"round/{new_round.id}",
        details={"trigger": new_round.trigger, "snapshot_digest": new_round.snapshot_digest},
    )


def _config(request: RoundRequest, task: str, *, method: str) -> FinetuneConfig:
    partial = dict(request.config or {})
    if request.seed is not None:
        partial["seed"] = request.seed
    return FinetuneConfig.from_json({"method": method, **settings_for_task(task, partial)})


def _refuse_second_publishing_round(session: Session, campaign_id: int) -> None:
    publishing = select(Round).where(
        Round.campaign_id == campaign_id,
        Round.publish_rule != PublishRule.NEVER,
        Round.state.not_in(FINAL_STATES),
    )
    running = session.scalars(publishing.limit(1)).one_or_none()
    if running is not None:
        raise ConflictError(
            f"round {running.id} of campaign {campaign_id} is {running.state!r} and may publish;"
            " wait for it, cancel it, or start a comparison round with publish_rule 'never'"
        )


def move(
    session: Session, now: datetime, round_id: int, to: RoundState, *, error: str | None = None
) -> Round:
    """Take the round to another state and tell the browsers; to the same state is no change.

    Raises ConflictError for a step that the diagram above does not have.
    """
    found = session.get(Round, round_id, with_for_update=True, populate_existing=True)
    if found is None:
        raise NotFoundError("round", round_id)
    state = RoundState(found.state)
    if state == to:
        return found
    legal = _TRANSITIONS.get(state, frozenset())
    if to not in legal:
        raise ConflictError(
            f"round {round_id} is {state.value!r} and cannot become {to.value!r};"
            f" legal are {sorted(item.value for item in legal)}"
        )
    found.state = to
    if error is not None:
        found.error = error
    if to in FINAL_STATES:
        found.finished_at = now
    _tell(session, now, found)
    session.flush()
    return found


def _tell(session: Session, now: datetime, changed: Round) -> None:
    data = {"round_id": changed.id, "state": str(changed.state), "error": changed.error}
    add_event(
        session,
        now,
        campaign_id=changed.campaign_id,
        round_id=changed.id,
        kind="round",
        data=data,
    )


def cancel(session: Session, now: datetime, round_id: int, *, by: int | None) -> Round:
    """Cancel the round and its unfinished jobs; ConflictError when it has ended otherwise."""
    unfinished = select(Job.id).where(
        Job.round_id == round_id, Job.state.in_((JobState.QUEUED, JobState.RUNNING))
    )
    # Jobs before the round, as a job step locks them: the other order could deadlock with it.
    session.scalars(unfinished.with_for_update()).all()
    cancelled = move(session, now, round_id, RoundState.CANCELLED)
    for job_id in list(session.scalars(unfinished)):
        jobs.cancel(session, now, job_id)
    audit(session, now, actor_id=by, action="round.cancel", subject=f"round/{round_id}")
    return cancelled


def retry_job(session: Session, now: datetime, job_id: int, *, by: int | None) -> Job:
    """Queue a failed job again, and take up its round or its pair where it stopped."""
    job = jobs.retry(session, now, job_id)
    if job.round_id is not None:
        # As a launch does, so that of both at once one wins. Job, campaign, round: the order in
        # which a publishing step locks them.
        lock_campaign(session, job.campaign_id)
        failed = session.get_one(Round, job.round_id, with_for_update=True)
        if failed.state == RoundState.FAILED:
            if failed.publish_rule != PublishRule.NEVER:
                _refuse_second_publishing_round(session, failed.campaign_id)
            failed.state = _STATE_OF_RETRIED[JobKind(job.kind)]
            failed.error = None
            failed.finished_at = None
            _tell(session, now, failed)
    if job.pair_id is not None:
        pair = session.get_one(Pair, job.pair_id)
        if pair.state == PairState.FAILED:
            pair.state = PairState.WAITING
    audit(session, now, actor_id=by, action="job.retry", subject=f"job/{job_id}")
    session.flush()
    return job


def is_due(session: Session, now: datetime, campaign: Campaign) -> RoundTrigger | None:
    """Why a round of this campaign should start now, by its settings; None when it should not."""
    every_labels = int(campaign.settings["round_after_labels"])
    every_minutes = float(campaign.settings["round_every_minutes"])
    if campaign.archived or (every_labels == 0 and every_minutes == 0):
        return None
    running = select(Round.id).where(may_learn(campaign), Round.state.not_in(FINAL_STATES))
    if session.scalar(running.limit(1)) is not None:
        return None
    if now < _rest_ends(session, campaign) or not has_decisive_label(session, campaign.id):
        return None
    new_labels = new_labels_since_round(session, campaign)
    if every_labels > 0 and new_labels >= every_labels:
        return RoundTrigger.LABELS
    last_start = session.scalar(select(func.max(Round.created_at)).where(may_learn(campaign)))
    waited = now - (last_start or campaign.created_at)
    if every_minutes > 0 and new_labels > 0 and waited >= timedelta(minutes=every_minutes):
        return RoundTrigger.PERIODIC
    return None


def _rest_ends(session: Session, campaign: Campaign) -> datetime:
    """When rounds may start by themselves again after those that failed or were cancelled."""
    ended = session.execute(
        select(Round.state, Round.finished_at)
        .where(may_learn(campaign))
        .order_by(Round.id.desc())
        .limit(20)  # after so many in a row the rest is longer than anybody waits
    ).all()
    in_vain = list(itertools.takewhile(lambda row: row.state in _ENDINGS, ended))
    if not in_vain:
        return campaign.created_at
    last: datetime = in_vain[0].finished_at
    rest: timedelta = RETRY_AFTER * 2 ** (len(in_vain) - 1)
    return last + rest


def launch_due(session: Session, now: datetime, campaign_id: int) -> Round | None:
    """Start the round that is due, if one is; two ticks at once start one round."""
    campaign = lock_campaign(session, campaign_id)
    trigger = is_due(session, now, campaign)
    if trigger is None:
        return None
    return launch(session, now, campaign_id, RoundRequest(), trigger=trigger)


def due_campaign_ids(session: Session, now: datetime) -> list[int]:
    """Campaigns that `launch_due` would start a round of."""
    query = select(Campaign).where(Campaign.archived.is_(False)).order_by(Campaign.id)
    return [row.id for row in session.scalars(query) if is_due(session, now, row) is not None]
