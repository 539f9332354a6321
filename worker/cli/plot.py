"""`rodif plot`: pictures of what a policy or a set of demonstrations does."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.spec import RolloutConfig
from worker.cli.evaluate import load_named, rolled_out
from worker.cli.options import output_file

if TYPE_CHECKING:
    from rodif_core.trajectory import Trajectory


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("plot", help="draw end-effector paths, coloured by mode")
    parser.add_argument("what", choices=["modes"])
    parser.add_argument(
        "source",
        help="a .safetensors file, a task: its shipped checkpoint, or a .npz file of `rodif demos`"
        " or `rodif rollout --out`",
    )
    parser.add_argument("--out", type=output_file, required=True, help="file to write (png)")
    parser.add_argument("--n", type=int, default=100, help="paths (default %(default)s)")
    parser.add_argument(
        "--seed", type=int, default=0, help="rollout i uses SEED + i (default %(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    """Roll out or read, draw, write."""
    if args.out.suffix.lower() != ".png":
        raise ValueOutOfRangeError("out", str(args.out), "a file name that ends in .png")
    config = RolloutConfig(episodes=args.n, seed=args.seed)

    from labeling_ui.mode_plot import mode_plot
    from rodif_core.tasks import get_task

    episodes = _episodes(args.source, config)
    task = get_task(str(episodes[0].info["task"]))
    origin = "the shipped policy" if args.source == task.name.value else Path(args.source).name
    title = f"{task.name.value}, {len(episodes)} paths of {origin}"
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_bytes(mode_plot(task, title, episodes))
    print(args.out)
    return 0


def _episodes(source: str, config: RolloutConfig) -> Sequence[Trajectory]:
    """The first demonstrations of a set, or rollouts of a checkpoint with a progress bar."""
    if source.endswith(".npz"):
        from rodif_core.demonstrations import load_demonstrations

        return load_demonstrations(Path(source))[: config.episodes]

    return rolled_out(load_named(source), config)
