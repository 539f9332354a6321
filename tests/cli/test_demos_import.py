"""`rodif demos import`: from files in D3IL's layout to a set that training and plots read."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from rodif_core.demonstrations import load_demonstrations, make_demonstrations
from rodif_core.policies.checkpoint import load_checkpoint
from rodif_core.tasks import get_task
from tests.core.d3il_files import d3il_record, write_record
from tests.core.test_plain_pickle import Calls
from worker.cli.main import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of Avoid, of which the second is driven into a cylinder."""
    made = tmp_path_factory.mktemp("d3il")
    task = get_task("avoid")
    for number, one in enumerate(make_demonstrations(task, episodes=3, seed=2)):
        record = d3il_record(task, one)
        if number == 1:
            record["robot"]["des_c_pos"][:, 0] = 0.5
        write_record(made / f"env_{number}.pkl", record)
    return made


def test_a_folder_becomes_a_set(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out, picture = tmp_path / "set.npz", tmp_path / "modes.png"
    assert main(["demos", "import", "avoid", str(folder), "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "replayed: 2 of 3 succeed here" in shown
    assert "left out: collision 1" in shown and "env_1.pkl" in shown
    made = load_demonstrations(out)
    assert [one.info["file"] for one in made] == ["env_0.pkl", "env_2.pkl"]
    assert all(one.success for one in made)
    assert main(["plot", "modes", str(out), "--out", str(picture)]) == 0


def test_imported_files_become_a_policy(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out, file = tmp_path / "set.npz", tmp_path / "human.safetensors"
    assert main(["demos", "import", "avoid", str(folder), "--out", str(out)]) == 0
    sizes = ["--updates", "3", "--track", "0", "--evaluate", "0"]
    assert main(["pretrain", "avoid", "--demos", str(out), "--out", str(file), *sizes]) == 0
    assert "set.npz: 2 demonstrations (d3il 2)" in capsys.readouterr().err.replace("\n", "")
    card = load_checkpoint(file.read_bytes()).card
    told = card["demonstration_set"]
    assert told["file"] == "set.npz"
    assert told["sha256"] == hashlib.sha256(out.read_bytes()).hexdigest()
    assert (told["episodes"], told["sources"]) == (2, {"d3il": 2})
    assert (card["demonstrations"], card["recoveries"]) == (2, 0)
    assert main(["rollout", "avoid", "--checkpoint", str(file), "--n", "2"]) == 0


def test_a_malicious_file_stops_the_import(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    trace = tmp_path / "was-here"
    evil = write_record(tmp_path / "evil.pkl", Calls(os.system, f"touch {trace}"))
    out = tmp_path / "set.npz"
    assert main(["demos", "import", "avoid", str(folder), str(evil), "--out", str(out)]) == 1
    assert "evil.pkl is not a pickle of plain data" in capsys.readouterr().err
    assert not trace.exists() and not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["import"], "name the task and its files"),
        (["import", "avoid"], "name the task and its files"),
        (["import", "juggling", "x.pkl"], "unknown task 'juggling'; legal values are 'avoid'"),
        (["import", "avoid", "nowhere.pkl"], "nowhere.pkl does not exist"),
        (["avoid", "x.pkl"], "unexpected 'x.pkl'"),
        (["import", "avoid", "x.pkl", "--n", "3"], "--n is for scripted demonstrations"),
    ],
)
def test_wrong_arguments_are_told(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
):
    assert main(["demos", *arguments, "--out", "set.npz"]) == 1
    assert message in capsys.readouterr().err


def test_an_import_of_nothing_but_failures_writes_no_file(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "set.npz"
    assert main(["demos", "import", "avoid", str(folder / "env_1.pkl"), "--out", str(out)]) == 1
    assert "left out: collision 1" in capsys.readouterr().err
    assert not out.exists()
