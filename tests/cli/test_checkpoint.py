"""`rodif checkpoint`: policies become what campaigns start from, and come out as files."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from safetensors.torch import save
from sqlalchemy import select

from rodif_core.policies.checkpoint import load_checkpoint, save_checkpoint
from rodif_core.spec import TaskName
from server.store.tables import AuditEntry, Checkpoint
from tests.cli.running_api import RunningApi
from tests.core.learning import tiny_checkpoint
from worker.cli.main import main


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A policy that nobody has added yet: its weights differ from test to test."""
    seed = int.from_bytes(tmp_path.name.encode()[-4:])
    made = tmp_path / "mine.safetensors"
    made.write_bytes(save_checkpoint(tiny_checkpoint(seed=seed)))
    return made


def state(api: RunningApi) -> list[str]:
    return ["--state", str(api.settings.state_dir)]


def rows(api: RunningApi) -> list[Checkpoint]:
    with api.database.read() as session:
        return list(session.scalars(select(Checkpoint).order_by(Checkpoint.id)))


def test_campaign_starts_from_a_file_that_was_added_while_the_system_runs(
    api: RunningApi, file: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["checkpoint", "add", str(file), *state(api)]) == 0
    told = capsys.readouterr().out
    row = rows(api)[-1]
    digest = load_checkpoint(file.read_bytes()).digest
    assert (row.digest, row.name, row.task) == (digest, f"mine-{digest[:8]}", "avoid")
    assert f"checkpoint {row.id}, {row.name!r} of task 'avoid', added" in told
    request = shlex.split(told[told.index("curl") :].replace("\\\n", ""))
    body = json.loads(request[request.index("-d") + 1])
    with api.admin() as admin:
        campaign = admin.post("/campaigns", body)
    assert campaign["start_checkpoint_id"] == campaign["published_checkpoint_id"] == row.id
    with api.database.read() as session:
        audited = session.scalars(select(AuditEntry).where(AuditEntry.action == "checkpoint.add"))
        assert [one.details["digest"] for one in audited][-1] == digest


def test_the_same_policy_is_added_once_and_a_lost_file_comes_back(
    api: RunningApi, file: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["checkpoint", "add", str(file), "--json", *state(api)]) == 0
    first = json.loads(capsys.readouterr().out)
    before = len(rows(api))
    assert api.settings.artifact_dir is not None
    sha256 = rows(api)[-1].artifact_sha256
    stored = api.settings.artifact_dir / "sha256" / sha256[:2] / sha256[2:4] / sha256
    stored.unlink()
    assert main(["checkpoint", "add", str(file), "--name", "other", *state(api)]) == 0
    assert f"checkpoint {first['id']}, {first['name']!r}" in (told := capsys.readouterr().out)
    assert "is there already" in told
    assert len(rows(api)) == before
    assert stored.read_bytes() == file.read_bytes()


def test_a_name_belongs_to_one_policy(
    api: RunningApi, file: Path, capsys: pytest.CaptureFixture[str]
):
    before = len(rows(api))
    assert main(["checkpoint", "add", str(file), "--name", "start", *state(api)]) == 1
    assert "checkpoint 'start' exists with digest 1111" in capsys.readouterr().err
    assert main(["checkpoint", "add", str(file), "--name", "", *state(api)]) == 1
    assert "name is '', but must be 1 … 128 characters" in capsys.readouterr().err
    assert len(rows(api)) == before


def other_task(task: str) -> bytes:
    """A file whose header names another task."""
    blob = save_checkpoint(replace(tiny_checkpoint(), task=TaskName.AVOID))
    header = json.loads(blob[8 : 8 + int.from_bytes(blob[:8], "little")])
    facts = json.loads(header["__metadata__"]["rodif"]) | {"task": task}
    policy = load_checkpoint(blob).policy
    tensors = {f"denoiser.{k}": v for k, v in policy.denoiser.state_dict().items()}
    tensors |= policy.normaliser.tensors() | {"support.points": tiny_checkpoint().support.points}
    return bytes(save(tensors, metadata={"rodif": json.dumps(facts)}))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot read"),
        (b"not a checkpoint", "mine.safetensors: not a readable checkpoint file"),
        (other_task("juggling"), "unknown task 'juggling'; legal values are 'avoid'"),
        (
            save_checkpoint(replace(tiny_checkpoint(), task=TaskName.PUSHING)),
            "does not fit task 'pushing'",
        ),
        (
            save_checkpoint(replace(tiny_checkpoint(), card={"loss": float("nan")})),
            "its card has a number that is none",
        ),
    ],
)
def test_what_is_no_policy_of_a_task_is_refused(
    content: bytes | None, message: str,
    api: RunningApi, tmp_path: Path, capsys: pytest.CaptureFixture[str],
):  # fmt: skip
    file, before = tmp_path / "mine.safetensors", len(rows(api))
    if content is not None:
        file.write_bytes(content)
    assert main(["checkpoint", "add", str(file), *state(api)]) == 1
    assert message in capsys.readouterr().err
    assert len(rows(api)) == before


def test_folder_without_a_database_stays_empty(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    nowhere = tmp_path / "nowhere"
    assert main(["checkpoint", "add", str(file), "--state", str(nowhere)]) == 1
    assert "there is no database" in capsys.readouterr().err
    assert not nowhere.exists()


def test_what_was_added_comes_out_again_and_rolls_out(
    api: RunningApi, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["checkpoint", "add", str(file), "--json", *state(api)]) == 0
    added = json.loads(capsys.readouterr().out)
    access = ["--url", api.url, "--token", api.token]
    out = tmp_path / "deep" / "out.safetensors"
    assert main(["checkpoint", "get", str(added["id"]), "--out", str(out), *access]) == 0
    assert out.read_bytes() == file.read_bytes()
    assert f"rodif rollout avoid --checkpoint {out}" in capsys.readouterr().out
    assert main(["rollout", "avoid", "--checkpoint", str(out), "--n", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["checkpoint"] == added["digest"]


def test_published_policy_of_a_campaign_is_what_get_takes_without_a_number(
    api: RunningApi, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["checkpoint", "add", str(file), "--json", *state(api)]) == 0
    added = json.loads(capsys.readouterr().out)
    with api.admin() as admin:
        admin.post(
            "/campaigns",
            {"name": "mine", "task": "avoid", "start_checkpoint_id": added["id"]},
        )
    out = ["--out", str(tmp_path / "out.safetensors"), "--url", api.url, "--token", api.token]
    assert main(["checkpoint", "get", "--campaign", "mine", "--json", *out]) == 0
    assert json.loads(capsys.readouterr().out)["digest"] == added["digest"]
    assert main(["checkpoint", "get", "1", "--campaign", "mine", *out]) == 1
    assert "checkpoint 1 and --campaign 'mine' both say which" in capsys.readouterr().err
    assert main(["checkpoint", "get", "99999", *out]) == 1
    assert "no checkpoint 99999" in capsys.readouterr().err
