"""Migrations on both engines, and what the databases themselves must refuse."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import inspect, text
from sqlalchemy.exc import DatabaseError
from starlette.testclient import TestClient

from server.app import create_app
from server.errors import DatabaseVersionError
from server.settings import Settings
from server.store import migrate
from server.store.session import Database, make_engine
from server.store.tables import SimulatedTruth
from tests import factories
from tests.server.threads import at_once


def test_migrations_equal_the_tables_up_down_and_up_again(empty_url: str) -> None:
    migrate.upgrade(empty_url)
    migrate.check_models(empty_url)
    migrate.check_at_head(empty_url)
    migrate.downgrade(empty_url, "base")
    engine = make_engine(empty_url)
    assert inspect(engine).get_table_names() == ["alembic_version"]
    engine.dispose()
    migrate.upgrade(empty_url)
    migrate.check_models(empty_url)


def test_two_processes_that_upgrade_together_both_succeed(empty_url: str) -> None:
    at_once([lambda: migrate.upgrade(empty_url)] * 2)
    migrate.check_at_head(empty_url)


def test_a_database_without_migrations_is_refused_with_what_to_run(empty_url: str) -> None:
    with pytest.raises(DatabaseVersionError, match=r"at migration None.*needs '0002'.*rodif up"):
        migrate.check_at_head(empty_url)


def test_the_service_does_not_start_when_the_database_is_not_at_head(tmp_path: Path) -> None:
    app = create_app(Settings(state_dir=tmp_path))
    with pytest.raises(DatabaseVersionError), TestClient(app):
        pass


@pytest.fixture
def filled(database: Database) -> Database:
    """A row in every append-only table."""
    with database.write() as session:
        campaign = factories.add_campaign(session)
        pair = factories.add_pairs(session, campaign, 1)[0]
        label = factories.add_label(session, pair, campaign.created_by)
        session.add(
            SimulatedTruth(
                label_id=label.id,
                true_choice="first",
                corrupted=False,
                corruption="none",
                criterion="left",
            )
        )
        session.execute(
            text(
                "INSERT INTO event (campaign_id, kind, data, at)"
                " VALUES (:id, 'label', '{}', '2026-11-22 12:00:00+00:00')"
            ),
            {"id": campaign.id},
        )
    return database


COLUMN_OF = {
    "label": "choice",
    "simulated_truth": "true_choice",
    "publication": "reason",
    "audit_entry": "action",
    "event": "kind",
}


@pytest.mark.parametrize("table", COLUMN_OF)
@pytest.mark.parametrize("action", ["update", "delete"])
def test_append_only_tables_refuse_change_and_deletion(
    filled: Database, table: str, action: str
) -> None:
    statement = (
        f"UPDATE {table} SET {COLUMN_OF[table]} = 'other'"
        if action == "update"
        else f"DELETE FROM {table}"
    )
    count = f"SELECT count(*) FROM {table}"
    with filled.read() as session:
        before = session.execute(text(count)).scalar_one()
    assert before >= 1
    with pytest.raises(DatabaseError, match=f"{table} is append-only"), filled.write() as session:
        session.execute(text(statement))
    with filled.read() as session:
        assert session.execute(text(count)).scalar_one() == before


def test_a_label_without_an_annotator_is_refused(filled: Database) -> None:
    with pytest.raises(DatabaseError, match="annotator_id"), filled.write() as session:
        session.execute(
            text(
                "INSERT INTO label (campaign_id, pair_id, choice, retracted, left_episode_id,"
                " right_episode_id, first_checkpoint_id, second_checkpoint_id, pair_reason, late,"
                " source, idempotency_key, request_sha256, created_at, replay_events, ui_version)"
                " SELECT campaign_id, pair_id, choice, retracted, left_episode_id,"
                " right_episode_id, first_checkpoint_id, second_checkpoint_id, pair_reason, late,"
                " source, 'another', request_sha256, created_at, replay_events, ui_version"
                " FROM label"
            )
        )
