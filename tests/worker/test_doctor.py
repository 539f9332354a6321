"""The doctor finds what is wrong and says what to do."""

from __future__ import annotations

import json
import socket
import sqlite3
from pathlib import Path

import pytest

from server.settings import Settings
from server.store.migrate import downgrade, upgrade
from worker.cli import doctor
from worker.cli.main import main


def _settings(folder: Path, **more: object) -> Settings:
    return Settings(_env_file=None, state_dir=folder, **more)  # type: ignore[arg-type]


def test_embedded_broker_starts_and_stops_without_touching_the_state_folder(
    tmp_path: Path,
) -> None:
    assert doctor.check_broker(_settings(tmp_path)).status == "ok"
    assert list(tmp_path.iterdir()) == []


def test_broker_elsewhere_that_does_not_answer_fails_with_its_address(tmp_path: Path) -> None:
    finding = doctor.check_broker(_settings(tmp_path, broker_url="redis://127.0.0.1:1/0"))
    assert finding.status == "fail"
    assert "127.0.0.1:1" in finding.found
    assert "RODIF_BROKER_URL" in finding.advice


def test_database_is_fine_when_absent_or_at_head_and_fails_behind(tmp_path: Path) -> None:
    settings = _settings(tmp_path)
    assert "does not exist yet" in doctor.check_database(settings).found
    upgrade(settings.database_url)
    assert doctor.check_database(settings).status == "ok"
    downgrade(settings.database_url, "base")
    behind = doctor.check_database(settings)
    assert (behind.status, "rodif migrate" in behind.advice) == ("fail", True)


def test_file_that_is_no_database_fails_and_is_named(tmp_path: Path) -> None:
    settings = _settings(tmp_path)
    (tmp_path / "rodif.sqlite3").write_bytes(b"these are not the tables you look for" * 99)
    finding = doctor.check_database(settings)
    assert finding.status == "fail"
    assert "rodif.sqlite3" in finding.found
    with pytest.raises(sqlite3.DatabaseError):
        sqlite3.connect(tmp_path / "rodif.sqlite3").execute("select 1 from sqlite_master")


def test_taken_port_is_a_warning_with_the_way_out(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        finding = doctor.check_port(_settings(tmp_path, port=other.getsockname()[1]))
    assert finding.status == "warn"
    assert "--port" in finding.advice


def test_full_disk_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "DISK_FAIL_GB", 1e9)
    finding = doctor.check_disk(_settings(tmp_path / "not" / "there" / "yet"))
    assert finding.status == "fail"
    assert str(tmp_path) in finding.found


def test_missing_package_fails_and_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "PACKAGES", ("numpy", "flux-capacitor"))
    finding = doctor.check_packages()
    assert (finding.status, finding.found) == ("fail", "missing: flux-capacitor")


def test_report_is_json_with_exit_code_1_only_when_something_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["doctor", "--state", str(tmp_path), "--json"]) == 0
    findings = json.loads(capsys.readouterr().out)
    names = [finding["name"] for finding in findings]
    expected = "python packages gl broker database checkpoint disk chromium port"
    assert " ".join(names) == expected
    monkeypatch.setattr(doctor, "DISK_FAIL_GB", 1e9)
    assert main(["doctor", "--state", str(tmp_path)]) == 1
    assert "→ free some space" in capsys.readouterr().out
