"""`rodif evaluate`: seeded rollouts of a checkpoint; success, alignment and drift."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rodif_core.errors import CheckpointFileError
from rodif_core.shipped import shipped_checkpoint, shipped_tasks
from rodif_core.spec import RolloutConfig, TaskName
from worker.cli.options import add_json_argument, give_json

if TYPE_CHECKING:
    from rodif_core.policies.checkpoint import Checkpoint
    from rodif_core.trajectory import Trajectory


def read_checkpoint(name: str) -> bytes:
    """A task's shipped checkpoint by the task's name, or a file.

    Raises CheckpointFileError when it is neither.
    """
    if name in list(TaskName):
        return shipped_checkpoint(TaskName(name))
    try:
        return Path(name).read_bytes()
    except OSError as error:
        tasks = ", ".join(repr(task.value) for task in shipped_tasks())
        raise CheckpointFileError(
            f"{name!r} is neither a readable file ({error.strerror}) nor a task with a shipped"
            f" checkpoint: {tasks}"
        ) from error


def load_named(name: str) -> Checkpoint:
    """The policy of `read_checkpoint`; raises CheckpointFileError that begins with its name."""
    from rodif_core.policies.checkpoint import load_checkpoint

    data = read_checkpoint(name)
    try:
        return load_checkpoint(data)
    except CheckpointFileError as error:
        raise CheckpointFileError(f"{name}: {error}") from error


def rolled_out(
    checkpoint: Checkpoint, config: RolloutConfig, processes: int = 1
) -> list[Trajectory]:
    """Rollouts, with a progress bar beside what is printed."""
    from rich.console import Console
    from rich.progress import Progress

    from worker.parallel import parallel_rollout

    with Progress(console=Console(stderr=True), transient=True) as bar:
        row = bar.add_task("rollouts", total=config.episodes)
        return parallel_rollout(
            checkpoint,
            config,
            processes,
            progress=lambda done, _: bar.update(row, completed=done),
        )


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("evaluate", help="roll a checkpoint out and sum up")
    parser.add_argument("checkpoint", help="a .safetensors file, or a task: its shipped checkpoint")
    parser.add_argument("--n", type=int, default=200, help="rollouts (default %(default)s)")
    parser.add_argument(
        "--seed", type=int, default=0, help="rollout i uses SEED + i (default %(default)s)"
    )
    parser.add_argument("--processes", type=int, default=1, help="cores used (default %(default)s)")
    add_json_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Roll out with a progress bar, then print the table or the JSON."""
    config = RolloutConfig(episodes=args.n, seed=args.seed)

    from rich.console import Console

    from rodif_core.evaluate import summarise
    from worker.cli.tables import evaluation_table

    checkpoint = load_named(args.checkpoint)
    result = summarise(checkpoint, rolled_out(checkpoint, config, args.processes)).to_json()
    facts = {"task": checkpoint.task.value, "checkpoint": checkpoint.digest, "seed": args.seed}
    if give_json(result | facts, args.json):
        return 0
    console = Console()
    title = f"{checkpoint.task.value}, seeds {args.seed} … {args.seed + args.n - 1}"
    console.print(evaluation_table(title, [(checkpoint.digest[:12], result)]))
    for kind in ("groups", "modes", "reasons"):
        counts = sorted(result[kind].items(), key=lambda item: -item[1])
        told = ", ".join(f"{count} × {name.replace('_', ' ')}" for name, count in counts)
        console.print(f"{kind}: {told or '–'}", highlight=False)
    return 0
