"""Jobs that a planned stop interrupts: they go back to the queue and keep their attempts.

Attempts are there for jobs that kill their worker. So one is given back only where the worker
was alive when the stop began: what had died before counts as ever.
"""

from __future__ import annotations

import logging
import os
import socket

from sqlalchemy.exc import SQLAlchemyError

from server.settings import Settings
from server.store import jobs
from server.store.session import Database

logger = logging.getLogger(__name__)


def claims_of_the_living(settings: Settings) -> list[jobs.Claim]:
    """Claims whose process runs on this machine now; none when the database is away."""
    database = Database(settings.database_url)
    try:
        with database.read() as session:
            return [claim for claim in jobs.running_claims(session) if _is_alive(claim.owner)]
    except SQLAlchemyError:
        logger.warning("running jobs unknown: their attempts will count", exc_info=True)
        return []
    finally:
        database.dispose()


def hand_back(settings: Settings, claims: list[jobs.Claim]) -> int:
    """Queue what still runs of these claims, without counting the attempt; returns how many.

    To be called when their processes have ended. When the database is away, the jobs stay as a
    crash leaves them.
    """
    database = Database(settings.database_url)
    try:
        with database.write() as session:
            return sum(jobs.hand_back(session, claim) for claim in claims)
    except SQLAlchemyError:
        logger.warning("interrupted jobs not handed back: the attempt counts", exc_info=True)
        return 0
    finally:
        database.dispose()


def _is_alive(owner: str) -> bool:
    """Whether `Workbench.owner`, a host name and a process id, is a process here and now."""
    host, _, pid = owner.rpartition(":")
    if host != socket.gethostname() or not pid.isdecimal():
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
