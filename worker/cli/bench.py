"""`rodif bench`: the fine-tuners on fresh seeds (`avoid`), and how quick rollouts are (`rollouts`).

The fine-tuners' JSON file is a list of rows and grows by one as each run ends; a second call with
the same file makes only what is missing.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rodif_core.errors import RodifError
from rodif_core.spec import FinetuneMethod, TaskName
from worker.cli.benchmarks import avoid, rollouts
from worker.cli.benchmarks.rollout_tables import parts_table, rates_table
from worker.cli.options import names, number_list, output_file
from worker.parallel import pool_of

if TYPE_CHECKING:
    from rich.table import Table

Row = Mapping[str, Any]
FIELDS = {
    *("method", "corruption", "labels", "design", "seed", "updates", "checkpoint"),
    *("success", "alignment", "alignment_of_successes", "off_support", "n"),
}


def read_rows(path: Path) -> list[Row]:
    """Rows of an earlier call, [] when there is no file; raises RodifError for anything else."""
    if not path.exists():
        return []
    try:
        rows = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise RodifError(f"{path} is not a benchmark's JSON file: {error}") from error
    if not isinstance(rows, list) or not all(
        isinstance(row, dict) and row.keys() >= FIELDS for row in rows
    ):
        raise RodifError(f"{path} is not a list of benchmark rows with {', '.join(sorted(FIELDS))}")
    return rows


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Replace the file at once: a killed benchmark leaves whole rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    lines = ",\n".join(json.dumps(row) for row in rows)
    part.write_text(f"[\n{lines}\n]\n")
    part.replace(path)


def make_missing(runs: Sequence[avoid.Run], path: Path, workers: int) -> list[Row]:
    """Make the rows that the file lacks, in `workers` processes; the rows of `runs`, in order."""
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from rodif_core.policies.checkpoint import load_checkpoint
    from rodif_core.shipped import shipped_checkpoint

    rows = read_rows(path)
    digest = load_checkpoint(shipped_checkpoint(TaskName.AVOID)).digest
    if any(row["checkpoint"] != digest for row in rows):
        raise RodifError(
            f"{path} has rows of another checkpoint than the shipped {digest[:12]};"
            " choose another file"
        )
    done = {avoid.key_of_row(row) for row in rows}
    missing = [run for run in runs if run.key() not in done]
    columns = (TextColumn("{task.description}"), MofNCompleteColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with (
        Progress(*columns, console=console) as bar,
        pool_of(workers) as pool,
    ):
        task = bar.add_task("runs", total=len(missing))
        futures = [pool.submit(avoid.execute, run) for run in missing]
        try:
            for future in as_completed(futures):
                rows.append(future.result())
                write_rows(path, rows)
                bar.advance(task)
                console.print(_line(rows[-1]))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    by_key = {avoid.key_of_row(row): row for row in rows}
    return [by_key[run.key()] for run in runs]


def _line(row: Row) -> str:
    return (
        f"{row['method']} {row['design']} {row['corruption']:.0%} seed {row['seed']}:"
        f" alignment {row['alignment']:.3f} success {row['success']:.3f}"
        f" off-support {row['off_support']:.4f} ({row['seconds']:.0f} s)"
    )


def seed_table(rows: Sequence[Row], seeds: Sequence[int]) -> Table:
    """One line a method, design and corruption; every seed in a column, then the mean."""
    from rich.table import Table

    table = Table(
        title="alignment / success / off-support, in per cent of n rollouts", title_justify="left"
    )
    for heading in ("design", "corruption", "method", "labels"):
        table.add_column(heading)
    for seed in seeds:
        table.add_column(f"seed {seed}", justify="right")
    table.add_column("mean", justify="right")
    cells: dict[tuple[Any, ...], dict[int, Row]] = {}
    for row in rows:
        cell = (row["design"], row["corruption"], row["method"], row["labels"])
        cells.setdefault(cell, {})[row["seed"]] = row
    for (design, corruption, method, labels), by_seed in cells.items():
        measured = [_numbers(by_seed[seed]) for seed in seeds if seed in by_seed]
        mean = tuple(sum(column) / len(measured) for column in zip(*measured, strict=True))
        table.add_row(
            design,
            f"{corruption:.0%}",
            method,
            str(labels),
            *(_cell(_numbers(by_seed[seed])) if seed in by_seed else "–" for seed in seeds),
            _cell(mean),
        )
        if method == FinetuneMethod.RODIF and design == "product":
            paper = avoid.PAPER_ROW.get(corruption)
            if paper is not None:
                note = f"{paper} / {paper} / –"
                table.add_row("", "", "RoDiF in the paper", "400", *[""] * len(seeds), note)
    return table


def _numbers(row: Row) -> tuple[float, float, float]:
    return (row["alignment"], row["success"], row["off_support"])


def _cell(numbers: tuple[float, ...]) -> str:
    alignment, success, off_support = (100 * number for number in numbers)
    return f"{alignment:.0f} / {success:.0f} / {off_support:.1f}"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("bench", help="compare the fine-tuners; time rollouts")
    kinds = parser.add_subparsers(dest="what", required=True)
    fine = kinds.add_parser(TaskName.AVOID.value, help="the fine-tuners on fresh seeds")
    fine.add_argument(
        "--json", type=output_file, required=True, help="file of rows; kept and completed"
    )
    fine.add_argument(
        "--seeds",
        type=number_list,
        default=number_list("100-104"),
        help="like 100-104 or 3,5,7 (default 100-104)",
    )
    fine.add_argument(
        "--corruption",
        type=float,
        nargs="+",
        default=[0.0, 0.2, 0.3, 0.4],
        help="shares of flipped labels (default 0 0.2 0.3 0.4)",
    )
    fine.add_argument("--designs", nargs="+", choices=avoid.DESIGNS, default=list(avoid.DESIGNS))
    fine.add_argument(
        "--methods",
        nargs="+",
        choices=names(FinetuneMethod),
        default=[method.value for method in avoid.METHODS],
        help=f"(default {' '.join(avoid.METHODS)})",
    )
    fine.add_argument("--n", type=int, default=200, help="rollouts a row (default %(default)s)")
    fine.add_argument("--updates", type=int, help="full-batch updates of the literal methods")
    fine.add_argument("--workers", type=int, default=2, help="processes (default %(default)s)")
    timing = kinds.add_parser("rollouts", help="how quick rollouts are")
    timing.add_argument("--json", type=output_file, help="file of rows to write")
    timing.add_argument(
        "--tasks",
        nargs="+",
        choices=names(TaskName),
        metavar="TASK",
        help="(default: all that are not seen through cameras)",
    )
    timing.add_argument(
        "--episodes", type=int, default=128, help="of each core (default %(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    """Compare or time; 1 when a target is missed."""
    if args.what == "rollouts":
        return _time_rollouts(args.tasks, args.episodes, args.json)

    from rich.console import Console

    methods = [FinetuneMethod(name) for name in args.methods]
    runs = avoid.plan(args.seeds, args.designs, args.corruption, methods, args.n, args.updates)
    rows = make_missing(runs, args.json, args.workers)
    console = Console()
    console.print(seed_table(rows, args.seeds))
    missed = avoid.shortfalls(rows)
    for sentence in missed:
        console.print(f"missed: {sentence}")
    if not missed and FinetuneMethod.RODIF_GUIDED in methods:
        console.print(f"{FinetuneMethod.RODIF_GUIDED} holds all targets that were run")
    return 1 if missed else 0


def _time_rollouts(names: Sequence[str] | None, episodes: int, file: Path | None) -> int:
    import torch
    from rich.console import Console
    from rich.progress import Progress

    tasks = rollouts.legal_tasks(names)
    torch.set_num_threads(1)
    rows = []
    with (
        Progress(console=Console(stderr=True), transient=True) as bar,
        pool_of(max(rollouts.CORES)) as pool,
    ):
        for task in bar.track(tasks, description="tasks"):
            rows.append(rollouts.measure(task, episodes, pool))
    if file is not None:
        write_rows(file, [row.to_json() for row in rows])
    console = Console()
    console.print(rates_table(rows))
    console.print(parts_table(rows))
    missed = rollouts.shortfalls(rows)
    for sentence in missed:
        console.print(f"missed: {sentence}", soft_wrap=True)
    return 1 if missed else 0
