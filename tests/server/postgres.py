"""Databases of a real PostgreSQL for tests."""

from __future__ import annotations

import uuid

import psycopg
from sqlalchemy.engine import make_url

from server.store.tables import Base


def execute(url: str, *statements: str) -> None:
    conninfo = url.replace("postgresql+psycopg://", "postgresql://")
    with psycopg.connect(conninfo, autocommit=True) as connection:
        for statement in statements:
            connection.execute(statement.encode())


class PostgresMaker:
    """Databases of one PostgreSQL, dropped at the end."""

    def __init__(self, admin_url: str) -> None:
        self.admin_url = admin_url

    def address(self, name: str) -> str:
        """SQLAlchemy address of a database."""
        return make_url(self.admin_url).set(database=name).render_as_string(hide_password=False)

    def create(self) -> tuple[str, str]:
        """Name and address of a new database."""
        name = f"rodif_{uuid.uuid4().hex}"
        execute(self.admin_url, f"CREATE DATABASE {name}")
        return name, self.address(name)

    def drop(self, name: str) -> None:
        """Drop it, whoever is still connected."""
        execute(self.admin_url, f"DROP DATABASE {name} WITH (FORCE)")

    def empty(self, name: str) -> None:
        """Remove all rows and start the ids at 1 again, whoever is still connected.

        The triggers of append-only tables rest while this session plays a replica. Much faster
        than a new database for every test.
        """
        tables = ", ".join(f'"{table}"' for table in Base.metadata.tables)
        execute(
            self.address(name),
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
            " WHERE datname = current_database() AND pid <> pg_backend_pid()",
            "SET session_replication_role = replica",
            f"TRUNCATE {tables} RESTART IDENTITY CASCADE",
        )
