"""The wheel alone, in a fresh environment without the test tools, runs the whole system."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import pytest

ROOT = Path(__file__).resolve().parents[2]
UV = Path(sys.executable).with_name("uv")
READY_SECONDS = 120.0
STOP_SECONDS = 30.0
PASSWORD = "correct horse battery"
# The first three would reach back into the source tree; without byte code every process compiles
# torch anew.
NOT_INHERITED = ("PYTHONPATH", "VIRTUAL_ENV", "RODIF_STATE_DIR", "PYTHONDONTWRITEBYTECODE")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def environment() -> dict[str, str]:
    env = {name: value for name, value in os.environ.items() if name not in NOT_INHERITED}
    links = env.get("PIP_FIND_LINKS", "")
    if links:  # uv has its own name for it
        env["UV_FIND_LINKS"] = links.replace(" ", ",")
    return env | {"OMP_NUM_THREADS": "1"}


def uv(*arguments: str | Path) -> None:
    done = subprocess.run([UV, *arguments], env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`bin` of an environment with the wheel and its runtime dependencies, nothing else."""
    folder = tmp_path_factory.mktemp("runtime")
    uv("build", "--wheel", "--out-dir", folder, ROOT)
    (wheel,) = folder.glob("*.whl")
    uv("venv", "--python", sys.executable, folder / "venv")
    binaries = folder / "venv" / "bin"
    # A CPU torch, unless a folder of wheels decides.
    torch = () if os.environ.get("PIP_FIND_LINKS") else ("--torch-backend", "cpu")
    into = ("--python", binaries / "python")
    uv("pip", "install", *into, *torch, "-c", ROOT / "constraints.txt", wheel)
    return binaries


@contextmanager
def running(binaries: Path, state: Path) -> Iterator[str]:
    """`rodif up` until the block ends; its address."""
    command = [binaries / "rodif", "up", "--state", state, "--port", "0", "--workers", "1"]
    env = environment() | {"PYTHONUNBUFFERED": "1", "RODIF_ADMIN_PASSWORD": PASSWORD}
    log = state.with_suffix(".log")
    with log.open("wb") as output:
        process = subprocess.Popen(
            command, cwd=state.parent, env=env, stdout=output, stderr=subprocess.STDOUT
        )
    try:
        deadline = time.monotonic() + READY_SECONDS
        while not (found := re.search(r"ready at (http://\S+)", log.read_text())):
            assert process.poll() is None and time.monotonic() < deadline, log.read_text()
            time.sleep(0.1)
        yield found.group(1)
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    assert process.returncode == 0, log.read_text()


def test_every_process_starts_and_all_pages_are_in_the_wheel(installed: Path, tmp_path: Path):
    # Ready means: database at head, broker, worker and beat have given signs of life.
    with (
        running(installed, tmp_path / "state") as url,
        httpx2.Client(base_url=url, headers={"Origin": url}) as browser,
    ):
        assert "password" in browser.get("/sign-in").text
        account = {"name": "admin", "password": PASSWORD}
        assert browser.post("/api/v1/session", json=account).status_code == 200
        replay = f"/replay-client/?playbackPath=/replays/{'0' * 64}.viser"
        for path in ("/admin", replay, "/vendor/plotly.min.js"):
            answer = browser.get(path)
            assert answer.status_code == 200 and len(answer.content) > 500, path
        folder = ROOT / "labeling_ui" / "site" / "static"
        for file in sorted(folder.rglob("*.*")):
            answer = browser.get(f"/static/{file.relative_to(folder)}")
            assert answer.content == file.read_bytes(), file


def test_doctor_finds_all_that_running_needs(installed: Path, tmp_path: Path):
    done = subprocess.run(
        [installed / "rodif", "doctor", "--state", tmp_path / "state"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert not re.search(r"^fail", done.stdout, flags=re.MULTILINE)


def test_test_tools_are_not_part_of_the_runtime(installed: Path):
    code = "import importlib.util as u; print([m for m in ('pytest', 'mypy') if u.find_spec(m)])"
    done = subprocess.run([installed / "python", "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]"
