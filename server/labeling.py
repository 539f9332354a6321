"""Labels: every click is a new row; nothing is changed, lost or made anonymous."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from server.errors import ConflictError, NotAllowedError, NotFoundError
from server.handout import Handout, handout, issue_lease
from server.sign_in import Me
from server.states import DECISIVE, AnnotatorKind, Choice
from server.store.events import add_event
from server.store.labels import newest_label
from server.store.session import LOCK
from server.store.tables import Campaign, Episode, Label, Lease, Pair, SimulatedTruth


class ScreenChoice(StrEnum):
    """What an annotator answers: sides of the screen, not episodes."""

    LEFT = "left"
    RIGHT = "right"
    EQUAL = "equal"
    CANNOT_TELL = "cannot_tell"


@dataclass(frozen=True)
class Submission:
    """One answer as it came from the page or the script."""

    pair_id: int
    choice: ScreenChoice
    lease_id: int | None = None
    client_time: datetime | None = None
    duration_ms: int | None = None
    active_ms: int | None = None
    replay_events: list[Any] = field(default_factory=list)
    ui_version: str = ""

    def digest(self) -> str:
        """SHA-256 of the canonical JSON; tells a repeated request from another one."""
        return _digest({"kind": "label", **asdict(self)})


@dataclass(frozen=True)
class Undone:
    """The row that takes a label back, if it is new, and the pair again (None: judged anew)."""

    retraction: Label
    again: Handout | None
    created: bool


def _digest(content: dict[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def choice_of(side: ScreenChoice, *, first_is_left: bool) -> Choice:
    """From the side of the screen to the episode."""
    if side is ScreenChoice.LEFT:
        return Choice.FIRST if first_is_left else Choice.SECOND
    if side is ScreenChoice.RIGHT:
        return Choice.SECOND if first_is_left else Choice.FIRST
    return Choice(side.value)


def side_of(choice: Choice, *, first_is_left: bool) -> ScreenChoice:
    """From the episode to the side of the screen."""
    if choice in DECISIVE:
        is_left = (choice is Choice.FIRST) == first_is_left
        return ScreenChoice.LEFT if is_left else ScreenChoice.RIGHT
    return ScreenChoice(choice.value)


def submit_label(
    session: Session, now: datetime, me: Me, submission: Submission, *, idempotency_key: str
) -> tuple[Label, bool]:
    """Store one answer; returns the row and whether it is new.

    The same key with the same request gives back the first row. A later answer to the same pair
    supersedes the earlier one with a new row. A label whose lease has run out is kept and marked
    as late. Raises NotFoundError for an unknown pair, NotAllowedError for one that was never handed
    to this annotator, ConflictError for a used key with another request.
    """
    request = submission.digest()
    if (known := _by_key(session, me.id, idempotency_key, request)) is not None:
        return known, False
    pair = _locked_pair(session, submission.pair_id)
    if (known := _by_key(session, me.id, idempotency_key, request)) is not None:
        return known, False
    lease = _lease_of(session, pair.id, me.id, submission.lease_id)
    label = _label_row(session, now, me, pair, lease)
    label.choice = choice_of(submission.choice, first_is_left=pair.first_is_left)
    label.client_time = submission.client_time
    label.duration_ms = submission.duration_ms
    label.active_ms = submission.active_ms
    label.replay_events = submission.replay_events
    label.ui_version = submission.ui_version
    earlier = newest_label(session, pair.id, me.id)
    label.supersedes_id = None if earlier is None else earlier.id
    label.idempotency_key, label.request_sha256 = idempotency_key, request
    stored, created = _insert(session, label)
    if created:
        _close_leases(session, now, pair.id, me.id)
        _tell(session, now, stored)
    return stored, created


def undo_label(
    session: Session,
    now: datetime,
    me: Me,
    label_id: int,
    *,
    idempotency_key: str,
    lease_for: timedelta,
) -> Undone:
    """Take back an own label by a new row, and hand the same pair out again.

    The same key gives back the first row; the pair comes with it only while that row is the
    annotator's last word on it, because a pair that was judged anew must not be handed out.
    Raises NotFoundError, NotAllowedError for somebody else's label, ConflictError when the label
    is superseded or taken back already, or when the key was used for another request.
    """
    target = session.get(Label, label_id)
    if target is None:
        raise NotFoundError("label", label_id)
    if target.annotator_id != me.id:
        raise NotAllowedError(f"label {label_id} was given by another annotator")
    pair = _locked_pair(session, target.pair_id)
    campaign = session.get_one(Campaign, target.campaign_id)
    request = _digest({"kind": "undo", "label_id": label_id})
    newest = newest_label(session, pair.id, me.id)
    retraction = _by_key(session, me.id, idempotency_key, request)
    if created := retraction is None:
        if newest is None or newest.id != target.id or target.retracted:
            raise ConflictError(
                f"label {label_id} is not in force: it was superseded or taken back;"
                f" the last row on pair {pair.id} is {newest.id if newest else None}"
            )
        row = _retraction_row(session, now, me, pair, target)
        row.idempotency_key, row.request_sha256 = idempotency_key, request
        retraction, created = _insert(session, row)
        if created:
            _tell(session, now, retraction)
    elif newest is None or newest.id != retraction.id:
        return Undone(retraction, None, created=False)
    lease = _live_or_new_lease(session, now, pair.id, me.id, lease_for)
    return Undone(retraction, handout(session, campaign, lease), created=created)


def _retraction_row(session: Session, now: datetime, me: Me, pair: Pair, target: Label) -> Label:
    lease = session.get(Lease, target.lease_id) if target.lease_id is not None else None
    row = _label_row(session, now, me, pair, lease)
    row.choice, row.retracted, row.supersedes_id = target.choice, True, target.id
    row.late, row.ui_version = False, target.ui_version
    return row


def _locked_pair(session: Session, pair_id: int) -> Pair:
    """Lock the row: answers to one pair come one after the other on every engine."""
    pair = session.get(Pair, pair_id, with_for_update=LOCK, populate_existing=True)
    if pair is None:
        raise NotFoundError("pair", pair_id)
    return pair


def _by_key(session: Session, annotator_id: int, key: str, request: str) -> Label | None:
    found = session.scalars(
        select(Label).where(Label.annotator_id == annotator_id, Label.idempotency_key == key)
    ).one_or_none()
    if found is not None and found.request_sha256 != request:
        raise ConflictError(
            f"Idempotency-Key {key!r} was used for label {found.id} with another request;"
            " make a new key for every new answer"
        )
    return found


def _lease_of(session: Session, pair_id: int, annotator_id: int, lease_id: int | None) -> Lease:
    mine = select(Lease).where(Lease.pair_id == pair_id, Lease.annotator_id == annotator_id)
    if lease_id is not None:
        mine = mine.where(Lease.id == lease_id)
    lease = session.scalars(mine.order_by(Lease.id.desc()).limit(1)).one_or_none()
    if lease is None:
        which = "" if lease_id is None else f" under lease {lease_id}"
        raise NotAllowedError(
            f"pair {pair_id} was never handed to you{which}; ask for the next pair instead"
        )
    return lease


def _label_row(session: Session, now: datetime, me: Me, pair: Pair, lease: Lease | None) -> Label:
    """What is common to an answer and a retraction: who, what was shown where, by which policy."""
    first = session.get_one(Episode, pair.first_episode_id)
    second = session.get_one(Episode, pair.second_episode_id)
    left, right = (first, second) if pair.first_is_left else (second, first)
    return Label(
        campaign_id=pair.campaign_id,
        pair_id=pair.id,
        annotator_id=me.id,
        retracted=False,
        left_episode_id=left.id,
        right_episode_id=right.id,
        first_checkpoint_id=first.checkpoint_id,
        second_checkpoint_id=second.checkpoint_id,
        pair_reason=pair.reason,
        lease_id=None if lease is None else lease.id,
        late=lease is not None and lease.expires_at <= now,
        source=me.kind,
        created_at=now,
        replay_events=[],
    )


def _insert(session: Session, label: Label) -> tuple[Label, bool]:
    """Insert, or find what another request with the same key has inserted at the same time."""
    try:
        with session.begin_nested():
            session.add(label)
    except IntegrityError:
        known = _by_key(session, label.annotator_id, label.idempotency_key, label.request_sha256)
        if known is None:
            raise
        return known, False
    return label, True


def _close_leases(session: Session, now: datetime, pair_id: int, annotator_id: int) -> None:
    query = select(Lease).where(
        Lease.pair_id == pair_id, Lease.annotator_id == annotator_id, Lease.closed_at.is_(None)
    )
    for lease in session.scalars(query):
        lease.closed_at = now


def _live_or_new_lease(
    session: Session, now: datetime, pair_id: int, annotator_id: int, lease_for: timedelta
) -> Lease:
    query = select(Lease).where(
        Lease.pair_id == pair_id,
        Lease.annotator_id == annotator_id,
        Lease.closed_at.is_(None),
        Lease.expires_at > now,
    )
    lease = session.scalars(query.order_by(Lease.id.desc()).limit(1)).one_or_none()
    return lease or issue_lease(session, now, pair_id, annotator_id, lease_for=lease_for)


def _tell(session: Session, now: datetime, label: Label) -> None:
    """The admin page counts along; the choice itself is not told."""
    data = {
        "label_id": label.id,
        "pair_id": label.pair_id,
        "annotator_id": label.annotator_id,
        "retracted": label.retracted,
    }
    add_event(session, now, campaign_id=label.campaign_id, kind="label", data=data)


def record_truth(
    session: Session,
    me: Me,
    label_id: int,
    *,
    true_choice: ScreenChoice,
    corruption: str,
    criterion: str,
) -> tuple[SimulatedTruth, bool]:
    """Note what a simulated annotator really preferred; kept apart from the labels.

    Returns the row and whether it is new. Raises NotFoundError, NotAllowedError unless it is an
    own label of a simulated annotator, ConflictError when something else is on record.
    """
    label = session.get(Label, label_id)
    if label is None:
        raise NotFoundError("label", label_id)
    if label.annotator_id != me.id or me.kind != AnnotatorKind.SIMULATED:
        raise NotAllowedError(
            f"the truth of label {label_id} can be told by the simulated annotator who gave it only"
        )
    pair = session.get_one(Pair, label.pair_id)
    truth = SimulatedTruth(
        label_id=label_id,
        true_choice=choice_of(true_choice, first_is_left=pair.first_is_left),
        corrupted=corruption != "none",
        corruption=corruption,
        criterion=criterion,
    )
    known = session.get(SimulatedTruth, label_id)
    if known is None:
        try:
            with session.begin_nested():
                session.add(truth)
            return truth, True
        except IntegrityError:  # another request has told it at the same time
            known = session.get_one(SimulatedTruth, label_id)
    same = (known.true_choice, known.corruption, known.criterion) == (
        truth.true_choice,
        truth.corruption,
        truth.criterion,
    )
    if not same:
        raise ConflictError(f"another truth is on record for label {label_id}")
    return known, False
