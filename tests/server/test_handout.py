"""Leases: who gets which pair, and never more annotators on a pair than wanted."""

from __future__ import annotations

from collections import Counter
from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import func, select

from server.handout import Handout, NothingReason, Outlook, look_ahead, next_pair
from server.labeling import ScreenChoice, Submission, submit_label
from server.states import PairState
from server.store.session import Database
from server.store.tables import Episode, Label, Lease, Pair
from tests import factories
from tests.factories import NOW
from tests.server.threads import at_once
from tests.server.world import World

LEASE = timedelta(minutes=10)


def _next(world: World, name: str, campaign_id: int, **body: Any) -> dict[str, Any]:
    answer = world.client(name).post(f"/campaigns/{campaign_id}/next", json=body)
    assert answer.status_code == 200, (answer.status_code, dict(answer.headers), answer.text)
    found: dict[str, Any] = answer.json()
    return found


def _nothing(world: World, name: str, campaign_id: int, **body: Any) -> str:
    answer = world.client(name).post(f"/campaigns/{campaign_id}/next", json=body)
    assert answer.status_code == 204, answer.text
    assert answer.content == b""
    return answer.headers["x-reason"]


def _label(world: World, name: str, handed: dict[str, Any], choice: str = "left") -> dict[str, Any]:
    answer = world.client(name).post(
        "/labels",
        json={
            "pair_id": handed["pair"]["id"],
            "lease_id": handed["lease_id"],
            "choice": choice,
            "ui_version": "test",
        },
        headers={"Idempotency-Key": f"{name}-{handed['lease_id']}"},
    )
    assert answer.status_code == 201, answer.text
    stored: dict[str, Any] = answer.json()
    return stored


def test_a_handed_out_pair_shows_nothing_but_the_pair(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=2)
    found = _next(world, "ann", campaign_id)
    assert found == {
        "lease_id": 1,
        "expires_at": "2026-11-22T12:10:00Z",
        "pair": {
            "id": pair_ids[0],
            "replay_url": f"/replays/{'b' * 64}.viser",
            "thumbnail_url": f"/thumbnails/{'c' * 64}.webp",
            "left_label": "A",
            "right_label": "B",
            "duration_s": pytest.approx(81 * 0.035),
            "step_s": 0.035,
        },
        "criterion": factories.TASK_FACTS["criterion"],
        "progress": {"done": 0, "remaining": 2},
    }


def test_a_reloaded_page_gets_its_pair_back_with_more_time(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=3)
    first = _next(world, "ann", campaign_id)
    world.clock.advance(minutes=9)
    again = _next(world, "ann", campaign_id)
    assert again["lease_id"] == first["lease_id"]
    assert again["expires_at"] == "2026-11-22T12:19:00Z"


def test_prefetching_gives_the_next_pair_and_keeps_both_leases(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=3)
    shown = _next(world, "ann", campaign_id, hold=1)
    prefetch = {"hold": 2, "prefetch_after_pair_id": shown["pair"]["id"]}
    ahead = _next(world, "ann", campaign_id, **prefetch)
    assert ahead["pair"]["id"] != shown["pair"]["id"]
    assert _next(world, "ann", campaign_id, **prefetch)["lease_id"] == ahead["lease_id"]
    assert ahead["progress"] == {"done": 0, "remaining": 3}
    _label(world, "ann", shown)
    follow = _next(world, "ann", campaign_id, hold=1)  # what was prefetched comes now
    assert follow["lease_id"] == ahead["lease_id"]
    assert follow["progress"] == {"done": 1, "remaining": 2}


def test_holding_two_pairs_gives_a_second_one_and_then_the_first_again(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=3)
    given = [_next(world, "ann", campaign_id, hold=2)["pair"]["id"] for _ in range(3)]
    assert given == [pair_ids[0], pair_ids[1], pair_ids[0]]


def test_prefetching_at_the_end_finds_nothing_but_a_reload_still_shows_the_last_pair(
    world: World,
) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    last = _next(world, "ann", campaign_id)
    prefetch = {"hold": 2, "prefetch_after_pair_id": last["pair"]["id"]}
    assert _nothing(world, "ann", campaign_id, **prefetch) == "all_done"
    assert _next(world, "ann", campaign_id, hold=2)["lease_id"] == last["lease_id"]


