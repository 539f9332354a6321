"""What is wrong with an argument is told in a line that names it, before any work is done."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from rodif_core.errors import RodifError, ValueOutOfRangeError
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import TaskName
from worker.cli.bench import read_rows
from worker.cli.loop import DemoConfig
from worker.cli.main import main
from worker.cli.options import connect, output_file, read_settings
from worker.cli.simulate import SimulationConfig
from worker.prepare import prepare

WRITERS = [
    ["evaluate", "avoid", "--json"],
    ["rollout", "avoid", "--out"],
    ["rollout", "avoid", "--video"],
    ["plot", "modes", "avoid", "--out"],
    ["demos", "avoid", "--out"],
    ["pretrain", "avoid", "--out"],
    ["checkpoint", "get", "--out"],
    ["bench", "avoid", "--json"],
    ["bench", "rollouts", "--json"],
    ["demo", "--json"],
]


@pytest.mark.parametrize("words", WRITERS, ids=" ".join)
def test_a_folder_in_place_of_a_file_to_write_is_told_at_once(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as stopped:
        main([*words, str(tmp_path)])
    assert stopped.value.code == 2
    assert f"'{tmp_path}' is a folder, but must be a file" in capsys.readouterr().err


def test_a_file_in_place_of_a_folder_to_write_into_is_told_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file = tmp_path / "file"
    file.write_text("")
    for wrong in (file, file / "deeper"):
        with pytest.raises(SystemExit) as stopped:
            main(["pretrain", "avoid", "--out", str(tmp_path / "x"), "--workspace", str(wrong)])
        assert stopped.value.code == 2
        assert f"'{wrong}' cannot be a folder to write into" in capsys.readouterr().err


def test_a_file_below_a_file_cannot_be_written(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(Exception, match="cannot be written.*/file' is no folder"):
        output_file(str(tmp_path / "file" / "new" / "set.npz"))
    assert output_file(str(tmp_path / "new" / "set.npz")) == tmp_path / "new" / "set.npz"


@pytest.mark.parametrize(
    ("words", "legal"),
    [
        (["rollout", "avvoid"], "'avoid', 'pushing'"),
        (["pretrain", "avvoid", "--out", "x"], "'avoid', 'pushing'"),
        (["round", "--method", "dpo"], "'rodif_guided', 'rodif'"),
        (["round", "--publish", "maybe"], "'auto', 'manual'"),
        (["bench", "rollouts", "--tasks", "avvoid"], "'avoid', 'pushing'"),
    ],
    ids=lambda part: " ".join(part) if isinstance(part, list) else "",
)
def test_legal_names_are_told_as_they_are_typed(
    words: list[str], legal: str, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit):
        main(words)
    told = capsys.readouterr().err
    assert f"(choose from {legal}" in told and "<" not in told.split("choose from")[1]


@pytest.mark.parametrize("words", [["evaluate"], ["rollout", "avoid", "--checkpoint"]])
def test_a_damaged_checkpoint_is_named(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file = tmp_path / "cut.safetensors"
    file.write_bytes(shipped_checkpoint(TaskName.AVOID)[:1000])
    assert main([*words, str(file)]) == 1
    assert f"{file}: not a readable checkpoint file (1000 bytes)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["plot", "modes", "avoid", "--out", "a.jpg"], "out is 'a.jpg', but must be.*.png"),
        (["pretrain", "avoid", "--out", "x", "--executed-steps", "17"], "executed_steps is 17"),
        (["round", "--minutes", "-1"], "minutes is -1.0, but must be at least 0"),
        (["simulate", "--seed", "-1"], "seed is -1, but must be at least 0"),
        (["up", "--port", "99999"], "port is 99999: .*less than or equal to 65535"),
    ],
    ids=lambda part: " ".join(part) if isinstance(part, list) else "",
)
def test_illegal_values_are_told_before_anything_starts(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
):
    assert main(words) == 1
    error = capsys.readouterr().err
    assert re.search(told, error), error


def test_a_state_folder_that_is_a_file_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "file"
    file.write_text("")
    assert main(["demo", "--state", str(file)]) == 1
    assert f"rodif demo: {file}: Not a directory" in capsys.readouterr().err


def test_a_setting_of_the_environment_is_told_by_its_name(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RODIF_PORT", "abc")
    monkeypatch.setenv("RODIF_LEASE_SECONDS", "-3")
    with pytest.raises(RodifError, match="RODIF_PORT is 'abc'.*RODIF_LEASE_SECONDS is '-3'"):
        read_settings()


@pytest.mark.parametrize("url", ["nonsense", "foo://x", "sqlite:////proc/none.sqlite3"])
def test_a_database_that_cannot_be_used_is_told(url: str, tmp_path: Path):
    with pytest.raises(RodifError, match="RODIF_DATABASE_URL cannot be used.*legal are sqlite:"):
        prepare(read_settings(state_dir=tmp_path, database_url=url))


def test_a_token_that_no_header_can_carry_is_refused():
    class Given:
        url, token = "http://127.0.0.1:1", "rdf_ä"

    with pytest.raises(RodifError, match="the token has characters"):
        connect(Given())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "given", [{"seed": -1}, {"episodes": 1}, {"evaluation_episodes": 9}], ids=str
)
def test_a_demo_refuses_what_the_api_would_refuse_later(given: dict[str, int]):
    with pytest.raises(ValueOutOfRangeError, match="but must be at least"):
        DemoConfig(**given)


def test_a_simulation_has_no_seed_below_0():
    with pytest.raises(ValueOutOfRangeError, match="seed is -1"):
        SimulationConfig(seed=-1)


@pytest.mark.parametrize("rows", [[1], ["row"], [{}], {"seed": 1}], ids=str)
def test_rows_of_something_else_are_no_benchmark(rows: object, tmp_path: Path):
    file = tmp_path / "rows.json"
    file.write_text(json.dumps(rows))
    with pytest.raises(RodifError, match="is not a list of benchmark rows"):
        read_rows(file)
