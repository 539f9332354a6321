"""Alembic environment: runs on the connection that `server.store.migrate` hands over."""

from __future__ import annotations

from alembic import context
from sqlalchemy import Connection

from server.settings import Settings
from server.store.session import make_engine
from server.store.tables import Base


def run(connection: Connection) -> None:
    """Run the requested command in the caller's transaction."""
    context.configure(
        connection=connection,
        target_metadata=Base.metadata,
        render_as_batch=connection.dialect.name == "sqlite",
        transactional_ddl=True,
    )
    with context.begin_transaction():
        context.run_migrations()


given = context.config.attributes.get("connection")
if given is not None:
    run(given)
else:  # the alembic command line: `alembic -c migrations/alembic.ini …`
    with make_engine(Settings().database_url, foreign_keys=False).begin() as own:
        run(own)
