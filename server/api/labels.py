"""Episodes, pairs, the hand-out of work, labels, truth of simulated annotators."""

from __future__ import annotations

from datetime import datetime

from fastapi import APIRouter, Response, status
from sqlalchemy import func, not_, select
from sqlalchemy.orm import Session

from server import handout, labeling
from server.api.access import (
    Admin,
    Anyone,
    ReadSession,
    Service,
    Staff,
    UseServices,
    WriteSession,
)
from server.api.params import Cursor, IdempotencyKey, Limit, PathId
from server.campaigns import get_campaign
from server.errors import NotFoundError
from server.handout import Handout, NothingReason
from server.schemas.common import Id, Page
from server.schemas.labels import (
    EpisodeOut,
    EpisodesOfPair,
    LabelCreate,
    LabelOut,
    LeasedPair,
    NextOut,
    NextRequest,
    PairOut,
    Progress,
    RawLabel,
    TruthCounts,
    TruthIn,
    TruthOut,
    UndoOut,
)
from server.states import Choice, PairState
from server.store.labels import effective_among, is_effective
from server.store.paging import page
from server.store.tables import Episode, Label, Pair, SimulatedTruth

router = APIRouter(tags=["labels"])


def _replay_url(pair: Pair) -> str | None:
    return f"/replays/{pair.replay_sha256}.viser" if pair.replay_sha256 else None


def _thumbnail_url(pair: Pair) -> str | None:
    return f"/thumbnails/{pair.thumbnail_sha256}.webp" if pair.thumbnail_sha256 else None


def _next_out(session: Session, now: datetime, found: Handout) -> NextOut:
    far = handout.progress(session, now, found.pair.campaign_id, found.lease.annotator_id)
    return NextOut(
        lease_id=found.lease.id,
        expires_at=found.lease.expires_at,
        pair=LeasedPair(
            id=found.pair.id,
            replay_url=_replay_url(found.pair) or "",
            thumbnail_url=_thumbnail_url(found.pair),
            duration_s=found.duration_s,
            step_s=found.step_s,
        ),
        criterion=found.criterion,
        progress=Progress.model_validate(far),
    )


def _label_out(label: Label, *, first_is_left: bool) -> LabelOut:
    choice = Choice(label.choice)
    return LabelOut(
        id=label.id,
        pair_id=label.pair_id,
        choice=choice,
        side=labeling.side_of(choice, first_is_left=first_is_left),
        retracted=label.retracted,
        late=label.late,
        supersedes_id=label.supersedes_id,
        created_at=label.created_at,
    )


def _pair_out(pair: Pair) -> PairOut:
    return PairOut(
        id=pair.id,
        campaign_id=pair.campaign_id,
        first_episode_id=pair.first_episode_id,
        second_episode_id=pair.second_episode_id,
        first_is_left=pair.first_is_left,
        reason=pair.reason,
        state=PairState(pair.state),
        replay_url=_replay_url(pair),
        thumbnail_url=_thumbnail_url(pair),
        created_at=pair.created_at,
    )


@router.post(
    "/campaigns/{campaign_id}/next",
    response_model=NextOut,
    responses={
        204: {"description": "nothing to label; X-Reason: no_pairs, replays_waiting or all_done"}
    },
)
def next_pair(
    campaign_id: PathId, me: Anyone, services: UseServices, body: NextRequest | None = None
) -> NextOut | Response:
    """The next pair to label, under a lease."""
    request, now = body or NextRequest(), services.clock()
    hold, prefetch_after = request.hold, request.prefetch_after_pair_id
    # SQLite has one writer at a time: what takes long is done before it and after it.
    with services.database.read() as session:
        outlook = handout.look_ahead(
            session, now, campaign_id, me.id, hold=hold, prefetch_after=prefetch_after
        )
    with services.database.write() as session:
        found = handout.next_pair(
            session,
            now,
            campaign_id,
            me.id,
            lease_for=services.lease_for,
            hold=hold,
            prefetch_after=prefetch_after,
            outlook=outlook,
        )
    if isinstance(found, NothingReason):
        return Response(status_code=status.HTTP_204_NO_CONTENT, headers={"X-Reason": found.value})
    with services.database.read() as session:
        return _next_out(session, now, found)


@router.post(
    "/labels",
    status_code=status.HTTP_201_CREATED,
    responses={200: {"model": LabelOut, "description": "stored before under this key"}},
)
def submit_label(
    body: LabelCreate,
    key: IdempotencyKey,
    me: Anyone,
    session: WriteSession,
    services: UseServices,
    response: Response,
) -> LabelOut:
    """Store an answer, for ever."""
    names = LabelCreate.model_fields
    submission = labeling.Submission(**{name: getattr(body, name) for name in names})
    label, created = labeling.submit_label(
        session, services.clock(), me, submission, idempotency_key=key
    )
    response.status_code = status.HTTP_201_CREATED if created else status.HTTP_200_OK
    pair = session.get_one(Pair, label.pair_id)
    return _label_out(label, first_is_left=pair.first_is_left)


