"""`rodif demos`: a set of scripted demonstrations as one file."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from rodif_core.spec import TaskName


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("demos", help="make a set of scripted demonstrations")
    parser.add_argument("task", choices=list(TaskName))
    parser.add_argument("--out", type=Path, required=True, help="file to write (npz)")
    parser.add_argument("--n", type=int, default=100, help="demonstrations (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--preferred-share",
        type=float,
        help="share in the task's preferred group (default: the task's)",
    )


def run(args: argparse.Namespace) -> int:
    """Make them with a progress bar, write the file, say what is in it."""
    from rich.console import Console
    from rich.progress import Progress

    from rodif_core.demonstrations import make_demonstrations, save_demonstrations
    from rodif_core.tasks import get_task

    with Progress(console=Console(stderr=True), transient=True) as bar:
        row = bar.add_task("demonstrations", total=args.n)
        made = make_demonstrations(
            get_task(args.task),
            episodes=args.n,
            seed=args.seed,
            preferred_share=args.preferred_share,
            progress=lambda done, _: bar.update(row, completed=done),
        )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    save_demonstrations(args.out, made)
    modes = Counter(one.outcome["mode"] for one in made)
    again = sum(one.info["attempt"] for one in made)
    steps = sum(len(one.actions) for one in made) / len(made)
    print(f"{args.out}  {args.out.stat().st_size} bytes  {steps:.0f} control steps each")
    print(f"failures drawn again: {again}")
    print("modes: " + ", ".join(f"{mode} {modes[mode]}" for mode in sorted(modes)))
    return 0
