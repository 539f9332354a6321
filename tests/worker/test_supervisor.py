"""The process tree: it starts, is restarted, gives up, and leaves nothing behind."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from rodif_core.errors import ValueOutOfRangeError
from server.errors import LeaseLostError
from server.settings import Settings
from server.states import JobKind, JobState
from server.store import jobs
from server.store.beats import BEAT, last_beat, record_beat
from server.store.tables import Job
from tests.worker.rows import make_world
from worker import interrupted, running, supervisor
from worker.broker import broker_answers, end_orphan_broker, socket_path
from worker.errors import ServiceCrashedError, StateInUseError, SystemStartError
from worker.prepare import Prepared
from worker.processes import Service
from worker.supervisor import System, running_system

PREPARED = Prepared(admin="admin", password=None, campaigns=0)
SLEEPER = Service("sleeper", (sys.executable, "-S", "-c", "import time; time.sleep(600)"))


def _settings(folder: Path) -> Settings:
    return Settings(_env_file=None, state_dir=folder, port=0, argon2_cheap=True)


@pytest.fixture
def system(tmp_path: Path) -> System:
    (tmp_path / "logs").mkdir()
    return System(_settings(tmp_path), PREPARED)


def _wait_for(condition: Callable[[], bool], what: str, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"not within {seconds} s: {what}"
        time.sleep(0.05)


def test_dead_service_is_started_again_and_stops_in_its_own_time(system: System) -> None:
    # It needs a moment to stop, as a worker does that hands its work back.
    code = (
        "import signal, sys, time\n"
        "def stop(*_): time.sleep(0.5); print('stopped by itself', flush=True); sys.exit()\n"
        "signal.signal(signal.SIGTERM, stop); print('on', flush=True); time.sleep(600)\n"
    )
    system.start(Service("tidy", (sys.executable, "-S", "-c", code)))
    log = system.settings.state_dir / "logs" / "tidy.log"
    _wait_for(lambda: "on" in log.read_text(), "the service is up")
    log.write_text("")
    system.watch()
    try:
        first = system.pid("tidy")
        os.kill(first, signal.SIGKILL)
        _wait_for(lambda: system.runs("tidy") and system.pid("tidy") != first, "restart")
        _wait_for(lambda: "on" in log.read_text(), "the restarted service is up")
    finally:
        system.stop()
    assert not system.runs("tidy")
    assert log.read_text().endswith("stopped by itself\n")


def test_everything_stops_with_the_log_shown_when_a_service_crashes_again_and_again(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "BACKOFF_SECONDS", (0.01,))
    broken = "print('no module named flux'); raise SystemExit(3)"
    system.start(SLEEPER)
    system.start(Service("broken", (sys.executable, "-S", "-c", broken)))
    system.watch()
    with pytest.raises(ServiceCrashedError, match="broken crashed 5 times") as caught:
        system.wait()
    assert "no module named flux" in str(caught.value)
    assert not system.runs("sleeper")


def test_unknown_service_is_refused_with_the_names_there_are(system: System) -> None:
    system.start(SLEEPER)
    try:
        with pytest.raises(SystemStartError, match="no running service 'flux'.*'sleeper'"):
            system.pid("flux")
    finally:
        system.stop()


def test_service_that_ignores_its_stop_signal_is_killed(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "STOP_SECONDS", 0.5)
    deaf = "import signal, time; signal.signal(15, signal.SIG_IGN); print('on', flush=True)"
    system.start(Service("deaf", (sys.executable, "-S", "-c", f"{deaf}; time.sleep(600)")))
    log = system.settings.state_dir / "logs" / "deaf.log"
    _wait_for(lambda: "on" in log.read_text(), "the service is up")
    pid = system.pid("deaf")
    system.stop()
    assert not psutil.pid_exists(pid)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's leash exists on Linux only")
def test_services_end_when_the_supervisor_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys, time; from tests.worker.test_supervisor import *\n"
        "folder = Path(sys.argv[1]); (folder / 'logs').mkdir()\n"
        "system = System(Settings(_env_file=None, state_dir=folder, port=0), PREPARED)\n"
        "system.start(SLEEPER); print(system.pid('sleeper'), flush=True); time.sleep(600)\n"
    )
    starter = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    )
    assert starter.stdout is not None
    pid = int(starter.stdout.readline())
    # Once the leash has become the sleeper itself, only the kernel can end it.
    _wait_for(lambda: "leash.py" not in " ".join(psutil.Process(pid).cmdline()), "leash on")
    starter.kill()
    starter.wait()
    _wait_for(lambda: not psutil.pid_exists(pid), "the service ends")


def test_start_is_refused_when_the_state_folder_is_in_use(tmp_path: Path) -> None:
    with (
        supervisor._own_state(tmp_path),
        pytest.raises(StateInUseError, match=f"{tmp_path}.*process {os.getpid()}.*--state"),
        running_system(_settings(tmp_path)),
    ):
        pass


def test_start_is_refused_when_the_port_is_taken(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        settings = _settings(tmp_path).model_copy(update={"port": port})
        with (
            pytest.raises(SystemStartError, match=f"127.0.0.1:{port}.*--port"),
            running_system(settings),
        ):
            pass


def test_start_is_refused_without_workers(tmp_path: Path) -> None:
    with (
        pytest.raises(ValueOutOfRangeError, match="workers is 0"),
        running_system(_settings(tmp_path), workers=0),
    ):
        pass


def test_socket_path_that_is_too_long_for_the_kernel_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemStartError, match="at most 107"):
        socket_path(_settings(tmp_path / ("x" * 120)))


def test_broker_elsewhere_has_no_socket(tmp_path: Path) -> None:
    settings = Settings(_env_file=None, state_dir=tmp_path, broker_url="redis://broker:6379/0")
    assert socket_path(settings) is None


def test_orphaned_broker_and_stale_socket_do_not_stop_a_new_start(tmp_path: Path) -> None:
    first, second = System(_settings(tmp_path), PREPARED), System(_settings(tmp_path), PREPARED)
    (tmp_path / "logs").mkdir()
    path = socket_path(first.settings)
    assert path is not None
    path.touch()  # stale
    supervisor._start_broker(first)
    orphan = first.pid("broker")
    supervisor._start_broker(second)  # nobody has stopped the first
    try:
        assert broker_answers(path)
        assert second.pid("broker") != orphan
        assert not first.runs("broker")
    finally:
        second.stop()
        first.stop()
    assert not broker_answers(path)


def test_foreign_process_with_the_number_of_a_dead_broker_is_spared(tmp_path: Path) -> None:
    pid_file = tmp_path / "valkey.pid"
    pid_file.write_text(str(os.getpid()))
    end_orphan_broker(pid_file)  # and we are still here
    pid_file.write_text("rubbish")
    end_orphan_broker(pid_file)


@contextmanager
def _process() -> Iterator[str]:
    """A process for as long as the block lasts; gives it as the owner of a job."""
    with subprocess.Popen(SLEEPER.command) as process:
        try:
            yield f"{socket.gethostname()}:{process.pid}"
        finally:
            process.kill()


def test_planned_stops_use_up_no_attempts_but_a_job_that_kills_its_worker_is_capped(
    tmp_path: Path,
) -> None:
    world = make_world(tmp_path)
    job_id = world.enqueue_collect()
    for _ in range(2 * jobs.DEFAULT_MAX_ATTEMPTS):  # Ctrl-C and `rodif up` again
        with _process() as owner:
            assert running._claim(world.workbench(owner), job_id) is not None
            at_work = interrupted.claims_of_the_living(world.settings)
            assert [claim.owner for claim in at_work] == [owner]
        assert interrupted.hand_back(world.settings, at_work) == 1
        supervisor.take_over(world.settings, world.clock())
    for _ in range(jobs.DEFAULT_MAX_ATTEMPTS):  # the job kills its worker, then comes a stop
        with _process() as owner:
            assert running._claim(world.workbench(owner), job_id) is not None
        assert interrupted.claims_of_the_living(world.settings) == []
        supervisor.take_over(world.settings, world.clock())
    with world.bench.database.write() as session:
        assert running.give_up_exhausted(session, world.clock()) == 1
    assert world.job_of(JobKind.COLLECT).state == JobState.FAILED


def test_a_stop_gives_back_only_what_this_machine_was_still_at(tmp_path: Path) -> None:
    world = make_world(tmp_path)
    elsewhere, done, odd = (world.enqueue_collect(seed=seed) for seed in (0, 10, 20))
    other_machine = world.workbench(f"another-machine:{os.getpid()}")
    assert running._claim(other_machine, elsewhere) is not None
    assert running._claim(world.workbench("no-process-id"), odd) is not None
    with _process() as owner:
        finishing = running._claim(world.workbench(owner), done)
        assert finishing is not None
        at_work = interrupted.claims_of_the_living(world.settings)
        assert [claim.job_id for claim in at_work] == [done]
        with finishing.step() as session:  # in the time that it is given to stop
            finishing.finish(session, {})
    assert interrupted.hand_back(world.settings, at_work) == 0
    states = [job.state for job in world.rows(Job)]
    assert states == [JobState.RUNNING, JobState.DONE, JobState.RUNNING]


def test_take_over_forgets_old_signs_of_life_and_frees_interrupted_jobs(tmp_path: Path) -> None:
    world = make_world(tmp_path)
    job_id = world.enqueue_collect()
    with world.bench.database.write() as session:
        record_beat(session, world.clock(), BEAT)
    dead = running._claim(world.bench, job_id)
    assert dead is not None
    assert running._claim(world.workbench("worker-2"), job_id) is None
    supervisor.take_over(world.settings, world.clock())
    with world.bench.database.read() as session:
        assert last_beat(session, BEAT) is None
    assert running._claim(world.workbench("worker-2"), job_id) is not None
    with pytest.raises(LeaseLostError):
        dead.progress("rollouts", 0.5)
