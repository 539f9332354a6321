"""`rodif up` as a person runs it: starts, a second one beside it, stops, also amid work."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from server.states import JobState
from server.store.tables import Episode, Job
from tests.acceptance.system import running_site, wait_for
from worker.cli.client import Client

pytestmark = pytest.mark.slow

RODIF = str(Path(sys.executable).parent / "rodif")


def _command(state: Path) -> list[str]:
    return [RODIF, "up", "--state", str(state), "--port", "0", "--workers", "1"]


@contextlib.contextmanager
def _up(state: Path, output: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """A started `rodif up` and what it has printed by the time it is ready."""
    with output.open("wb") as file:
        process = subprocess.Popen(_command(state), stdout=file, stderr=subprocess.STDOUT)

    def settled() -> bool:
        return "Ctrl-C stops" in output.read_text() or process.poll() is not None

    try:
        wait_for(settled, "the system is up or has given up")
        assert process.poll() is None, output.read_text()
        yield process, output.read_text()
    finally:
        if process.poll() is None:
            process.terminate()
        process.wait(timeout=120)


def _address(printed: str) -> str:
    found = re.search(r"ready at (http://\S+)", printed)
    assert found, printed
    return found[1]


def test_up_starts_signs_in_refuses_a_second_one_stops_cleanly_and_starts_again(
    tmp_path: Path,
) -> None:
    state = tmp_path / "state"
    with _up(state, tmp_path / "first.txt") as (process, printed):
        found = re.search(r"Sign in as (\w+) with password (\S+) \(shown only now\)", printed)
        assert found, printed
        name, password = found.groups()
        with Client(_address(printed)) as api:
            api.sign_in(name, password)
            campaign = api.find_campaign(None)
            assert campaign["task"] == "avoid"

        second = subprocess.run(_command(state), capture_output=True, text=True, timeout=60)
        assert second.returncode == 1
        assert "in use by process" in second.stderr and "--state" in second.stderr

        family = psutil.Process(process.pid).children(recursive=True)
        assert len(family) >= 6  # broker, API, worker and its child, ticker, beat
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=120) == 0
        _, alive = psutil.wait_procs(family, timeout=5)
        assert alive == []

    with _up(state, tmp_path / "second.txt") as (process, printed):
        assert "password shown at the first start" in printed
        with Client(_address(printed)) as api:
            api.sign_in(name, password)
            assert api.find_campaign(None)["id"] == campaign["id"]
        process.send_signal(signal.SIGINT)  # Ctrl-C
        assert process.wait(timeout=120) == 0


def test_stop_in_the_middle_of_a_job_costs_it_no_attempt(tmp_path: Path) -> None:
    with running_site(tmp_path) as site:
        collect = {"episodes": 60, "pairs": 1, "strategy": "random"}
        job_id = site.post("/collect", collect)["id"]
        wait_for(lambda: len(site.rows(Episode)) > 0, "the first episodes are stored")
        (begun,) = site.rows(Job, id=job_id)
        assert begun.state == JobState.RUNNING, "stopped too late for this test"
    (stopped,) = site.rows(Job, id=job_id)
    assert (stopped.state, stopped.owner) == (JobState.QUEUED, None)
    assert stopped.max_attempts - stopped.attempt == begun.max_attempts
    with running_site(tmp_path) as site:
        site.api.wait_for_job(job_id, seconds=180)
        assert sorted(episode.seed for episode in site.rows(Episode)) == list(range(60))
