"""The Celery application: `celery -A worker.app worker` and `celery -A worker.app beat`.

A message only says "job N is ready"; the truth is the job's row in SQL. Hence late
acknowledgement, no result backend, and freedom to deliver a message twice. A job may outlive the
broker's visibility timeout: its message then comes a second time, finds the lease alive, and goes.
"""

from __future__ import annotations

from typing import Any

from celery import Celery
from celery.signals import beat_init
from kombu import Queue

from server.queue import BROKER_TRANSPORT_OPTIONS, QUEUES, TICK_QUEUE
from server.settings import Settings
from worker.liveness import LivenessStep
from worker.schedule import beat_schedule

# A child is replaced after so many jobs, or above this memory (KiB): a guard against leaks.
JOBS_PER_CHILD = 200
MEMORY_PER_CHILD_KIB = 3_000_000
# After SIGQUIT a running job gets this long; then its message goes back to the queue.
SOFT_SHUTDOWN_SECONDS = 2.0


def make_app(settings: Settings) -> Celery:
    """The application for one broker; state files of beat lie in the state folder."""
    app = Celery("rodif", broker=settings.broker_url, include=["worker.tasks"])
    app.conf.update(
        task_queues=[Queue(name) for name in QUEUES],
        task_default_queue=TICK_QUEUE,
        task_create_missing_queues=False,
        task_serializer="json",
        accept_content=["json"],
        task_ignore_result=True,
        task_acks_late=True,
        task_reject_on_worker_lost=True,
        worker_prefetch_multiplier=1,
        worker_max_tasks_per_child=JOBS_PER_CHILD,
        worker_max_memory_per_child=MEMORY_PER_CHILD_KIB,
        worker_soft_shutdown_timeout=SOFT_SHUTDOWN_SECONDS,
        worker_cancel_long_running_tasks_on_connection_loss=False,
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,
        broker_transport_options=dict(BROKER_TRANSPORT_OPTIONS),
        beat_schedule=beat_schedule(settings),
        beat_schedule_filename=str(settings.state_dir / "beat-schedule"),
        beat_max_loop_interval=min(5.0, settings.resend_seconds, settings.round_tick_seconds),
        timezone="UTC",
        enable_utc=True,
    )
    app.steps["worker"].add(LivenessStep)
    return app


app = make_app(Settings())


@beat_init.connect  # type: ignore[untyped-decorator]
def _tick_at_once(**_: Any) -> None:
    """Celery waits one period before the first tick; stuck work need not wait that long."""
    for name, entry in app.conf.beat_schedule.items():
        app.send_task(name, **entry["options"])
