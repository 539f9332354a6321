"""When a round starts by itself: after enough new labels, or every few minutes."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import select

from server import rounds
from server.rounds import RoundRequest
from server.snapshots import new_labels_since_round
from server.states import (
    Choice,
    PublishRule,
    RoundState,
    RoundTrigger,
)
from server.store.session import Database
from server.store.tables import LabelSnapshot, Pair, Round
from tests import factories
from tests.factories import NOW, PUBLISHED_PATH
from tests.server.threads import at_once


def _add_labels(session: Any, campaign_id: int, pairs: slice) -> None:
    owner = session.get_one(factories.Campaign, campaign_id).created_by
    rows = session.scalars(select(Pair).where(Pair.campaign_id == campaign_id).order_by(Pair.id))
    for pair in rows.all()[pairs]:
        factories.add_label(session, pair, owner)


def _due(database: Database, campaign_id: int, minutes: float = 0) -> RoundTrigger | None:
    with database.read() as session:
        campaign = session.get_one(factories.Campaign, campaign_id)
        return rounds.is_due(session, NOW + timedelta(minutes=minutes), campaign)


def _campaign(database: Database, **settings: Any) -> int:
    with database.write() as session:
        campaign = factories.add_campaign(session, **settings)
        factories.add_pairs(session, campaign, 8)
        return campaign.id


def test_a_round_is_due_after_enough_new_labels(database: Database) -> None:
    campaign_id = _campaign(database, round_after_labels=3)
    with database.write() as session:
        _add_labels(session, campaign_id, slice(0, 2))
    assert _due(database, campaign_id) is None
    with database.write() as session:
        _add_labels(session, campaign_id, slice(2, 3))
    assert _due(database, campaign_id) is RoundTrigger.LABELS
    with database.write() as session:
        started = rounds.launch_due(session, NOW, campaign_id)
        assert started is not None and started.trigger == RoundTrigger.LABELS
    assert _due(database, campaign_id) is None  # it runs
    _end(database, started.id, RoundState.REJECTED)
    with database.write() as session:
        _add_labels(session, campaign_id, slice(3, 5))
    assert _due(database, campaign_id) is None  # two new ones only
    with database.write() as session:
        _add_labels(session, campaign_id, slice(5, 6))
    assert _due(database, campaign_id) is RoundTrigger.LABELS


def _end(database: Database, round_id: int, state: RoundState, minutes: float = 0) -> None:
    """Take the round to its end, by way of the gate if it has one."""
    with database.write() as session:
        gated = (
            () if state in (RoundState.FAILED, RoundState.CANCELLED) else tuple(PUBLISHED_PATH[:3])
        )
        for step in (*gated, state):
            rounds.move(session, NOW + timedelta(minutes=minutes), round_id, step)


def _new_labels(database: Database, campaign_id: int) -> int:
    with database.read() as session:
        campaign = session.get_one(factories.Campaign, campaign_id)
        return new_labels_since_round(session, campaign)


@pytest.mark.parametrize("state", [RoundState.FAILED, RoundState.CANCELLED])
@pytest.mark.parametrize("reached", [[], PUBLISHED_PATH[:1], PUBLISHED_PATH[:2]])
def test_labels_of_a_round_that_came_to_nothing_are_new_again(
    database: Database, state: RoundState, reached: list[RoundState]
) -> None:
    campaign_id = _campaign(database, round_after_labels=4)
    with database.write() as session:
        _add_labels(session, campaign_id, slice(0, 4))
        started = rounds.launch(session, NOW, campaign_id, RoundRequest())
        for step in reached:
            rounds.move(session, NOW, started.id, step)
    assert _new_labels(database, campaign_id) == 0  # it learns from them
    _end(database, started.id, state)
    assert _new_labels(database, campaign_id) == 4
    assert _due(database, campaign_id, minutes=9.9) is None
    assert _due(database, campaign_id, minutes=10) is RoundTrigger.LABELS


def test_rounds_that_come_to_nothing_again_and_again_wait_longer_each_time(
    database: Database,
) -> None:
    campaign_id = _campaign(database, round_after_labels=1, round_every_minutes=1.0)
    with database.write() as session:
        _add_labels(session, campaign_id, slice(0, 2))
    at = 0.0
    for rest in (10, 20, 40, 80):
        with database.write() as session:
            started = rounds.launch_due(session, NOW + timedelta(minutes=at), campaign_id)
            assert started is not None
        _end(database, started.id, RoundState.FAILED, minutes=at)
        assert _due(database, campaign_id, minutes=at + rest - 0.1) is None
        at += rest
    with database.write() as session:  # one that comes to its end makes the next rest short again
        started = rounds.launch_due(session, NOW + timedelta(minutes=at), campaign_id)
        assert started is not None
    _end(database, started.id, RoundState.KEPT, minutes=at)
    with database.write() as session:
        _add_labels(session, campaign_id, slice(2, 3))
    assert _due(database, campaign_id, minutes=at) is RoundTrigger.LABELS


def test_a_round_on_an_old_snapshot_makes_nothing_new(database: Database) -> None:
    campaign_id = _campaign(database, round_after_labels=2)
    digests = []
    for labels in (slice(0, 2), slice(2, 5)):
        with database.write() as session:
            _add_labels(session, campaign_id, labels)
            started = rounds.launch(session, NOW, campaign_id, RoundRequest())
            digests.append(started.snapshot_digest)
        _end(database, started.id, RoundState.REJECTED)
    with database.write() as session:
        request = RoundRequest(snapshot_digest=digests[0])
        again = rounds.launch(session, NOW, campaign_id, request)
    _end(database, again.id, RoundState.PUBLISHED)
    assert _new_labels(database, campaign_id) == 0
    assert _due(database, campaign_id, minutes=100) is None
    with database.write() as session:
        _add_labels(session, campaign_id, slice(5, 6))
    assert _new_labels(database, campaign_id) == 1


def test_a_snapshot_of_a_failed_round_counts_once_another_learned_from_it(
    database: Database,
) -> None:
    campaign_id = _campaign(database)
    with database.write() as session:
        _add_labels(session, campaign_id, slice(0, 2))
        failed = rounds.launch(session, NOW, campaign_id, RoundRequest())
    _end(database, failed.id, RoundState.FAILED)
    with database.write() as session:
        _add_labels(session, campaign_id, slice(2, 3))
        request = RoundRequest(snapshot_digest=failed.snapshot_digest)
        again = rounds.launch(session, NOW, campaign_id, request)
    _end(database, again.id, RoundState.REJECTED)
    assert _new_labels(database, campaign_id) == 1


def test_a_round_is_due_every_few_minutes_when_there_is_something_new(database: Database) -> None:
    campaign_id = _campaign(database, round_every_minutes=30.0)
    assert _due(database, campaign_id, minutes=60) is None  # no labels at all
    with database.write() as session:
        _add_labels(session, campaign_id, slice(0, 1))
    assert _due(database, campaign_id, minutes=29) is None
    assert _due(database, campaign_id, minutes=30) is RoundTrigger.PERIODIC
    with database.write() as session:
        at = NOW + timedelta(minutes=30)
        started = rounds.launch_due(session, at, campaign_id)
        assert started is not None
    _end(database, started.id, RoundState.REJECTED, minutes=30)
    assert _due(database, campaign_id, minutes=90) is None  # nothing new since
    with database.write() as session:
        _add_labels(session, campaign_id, slice(1, 2))
    assert _due(database, campaign_id, minutes=59) is None
    assert _due(database, campaign_id, minutes=60) is RoundTrigger.PERIODIC


def test_nothing_is_due_when_switched_off_or_archived(database: Database) -> None:
    off = _campaign(database)
    with database.write() as session:
        _add_labels(session, off, slice(0, 8))
        assert rounds.due_campaign_ids(session, NOW) == []
    assert _due(database, off, minutes=10_000) is None
    with database.write() as session:
        campaign = session.get_one(factories.Campaign, off)
        campaign.settings = campaign.settings | {"round_after_labels": 1}
        session.flush()
        assert rounds.due_campaign_ids(session, NOW) == [off]
        campaign.archived = True
    assert _due(database, off) is None
    with database.read() as session:
        assert rounds.due_campaign_ids(session, NOW) == []


def test_comparison_rounds_do_not_count_as_learning(database: Database) -> None:
    campaign_id = _campaign(database, round_after_labels=2)
    with database.write() as session:
        _add_labels(session, campaign_id, slice(0, 2))
        rounds.launch(session, NOW, campaign_id, RoundRequest(publish_rule=PublishRule.NEVER))
    assert _due(database, campaign_id) is RoundTrigger.LABELS


def test_a_campaign_that_only_compares_starts_one_round_for_each_set_of_new_labels(
    database: Database,
) -> None:
    campaign_id = _campaign(database, round_after_labels=2, publish_rule="never")
    for labels in (slice(0, 2), slice(2, 4)):
        with database.write() as session:
            _add_labels(session, campaign_id, labels)
        assert _due(database, campaign_id) is RoundTrigger.LABELS
        with database.write() as session:
            started = rounds.launch_due(session, NOW, campaign_id)
            assert started is not None and started.publish_rule == PublishRule.NEVER
        assert _due(database, campaign_id) is None  # it runs
        _end(database, started.id, RoundState.KEPT)
        assert _due(database, campaign_id, minutes=10_000) is None  # nothing new
    with database.write() as session:
        _add_labels(session, campaign_id, slice(4, 5))
    assert _due(database, campaign_id, minutes=10_000) is None  # one new label of two


def test_a_campaign_that_only_compares_waits_its_minutes_and_rests_after_a_failure(
    database: Database,
) -> None:
    campaign_id = _campaign(database, round_every_minutes=30.0, publish_rule="never")
    with database.write() as session:
        _add_labels(session, campaign_id, slice(0, 2))
        at = NOW + timedelta(minutes=30)
        failed = rounds.launch_due(session, at, campaign_id)
        assert failed is not None
    _end(database, failed.id, RoundState.FAILED, minutes=55)
    assert _due(database, campaign_id, minutes=64.9) is None  # the rest after a failure
    assert _due(database, campaign_id, minutes=65) is RoundTrigger.PERIODIC
    with database.write() as session:
        again = rounds.launch_due(session, NOW + timedelta(minutes=65), campaign_id)
        assert again is not None
        _add_labels(session, campaign_id, slice(2, 3))
    assert _due(database, campaign_id, minutes=100) is None  # it runs
    _end(database, again.id, RoundState.KEPT, minutes=66)
    assert _due(database, campaign_id, minutes=94.9) is None
    assert _due(database, campaign_id, minutes=95) is RoundTrigger.PERIODIC


def test_labels_of_comparisons_are_new_once_the_campaign_publishes(database: Database) -> None:
    campaign_id = _campaign(database, round_after_labels=2, publish_rule="never")
    with database.write() as session:
        _add_labels(session, campaign_id, slice(0, 2))
        compared = rounds.launch_due(session, NOW, campaign_id)
        assert compared is not None
    _end(database, compared.id, RoundState.KEPT)
    assert _new_labels(database, campaign_id) == 0
    with database.write() as session:
        campaign = session.get_one(factories.Campaign, campaign_id)
        campaign.settings = campaign.settings | {"publish_rule": "auto"}
    assert _new_labels(database, campaign_id) == 2
    assert _due(database, campaign_id) is RoundTrigger.LABELS


def test_labels_that_say_nothing_start_no_round(database: Database) -> None:
    campaign_id = _campaign(database, round_after_labels=1)
    with database.write() as session:
        pair = session.scalars(select(Pair)).first()
        assert pair is not None
        factories.add_label(session, pair, 1, Choice.EQUAL)
        assert rounds.launch_due(session, NOW, campaign_id) is None
    with database.read() as session:
        assert rounds.due_campaign_ids(session, NOW) == []
        assert session.scalars(select(Round)).all() == []
        assert session.scalars(select(LabelSnapshot)).all() == []


@pytest.mark.parametrize(
    ("choice", "due"),
    [
        (Choice.SECOND, RoundTrigger.LABELS),
        (Choice.EQUAL, RoundTrigger.LABELS),
        (Choice.CANNOT_TELL, None),
    ],
)
def test_labels_from_which_nothing_is_learned_are_not_new(
    database: Database, choice: Choice, due: RoundTrigger | None
) -> None:
    campaign_id = _campaign(database, round_after_labels=3)
    with database.write() as session:
        _add_labels(session, campaign_id, slice(0, 2))
        third = session.scalars(select(Pair).order_by(Pair.id)).all()[2]
        factories.add_label(session, third, 1, choice)
    assert _new_labels(database, campaign_id) == (2 if due is None else 3)
    assert _due(database, campaign_id) is due


def test_two_ticks_at_once_start_one_round(database: Database) -> None:
    campaign_id = _campaign(database, round_after_labels=1)
    with database.write() as session:
        _add_labels(session, campaign_id, slice(0, 2))

    def tick() -> bool:
        with database.write() as session:
            return rounds.launch_due(session, NOW, campaign_id) is not None

    assert sorted(at_once([tick] * 4)) == [False, False, False, True]
