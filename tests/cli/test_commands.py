"""The command line itself: quick help, clear errors, and the commands that need no server."""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from rich.console import Console

from labeling_ui.mode_plot import GROUP_COLOURS
from rodif_core import shipped, steered
from rodif_core.demonstrations import load_demonstrations
from rodif_core.policies.checkpoint import load_checkpoint, save_checkpoint
from rodif_core.presets import PRESETS
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import TaskName
from rodif_core.training_state import Precision
from tests.core.learning import tiny_checkpoint
from worker.cli import pretrain
from worker.cli.main import main
from worker.cli.options import number_list
from worker.cli.tables import evaluation_table


def test_help_loads_no_simulator_and_no_database():
    code = (
        "import sys; from worker.cli.main import build_parser; build_parser().format_help();"
        "heavy = {'torch', 'mujoco', 'viser', 'celery', 'sqlalchemy', 'rich'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


def test_unknown_command_names_the_legal_ones(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as caught:
        main(["fly"])
    assert caught.value.code == 2
    assert "invalid choice: 'fly'" in capsys.readouterr().err


@pytest.mark.parametrize("wish", [["tasks", "--json"], ["tasks"]])  # at once, and at the end
def test_reader_who_has_left_ends_the_command_without_a_traceback(wish: list[str]):
    unread, output = os.pipe()
    os.close(unread)
    code = "import sys; from worker.cli.main import main; sys.exit(main(sys.argv[1:]))"
    with open(output, "wb") as nobody:
        done = subprocess.run(
            [sys.executable, "-c", code, *wish], stdout=nobody, stderr=subprocess.PIPE, text=True
        )
    assert (done.returncode, done.stderr) == (1, "")


def test_evaluate_prints_rates_and_intervals_of_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file = tmp_path / "tiny.safetensors"
    file.write_bytes(save_checkpoint(tiny_checkpoint()))
    assert main(["evaluate", str(file), "--n", "3", "--seed", "7", "--json"]) == 0
    measured = json.loads(capsys.readouterr().out)
    assert measured["checkpoint"] == tiny_checkpoint().digest
    assert measured["n"] == 3
    assert 0 <= measured["intervals"]["success"][0] <= measured["success"] <= 1
    written = tmp_path / "deep" / "out.json"
    assert main(["evaluate", str(file), "--n", "3", "--seed", "7", "--json", str(written)]) == 0
    table = capsys.readouterr().out
    assert "off support" in table
    assert "reasons: 3 × left workspace\n" in table
    assert "modes: –\n" in table
    assert json.loads(written.read_text()) == measured
    assert {"success", "alignment", "modes", "n", "intervals"} <= set(measured)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "neither a readable file"),
        (b"not a checkpoint", "rodif evaluate: "),
    ],
)
def test_evaluate_refuses_what_is_no_checkpoint(
    content: bytes | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file = tmp_path / "broken.safetensors"
    if content is not None:
        file.write_bytes(content)
    assert main(["evaluate", str(file)]) == 1
    assert message in capsys.readouterr().err


def test_rates_stand_above_their_intervals_where_80_columns_are_too_few_for_both():
    rate = {"success": 0.5, "alignment": 0.25, "alignment_of_successes": 1.0}
    evaluation = rate | {"off_support": 0.0, "n": 400, "intervals": {"success": [0.4, 0.6]}}
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(evaluation_table("two", [("after (published)", evaluation)]))
    (row, below) = [line for line in console.export_text().splitlines() if line.startswith("│")]
    assert [cell.strip() for cell in row.split("│")[2:4]] == ["50.0 %", "25.0 %"]
    assert [cell.strip() for cell in below.split("│")[1:4]] == ["", "[40–60]", ""]


@pytest.mark.parametrize("command", ["simulate", "round"])
def test_without_a_token_the_command_says_where_to_get_one(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.delenv("RODIF_TOKEN", raising=False)
    assert main([command, "--url", "http://127.0.0.1:9"]) == 1
    error = capsys.readouterr().err
    assert "sign in at http://127.0.0.1:9 as an admin, make one under Tokens" in error


def test_evaluate_names_the_legal_number_of_rollouts(capsys: pytest.CaptureFixture[str]):
    assert main(["evaluate", "avoid", "--n", "0"]) == 1
    assert "episodes is 0, but must be 1 … 100000" in capsys.readouterr().err


@pytest.mark.slow
def test_pretrain_writes_a_checkpoint_with_its_measurements(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file = tmp_path / "deep" / "new.safetensors"
    sizes = ["--demonstrations", "24", "--updates", "5", "--track", "2", "--evaluate", "4"]
    assert main(["pretrain", "avoid", "--out", str(file), *sizes, "--seed", "5"]) == 0
    made = load_checkpoint(file.read_bytes())
    assert made.card["evaluation"]["n"] == 4
    assert made.card["demonstrations"] == 24
    told = capsys.readouterr()
    assert made.digest in told.out
    first, *_, last = made.card["rollout_curve"]
    assert (first["update"], last["update"]) == (1, 4)
    assert f"after 4 of 5 updates: success {last['success']:.1%} (n = 2)" in told.err


@pytest.mark.slow
def test_pretrain_trains_again_on_what_the_expert_did_after_taking_over(tmp_path: Path):
    file = tmp_path / "new.safetensors"
    sizes = ["--demonstrations", "4", "--updates", "2", "--track", "0", "--evaluate", "0"]
    rounds = ["--rounds", "1", "--recoveries", "4", "--drives", "2", "--round-updates", "3"]
    work = ["--workspace", str(tmp_path / "work"), "--executed-steps", "4"]
    assert main(["pretrain", "pushing", "--out", str(file), *sizes, *rounds, *work]) == 0
    made = load_checkpoint(file.read_bytes())
    assert made.task is TaskName.PUSHING
    assert made.card["preset"]["drives"] == 2 and 1 <= made.card["recoveries"] <= 4
    assert made.policy.config.executed_steps == 4
    assert made.card["start"] is not None
    assert made.card["demonstrations"] == 4 + made.card["recoveries"]
    assert made.card["success_before_rounds"] == [0.0]
    assert made.card["held_out_curve"][-1]["update"] == 2  # the last of three


@pytest.mark.slow
def test_pretrain_goes_on_from_a_file_with_takeovers_from_steered_copies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(steered, "UPDATES", 2)
    before, file = tmp_path / "before.safetensors", tmp_path / "after.safetensors"
    before.write_bytes(shipped_checkpoint(TaskName.AVOID))
    sizes = ["--demonstrations", "4", "--track", "0", "--evaluate", "0"]
    rounds = ["--rounds", "1", "--recoveries", "4", "--steered-drives", "2", "--round-updates", "3"]
    work = tmp_path / "work"
    arguments = [*sizes, *rounds, "--begin-with", str(before), "--workspace", str(work)]
    assert main(["pretrain", "avoid", "--out", str(file), *arguments]) == 0
    made, begun = load_checkpoint(file.read_bytes()), load_checkpoint(before.read_bytes())
    assert made.card["start"] == begun.digest
    assert made.card["preset"]["steered_drives"] == 2
    assert len(made.card["success_before_rounds"]) == 1
    origin = {"task": "avoid", "digest": begun.digest}
    kept = {"preset": begun.card["preset"], "demonstrations": begun.card["demonstrations"]}
    assert made.card["began_with"] == origin | kept
    taken = load_demonstrations(work / "round-0" / "recoveries-4x1+2.npz")
    assert 1 <= made.card["recoveries"] == len(taken) <= 4
    assert {one.info["checkpoint"] for one in taken} - {begun.digest}  # a copy drove, too


@pytest.mark.parametrize(
    ("task", "rounds", "message"),
    [
        ("pushing", "1", "is a policy of task 'avoid', but must be of 'pushing'"),
        ("aligning", "1", "but must be of 'aligning' or 'aligning-state'"),
        ("avoid", "0", "with 0 rounds trains nothing"),
    ],
)
def test_pretrain_tells_what_it_cannot_begin_with(
    task: str, rounds: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    before = tmp_path / "before.safetensors"
    before.write_bytes(shipped_checkpoint(TaskName.AVOID))
    arguments = ["--begin-with", str(before), "--rounds", rounds, "--out", str(tmp_path / "x")]
    assert main(["pretrain", task, *arguments]) == 1
    assert message in capsys.readouterr().err


def test_pretrain_names_a_file_that_it_cannot_begin_with_because_it_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = ["--begin-with", str(tmp_path / "none"), "--rounds", "1"]
    assert main(["pretrain", "avoid", *arguments, "--out", str(tmp_path / "x")]) == 1
    assert "none' is neither a readable file" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--rounds", "--track", "--evaluate", "--steered-drives"])
def test_pretrain_refuses_negative_numbers(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["pretrain", "avoid", "--out", str(tmp_path / "x"), option, "-1"]) == 1
    assert "is -1, but must be at least 0" in capsys.readouterr().err


def test_evaluate_of_a_task_without_a_checkpoint_names_those_with_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """As where the package was installed without all of its weights."""
    (tmp_path / "avoid.safetensors").write_bytes(shipped.shipped_checkpoint(TaskName.AVOID))
    monkeypatch.setattr(shipped, "_file", lambda task: tmp_path / f"{task.value}.safetensors")
    assert main(["evaluate", "sorting"]) == 1
    error = capsys.readouterr().err
    assert "no checkpoint is shipped for task 'sorting'; tasks that have one: 'avoid'." in error
    assert "rodif pretrain sorting --out FILE" in error


def test_tasks_lists_every_task_with_its_modes(capsys: pytest.CaptureFixture[str]):
    assert main(["tasks", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["task"] for row in rows] == [task.value for task in TaskName]
    assert [row["task"] for row in rows if row["shipped_checkpoint"]] == shipped.shipped_tasks()
    assert all(row["preferred_group"] in row["groups"] for row in rows)
    assert main(["tasks"]) == 0
    assert "pushing" in capsys.readouterr().out


@pytest.mark.parametrize("task", ["avoid", "pushing", "sorting"])
def test_demos_writes_a_set_that_plot_can_draw(
    task: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file, picture = tmp_path / "set.npz", tmp_path / "modes.png"
    share = ["--preferred-share", "0.5"]
    assert main(["demos", task, "--out", str(file), "--n", "4", "--seed", "3", *share]) == 0
    made = load_demonstrations(file)
    assert len(made) == 4 and all(one.success and one.info["seed"] == 3 for one in made)
    assert made[0].outcome["mode"] in capsys.readouterr().out
    assert main(["plot", "modes", str(file), "--out", str(picture)]) == 0
    with Image.open(picture) as drawn:
        colours = {colour for _, colour in drawn.convert("RGB").getcolors(1 << 20)}
    assert set(GROUP_COLOURS[:2]) <= colours  # both groups of the legend


def test_plot_of_a_foreign_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = ["--out", str(tmp_path / "x.png")]
    assert main(["plot", "modes", str(tmp_path / "none.npz"), *out]) == 1
    assert "is not readable" in capsys.readouterr().err
    assert main(["plot", "modes", "juggling", *out]) == 1
    assert "'juggling' is neither a readable file" in capsys.readouterr().err


def test_number_list_takes_numbers_and_ranges():
    assert number_list("7") == [7]
    assert number_list("100-102,7") == [100, 101, 102, 7]


@pytest.mark.parametrize("text", ["", "x", "5-", "5-3", "1,,2"])
def test_number_list_refuses_anything_else(text: str):
    with pytest.raises(argparse.ArgumentTypeError):
        number_list(text)


def test_pretrain_offers_the_presets_and_precisions_that_there_are() -> None:
    """The help does not load torch, so it has copies of these names."""
    assert all(set(pretrain.PRESET_NAMES) == set(presets) for presets in PRESETS.values())
    assert tuple(precision.value for precision in Precision) == pretrain.PRECISIONS
