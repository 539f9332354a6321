"""`rodif pretrain`: scripted demonstrations, then imitation; writes one checkpoint file."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.spec import RolloutConfig, TaskName

PRESET_NAMES = ("cpu", "paper")  # rodif_core.pretrain.PRESETS, not imported for the help's sake


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("pretrain", help="train a policy on scripted demonstrations")
    parser.add_argument("task", choices=list(TaskName))
    parser.add_argument("--out", type=Path, required=True, help="checkpoint file to write")
    parser.add_argument("--preset", choices=PRESET_NAMES, default="cpu")
    parser.add_argument("--demonstrations", type=int, default=2000)
    parser.add_argument(
        "--preferred-share",
        "--left-share",
        type=float,
        help="share of demonstrations in the preferred group, for avoid: on the left"
        " (default: the task's)",
    )
    parser.add_argument("--updates", type=int, help="default: the preset's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default %(default)s)")
    parser.add_argument(
        "--workspace", type=Path, help="keeps partial state; a broken run goes on from there"
    )
    parser.add_argument(
        "--evaluate", type=int, default=500, help="rollouts of the final measurement, 0 for none"
    )


def run(args: argparse.Namespace) -> int:
    """Demonstrate, train, measure, write."""
    if args.evaluate < 0:
        raise ValueOutOfRangeError("evaluate", args.evaluate, "at least 0")

    from rich.console import Console
    from rich.progress import Progress

    from rodif_core.demonstrations import make_demonstrations
    from rodif_core.evaluate import evaluate
    from rodif_core.policies.checkpoint import save_checkpoint
    from rodif_core.pretrain import PRESETS, pretrain
    from rodif_core.tasks import get_task
    from worker.cli.tables import evaluation_table

    config = replace(PRESETS[args.preset], seed=args.seed)
    if args.updates is not None:
        config = replace(config, updates=args.updates)
    if args.workspace is not None:
        args.workspace.mkdir(parents=True, exist_ok=True)
    task_name = TaskName(args.task)
    console = Console(stderr=True)
    with Progress(console=console) as bar:
        making = bar.add_task("demonstrations", total=args.demonstrations)
        demonstrations = make_demonstrations(
            get_task(task_name),
            episodes=args.demonstrations,
            seed=args.seed,
            preferred_share=args.preferred_share,
            progress=lambda done, _: bar.update(making, completed=done),
        )
        training = bar.add_task("training", total=config.updates)

        def show(done: int, _: int, metrics: dict[str, float]) -> None:
            losses = ", ".join(f"{name} {value:.4f}" for name, value in metrics.items())
            bar.update(training, completed=done, description=f"training ({losses})")

        checkpoint = pretrain(
            task_name,
            demonstrations,
            config,
            workspace=args.workspace,
            device=args.device,
            progress=show,
        )
        if args.evaluate:
            rolling = bar.add_task("rollouts", total=args.evaluate)
            measured = evaluate(
                checkpoint,
                RolloutConfig(episodes=args.evaluate),
                progress=lambda done, _: bar.update(rolling, completed=done),
            ).to_json()
            kept = {k: v for k, v in measured.items() if k not in ("paths", "path_groups")}
            checkpoint = replace(checkpoint, card=checkpoint.card | {"evaluation": kept})
            console.print(evaluation_table(f"{task_name.value}, seed 0 on", [("new", measured)]))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_bytes(save_checkpoint(checkpoint))
    print(f"{args.out}  {args.out.stat().st_size} bytes  digest {checkpoint.digest}")
    return 0
