"""Tables that several commands print: one row an evaluated policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table


def percent(value: float) -> str:
    """A rate in 0–1 as per cent."""
    return f"{100 * value:.1f} %"


def with_interval(evaluation: Mapping[str, Any], name: str) -> str:
    """A rate and below it its 95 % interval, if the evaluation has one.

    Side by side they are too wide for a terminal of 80 columns, which would break some of them.
    """
    interval = evaluation.get("intervals", {}).get(name)
    text = percent(evaluation[name])
    if interval is None:
        return text
    return f"{text}\n[{100 * interval[0]:.0f}–{100 * interval[1]:.0f}]"


def evaluation_table(title: str, rows: Sequence[tuple[str, Mapping[str, Any]]]) -> Table:
    """Success, alignment and drift of named evaluations (`Evaluation.to_json`)."""
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    table.add_column("policy", no_wrap=True)
    for heading in ("success", "alignment", "of successes", "off support", "n"):
        table.add_column(heading, justify="right")
    for name, evaluation in rows:
        table.add_row(
            name,
            with_interval(evaluation, "success"),
            with_interval(evaluation, "alignment"),
            with_interval(evaluation, "alignment_of_successes"),
            percent(evaluation["off_support"]),
            str(evaluation["n"]),
        )
    table.caption = "[..] 95 % Wilson interval; alignment counts all rollouts"
    return table