@router.post(
    "/labels/{label_id}/undo",
    status_code=status.HTTP_201_CREATED,
    responses={200: {"model": UndoOut, "description": "taken back before under this key"}},
)
def undo_label(
    label_id: PathId,
    key: IdempotencyKey,
    me: Anyone,
    session: WriteSession,
    services: UseServices,
    response: Response,
) -> UndoOut:
    """Take an own label back and get the same pair again."""
    undone = labeling.undo_label(
        session,
        services.clock(),
        me,
        label_id,
        idempotency_key=key,
        lease_for=services.lease_for,
    )
    response.status_code = status.HTTP_201_CREATED if undone.created else status.HTTP_200_OK
    pair = session.get_one(Pair, undone.retraction.pair_id)
    return UndoOut(
        label=_label_out(undone.retraction, first_is_left=pair.first_is_left),
        next=None if undone.again is None else _next_out(session, services.clock(), undone.again),
    )


@router.get("/campaigns/{campaign_id}/labels")
def list_labels(
    campaign_id: PathId,
    _me: Admin,
    session: ReadSession,
    in_force: bool | None = None,
    pair_id: Id | None = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[RawLabel]:
    """Label rows of the campaign with everything on record, oldest first; all, unless asked for
    those that are in force (the last word of their annotator, not taken back), or are not, or for
    those of a pair."""
    get_campaign(session, campaign_id)
    query = select(Label).where(Label.campaign_id == campaign_id)
    if pair_id is not None:
        query = query.where(Label.pair_id == pair_id)
    if in_force is not None:
        query = query.where(is_effective() if in_force else not_(is_effective()))
    rows, next_cursor = page(session, query, Label.id, limit=limit, cursor=cursor)
    effective = effective_among(session, [row.id for row in rows])
    names = [name for name in RawLabel.model_fields if name != "in_force"]
    items = [
        RawLabel(in_force=row.id in effective, **{name: getattr(row, name) for name in names})
        for row in rows
    ]
    return Page[RawLabel](items=items, next_cursor=next_cursor)


@router.put(
    "/labels/{label_id}/truth",
    status_code=status.HTTP_201_CREATED,
    responses={200: {"model": TruthOut, "description": "on record already"}},
)
def record_truth(
    label_id: PathId, body: TruthIn, me: Service, session: WriteSession, response: Response
) -> TruthOut:
    """Note what a simulated annotator really preferred (own labels only)."""
    truth, created = labeling.record_truth(
        session,
        me,
        label_id,
        true_choice=body.true_choice,
        corruption=body.corruption,
        criterion=body.criterion,
    )
    response.status_code = status.HTTP_201_CREATED if created else status.HTTP_200_OK
    return TruthOut.model_validate(truth)


@router.get("/campaigns/{campaign_id}/truth")
def count_truth(campaign_id: PathId, _me: Staff, session: ReadSession) -> TruthCounts:
    """How many labels of simulated annotators contradict what they really preferred."""
    get_campaign(session, campaign_id)
    known = (
        select(SimulatedTruth.corrupted, func.count())
        .join(Label, Label.id == SimulatedTruth.label_id)
        .where(Label.campaign_id == campaign_id)
        .group_by(SimulatedTruth.corrupted)
    )
    counts = dict(session.execute(known).all())
    return TruthCounts(total=sum(counts.values()), flipped=counts.get(True, 0))


@router.get("/campaigns/{campaign_id}/episodes")
def list_episodes(
    campaign_id: PathId,
    _me: Staff,
    session: ReadSession,
    checkpoint_id: Id | None = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[EpisodeOut]:
    """Rollouts of the campaign, oldest first."""
    get_campaign(session, campaign_id)
    query = select(Episode).where(Episode.campaign_id == campaign_id)
    if checkpoint_id is not None:
        query = query.where(Episode.checkpoint_id == checkpoint_id)
    rows, next_cursor = page(session, query, Episode.id, limit=limit, cursor=cursor)
    items = [EpisodeOut.model_validate(row) for row in rows]
    return Page[EpisodeOut](items=items, next_cursor=next_cursor)


@router.get("/campaigns/{campaign_id}/pairs")
def list_pairs(
    campaign_id: PathId,
    _me: Staff,
    session: ReadSession,
    state: PairState | None = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[PairOut]:
    """Pairs of the campaign, oldest first."""
    get_campaign(session, campaign_id)
    query = select(Pair).where(Pair.campaign_id == campaign_id)
    if state is not None:
        query = query.where(Pair.state == state)
    rows, next_cursor = page(session, query, Pair.id, limit=limit, cursor=cursor)
    return Page[PairOut](items=[_pair_out(row) for row in rows], next_cursor=next_cursor)


@router.get("/pairs/{pair_id}")
def get_pair(pair_id: PathId, _me: Staff, session: ReadSession) -> PairOut:
    """One pair."""
    pair = session.get(Pair, pair_id)
    if pair is None:
        raise NotFoundError("pair", pair_id)
    return _pair_out(pair)


@router.get("/pairs/{pair_id}/episodes")
def episodes_of_pair(pair_id: PathId, _me: Staff, session: ReadSession) -> EpisodesOfPair:
    """Ground truth of both episodes, for simulated annotators; never shown to people."""
    pair = session.get(Pair, pair_id)
    if pair is None:
        raise NotFoundError("pair", pair_id)
    return EpisodesOfPair(
        pair_id=pair.id,
        first_is_left=pair.first_is_left,
        first=EpisodeOut.model_validate(session.get_one(Episode, pair.first_episode_id)),
        second=EpisodeOut.model_validate(session.get_one(Episode, pair.second_episode_id)),
    )
