"""The embedded system as one process tree: start in order, restart with back-off, stop cleanly.

`running_system(settings)` is what `rodif up`, the demo, the benchmarks and the tests use.
"""

from __future__ import annotations

import collections
import contextlib
import fcntl
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import IO

from sqlalchemy import delete, update

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.spec import TaskName
from server.settings import Settings
from server.states import JobState
from server.store.session import Database
from server.store.tables import Job, ServiceBeat
from worker import interrupted, leash
from worker.broker import broker_answers, broker_service, end_orphan_broker, socket_path
from worker.errors import ServiceCrashedError, StateInUseError, SystemStartError
from worker.prepare import Prepared, prepare
from worker.processes import Service, child_environment, embedded_services
from worker.workbench import utc_now

logger = logging.getLogger(__name__)

CRASHES_ALLOWED = 5  # that many within CRASH_WINDOW_SECONDS, and everything stops
CRASH_WINDOW_SECONDS = 60.0
BACKOFF_SECONDS = (0.2, 1.0, 2.0, 5.0)  # before the first, second … restart within the window
POLL_SECONDS = 0.1
STOP_SECONDS = 10.0  # then SIGKILL; the soft shutdown of a worker takes about 4
BROKER_SECONDS = 10.0
LOG_TAIL_LINES = 30
LOG_BYTES_KEPT = 5_000_000  # a larger log is put aside at the next start

# Our own address must not be asked for through a proxy of the environment.
_direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))


@dataclass
class _Running:
    """A service and its life so far."""

    service: Service
    log: Path
    process: subprocess.Popen[bytes] | None = None
    crashes: collections.deque[float] = field(default_factory=collections.deque)
    restart_at: float | None = None  # monotonic clock; set while it waits for its restart


class System:
    """A started system; `running_system` makes it and takes it down."""

    def __init__(self, settings: Settings, prepared: Prepared) -> None:
        self.settings, self.prepared = settings, prepared
        host = "127.0.0.1" if settings.host in ("0.0.0.0", "::", "") else settings.host
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{settings.port}"
        self.failure: SystemStartError | None = None
        self._environment = child_environment(settings)
        self._services: list[_Running] = []
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._ended = threading.Event()
        self._monitor = threading.Thread(target=self._watch, name="supervisor", daemon=True)

    def pid(self, name: str) -> int:
        """Process id of a service now; raises SystemStartError when it is not running."""
        for running in self._services:
            process = running.process
            if running.service.name == name and process is not None and process.poll() is None:
                return process.pid
        names = ", ".join(repr(running.service.name) for running in self._services)
        raise SystemStartError(f"no running service {name!r}; services are {names}")

    def runs(self, name: str) -> bool:
        """Whether a service runs now."""
        try:
            self.pid(name)
        except SystemStartError:
            return False
        return True

    def wait(self) -> None:
        """Block until the system ends; raises ServiceCrashedError when it gave up."""
        while not self._ended.wait(timeout=0.5):
            pass  # a wait without timeout would not see signals
        if self.failure is not None:
            raise self.failure

    def not_ready(self) -> str | None:
        """None when every part works, else what `/ready` says."""
        try:
            with _direct.open(f"{self.url}/api/v1/ready", timeout=5):
                return None
        except urllib.error.HTTPError as error:
            return error.read().decode(errors="replace")
        except (OSError, TimeoutError) as error:
            return f"the API does not answer: {error}"

    def wait_until_ready(self, seconds: float) -> None:
        """Raises ServiceCrashedError or, after `seconds`, SystemStartError with the reason."""
        deadline = time.monotonic() + seconds
        while (reason := self.not_ready()) is not None:
            if self.failure is not None:
                raise self.failure
            if time.monotonic() > deadline:
                raise SystemStartError(
                    f"the system is not ready after {seconds:.0f} seconds: {reason};"
                    f" logs are in {self.settings.state_dir / 'logs'}"
                )
            time.sleep(POLL_SECONDS)

    def start(self, service: Service) -> None:
        """Start one service of the tree, with a log file of its name."""
        log = self.settings.state_dir / "logs" / f"{service.name}.log"
        if log.exists() and log.stat().st_size > LOG_BYTES_KEPT:
            log.replace(log.with_suffix(".log.1"))
        running = _Running(service, log)
        self._services.append(running)
        self._launch(running)

    def watch(self) -> None:
        """From now on restart what dies."""
        self._monitor.start()

    def _launch(self, running: _Running) -> None:
        service = running.service
        on_leash = [sys.executable, "-S", leash.__file__, str(os.getpid())]
        command = [*on_leash, str(int(signal.SIGKILL)), *service.command]
        with running.log.open("ab") as log:
            running.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self._environment,
                # Its own group: Ctrl-C reaches the supervisor alone, which stops all in order.
                start_new_session=True,
            )
        running.restart_at = None

    def _watch(self) -> None:
        """The supervisor's thread: restart what died, give up on what dies again and again.

        It lives until everything has ended: with the thread that started a service, the kernel
        would end the service, too (see `leash`), before it can stop by itself.
        """
        while not self._stopping.wait(POLL_SECONDS):
            with self._lock:
                if self._stopping.is_set():
                    break
                for running in self._services:
                    self._look_at(running)
                if self.failure is not None:
                    break
        if self.failure is not None:
            self.stop()
        self._ended.wait()

    def _look_at(self, running: _Running) -> None:
        now = time.monotonic()
        if running.restart_at is not None:
            if now >= running.restart_at:
                self._launch(running)
            return
        if running.process is None or running.process.poll() is None:
            return
        _kill_group(running.process.pid)
        crashes = running.crashes
        crashes.append(now)
        while crashes[0] < now - CRASH_WINDOW_SECONDS:
            crashes.popleft()
        name, code = running.service.name, running.process.returncode
        if len(crashes) >= CRASHES_ALLOWED:
            self.failure = ServiceCrashedError(
                name, len(crashes), now - crashes[0], running.log, tail(running.log)
            )
            return
        pause = BACKOFF_SECONDS[min(len(crashes), len(BACKOFF_SECONDS)) - 1]
        logger.warning("%s ended with code %s; restart in %.1f s", name, code, pause)
        running.restart_at = now + pause

    def stop(self) -> None:
        """Stop everything, the broker last; a second call does nothing more."""
        with self._lock:
            if self._stopping.is_set() and self._ended.is_set():
                return
            self._stopping.set()
            broker = [item for item in self._services if item.service.name == "broker"]
            _stop_all([item for item in self._services if item not in broker])
            _stop_all(broker)
            self._ended.set()


