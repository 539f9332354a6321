"""`rodif pretrain`: demonstrations, scripted or from a file, then imitation; writes one checkpoint
file."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rodif_core.errors import RodifError, ValueOutOfRangeError
from rodif_core.spec import RolloutConfig, TaskName
from worker.cli.options import names, output_file, output_folder
from worker.cli.takeovers import round_folder, take_over

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from rodif_core.policies.checkpoint import Checkpoint
    from rodif_core.presets import PretrainConfig
    from rodif_core.tasks import Task
    from rodif_core.training_state import UpdateProgress
    from rodif_core.trajectory import Trajectory

PRESET_NAMES = ("cpu", "paper")  # of rodif_core.presets, which the help does not load
# Fields of a preset that an argument changes.
OF_PRESETS = (
    *("updates", "executed_steps", "rounds", "recoveries", "drives", "steered_drives"),
    "round_updates",
)
PRECISIONS = ("float32", "bfloat16")  # of rodif_core.training_state
DEMONSTRATIONS = 2000  # scripted ones, unless said


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("pretrain", help="train a policy on demonstrations")
    parser.add_argument("task", choices=names(TaskName))
    parser.add_argument("--out", type=output_file, required=True, help="checkpoint file to write")
    parser.add_argument("--preset", choices=PRESET_NAMES, default="cpu")
    _add_demonstration_arguments(parser)
    parser.add_argument("--updates", type=int, help="from fresh weights (default: the preset's)")
    parser.add_argument(
        "--executed-steps", type=int, help="control steps between two decisions (default: preset's)"
    )
    _add_round_arguments(parser)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--processes", type=int, default=1, help="cores for rollouts (default %(default)s)"
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default %(default)s)")
    parser.add_argument(
        "--precision",
        choices=PRECISIONS,
        help="of the forward passes; bfloat16 is mixed precision (default: that on a GPU)",
    )
    parser.add_argument(
        "--workspace",
        type=output_folder,
        help="keeps partial state; a broken run goes on from there",
    )
    parser.add_argument(
        "--track",
        type=int,
        default=50,
        help="rollouts after each of the first four fifths of a training, which tell how far it"
        " is; 0 for none (default %(default)s)",
    )
    parser.add_argument(
        "--evaluate", type=int, default=500, help="rollouts of the final measurement, 0 for none"
    )


def _add_round_arguments(parser: argparse.ArgumentParser) -> None:
    """What follows the first training, or takes its place."""
    parser.add_argument(
        "--rounds",
        type=int,
        help="after the first training, let the expert take over from the policy, and train on"
        " that too, so many times (default: the preset's)",
    )
    parser.add_argument(
        "--recoveries", type=int, help="takeovers tried a round (default: the preset's)"
    )
    parser.add_argument(
        "--drives",
        type=int,
        help="rollouts for each takeover; from 2 on, as many takeovers from the failures as from"
        " the successes of each group (default: the preset's)",
    )
    parser.add_argument(
        "--steered-drives",
        type=int,
        help="further rollouts for each takeover, by copies of the policy that each go the way"
        " of a group it rarely goes (default: the preset's)",
    )
    parser.add_argument("--round-updates", type=int, help="of a round (default: the preset's)")
    parser.add_argument(
        "--begin-with",
        type=Path,
        metavar="FILE",
        help="no first training: go on from this checkpoint, with --rounds (and, where the preset"
        " gives eyes to a policy of another task, its looks)",
    )


def _add_demonstration_arguments(parser: argparse.ArgumentParser) -> None:
    """What is shown: a set from a file, or scripted demonstrations made now."""
    parser.add_argument(
        "--demos",
        type=Path,
        metavar="FILE",
        help="a set of `rodif demos` or `rodif demos import`, in place of scripted demonstrations;"
        " rounds only where --rounds asks for them",
    )
    # No defaults here: they do not go together with --demos, so we must know who was given.
    parser.add_argument(
        "--demonstrations", type=int, help=f"how many scripted ones (default {DEMONSTRATIONS})"
    )
    parser.add_argument(
        "--preferred-share",
        "--left-share",
        type=float,
        help="share of demonstrations in the preferred group, for avoid: on the left"
        " (default: the task's)",
    )


def run(args: argparse.Namespace) -> int:
    """Demonstrate or read, train, let the expert take over and train again, measure, write."""
    for name in ("evaluate", "track"):
        if getattr(args, name) < 0:
            raise ValueOutOfRangeError(name, getattr(args, name), "at least 0")
    if args.processes < 1:
        raise ValueOutOfRangeError("processes", args.processes, "at least 1")

    from rich.console import Console
    from rich.progress import Progress

    from rodif_core.policies.checkpoint import save_checkpoint
    from rodif_core.presets import preset_for

    task_name = TaskName(args.task)
    wishes = {name: getattr(args, name) for name in OF_PRESETS}
    given = {name: value for name, value in wishes.items() if value is not None}
    config = replace(preset_for(task_name, args.preset), seed=args.seed, **given)
    if args.demos is not None:
        config = _for_a_set(args, config)
    console = Console(stderr=True)
    with Progress(console=console) as bar:
        checkpoint = _train(args, config, bar)
        if args.evaluate:
            checkpoint = _measure(checkpoint, args.evaluate, args.processes, bar)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_bytes(save_checkpoint(checkpoint))
    print(f"{args.out}  {args.out.stat().st_size} bytes  digest {checkpoint.digest}")
    return 0


def _for_a_set(args: argparse.Namespace, config: PretrainConfig) -> PretrainConfig:
    """The configuration for demonstrations out of a file.

    In rounds scripted experts take over from the policy, so they are left out unless asked for.
    Raises RodifError for arguments that are about scripted demonstrations, and for a preset that
    begins with a policy which has learned from those.
    """
    for name in ("demonstrations", "preferred_share"):
        if getattr(args, name) is not None:
            raise RodifError(
                f"--{name.replace('_', '-')} is for scripted demonstrations, and --demos takes all"
                f" of {args.demos}; give one or the other"
            )
    if config.begin_with is not None and args.begin_with is None:
        raise RodifError(
            f"preset {args.preset!r} of task {args.task!r} begins with the shipped policy of"
            f" {config.begin_with.value!r}, which learned from scripted demonstrations, so --demos"
            f" cannot decide what it does; legal are --preset paper, which begins with fresh"
            f" weights, --begin-with a policy of your own, or task {config.begin_with.value!r}"
            f" with a set of its own"
        )
    return config if args.rounds is not None else replace(config, rounds=0)


def _first_shown(
    args: argparse.Namespace, task: Task, bar: Progress
) -> tuple[list[Trajectory], dict[str, Any]]:
    """Demonstrations for the first training, and what the card tells of where they come from."""
    from rodif_core.demonstration_set import read_set
    from rodif_core.demonstrations import make_demonstrations

    if args.demos is not None:
        shown, told = read_set(task, args.demos)
        sources = ", ".join(f"{source} {count}" for source, count in told["sources"].items())
        said = f"{args.demos}: {len(shown)} demonstrations ({sources})"
        bar.console.print(said, markup=False, highlight=False, soft_wrap=True)
        return shown, {"demonstration_set": told}
    episodes = DEMONSTRATIONS if args.demonstrations is None else args.demonstrations
    making = bar.add_task("demonstrations", total=episodes)
    shown = make_demonstrations(
        task,
        episodes=episodes,
        seed=args.seed,
        preferred_share=args.preferred_share,
        progress=lambda done, _: bar.update(making, completed=done),
    )
    return shown, {}


def _begin(args: argparse.Namespace, config: PretrainConfig) -> Checkpoint | None:
    """The policy to go on from: of a file, the shipped one that the preset names, or none.

    Raises RodifError for a file that cannot be read or is of a task that this one cannot begin
    with, and where nothing would follow.
    """
    from rodif_core.fit import check_fit
    from rodif_core.policies.checkpoint import load_checkpoint
    from rodif_core.shipped import shipped_checkpoint
    from worker.cli.evaluate import load_named

    if args.begin_with is None:
        named = config.begin_with
        return None if named is None else load_checkpoint(shipped_checkpoint(named))
    start = load_named(str(args.begin_with))
    check_fit(start)
    legal = [TaskName(args.task), *([config.begin_with] if config.begin_with else [])]
    if start.task not in legal:
        names = " or ".join(repr(name.value) for name in legal)
        raise RodifError(
            f"--begin-with {args.begin_with} is a policy of task {start.task.value!r}, but must be"
            f" of {names}"
        )
    if config.looks + config.rounds < 1:
        raise RodifError(f"--begin-with {args.begin_with} with 0 rounds trains nothing; legal: 1 …")
    return start


def _train(args: argparse.Namespace, config: PretrainConfig, bar: Progress) -> Checkpoint:
    """The first training and the rounds after it, each on all that experts have shown so far."""
    from rodif_core.pretrain import pretrain
    from rodif_core.tasks import get_task
    from rodif_core.training_state import Precision, check_device

    check_device(args.device)
    config.policy_config(get_task(args.task))  # a shape that cannot be is told before the work
    checkpoint = start = _begin(args, config)
    shown, told = _first_shown(args, get_task(args.task), bar)
    shown_first = len(shown)
    driven: list[Trajectory] = []
    on_the_way: list[float] = []  # success of the policies that experts took over from
    first = 1 if checkpoint is None else 0  # a first training, which no rollouts precede
    for number in range(first + config.looks + config.rounds):
        if checkpoint is not None:
            met, recoveries = take_over(args, config, checkpoint, number)
            shown += recoveries
            # Only encoders learn from it, and thousands of rollouts take gigabytes.
            driven += met if config.images is not None else []
            succeeded = sum(one.success for one in met) / len(met)
            bar.console.print(f"before round {number}: success {succeeded:.1%}")
            # The policy begun with may be another task's, which is told the state.
            on_the_way += [succeeded] if checkpoint.task == args.task else []
        updates = config.updates if checkpoint is None else config.round_updates
        training = bar.add_task(f"training {number}", total=updates)
        checkpoint = pretrain(
            TaskName(args.task),
            shown,
            config,
            start=checkpoint,
            driven=driven,
            only_encoder=number < config.looks,
            workspace=round_folder(args.workspace, number),
            kept_rows=args.workspace and args.workspace / "rows",
            device=args.device,
            precision=Precision(args.precision) if args.precision else None,
            track=args.track,
            progress=_showing(bar, training, args.track),
        )
        bar.update(training, total=updates, completed=updates)  # also one that was done before
    assert checkpoint is not None
    facts = {
        "rounds": config.rounds,
        "recoveries": len(shown) - shown_first,
        "success_before_rounds": on_the_way,
        **told,
    }
    if start is not None and args.begin_with is not None:
        facts["began_with"] = _origin(start)
    return replace(checkpoint, card=checkpoint.card | facts)


def _origin(start: Checkpoint) -> dict[str, Any]:
    """How a policy was made that a training goes on from: no shipped file may tell of it."""
    names = ("preset", "demonstrations", "rounds", "recoveries", "demonstration_set", "began_with")
    kept = {name: start.card[name] for name in names if name in start.card}
    return {"task": start.task.value, "digest": start.digest, **kept}


def _showing(bar: Progress, row: TaskID, tracked: int) -> UpdateProgress:
    """Shows a training's progress in a row of the bar, and above it what rollouts say."""

    def show(done: int, of: int, metrics: dict[str, float]) -> None:
        if "success" in metrics:
            told = f"success {metrics['success']:.1%} (n = {tracked})"
            bar.console.print(f"after {done:,} of {of:,} updates: {told}")
            return
        losses = ", ".join(f"{k} {value:.4f}" for k, value in metrics.items() if k != "update")
        # The encoder of a task with cameras trains first, and has a length of its own.
        bar.update(row, completed=done, total=of, description=f"training ({losses})")

    return show


def _measure(checkpoint: Checkpoint, episodes: int, processes: int, bar: Progress) -> Checkpoint:
    """The same checkpoint with a measurement on its card."""
    from rodif_core.evaluate import summarise
    from worker.cli.tables import evaluation_table
    from worker.parallel import parallel_rollout

    rolling = bar.add_task("rollouts", total=episodes)
    rollouts = parallel_rollout(
        checkpoint,
        RolloutConfig(episodes=episodes),
        processes,
        progress=lambda done, _: bar.update(rolling, completed=done),
    )
    measured = summarise(checkpoint, rollouts).to_json()
    kept = {k: v for k, v in measured.items() if k not in ("paths", "path_groups")}
    table = evaluation_table(f"{checkpoint.task.value}, seed 0 on", [("new", measured)])
    bar.console.print(table)
    return replace(checkpoint, card=checkpoint.card | {"evaluation": kept})