def test_pairs_of_the_published_policy_come_before_those_of_its_predecessors(world: World) -> None:
    campaign_id, old = world.add_campaign(pairs=6)
    with world.database.write() as session:
        campaign = session.get_one(factories.Campaign, campaign_id)
        campaign.published_checkpoint_id = factories.add_checkpoint(session, "avoid-round-1").id
        new = [pair.id for pair in factories.add_pairs(session, campaign, 6)]
        for pair_id in new:
            pair = session.get_one(Pair, pair_id)
            for episode_id in (pair.first_episode_id, pair.second_episode_id):
                episode = session.get_one(Episode, episode_id)
                episode.checkpoint_id = campaign.published_checkpoint_id
    got = []
    for _ in range(8):  # both of the turns that look for what tells most and of those in turn
        handed = _next(world, "ann", campaign_id)
        _label(world, "ann", handed, "equal")
        got.append(handed["pair"]["id"])
    assert got == new + old[:2]


def test_reasons_when_there_is_nothing_to_label(world: World) -> None:
    campaign_id, _ = world.add_campaign()
    assert _nothing(world, "ann", campaign_id) == "no_pairs"
    with world.database.write() as session:
        campaign = session.get_one(factories.Campaign, campaign_id)
        factories.add_pairs(session, campaign, 1, state=PairState.WAITING)
    assert _nothing(world, "ann", campaign_id) == "replays_waiting"
    with world.database.write() as session:
        for pair in session.scalars(select(Pair)):
            pair.state = PairState.READY
            pair.replay_sha256 = "b" * 64
    _label(world, "ann", _next(world, "ann", campaign_id))
    assert _nothing(world, "ann", campaign_id) == "all_done"
    assert world.client("ann").post("/campaigns/99/next", json={}).status_code == 404


def test_an_annotator_never_gets_the_same_pair_twice(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=4, labels_per_pair=2)
    for name in ("ann", "bob"):
        seen = []
        for _ in pair_ids:
            handed = _next(world, name, campaign_id)
            seen.append(handed["pair"]["id"])
            _label(world, name, handed)
        assert sorted(seen) == pair_ids
        assert _nothing(world, name, campaign_id) == "all_done"


def test_a_pair_that_others_hold_or_have_labelled_is_not_handed_out(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=2)
    anns = _next(world, "ann", campaign_id)
    bobs = _next(world, "bob", campaign_id)
    assert {anns["pair"]["id"], bobs["pair"]["id"]} == set(pair_ids)
    assert _nothing(world, "sam", campaign_id) == "all_done"
    _label(world, "ann", anns)
    world.clock.advance(minutes=11)  # bob has left; ann's label holds
    assert _next(world, "sam", campaign_id)["pair"]["id"] == bobs["pair"]["id"]


def test_pairs_with_fewer_labels_come_first(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=2, labels_per_pair=2)
    first = _next(world, "ann", campaign_id)
    assert first["pair"]["id"] == pair_ids[0]
    assert _next(world, "bob", campaign_id)["pair"]["id"] == pair_ids[1]


def _set_kinds(world: World, pair_ids: list[int], *kinds: tuple[str | None, bool]) -> None:
    """Behaviour group and success of the first and the second episode of those pairs."""
    with world.database.write() as session:
        for pair_id in pair_ids:
            pair = session.get_one(Pair, pair_id)
            episodes = (pair.first_episode_id, pair.second_episode_id)
            for episode_id, (group, success) in zip(episodes, kinds, strict=True):
                episode = session.get_one(Episode, episode_id)
                episode.group, episode.success = group, success