def _kill_group(pid: int) -> None:
    """SIGKILL what is left of a service's process group (pool children)."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


def _stop_all(services: list[_Running]) -> None:
    processes = [(item.service, item.process) for item in services if item.process is not None]
    for service, process in processes:
        if process.poll() is None:
            process.send_signal(service.stop_signal)
    deadline = time.monotonic() + STOP_SECONDS
    for service, process in processes:
        try:
            process.wait(timeout=max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            logger.warning("%s did not stop in %.0f s; killed", service.name, STOP_SECONDS)
            process.kill()
            process.wait()
        _kill_group(process.pid)


def tail(log: Path, lines: int = LOG_TAIL_LINES) -> str:
    """The last lines of a log file."""
    text = log.read_bytes()[-20_000:].decode(errors="replace")
    return "\n".join(text.splitlines()[-lines:])


@contextlib.contextmanager
def running_system(
    settings: Settings,
    *,
    workers: int = 2,
    admin_password: str | None = None,
    first_campaign: TaskName = TaskName.AVOID,
    ready_seconds: float = 90.0,
) -> Iterator[System]:
    """Prepare the state folder, start everything, yield when all parts are ready, stop it all.

    Parts: broker (unless `settings.broker_url` names one elsewhere), API, a worker with `workers`
    job children, tick worker, beat. `settings.port` 0 picks a free port; the address is in `.url`,
    the settings in force in `.settings`, the admin account in `.prepared`. Logs lie in
    `<state_dir>/logs`. Jobs that the stop interrupts keep their attempts. Raises StateInUseError,
    SystemStartError or ServiceCrashedError.
    """
    if workers < 1:
        raise ValueOutOfRangeError("workers", workers, "at least 1")
    (settings.state_dir / "logs").mkdir(parents=True, exist_ok=True)
    with _own_state(settings.state_dir):
        settings = settings.model_copy(update={"port": _free_port(settings)})
        prepared = prepare(settings, admin_password=admin_password, first_campaign=first_campaign)
        system = System(settings, prepared)
        try:
            if socket_path(settings) is not None:
                take_over(settings, utc_now())
                _start_broker(system)
            for service in embedded_services(settings, workers):
                system.start(service)
            system.watch()
            system.wait_until_ready(ready_seconds)
            yield system
        finally:
            at_work = interrupted.claims_of_the_living(settings)
            system.stop()
            interrupted.hand_back(settings, at_work)


@contextlib.contextmanager
def _own_state(state_dir: Path) -> Iterator[IO[str]]:
    """Hold the state folder: the kernel lets go of the lock whenever this process ends."""
    with (state_dir / "supervisor.pid").open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise StateInUseError(state_dir, file.read().strip()) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield file


def _free_port(settings: Settings) -> int:
    """The port to serve on; raises SystemStartError when it is taken."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            raise SystemStartError(
                f"cannot serve on {settings.host}:{settings.port} ({error.strerror});"
                " choose another with --port, or 0 for a free one"
            ) from error
        return int(probe.getsockname()[1])


def take_over(settings: Settings, now: datetime) -> None:
    """Forget what the last run of this state folder left in the database.

    Its signs of life would make a system look ready that is not, and its leases would let
    interrupted jobs wait: whoever held them is gone, since the folder is ours.
    """
    database = Database(settings.database_url)
    try:
        with database.write() as session:
            session.execute(delete(ServiceBeat))
            interrupted = update(Job).where(Job.state == JobState.RUNNING)
            session.execute(interrupted.values(lease_expires_at=now - timedelta(seconds=1)))
    finally:
        database.dispose()


def _start_broker(system: System) -> None:
    """Start the embedded broker and wait for its PONG."""
    path = socket_path(system.settings)
    assert path is not None
    folder = system.settings.state_dir / "valkey"
    folder.mkdir(exist_ok=True)
    end_orphan_broker(folder / "valkey.pid")
    path.unlink(missing_ok=True)
    service = broker_service(system.settings)
    system.start(service)
    deadline = time.monotonic() + BROKER_SECONDS
    while not broker_answers(path):
        if not system.runs(service.name) or time.monotonic() > deadline:
            log = system.settings.state_dir / "logs" / f"{service.name}.log"
            raise SystemStartError(f"the broker does not start; the end of {log}:\n{tail(log)}")
        time.sleep(0.02)
