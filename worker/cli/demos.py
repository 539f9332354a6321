"""`rodif demos`: a set of demonstrations as one file, scripted or imported."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rodif_core.errors import LearningError, RodifError
from rodif_core.spec import TaskName, parse_name
from worker.cli.options import names, output_file

if TYPE_CHECKING:
    from rodif_core.trajectory import Trajectory

IMPORT = "import"
EPISODES = 100
SHOWN_REJECTIONS = 5  # files named after an import; the counts tell of all


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser(
        "demos",
        help="make a set of scripted demonstrations, or import D3IL's",
        usage="rodif demos TASK --out FILE [options]\n"
        "       rodif demos import TASK PATH [PATH …] --out FILE",
    )
    parser.add_argument("what", choices=[*names(TaskName), IMPORT], metavar="TASK|import")
    parser.add_argument(
        "paths", nargs="*", metavar="PATH", help="for import: the task, then files or folders"
    )
    parser.add_argument("--out", type=output_file, required=True, help="file to write (npz)")
    # No defaults here: an import refuses these, and must know whether they were given.
    parser.add_argument("--n", type=int, help=f"demonstrations (default {EPISODES})")
    parser.add_argument("--seed", type=int, help="(default 0)")
    parser.add_argument(
        "--preferred-share",
        type=float,
        help="share in the task's preferred group (default: the task's)",
    )


def run(args: argparse.Namespace) -> int:
    """Make or import them with a progress bar, write the file, say what is in it."""
    if args.what == IMPORT:
        for option in ("n", "seed", "preferred_share"):
            if getattr(args, option) is not None:
                raise RodifError(
                    f"--{option.replace('_', '-')} is for scripted demonstrations;"
                    " `rodif demos import` has no option but --out"
                )
        return _import(args.paths, args.out)
    episodes = EPISODES if args.n is None else args.n
    if args.paths:
        raise RodifError(
            f"unexpected {args.paths[0]!r}; files are only read by `rodif demos import TASK PATH`"
        )

    from rich.console import Console
    from rich.progress import Progress

    from rodif_core.demonstrations import make_demonstrations
    from rodif_core.tasks import get_task

    with Progress(console=Console(stderr=True), transient=True) as bar:
        row = bar.add_task("demonstrations", total=episodes)
        made = make_demonstrations(
            get_task(args.what),
            episodes=episodes,
            seed=args.seed or 0,
            preferred_share=args.preferred_share,
            progress=lambda done, _: bar.update(row, completed=done),
        )
    again = sum(one.info["attempt"] for one in made)
    _save(args.out, made, f"failures drawn again: {again}")
    return 0


def _import(arguments: Sequence[str], out: Path) -> int:
    if len(arguments) < 2:
        raise RodifError("name the task and its files: `rodif demos import TASK PATH … --out FILE`")
    name = parse_name(TaskName, arguments[0], "task")

    from rich.console import Console
    from rich.progress import Progress

    from rodif_core.d3il import episode_files, read_episode, replay
    from rodif_core.tasks import get_task

    files = episode_files([Path(path) for path in arguments[1:]])
    with Progress(console=Console(stderr=True), transient=True) as bar:
        reading = bar.track(files, description="reading")
        episodes = [read_episode(name, file) for file in reading]
        row = bar.add_task("replaying", total=len(episodes))
        made, rejected = replay(
            get_task(name), episodes, progress=lambda done, _: bar.update(row, completed=done)
        )
    reasons = Counter(one.reason.replace("_", " ") for one in rejected)
    told = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
    lines = [f"replayed: {len(made)} of {len(episodes)} succeed here"]
    if rejected:
        names = ", ".join(one.name for one in rejected[:SHOWN_REJECTIONS])
        more = " …" if len(rejected) > SHOWN_REJECTIONS else ""
        lines += [f"left out: {told}", f"  {names}{more}"]
    if not made:
        raise LearningError("no episode succeeds in this simulation. " + "; ".join(lines))
    _save(out, made, *lines)
    return 0


def _save(out: Path, made: Sequence[Trajectory], *lines: str) -> None:
    """Write the set and say what is in it."""
    from rodif_core.demonstrations import save_demonstrations

    out.parent.mkdir(parents=True, exist_ok=True)
    save_demonstrations(out, made)
    modes = Counter(one.outcome["mode"] for one in made)
    steps = sum(len(one.actions) for one in made) / len(made)
    print(f"{out}  {out.stat().st_size} bytes  {steps:.0f} control steps each")
    for line in lines:
        print(line)
    print("modes: " + ", ".join(f"{mode} {modes[mode]}" for mode in sorted(modes)))