def test_pairs_of_kinds_that_people_can_judge_come_first(world: World) -> None:
    campaign_id, pair_ids = world.add_campaign(pairs=14)
    alike, telling = pair_ids[:7], pair_ids[7:]
    _set_kinds(world, alike, ("blue", True), ("green", True))
    # The same two groups in either order, and a failure that settled none: kinds of their own.
    _set_kinds(world, telling[::2], ("red", True), ("green", True))
    _set_kinds(world, telling[1::2], ("green", True), ("red", True))
    _set_kinds(world, telling[-1:], (None, False), ("red", True))
    got = []
    for _ in range(8):
        handed = _next(world, "ann", campaign_id)
        got.append(handed["pair"]["id"])
        _label(world, "ann", handed, "equal" if got[-1] in alike else "left")
    # The first and the sixth come in turn; what was judged most often comes before what nobody has
    # seen yet, and that before what was found alike.
    assert got == [alike[0], *telling[:4], alike[1], *telling[4:6]]
    got = [_next_labelled(world, campaign_id) for _ in range(6)]
    assert got == [telling[6], alike[2], *alike[3:]]


def _next_labelled(world: World, campaign_id: int) -> int:
    handed = _next(world, "ann", campaign_id)
    _label(world, "ann", handed, "cannot_tell")
    found: int = handed["pair"]["id"]
    return found


def test_labels_of_another_campaign_and_those_taken_back_do_not_count(world: World) -> None:
    other_id, (other,) = world.add_campaign(pairs=1)
    campaign_id, pair_ids = world.add_campaign(pairs=3)
    _set_kinds(world, [other, *pair_ids[:2]], ("blue", True), ("green", True))
    _set_kinds(world, pair_ids[2:], ("red", True), ("green", True))
    _label(world, "bob", _next(world, "bob", other_id), "equal")
    handed = _next(world, "bob", campaign_id)
    assert handed["pair"]["id"] == pair_ids[0]
    stored = _label(world, "bob", handed, "equal")
    undone = world.client("bob").post(
        f"/labels/{stored['id']}/undo", headers={"Idempotency-Key": "undo"}
    )
    assert undone.is_success, undone.text
    assert _next(world, "bob", campaign_id, hold=2)["pair"]["id"] == pair_ids[1]


def test_an_archived_campaign_hands_out_nothing(world: World) -> None:
    campaign_id, _ = world.add_campaign(pairs=1)
    world.client("ada").patch(f"/campaigns/{campaign_id}", json={"archived": True})
    assert _nothing(world, "ann", campaign_id) == "all_done"


def _take(database: Database, campaign_id: int, annotator_id: int, hold: int = 1) -> int | None:
    """One request for work; the pair's id."""
    with database.write() as session:
        found = next_pair(session, NOW, campaign_id, annotator_id, lease_for=LEASE, hold=hold)
        return found.pair.id if isinstance(found, Handout) else None


@pytest.mark.parametrize("labels_per_pair", [1, 2, 3])
def test_annotators_who_ask_at_once_never_crowd_a_pair(
    database: Database, labels_per_pair: int
) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session, labels_per_pair=labels_per_pair)
        factories.add_pairs(session, campaign, 3)
        people = [factories.add_me(session, f"p{i}") for i in range(10)]
    given = at_once([lambda me=me: _take(database, campaign.id, me.id) for me in people])
    counts = Counter(pair_id for pair_id in given if pair_id is not None)
    assert max(counts.values()) <= labels_per_pair
    assert sum(counts.values()) == min(10, 3 * labels_per_pair)  # and no room stays unused


def _foresee(database: Database, campaign_id: int, annotator_id: int) -> Outlook:
    with database.read() as session:
        outlook = look_ahead(session, NOW, campaign_id, annotator_id)
    assert outlook is not None
    return outlook


def _take_foreseen(
    database: Database, campaign_id: int, annotator_id: int, outlook: Outlook
) -> int | None:
    with database.write() as session:
        found = next_pair(session, NOW, campaign_id, annotator_id, lease_for=LEASE, outlook=outlook)
        return found.pair.id if isinstance(found, Handout) else None


