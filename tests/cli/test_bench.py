"""The benchmark: its labels, its file of rows, its judgement, and one real row."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rodif_core.errors import RodifError, UnknownNameError, ValueOutOfRangeError
from rodif_core.policies.checkpoint import load_checkpoint
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import FinetuneMethod, TaskName
from worker.cli import bench
from worker.cli.benchmarks import avoid
from worker.cli.benchmarks.avoid import Run
from worker.cli.main import build_parser

GUIDED = FinetuneMethod.RODIF_GUIDED


def row(method: str, seed: int, **more: Any) -> dict[str, Any]:
    """A finished row of the product design at 30 % corruption."""
    return {
        "method": method,
        "corruption": 0.3,
        "design": "product",
        "seed": seed,
        "labels": 400,
        "success": 0.9,
        "alignment": 0.95,
        "alignment_of_successes": 0.97,
        "off_support": 0.02,
        "n": 200,
        "updates": None,
        "checkpoint": load_checkpoint(shipped_checkpoint(TaskName.AVOID)).digest,
        "seconds": 1.0,
    } | more


def start(seed: int) -> dict[str, Any]:
    facts = {"corruption": 0.0, "design": "none", "labels": 0, "success": 0.7, "alignment": 0.1}
    return row(avoid.PRETRAINED, seed, **facts)


@pytest.mark.parametrize(
    ("design", "corruption", "labels", "flipped"),
    [("product", 0.3, 400, 120), ("product", 0.0, 400, 0), ("sparse", 0.3, 60, 18)],
)
def test_labels_have_the_exact_share_of_flips(
    design: str, corruption: float, labels: int, flipped: int
):
    comparisons = avoid.label(design, corruption, np.random.default_rng(0))
    assert len(comparisons) == labels
    assert len({frozenset((c.first, c.second)) for c in comparisons}) == labels
    wrong = [(c.first if c.choice == "first" else c.second) >= avoid.WINNERS for c in comparisons]
    assert sum(wrong) == flipped


def test_plan_measures_the_start_once_a_seed():
    runs = avoid.plan([1, 2], ["product", "sparse"], [0.0, 0.3], avoid.METHODS, 200, None)
    assert len(runs) == 2 * (1 + 2 * 2 * 3)
    assert sum(run.method is None for run in runs) == 2
    assert len({run.key() for run in runs}) == len(runs)


@pytest.mark.parametrize(
    ("words", "methods"), [([], avoid.METHODS), (["--methods", "ipo", "cpo"], ("ipo", "cpo"))]
)
def test_further_baselines_run_on_request_only(words: list[str], methods: tuple[str, ...]):
    args = build_parser().parse_args(["bench", "avoid", "--json", "out.json", *words])
    assert tuple(args.methods) == methods


def test_run_refuses_illegal_values():
    with pytest.raises(UnknownNameError, match="'dense'.*'product', 'sparse'"):
        Run(1, "dense", 0.3, GUIDED, 200)
    with pytest.raises(ValueOutOfRangeError, match=r"corruption is 0.6.*\[0, 0.5\)"):
        Run(1, "product", 0.6, GUIDED, 200)
    with pytest.raises(ValueOutOfRangeError, match="seed is 300"):
        Run(300, "product", 0.3, GUIDED, 200)


def test_targets_hold_for_a_good_policy_and_are_missed_by_a_bad_one():
    good = [start(1), row(GUIDED, 1), start(2), row(GUIDED, 2)]
    assert avoid.shortfalls(good) == []
    low = avoid.shortfalls([start(1), row(GUIDED, 1, alignment=0.8)])
    assert low == ["product, 30% corruption: mean alignment 0.800 is below 0.9"]
    worse = row(GUIDED, 1, alignment_of_successes=0.4, success=0.6, off_support=0.04)
    found = avoid.shortfalls([start(1), worse])
    assert [text.rpartition(": ")[2][:12] for text in found] == [
        "the policy g",
        "success 0.60",
        "off-support ",
    ]


def test_other_methods_are_reported_but_not_judged():
    assert avoid.shortfalls([start(1), row(FinetuneMethod.RODIF, 1, alignment=0.1)]) == []


def test_finished_rows_are_not_made_again(tmp_path: Path):
    file = tmp_path / "out.json"
    rows = [start(1), row(GUIDED, 1)]
    bench.write_rows(file, rows)
    runs = [Run(1, "none", 0.0, None, 200), Run(1, "product", 0.3, GUIDED, 200)]
    assert bench.make_missing(runs, file, workers=1) == rows


@pytest.mark.slow
def test_missing_row_is_made_and_kept(tmp_path: Path):
    file = tmp_path / "out.json"
    runs = [Run(3, "none", 0.0, None, 6)]
    made = bench.make_missing(runs, file, workers=1)
    assert json.loads(file.read_text()) == made
    assert made[0]["n"] == 6
    assert set(made[0]) >= bench.FIELDS
    assert avoid.key_of_row(made[0]) == runs[0].key()


@pytest.mark.parametrize("content", ["{", "{}", '[{"method": "rodif"}]'])
def test_foreign_file_is_refused(content: str, tmp_path: Path):
    file = tmp_path / "out.json"
    file.write_text(content)
    with pytest.raises(RodifError, match="out.json is not a"):
        bench.read_rows(file)


def test_rows_of_another_checkpoint_are_refused(tmp_path: Path):
    file = tmp_path / "out.json"
    bench.write_rows(file, [row(GUIDED, 1, checkpoint="f" * 64)])
    with pytest.raises(RodifError, match="another checkpoint"):
        bench.make_missing([], file, workers=1)


def test_table_shows_every_seed_and_the_papers_row():
    from rich.console import Console

    shown = StringIO()
    rows = [row(FinetuneMethod.RODIF, 1, alignment=0.41), row(FinetuneMethod.RODIF, 2)]
    Console(width=200, file=shown).print(bench.seed_table(rows, [1, 2]))
    text = shown.getvalue()
    assert all(cell in text for cell in ("41 / 90 / 2.0", "95 / 90 / 2.0", "68 / 90 / 2.0"))
    assert "84 / 84" in text
