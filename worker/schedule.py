"""What the beat sends. Every tick is idempotent, so a second beat does no harm."""

from __future__ import annotations

from typing import Any

from server.queue import TICK_QUEUE, TICK_RESEND, TICK_ROUNDS
from server.settings import Settings


def beat_schedule(settings: Settings) -> dict[str, dict[str, Any]]:
    """Celery's `beat_schedule`: a tick is dropped when it waited longer than its period."""
    return {
        name: {
            "task": name,
            "schedule": seconds,
            "options": {"queue": TICK_QUEUE, "expires": max(seconds, 1.0)},
        }
        for name, seconds in (
            (TICK_RESEND, settings.resend_seconds),
            (TICK_ROUNDS, settings.round_tick_seconds),
        )
    }
