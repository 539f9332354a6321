"""The programs of docs/python.md do what the page says."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from rodif_core.demonstration_set import read_set
from rodif_core.tasks import get_task
from tests.cli.running_api import RunningApi
from worker.cli.simulate import SimulationConfig, simulate

PAGE = Path(__file__).parents[2] / "docs" / "python.md"
PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)


def test_demonstrations_of_a_program_can_be_trained_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    exec(PROGRAMS[0], {})
    made, told = read_set(get_task("avoid"), tmp_path / "mine.npz")
    assert len(made) >= 15 and told["sources"] == {"mine": len(made)}
    assert {one.outcome["group"] for one in made} == {"left"}


def test_winners_are_read_from_labels_pairs_and_episodes(
    api: RunningApi, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    outcomes = [(True, "left"), (True, "right")] * 4
    campaign = api.make_campaign(outcomes, name="avoid")
    with api.admin() as admin:
        simulate(admin, campaign, SimulationConfig(annotators=1, labels=5))
    monkeypatch.setenv("RODIF_URL", api.url)
    monkeypatch.setenv("RODIF_TOKEN", api.token)
    found: dict[str, Any] = {}
    exec(PROGRAMS[1], found)
    assert found["preferred"] == {("left", True): 5}
    assert "5 labels; winners" in capsys.readouterr().out
    # The fields that the page names.
    section = PAGE.read_text().split("A label has")[1].split("```")[0]
    rows = found["labels"][0] | next(iter(found["episodes"].values()))
    named = set(re.findall(r"`([a-z_]+)`", section)) - {"person", "simulated"}
    assert named <= rows.keys()
