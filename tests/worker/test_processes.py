"""Commands and environment of the processes, embedded and in the compose file."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from server.queue import QUEUES
from server.settings import Settings
from worker.processes import THREAD_LIMITS, child_environment, embedded_services

ROOT = Path(__file__).parents[2]
OURS = ("migrate", "api", "worker-rollout", "worker-replay", "worker-finetune", "beat")


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
    return loaded


def _built(compose: dict[str, Any]) -> dict[str, Any]:
    """Services that run our image."""
    return {name: item for name, item in compose["services"].items() if "build" in item}


def test_compose_has_every_part(compose: dict[str, Any]) -> None:
    assert set(OURS) | {"postgres", "valkey"} <= set(compose["services"])


def test_compose_commands_start_with_console_entries_that_exist(compose: dict[str, Any]) -> None:
    folder = str(Path(sys.executable).parent)
    for name, service in _built(compose).items():
        entry = service["command"][0]
        assert shutil.which(entry, path=folder), f"{name}: no command {entry!r} in {folder}"


def test_compose_workers_serve_every_queue_and_keep_the_pool_rules(compose: dict[str, Any]) -> None:
    served = set()
    for service in _built(compose).values():
        command = service["command"]
        if "worker" not in command:
            continue
        queue = command[command.index("-Q") + 1]
        served.add(queue)
        assert command[command.index("-P") + 1] == ("solo" if queue == "tick" else "prefork")
        assert service["stop_signal"] == "SIGQUIT"
        assert {"--without-gossip", "--without-mingle"} <= set(command)
    assert served == set(QUEUES)


def test_compose_sets_only_settings_that_exist(compose: dict[str, Any]) -> None:
    known = {f"RODIF_{name.upper()}" for name in Settings.model_fields} | {"RODIF_ADMIN_PASSWORD"}
    known |= {"FORWARDED_ALLOW_IPS"}  # uvicorn's own
    for service in _built(compose).values():
        assert set(service["environment"]) <= known


def test_image_uses_one_numerical_thread_per_process_too() -> None:
    text = (ROOT / "Dockerfile").read_text()
    for name, value in THREAD_LIMITS.items():
        assert f"{name}={value}" in text


def test_children_see_the_same_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(
        _env_file=None, state_dir=tmp_path, port=1234, argon2_cheap=True, job_lease_seconds=2.5
    )
    for name, value in child_environment(settings, {"PATH": "/bin"}).items():
        monkeypatch.setenv(name, value)
    assert Settings(_env_file=None) == settings


def test_environment_of_children_limits_numerical_threads(tmp_path: Path) -> None:
    env = child_environment(Settings(_env_file=None, state_dir=tmp_path), {"OMP_NUM_THREADS": "8"})
    assert env["OMP_NUM_THREADS"] == "1"


def test_job_worker_of_the_embedded_system_leaves_ticks_alone(tmp_path: Path) -> None:
    services = {
        service.name: service.command
        for service in embedded_services(Settings(_env_file=None, state_dir=tmp_path), 3)
    }
    assert set(services) == {"api", "worker", "ticker", "beat"}
    worker, ticker = services["worker"], services["ticker"]
    assert worker[worker.index("-Q") + 1] == "rollout,replay,finetune"
    assert (worker[worker.index("-c") + 1], worker[worker.index("-P") + 1]) == ("3", "prefork")
    assert ticker[ticker.index("-Q") + 1] == "tick"


@pytest.mark.parametrize(
    "module", ["worker.app", "worker.tasks", "worker.supervisor", "worker.cli.main"]
)
def test_processes_that_fork_or_stay_do_not_load_simulation_or_learning(
    module: str, tmp_path: Path
) -> None:
    code = (
        f"import sys, {module}\n"
        "found = {'torch', 'mujoco', 'viser'} & set(sys.modules)\n"
        "sys.exit(f'loaded: {sorted(found)}' if found else 0)"
    )
    env = child_environment(Settings(_env_file=None, state_dir=tmp_path))
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=env, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
