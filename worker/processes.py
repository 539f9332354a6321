"""Which processes a running system consists of, and the environment they run in."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping
from dataclasses import dataclass

from server.queue import JOB_QUEUES, TICK_QUEUE
from server.settings import Settings

# One numerical thread per pool child: two children with two threads each were five times slower
# than with one on two cores. Must be set before Python starts.
THREAD_LIMITS = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)


@dataclass(frozen=True)
class Service:
    """One process of the tree: how it starts and how it is asked to stop."""

    name: str
    command: tuple[str, ...]
    stop_signal: signal.Signals = signal.SIGTERM


def api_service(settings: Settings) -> Service:
    """The REST service and the pages."""
    command = (
        *(sys.executable, "-m", "uvicorn", "server.app:create_app", "--factory"),
        *("--host", settings.host, "--port", str(settings.port), "--no-access-log"),
        # Browsers hold event streams open; they come back by themselves.
        *("--timeout-graceful-shutdown", "2"),
    )
    return Service("api", command)


def worker_service(name: str, queues: tuple[str, ...], concurrency: int) -> Service:
    """A pool of job children for some queues. SIGQUIT hands unfinished messages back."""
    # Ticks may be lost, so they do without a pool; every other task needs prefork.
    pool = "solo" if queues == (TICK_QUEUE,) else "prefork"
    command = (
        *(sys.executable, "-m", "celery", "-A", "worker.app", "worker"),
        *("-P", pool, "-c", str(concurrency), "-Q", ",".join(queues), "-n", f"{name}@%h"),
        *("--without-gossip", "--without-mingle", "-l", "WARNING" if pool == "solo" else "INFO"),
    )
    return Service(name, command, signal.SIGQUIT)


def beat_service(settings: Settings) -> Service:
    """The clock that sends ticks."""
    command = (
        *(sys.executable, "-m", "celery", "-A", "worker.app", "beat", "-l", "WARNING"),
        *("--schedule", str(settings.state_dir / "beat-schedule"), "--pidfile="),
    )
    return Service("beat", command)


def embedded_services(settings: Settings, workers: int) -> list[Service]:
    """Everything after the broker: API, job worker, tick worker, beat."""
    return [
        api_service(settings),
        worker_service("worker", JOB_QUEUES, workers),
        worker_service("ticker", (TICK_QUEUE,), 1),
        beat_service(settings),
    ]


def child_environment(
    settings: Settings, inherited: Mapping[str, str] = os.environ
) -> dict[str, str]:
    """The environment of every process: the settings as `RODIF_*`, one thread per child."""
    env = dict(inherited) | THREAD_LIMITS
    for name, value in settings.model_dump(mode="json").items():
        if value is not None:
            env[f"RODIF_{name.upper()}"] = str(value)
    return env
