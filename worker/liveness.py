"""Signs of life in SQL: the API's readiness and the admin page read them."""

from __future__ import annotations

import logging
import os
from typing import Any

from celery import bootsteps
from sqlalchemy.exc import SQLAlchemyError

from server.queue import TICK_QUEUE
from server.settings import Settings
from server.store.beats import WORKER, record_beat
from server.store.session import Database
from worker.workbench import utc_now

logger = logging.getLogger(__name__)

WORKER_BEAT_SECONDS = 5.0


class LivenessStep(bootsteps.StartStopStep):  # type: ignore[misc]
    """While the worker's main loop turns, a row says so.

    It runs in the parent of the pool, on its loop: a parent that hangs stops saying so. The
    connection is closed again each time, because the parent forks.
    """

    requires = {"celery.worker.components:Timer"}

    def __init__(self, worker: Any, **options: Any) -> None:
        super().__init__(worker, **options)
        self._entry: Any = None

    def start(self, worker: Any) -> None:
        """Begin, unless this worker serves ticks only."""
        queues = sorted(worker.app.amqp.queues.consume_from)
        if queues != [TICK_QUEUE]:
            details = {"queues": queues, "node": worker.hostname, "pid": os.getpid()}
            self._say(details)
            self._entry = worker.timer.call_repeatedly(WORKER_BEAT_SECONDS, self._say, (details,))

    def stop(self, worker: Any) -> None:  # noqa: ARG002
        """Fall silent."""
        if self._entry is not None:
            self._entry.cancel()
            self._entry = None

    def _say(self, details: dict[str, Any]) -> None:
        database = Database(Settings().database_url)
        try:
            with database.write() as session:
                record_beat(session, utc_now(), f"{WORKER}@{details['node']}", details)
        except SQLAlchemyError:
            # The database is away for a moment; the age of the row tells readers.
            logger.warning("no sign of life written", exc_info=True)
        finally:
            database.dispose()
