"""What the demo calls a success, and what its JSON holds."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from rodif_core.errors import RodifError, ValueOutOfRangeError
from rodif_core.spec import TaskName
from rodif_core.tasks import get_task
from worker.cli.loop import DemoConfig, DemoResult
from worker.cli.main import main


def evaluation(alignment: float, success: float) -> dict[str, Any]:
    return {
        "success": success,
        "alignment": alignment,
        "alignment_of_successes": alignment / success,
        "off_support": 0.02,
        "n": 200,
        "intervals": {"success": [0.0, 1.0], "alignment": [0.0, 1.0]},
        "paths": [[[0.5, 0.0]]],
    }


def result(after: dict[str, Any], state: str = "published") -> DemoResult:
    before = evaluation(0.15, 0.75)
    return DemoResult(
        evaluations={"before": before, "after": after, "rodif": before, "dp_dpo": before},
        labels={"total": 80, "flipped": 24, "equal": 90},
        seconds={"total": 123.456},
        state=state,
        conservativeness=0.38,
    )


def test_rise_of_thirty_points_with_success_kept_is_a_success():
    assert result(evaluation(0.46, 0.75)).failures() == []


@pytest.mark.parametrize(
    ("after", "state", "message"),
    [
        (evaluation(0.44, 0.9), "published", "a rise of at least 0.30"),
        (evaluation(0.7, 0.74), "published", "success fell from 0.750 to 0.740"),
        (evaluation(0.9, 0.9), "rejected", "not published: the round is rejected"),
    ],
)
def test_anything_less_is_a_failure_that_says_why(after: dict[str, Any], state: str, message: str):
    (sentence,) = result(after, state).failures()
    assert message in sentence


def test_where_most_is_as_preferred_two_fifths_of_the_rest_are_enough():
    # 0.70 before leaves 0.30, of which 0.12 must be won.
    before = evaluation(0.70, 0.75)
    for alignment, failures in ((0.83, 0), (0.81, 1)):
        one = result(evaluation(alignment, 0.9))
        one.evaluations["before"] = before
        assert len(one.failures()) == failures


def test_json_has_the_four_policies_the_labels_and_the_seconds():
    table = result(evaluation(0.9, 0.9)).to_json()
    assert set(table) == {"before", "after", "rodif", "dp_dpo", "labels", "seconds", "round"}
    assert {"success", "alignment", "off_support", "n"} <= set(table["after"])
    assert "paths" not in table["after"]
    assert table["labels"]["flipped"] == 24
    assert table["seconds"] == {"total": 123.5}


def test_sizes_out_of_range_are_named(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(ValueOutOfRangeError, match=r"flip_rate is 0.5.*\[0, 0.5\)"):
        DemoConfig(flip_rate=0.5)
    with pytest.raises(RodifError, match="pairs is 0"):
        DemoConfig(pairs=0)
    with pytest.raises(RodifError, match="evaluation_episodes is 0"):
        DemoConfig(evaluation_episodes=0)
    with pytest.raises(RodifError, match="method is 'dp_dpo', but must be 'rodif_guided'"):
        DemoConfig(finetune={"method": "dp_dpo"})
    assert main(["demo", "--headless", "--labels", "0"]) == 1
    assert "labels is 0, but must be at least 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is not a readable JSON file"),
        ("{", "is not a readable JSON file"),
        ("[1]", r"holds \[1\], not an object of settings"),
        ('{"gamma": 1}', "gamma"),
        ('{"guide": {"self_training_rounds": 9}}', r"self_training_rounds is 9.*0 … 5"),
    ],
)
def test_settings_that_the_fine_tuner_lacks_are_named_before_anything_starts(
    content: str | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file = tmp_path / "settings.json"
    if content is not None:
        file.write_text(content)
    with pytest.raises(SystemExit) as refused:
        main(["demo", "--config", str(file), "--state", str(tmp_path / "state")])
    assert refused.value.code == 2
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "state").exists()


def test_usual_sizes_grow_with_the_groups_and_measure_the_longest_tasks_on_fewer_rollouts() -> None:
    assert DemoConfig.for_task(get_task(TaskName.AVOID)) == DemoConfig()
    stacking = DemoConfig.for_task(get_task(TaskName.STACKING_STATE))
    assert (stacking.pairs, stacking.evaluation_episodes) == (300, 200)
    sorting = DemoConfig.for_task(get_task(TaskName.SORTING))
    assert (sorting.evaluation_episodes, sorting.comparison_updates) == (400, 4)
