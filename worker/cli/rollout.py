"""`rodif rollout`: run a policy, say how it did, and film it."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rodif_core.errors import CheckpointFileError, ValueOutOfRangeError
from rodif_core.spec import RolloutConfig, TaskName
from worker.cli.evaluate import load_named, rolled_out
from worker.cli.options import add_json_argument, give_json, names, output_file

MAP_DATA = ("paths", "path_groups")  # of an evaluation, for the site's maps; the film shows more

if TYPE_CHECKING:
    from rodif_core.policies.checkpoint import Checkpoint
    from rodif_core.trajectory import Trajectory


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("rollout", help="roll a policy out, and film it")
    parser.add_argument("task", choices=names(TaskName))
    parser.add_argument("--checkpoint", help="a .safetensors file (default: the shipped one)")
    parser.add_argument("--n", type=int, default=100, help="rollouts (default %(default)s)")
    parser.add_argument(
        "--seed", type=int, default=0, help="rollout i uses SEED + i (default %(default)s)"
    )
    parser.add_argument("--processes", type=int, default=1, help="cores used (default %(default)s)")
    parser.add_argument(
        "--video",
        type=output_file,
        help="film of the first rollouts (mp4; or webp, for pages)",
    )
    parser.add_argument(
        "--speed", type=int, default=1, help="of the film; 2: twice real time (default %(default)s)"
    )
    parser.add_argument(
        "--detailed", action="store_true", help="film the detailed arm, which takes much longer"
    )
    parser.add_argument(
        "--out",
        type=output_file,
        help="file of the episodes (npz), which `rodif plot modes` draws",
    )
    add_json_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Check the wishes, roll out, write what was asked for, print the table or the JSON."""
    config = RolloutConfig(episodes=args.n, seed=args.seed)
    if args.speed < 1:
        raise ValueOutOfRangeError("speed", args.speed, "at least 1")

    from labeling_ui.film import check_film_path
    from rodif_core.demonstrations import save_demonstrations
    from rodif_core.evaluate import summarise
    from rodif_core.tasks import get_task
    from rodif_core.tasks.camera import Camera

    if args.video is not None:
        check_film_path(args.video)
        # Told now and not after the rollouts.
        with Camera(get_task(args.task), 32, 24) as camera:
            camera.start()
    checkpoint = _checkpoint(TaskName(args.task), args.checkpoint)
    episodes = rolled_out(checkpoint, config, args.processes)
    report = summarise(checkpoint, episodes).to_json() | {
        "task": checkpoint.task.value,
        "checkpoint": checkpoint.digest,
        "seed": args.seed,
        "steps": _steps(episodes),
    }
    for path in (args.out, args.video):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
    if args.out is not None:
        save_demonstrations(args.out, episodes)
    if args.video is not None:
        _film(args, report, episodes)
    kept = {name: value for name, value in report.items() if name not in MAP_DATA}
    if not give_json(kept, args.json):
        _print(kept, [path for path in (args.out, args.video) if path is not None])
    return 0


def _checkpoint(task: TaskName, file: str | None) -> Checkpoint:
    """The named file, or the task's shipped checkpoint; raises CheckpointFileError."""
    checkpoint = load_named(task.value if file is None else file)
    if checkpoint.task is not task:
        raise CheckpointFileError(
            f"{file} is a checkpoint of task {checkpoint.task.value!r}, not of {task.value!r}"
        )
    return checkpoint


def _steps(episodes: Sequence[Trajectory]) -> dict[str, float]:
    """Control steps of the episodes: mean, fewest, most."""
    steps = [len(one.actions) for one in episodes]
    return {"mean": sum(steps) / len(steps), "least": min(steps), "most": max(steps)}


def _film(
    args: argparse.Namespace,
    report: dict[str, Any],
    episodes: Sequence[Trajectory],
) -> None:
    from rich.console import Console
    from rich.progress import Progress

    from labeling_ui.film import write_film
    from labeling_ui.mosaic import Mosaic
    from rodif_core.tasks import get_task

    low, high = (100 * value for value in report["intervals"]["success"])
    title = (
        f"{report['task']}  {report['checkpoint'][:12]}     {report['n']} rollouts from seed"
        f" {args.seed}     success {100 * report['success']:.1f} % ({low:.0f} to {high:.0f})"
    )
    mosaic = Mosaic(
        get_task(report["task"]),
        title if args.speed == 1 else f"{title}     {args.speed} x real time",
        episodes,
        stride=args.speed,
        mesh="viz" if args.detailed else "col",
    )
    with Progress(console=Console(stderr=True), transient=True) as bar:
        row = bar.add_task("film", total=mosaic.frame_count)

        def counted() -> Iterator[Any]:
            for frame in mosaic.frames():
                yield frame
                bar.advance(row)

        write_film(args.video, counted(), mosaic.frame_ms)


def _print(report: dict[str, Any], files: Sequence[Path]) -> None:
    from rich.console import Console
    from rich.table import Table

    from worker.cli.tables import evaluation_table, percent

    console = Console()
    n, steps = report["n"], report["steps"]
    title = f"{report['task']}, seeds {report['seed']} … {report['seed'] + n - 1}"
    console.print(evaluation_table(title, [(report["checkpoint"][:12], report)]))
    table = Table()
    for heading in ("mode", "rollouts", "share"):
        table.add_column(heading, justify="left" if heading == "mode" else "right")
    for mode, count in sorted(report["modes"].items(), key=lambda item: -item[1]):
        table.add_row(mode, str(count), percent(count / n))
    for reason, count in report["reasons"].items():
        if reason != "finished":
            table.add_row(f"[dim]{reason.replace('_', ' ')}", str(count), percent(count / n))
    console.print(table)
    console.print(
        f"control steps: {steps['mean']:.0f} on average, {steps['least']} to {steps['most']}"
    )
    for file in files:
        console.print(f"{file}  {file.stat().st_size} bytes", soft_wrap=True, highlight=False)
