"""A whole service for a test: application, database, clock, accounts, and what was sent."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from starlette.testclient import TestClient

from server.api.services import Services
from server.app import create_app
from server.settings import Settings
from server.states import AnnotatorKind, JobKind, PairState, Role
from server.store.artifacts import ArtifactStore
from server.store.session import Database
from tests import factories
from tests.factories import Clock


@dataclass
class World:
    """What a test talks to."""

    app: FastAPI
    settings: Settings
    database: Database
    clock: Clock
    sent: list[tuple[int, JobKind]]
    tokens: dict[str, str] = field(default_factory=dict)
    ids: dict[str, int] = field(default_factory=dict)
    numbers: Iterator[int] = field(default_factory=itertools.count)

    def client(self, name: str | None = None) -> TestClient:
        """A client with the bearer token of the account, or without any."""
        headers = {} if name is None else {"Authorization": f"Bearer {self.tokens[name]}"}
        return TestClient(self.app, base_url="http://testserver/api/v1", headers=headers)

    def browser(self) -> TestClient:
        """A client that behaves like a browser on our own pages."""
        return TestClient(self.app, headers={"Sec-Fetch-Site": "same-origin"})

    def signed_in(self, name: str) -> TestClient:
        """A browser with a session."""
        browser = self.browser()
        answer = browser.post(
            "/api/v1/session", json={"name": name, "password": factories.PASSWORD}
        )
        assert answer.status_code == 200, answer.text
        return browser

    def add_account(
        self,
        name: str,
        role: Role = Role.ANNOTATOR,
        kind: AnnotatorKind = AnnotatorKind.PERSON,
    ) -> int:
        """Another account with a token."""
        with self.database.write() as session:
            account = factories.add_account(session, name, role, kind)
            self.tokens[name] = factories.add_token(session, account.id)
            self.ids[name] = account.id
            return account.id

    def add_campaign(
        self, pairs: int = 0, *, first_is_left: bool | None = None, **settings: Any
    ) -> tuple[int, list[int]]:
        """A campaign with ready pairs; gives their ids."""
        with self.database.write() as session:
            name = f"campaign {next(self.numbers)}"
            campaign = factories.add_campaign(session, name, **settings)
            made = []
            if pairs:
                made = factories.add_pairs(
                    session, campaign, pairs, state=PairState.READY, first_is_left=first_is_left
                )
            return campaign.id, [pair.id for pair in made]


@cache
def _app() -> FastAPI:
    """The application, made once per process: building its routes takes longer than most tests.

    All that it remembers lies in the services that each world gives it.
    """
    return create_app(Settings(state_dir=Path(tempfile.gettempdir())))


@contextmanager
def make_world(database_url: str, folder: Path) -> Iterator[World]:
    """Accounts: ada (admin), sam (service, simulated), ann and bob (annotators)."""
    settings = Settings(state_dir=folder, database_url=database_url, argon2_cheap=True)
    clock = Clock()
    sent: list[tuple[int, JobKind]] = []
    served = Database(database_url, lambda job_id, kind: sent.append((job_id, kind)))
    artifacts = ArtifactStore(folder / "artifacts")
    app = _app()
    app.state.services = Services(settings, served, artifacts, clock)
    database = Database(database_url)
    made = World(app, settings, database, clock, sent)
    made.add_account("ada", Role.ADMIN)
    made.add_account("sam", Role.SERVICE, AnnotatorKind.SIMULATED)
    made.add_account("ann")
    made.add_account("bob")
    yield made
    served.dispose()
    database.dispose()
