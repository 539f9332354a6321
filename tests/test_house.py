"""The house itself: commands, pins, hooks, and what must not stand in any file."""

from __future__ import annotations

import os
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT_SUFFIXES = {"", ".py", ".md", ".toml", ".txt", ".yml", ".yaml", ".sh", ".js", ".css", ".html"}
TEXT_SUFFIXES |= {".ini", ".mako", ".json"}
MAX_TRACKED_BYTES = 5_000_000
MAX_WEIGHTS_BYTES = 20_000_000  # of a shipped policy; those that see carry an encoder
SCRIPTS = ("scripts/setup.sh", ".ci/run")


def tracked() -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()]


def texts() -> list[tuple[Path, str]]:
    return [(path, path.read_text()) for path in tracked() if path.suffix in TEXT_SUFFIXES]


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))


def test_ci_runs_the_readmes_test_command():
    assert "make test" in (ROOT / "README.md").read_text()
    assert re.search(r"^make test\b", (ROOT / ".ci" / "run").read_text(), flags=re.MULTILINE)


def test_make_help_lists_every_command_of_the_readme():
    shown = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True)
    for page in ("README.md", "CONTRIBUTING.md"):
        for target in re.findall(r"\bmake ([a-z-]+)", (ROOT / page).read_text()):
            assert target in make_targets(), f"{page} names make {target}"
    for target in ("setup", "demo", "test", "check", "lint", "type", "up", "bench", "screenshots"):
        assert f"make {target} " in shown.stdout


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_are_executable_and_parse(name: str):
    assert os.access(ROOT / name, os.X_OK)
    subprocess.run(["bash", "-n", str(ROOT / name)], check=True)


def test_setup_refuses_an_unknown_kind():
    done = subprocess.run(["scripts/setup.sh", "all"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2
    assert "'all'" in done.stderr and "runtime, dev" in done.stderr


def test_constraints_are_plain_pins_of_everything_we_ask_for():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    for line in lines:
        assert re.fullmatch(r"[a-z0-9-]+==[A-Za-z0-9.]+", line), line
    pinned = {line.partition("==")[0] for line in lines}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *sum(project["optional-dependencies"].values(), [])]
    for requirement in wanted:
        name = canonical(re.split(r"[\s\[<>=!~;]", requirement, maxsplit=1)[0])
        assert name in pinned or name == canonical(project["name"]), requirement


def test_no_file_names_a_package_registry_or_a_machine():
    hosts = [".".join(parts) for parts in (("pypi", "org"), ("pythonhosted", "org"))]
    hosts += [".".join(parts) for parts in (("download", "pytorch", "org"), ("npmjs", "com"))]
    for path, text in texts():
        for forbidden in (*hosts, f"{ROOT.parent}/"):
            assert forbidden not in text, f"{path.relative_to(ROOT)} names {forbidden}"


def test_no_unfinished_business_is_written_down():
    words = "|".join(("TO" + "DO", "FIX" + "ME", "Not" + "Implemented" + "Error"))
    for path, text in texts():
        if path.suffix in (".py", ".js", ".sh"):
            assert not re.search(rf"\b({words})\b", text), path.relative_to(ROOT)


def test_no_tracked_file_is_large():
    def limit(path: Path) -> int:
        return MAX_WEIGHTS_BYTES if path.suffix == ".safetensors" else MAX_TRACKED_BYTES

    assert [str(path) for path in tracked() if path.stat().st_size > limit(path)] == []


def test_commit_hooks_run_what_ci_runs():
    hooks = (ROOT / ".pre-commit-config.yaml").read_text()
    entries = re.findall(r"entry: (.+)", hooks)
    recipes = (ROOT / "Makefile").read_text().replace("$(BIN)", ".venv/bin")
    for entry in entries[:3]:
        assert entry in recipes, entry
    assert "tests/test_architecture.py" in entries[3]
    assert "http" not in hooks


def test_changelog_knows_the_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text()
