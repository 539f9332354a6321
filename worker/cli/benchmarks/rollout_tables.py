"""The benchmark of rollouts in a terminal: rates, and where the time goes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from worker.cli.benchmarks.rollouts import CORES, Row

if TYPE_CHECKING:
    from rich.table import Table


def _narrow_table(title: str) -> Table:
    """A table without rules between its columns, which there are many of."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    return Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))


def rates_table(rows: Sequence[Row]) -> Table:
    """Episodes and control steps per CPU second, one line a task."""
    table = _narrow_table("per CPU second")
    table.add_column("task", no_wrap=True)
    episodes = ("episodes\n1 core", "episodes\n2 cores")
    headings = ("policy", "n", *episodes, "steps\n1 core", "steps\n2 cores", "steps\nplain")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            row.task,
            row.policy,
            str(row.episodes),
            *(f"{row.episodes_per_s(cores):.1f}" for cores in CORES),
            *(f"{row.steps_per_s[cores]:.0f}" for cores in CORES),
            f"{row.plain_steps_per_s:.0f}",
        )
    table.caption = (
        "n episodes on each core; steps: control steps; plain: one simulation in a loop. random:"
        " no checkpoint is shipped, the CPU preset has fresh weights, so its episodes run to their"
        " ends and hardly touch anything"
    )
    return table


def parts_table(rows: Sequence[Row]) -> Table:
    """What is gained on the plain loop, and where one core's time goes, one line a task."""
    table = _narrow_table("times the plain loop; µs of CPU a control step")
    table.add_column("task", no_wrap=True)
    gains = ("gain\n1 core", "gain\n2 cores")
    headings = (*gains, "whole\nµs", "physics\nµs", "network\nµs", "rest\nµs", "whole/\nparts")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        parts = (row.batch_s, row.physics_s, row.network_s)
        rest = row.batch_s - row.physics_s - row.network_s
        table.add_row(
            row.task,
            *(f"{row.speedup(cores):.1f}" for cores in CORES),
            *(f"{1e6 * part / row.steps:.0f}" for part in (*parts, rest)),
            f"{row.overhead:.2f}",
        )
    table.caption = "physics and network: the same episodes' work alone; parts: their sum"
    return table
