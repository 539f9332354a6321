"""Handing out pairs to annotators under leases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum

from sqlalchemy import ColumnElement, Select, func, select
from sqlalchemy.orm import Session

from server.errors import NotFoundError
from server.states import PairState
from server.store.labels import is_effective
from server.store.leases import pairs_given_back
from server.store.pairs import (
    count_by_state,
    count_taken,
    has_labelled,
    live_leases,
    open_pairs,
)
from server.store.session import LOCK
from server.store.tables import Campaign, Checkpoint, Episode, Label, Lease, Pair

GIVEN_BACK_FOR = timedelta(hours=12)  # for so long a pair that one gave back stays away
MAX_HOLD = 5  # leases that one annotator can hold in a campaign, for prefetching
# Pairs of which labels so far say that people will prefer one side come first, because a click on
# "equal" teaches less. Every so many of an annotator's pairs comes in turn all the same: what
# the first labels took for alike is looked at again.
IN_TURN = 5
LOOK_AHEAD = 20  # more annotators than ask in the same moment: each finds the one before at work


class NothingReason(StrEnum):
    """Why there is nothing to label; sent as the header X-Reason."""

    NO_PAIRS = "no_pairs"
    REPLAYS_WAITING = "replays_waiting"
    ALL_DONE = "all_done"


@dataclass(frozen=True)
class Handout:
    """A leased pair. Nothing of policies, modes or other labels."""

    lease: Lease
    pair: Pair
    criterion: str
    duration_s: float | None  # of the longer episode
    step_s: float | None  # of one control step, which is one frame of the replay


@dataclass(frozen=True)
class Progress:
    """How far an annotator is in a campaign."""

    done: int
    remaining: int  # including the pairs that the annotator holds


@dataclass(frozen=True)
class Outlook:
    """What an annotator would get next, as seen before the pair is locked.

    Looking for it takes long in a large campaign, and needs no lock. What has changed since is
    noticed when the pair is handed out.
    """

    handed_out: int  # leases that the annotator ever had
    pairs: tuple[tuple[int, int], ...]  # id, and how often it was taken, in the order of hand-out


def look_ahead(
    session: Session,
    now: datetime,
    campaign_id: int,
    annotator_id: int,
    *,
    hold: int = 1,
    prefetch_after: int | None = None,
) -> Outlook | None:
    """What `next_pair` would lease; None when it would not look for a pair at all."""
    campaign = session.get(Campaign, campaign_id)
    if campaign is None or campaign.archived:
        return None
    held = live_leases(session, now, campaign_id, annotator_id)
    if _held_suffices(held, hold, prefetch_after):
        return None
    handed_out = _handed_out(session, annotator_id)
    found = session.execute(_open_for(now, campaign, annotator_id, handed_out).limit(LOOK_AHEAD))
    return Outlook(handed_out, tuple((pair.id, taken) for pair, taken in found))


def next_pair(
    session: Session,
    now: datetime,
    campaign_id: int,
    annotator_id: int,
    *,
    lease_for: timedelta,
    hold: int = 1,
    prefetch_after: int | None = None,
    outlook: Outlook | None = None,
) -> Handout | NothingReason:
    """The pair to label next, under a lease.

    What the annotator holds already comes first (a reloaded page gets its pair back). While fewer
    than `hold` pairs are held a new one is leased; with `prefetch_after` the answer is never that
    pair. With the `outlook` of `look_ahead` the pair is mostly found without a search. Raises
    NotFoundError.
    """
    campaign = session.get(Campaign, campaign_id)
    if campaign is None:
        raise NotFoundError("campaign", campaign_id)
    if campaign.archived:
        return NothingReason.ALL_DONE
    _one_request_at_a_time(session, campaign_id, annotator_id)
    held = list(live_leases(session, now, campaign_id, annotator_id))
    others = [lease for lease in held if lease.pair_id != prefetch_after]
    if _held_suffices(held, hold, prefetch_after):
        return handout(session, campaign, _prolong(others[0], now, lease_for))
    pair = _take_foreseen_pair(session, now, annotator_id, outlook)
    pair = pair or _take_open_pair(session, now, campaign, annotator_id)
    if pair is not None:
        lease = issue_lease(session, now, pair.id, annotator_id, lease_for=lease_for)
        return handout(session, campaign, lease)
    if others:
        return handout(session, campaign, _prolong(others[0], now, lease_for))
    return _why_nothing(session, campaign_id)


def _held_suffices(held: Sequence[Lease], hold: int, prefetch_after: int | None) -> bool:
    """Whether a pair that the annotator holds is the answer, and no new one is wanted."""
    if all(lease.pair_id == prefetch_after for lease in held):
        return False
    return prefetch_after is not None or len(held) >= min(hold, MAX_HOLD)


def _one_request_at_a_time(session: Session, campaign_id: int, annotator_id: int) -> None:
    """Two tabs of one annotator take turns (SQLite's writers do so anyway)."""
    if session.get_bind().dialect.name == "postgresql":
        session.execute(select(func.pg_advisory_xact_lock(campaign_id, annotator_id)))


def _prolong(lease: Lease, now: datetime, lease_for: timedelta) -> Lease:
    lease.expires_at = now + lease_for
    return lease


def _take_foreseen_pair(
    session: Session, now: datetime, annotator_id: int, outlook: Outlook | None
) -> Pair | None:
    """Lock the first pair of the outlook that is still what it was; None when none is."""
    if outlook is None or outlook.handed_out != _handed_out(session, annotator_id):
        return None
    given_back = set(session.scalars(pairs_given_back(annotator_id, since=now - GIVEN_BACK_FOR)))
    for pair_id, taken in outlook.pairs:
        if pair_id in given_back:
            continue
        pair: Pair | None = session.get(
            Pair, pair_id, with_for_update=LOCK | {"skip_locked": True}, populate_existing=True
        )
        if pair is None or pair.state != PairState.READY:
            continue
        unchanged = taken == count_taken(session, now, pair_id, annotator_id)
        if unchanged and not has_labelled(session, pair_id, annotator_id):
            return pair
    return None


def _take_open_pair(
    session: Session, now: datetime, campaign: Campaign, annotator_id: int
) -> Pair | None:
    """Find a pair with room and lock its row, so that nobody else counts the same room.

    The room is counted again under the lock: the search may have seen the state before another
    annotator's lease. Rows that others hold locked are skipped at first, and waited for when
    nothing else is left.
    """
    wanted = int(campaign.settings["labels_per_pair"])
    handed_out = _handed_out(session, annotator_id)
    refused: list[int] = []
    skip_locked = True
    while True:
        query = (
            _open_for(now, campaign, annotator_id, handed_out)
            .where(Pair.id.not_in(refused))
            .limit(1)
            .with_for_update(of=Pair, key_share=True, skip_locked=skip_locked)
        )
        pair: Pair | None = session.scalars(query).one_or_none()
        if pair is None and not skip_locked:
            return None
        if pair is None:
            skip_locked = False
        elif count_taken(session, now, pair.id, annotator_id) < wanted:
            return pair
        else:
            refused.append(pair.id)


def _open_for(
    now: datetime, campaign: Campaign, annotator_id: int, handed_out: int | None = None
) -> Select[Pair, int]:
    """The pairs that the annotator can get, in the order of hand-out.

    `handed_out`: how many leases the annotator ever had; None when the order does not matter.
    """
    pairs = open_pairs(
        now,
        campaign.id,
        annotator_id,
        labels_per_pair=int(campaign.settings["labels_per_pair"]),
        published_checkpoint_id=campaign.published_checkpoint_id,
        telling_first=handed_out is not None and handed_out % IN_TURN != 0,
    )
    return pairs.where(_not_given_back(now, annotator_id))


def _not_given_back(now: datetime, annotator_id: int) -> ColumnElement[bool]:
    """Condition on Pair: what one skipped does not come straight back."""
    return Pair.id.not_in(pairs_given_back(annotator_id, since=now - GIVEN_BACK_FOR))


def _handed_out(session: Session, annotator_id: int) -> int:
    leases = select(func.count()).where(Lease.annotator_id == annotator_id)
    return session.scalars(leases.select_from(Lease)).one()


def issue_lease(
    session: Session, now: datetime, pair_id: int, annotator_id: int, *, lease_for: timedelta
) -> Lease:
    """Hand the pair to the annotator. The caller has locked the pair and counted its room."""
    lease = Lease(
        pair_id=pair_id, annotator_id=annotator_id, issued_at=now, expires_at=now + lease_for
    )
    session.add(lease)
    session.flush()
    return lease


def handout(session: Session, campaign: Campaign, lease: Lease) -> Handout:
    """The lease with what its page shows."""
    session.flush()
    pair = session.get_one(Pair, lease.pair_id)
    return Handout(lease, pair, campaign.criterion, *_duration_and_step(session, pair))


def progress(session: Session, now: datetime, campaign_id: int, annotator_id: int) -> Progress:
    """How far the annotator is. It counts the whole campaign: not for a writer's session."""
    campaign = session.get_one(Campaign, campaign_id)
    mine = select(func.count()).where(
        Label.campaign_id == campaign_id, Label.annotator_id == annotator_id, is_effective()
    )
    still_open = _open_for(now, campaign, annotator_id).with_only_columns(Pair.id).order_by(None)
    counted = session.execute(select(func.count()).select_from(still_open.subquery())).scalar_one()
    held = len(live_leases(session, now, campaign_id, annotator_id))
    return Progress(done=session.execute(mine).scalar_one(), remaining=counted + held)


def _duration_and_step(session: Session, pair: Pair) -> tuple[float | None, float | None]:
    """Seconds of the longer episode and of one control step; None when the checkpoint does not
    tell its control step. Both episodes are of the campaign's task."""
    episodes = [
        session.get_one(Episode, i) for i in (pair.first_episode_id, pair.second_episode_id)
    ]
    checkpoint = session.get_one(Checkpoint, episodes[0].checkpoint_id)
    control_dt = checkpoint.config.get("task_facts", {}).get("control_dt")
    if control_dt is None:
        return None, None
    return max(episode.steps for episode in episodes) * float(control_dt), float(control_dt)


def _why_nothing(session: Session, campaign_id: int) -> NothingReason:
    counts = count_by_state(session, campaign_id)
    if counts[PairState.WAITING] > 0:
        return NothingReason.REPLAYS_WAITING
    return NothingReason.ALL_DONE if any(counts.values()) else NothingReason.NO_PAIRS
