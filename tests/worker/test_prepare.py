"""Preparing a database: once or twice, with and without a password, with a newer checkpoint."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import select

from rodif_core.policies.checkpoint import (
    CheckpointFileError,
    load_checkpoint,
    save_checkpoint,
)
from rodif_core.shipped import shipped_checkpoint, shipped_tasks
from rodif_core.spec import TaskName
from server.settings import Settings
from server.store.session import Database
from server.store.tables import Annotator, Campaign, Checkpoint
from tests.core.learning import tiny_checkpoint
from worker import prepare as preparing
from worker.cli.up import how_to_sign_in
from worker.prepare import Prepared, prepare

TINY = save_checkpoint(tiny_checkpoint())


def _settings(folder: Path) -> Settings:
    return Settings(_env_file=None, state_dir=folder, argon2_cheap=True)


def _ship(patch: pytest.MonkeyPatch, blob: bytes) -> None:
    """Let one small policy, for Avoid, be all that the package ships."""
    patch.setattr(preparing, "shipped_tasks", lambda: [TaskName.AVOID])
    patch.setattr(preparing, "shipped_checkpoint", lambda _task: blob)


@pytest.fixture(scope="module")
def first_time(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Prepared]:
    """A folder prepared once; a tiny policy stands for the shipped one."""
    folder = tmp_path_factory.mktemp("first")
    with pytest.MonkeyPatch.context() as patch:
        _ship(patch, TINY)
        return folder, prepare(_settings(folder))


@pytest.fixture
def settings(
    first_time: tuple[Path, Prepared], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Settings:
    """A copy of the prepared folder."""
    _ship(monkeypatch, TINY)
    shutil.copytree(first_time[0], tmp_path / "state")
    return _settings(tmp_path / "state")


def test_a_deactivated_admin_is_not_asked_to_sign_in_until_a_password_is_given(
    settings: Settings,
) -> None:
    database = Database(settings.database_url)
    with database.write() as session:
        session.scalars(select(Annotator)).one().active = False
    database.dispose()
    assert "admin is deactivated" in how_to_sign_in(prepare(settings), given=False)
    again = prepare(settings, admin_password="given by hand")
    assert again.active and "Sign in as admin" in how_to_sign_in(again, given=True)


def _rows(settings: Settings) -> tuple[list[str], list[Checkpoint], list[Campaign]]:
    database = Database(settings.database_url)
    with database.read() as session:
        names = [row.name for row in session.query(Annotator)]
        found = (names, list(session.query(Checkpoint)), list(session.query(Campaign)))
    database.dispose()
    return found


def test_empty_folder_gets_admin_checkpoint_and_a_campaign_that_can_start(
    first_time: tuple[Path, Prepared],
) -> None:
    folder, prepared = first_time
    settings = _settings(folder)
    assert prepared.password is not None and len(prepared.password) >= 12
    names, (checkpoint,), (campaign,) = _rows(settings)
    assert names == ["admin"]
    assert checkpoint.digest == tiny_checkpoint().digest
    facts = checkpoint.config["task_facts"]
    assert facts["preferred_group"] in facts["groups"]
    assert len(facts["modes"]) == 24
    assert campaign.published_checkpoint_id == checkpoint.id
    assert campaign.criterion == facts["criterion"]
    assert settings.artifact_dir is not None
    assert (settings.artifact_dir / "sha256").is_dir()


def test_first_campaign_is_on_the_task_asked_for(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pushing = save_checkpoint(replace(tiny_checkpoint(), task=TaskName.PUSHING))
    monkeypatch.setattr(preparing, "shipped_tasks", lambda: [TaskName.AVOID, TaskName.PUSHING])
    monkeypatch.setattr(
        preparing,
        "shipped_checkpoint",
        lambda task: pushing if task == TaskName.PUSHING else TINY,
    )
    other = _settings(tmp_path / "other")
    prepare(other, first_campaign=TaskName.PUSHING)
    _, checkpoints, (campaign,) = _rows(other)
    assert [one.task for one in checkpoints] == ["avoid", "pushing"]
    assert (campaign.name, campaign.task) == ("pushing", "pushing")
    assert campaign.published_checkpoint_id == checkpoints[1].id
    # Where there is a campaign already, none is added.
    prepare(settings, first_campaign=TaskName.PUSHING)
    assert [one.task for one in _rows(settings)[2]] == ["avoid"]


def test_second_time_changes_nothing_and_shows_no_password(settings: Settings) -> None:
    before = _rows(settings)
    assert prepare(settings).password is None
    after = _rows(settings)
    assert [len(part) for part in after] == [len(part) for part in before]


def test_given_password_replaces_a_forgotten_one(settings: Settings) -> None:
    assert prepare(settings, admin_password="a new beginning").password == "a new beginning"


def test_newer_shipped_checkpoint_is_added_beside_the_old_one(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    newer = save_checkpoint(tiny_checkpoint(seed=1))
    _ship(monkeypatch, newer)
    prepare(settings)
    _, checkpoints, (campaign,) = _rows(settings)
    assert len(checkpoints) == 2
    assert campaign.published_checkpoint_id == checkpoints[0].id


def test_damaged_shipped_checkpoint_is_refused(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    damaged = save_checkpoint(tiny_checkpoint())[:-40]
    _ship(monkeypatch, damaged)
    with pytest.raises(CheckpointFileError, match="not a readable checkpoint"):
        prepare(settings)


@pytest.mark.parametrize("task", shipped_tasks())
def test_a_shipped_checkpoint_is_of_its_task(task: TaskName) -> None:
    assert load_checkpoint(shipped_checkpoint(task)).task == task
