"""`rodif demo --headless`, small: the whole loop in a process tree of its own."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from rodif_core import shipped
from worker.cli.client import Client
from worker.cli.main import main

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

SIZES = {
    "episodes": 40,
    "pairs": 60,
    "labels": 30,
    "annotators": 3,
    "flip-rate": 0.2,
    "evaluation-episodes": 60,
    "comparison-updates": 2,
}
# A full round is what `make demo` and `rodif bench avoid` show; here it need not be repeated.
QUICK = {
    "guide": {
        "scales": [2.0],
        "selection_rollouts": 40,
        "self_training_rounds": 1,
        "self_training_rollouts": 40,
        "self_training_updates": 60,
    }
}
RATES = ("success", "alignment", "alignment_of_successes", "off_support")


def test_headless_demo_writes_the_table_and_leaves_nothing_running(tmp_path: Path):
    table, state = tmp_path / "out.json", tmp_path / "state"
    sizes = [part for name, value in SIZES.items() for part in (f"--{name}", str(value))]
    config = tmp_path / "quick.json"
    config.write_text(json.dumps(QUICK))
    command = [sys.executable, "-m", "worker.cli.main", "demo", "--headless", "--config", config]
    done = subprocess.run(
        [*command, "--json", table, "--state", state, *sizes],
        env=os.environ | {"RODIF_ARGON2_CHEAP": "true"},
        capture_output=True,
        text=True,
    )
    told = done.stdout + done.stderr
    assert table.exists(), told
    result = json.loads(table.read_text())
    for name in ("before", "after", "rodif", "dp_dpo"):
        assert all(0 <= result[name][rate] <= 1 for rate in RATES), name
        assert result[name]["n"] == 60
    assert result["labels"]["total"] == 30
    assert result["labels"]["flipped"] == 6
    assert {"start", "collect", "replays", "labels", "rounds", "total"} <= set(result["seconds"])
    # So few labels may steer too little for the demo's own bar; that it steers is certain.
    before, after = result["before"], result["after"]
    assert after["alignment"] > before["alignment"], told
    shown = (
        after["alignment"] - before["alignment"] >= 0.30
        and after["success"] >= before["success"]
        and result["round"]["state"] == "published"
    )
    assert done.returncode == (0 if shown else 1), told
    left = [p for p in psutil.process_iter(["cmdline"]) if str(state) in str(p.info["cmdline"])]
    assert left == []


def test_demo_of_a_task_without_policy_says_how_to_make_one(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr(shipped, "_file", lambda _task: tmp_path / "none.safetensors")
    assert main(["demo", "pushing", "--state", str(tmp_path / "state")]) == 1
    said = capsys.readouterr().err
    assert "no checkpoint is shipped for task 'pushing'" in said
    assert "rodif pretrain pushing" in said
    assert not (tmp_path / "state").exists()


def test_demo_refuses_a_folder_in_use(tmp_path: Path):
    (tmp_path / "something").touch()
    done = subprocess.run(
        [sys.executable, "-m", "worker.cli.main", "demo", "--state", tmp_path],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert "wants an empty folder" in done.stderr


def test_demo_can_be_watched_from_its_start_and_ctrl_c_ends_all_of_it(tmp_path: Path):
    state = tmp_path / "state"
    demo = subprocess.Popen(
        [sys.executable, "-m", "worker.cli.main", "demo", "--port", "0", "--state", state],
        env=os.environ | {"RODIF_ARGON2_CHEAP": "true", "COLUMNS": "80", "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert demo.stdout is not None
    ready, sign_in = (demo.stdout.readline() for _ in range(2))
    try:
        url = re.search(r"http://[\d.:]+\d", ready)
        password = re.search(r"sign in as admin, password (\S+)", sign_in)
        assert url and password, ready + sign_in
        with Client(url.group()) as browser:
            browser.sign_in("admin", password.group(1))
            assert browser.get("/me")["role"] == "admin"
    finally:
        demo.send_signal(signal.SIGINT)
        demo.communicate(timeout=120)
    assert demo.returncode == 130
    left = [p for p in psutil.process_iter(["cmdline"]) if str(state) in str(p.info["cmdline"])]
    assert left == []