def test_annotators_who_foresee_the_same_pairs_get_them_one_by_one(database: Database) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session, labels_per_pair=2)
        pairs = [pair.id for pair in factories.add_pairs(session, campaign, 3)]
        people = [factories.add_me(session, f"p{i}").id for i in range(4)]
    seen = [_foresee(database, campaign.id, who) for who in people]
    assert [outlook.pairs for outlook in seen] == [tuple((pair, 0) for pair in pairs)] * 4
    got = [
        _take_foreseen(database, campaign.id, who, outlook)
        for who, outlook in zip(people, seen, strict=True)
    ]
    # The last one finds all three changed and searches again: fewest labels first, then the oldest.
    assert got == [*pairs, pairs[0]]


def test_an_outlook_from_before_the_own_last_pair_is_not_used(database: Database) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session)
        pairs = [pair.id for pair in factories.add_pairs(session, campaign, 3)]
        me = factories.add_me(session, "ann")
    old = _foresee(database, campaign.id, me.id)
    assert _take(database, campaign.id, me.id) == pairs[0]
    with database.write() as session:
        answer = Submission(pairs[0], ScreenChoice.LEFT)
        submit_label(session, NOW, me, answer, idempotency_key="a")
    # Or an outlook could bring back a pair that was judged in the meantime.
    assert _take_foreseen(database, campaign.id, me.id, old) == pairs[1]


def test_a_foreseen_pair_whose_late_label_came_meanwhile_is_left_out(database: Database) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session)
        pairs = [pair.id for pair in factories.add_pairs(session, campaign, 2)]
        me = factories.add_me(session, "ann")
    assert _take(database, campaign.id, me.id) == pairs[0]
    later = NOW + 2 * LEASE
    with database.read() as session:
        outlook = look_ahead(session, later, campaign.id, me.id)
    assert outlook is not None and [pair for pair, _ in outlook.pairs] == pairs
    with database.write() as session:
        answer = Submission(pairs[0], ScreenChoice.LEFT)
        submit_label(session, later, me, answer, idempotency_key="a")
        found = next_pair(session, later, campaign.id, me.id, lease_for=LEASE, outlook=outlook)
        assert isinstance(found, Handout) and found.pair.id == pairs[1]


def test_nothing_is_foreseen_when_the_answer_is_held_already(database: Database) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session)
        factories.add_pairs(session, campaign, 2)
        me = factories.add_me(session, "ann")
    _take(database, campaign.id, me.id)
    with database.read() as session:
        assert look_ahead(session, NOW, campaign.id, me.id) is None
        assert look_ahead(session, NOW, campaign.id, me.id, hold=2) is not None
        assert look_ahead(session, NOW, 99, me.id) is None


def test_two_tabs_of_one_annotator_hold_one_pair(database: Database) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session, labels_per_pair=5)
        factories.add_pairs(session, campaign, 4)
        me = factories.add_me(session, "ann")
    given = at_once([lambda: _take(database, campaign.id, me.id)] * 5)
    assert len(set(given)) == 1
    with database.read() as session:
        assert session.scalar(select(func.count()).select_from(Lease)) == 1


def test_a_crowd_labels_everything_exactly_as_often_as_wanted(database: Database) -> None:
    with database.write() as session:
        campaign = factories.add_campaign(session, labels_per_pair=2)
        pairs = factories.add_pairs(session, campaign, 12)
        people = [factories.add_me(session, f"p{i}") for i in range(5)]

    def work(index: int) -> int:
        me, done = people[index], 0
        while True:
            with database.write() as session:
                found = next_pair(session, NOW, campaign.id, me.id, lease_for=LEASE)
            if isinstance(found, NothingReason):
                return done
            answer = Submission(found.pair.id, ScreenChoice.LEFT, lease_id=found.lease.id)
            with database.write() as session:
                submit_label(session, NOW, me, answer, idempotency_key=f"{found.lease.id}")
            done += 1

    done = at_once([lambda index=index: work(index) for index in range(5)])
    assert sum(done) == 24
    with database.read() as session:
        per_pair = Counter(session.scalars(select(Label.pair_id)))
        twice = select(Label.pair_id, Label.annotator_id).group_by(
            Label.pair_id, Label.annotator_id
        )
        assert len(session.execute(twice).all()) == 24
    assert per_pair == {pair.id: 2 for pair in pairs}
