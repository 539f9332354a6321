"""`rodif tasks`: what can be rolled out, and in which modes."""

from __future__ import annotations

import argparse
import json
from typing import Any


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("tasks", help="list the robot tasks")
    parser.add_argument("--json", action="store_true", help="print JSON")


def facts() -> list[dict[str, Any]]:
    """One row a task, as JSON types."""
    from rodif_core.shipped import shipped_tasks
    from rodif_core.tasks import TASKS

    return [
        {
            "task": name.value,
            "observation_dim": task.observation_dim,
            "cameras": list(task.cameras),
            "proprioception_dim": task.proprioception_dim,
            "action_dim": task.action_dim,
            "action_limits": task.action_limits.tolist(),
            "control_dt": task.control_dt,
            "max_steps": task.max_steps,
            "objects": list(task.objects),
            "modes": list(task.modes),
            "groups": list(task.groups),
            "preferred_group": task.preferred_group,
            "criterion": task.criterion,
            "shipped_checkpoint": name in shipped_tasks(),
        }
        for name, task in TASKS.items()
    ]


def run(args: argparse.Namespace) -> int:
    """Print the table or the JSON."""
    rows = facts()
    if args.json:
        print(json.dumps(rows))
        return 0

    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        caption="obs and act: dims, cam: cameras beside them; limit: mm (of joints: mrad) per "
        "control step and axis; --json names the modes",
    )
    for heading in ("task", "obs", "act", "limit", "steps", "modes", "preferred", "shipped"):
        table.add_column(heading, no_wrap=True)
    for row in rows:
        table.add_row(
            row["task"],
            _observation(row),
            str(row["action_dim"]),
            # 12.5 for a rod; 60, 8 for seven joints and a gripper
            ", ".join(f"{1000 * limit:g}" for limit in dict.fromkeys(row["action_limits"])),
            str(row["max_steps"]),
            str(len(row["modes"])),
            row["preferred_group"],
            "yes" if row["shipped_checkpoint"] else "no",
        )
    Console().print(table)
    return 0


def _observation(row: dict[str, Any]) -> str:
    """Numbers that a policy is given, and the cameras that it looks through."""
    if not row["cameras"]:
        return str(row["observation_dim"])
    return f"{row['proprioception_dim']}, {len(row['cameras'])} cam"
