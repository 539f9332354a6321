"""Database migrations; run by `server.store.migrate` or `alembic -c migrations/alembic.ini`."""
