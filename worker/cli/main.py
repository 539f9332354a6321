"""`rodif`: the command line. Heavy imports happen inside the commands, so that help is quick."""

from __future__ import annotations

import argparse
import os
import select
import sys
from collections.abc import Sequence

from rodif_core.errors import RodifError
from worker.cli import (
    bench,
    checkpoint,
    demo,
    demos,
    doctor,
    evaluate,
    migrate,
    plot,
    pretrain,
    rollout,
    round,
    simulate,
    tasks,
    up,
)

COMMANDS = {
    "up": up,
    "demo": demo,
    "simulate": simulate,
    "round": round,
    "tasks": tasks,
    "evaluate": evaluate,
    "rollout": rollout,
    "plot": plot,
    "demos": demos,
    "pretrain": pretrain,
    "checkpoint": checkpoint,
    "bench": bench,
    "doctor": doctor,
    "migrate": migrate,
}


def build_parser() -> argparse.ArgumentParser:
    """All commands with their options."""
    parser = argparse.ArgumentParser(
        prog="rodif",
        description="Steer a diffusion policy by looking at its behaviour and clicking.",
    )
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in COMMANDS.values():
        module.add_parser(subparsers)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; 0 when it did what was asked, 1 on an error or when nobody reads the output
    any more, 130 on Ctrl-C."""
    args = build_parser().parse_args(arguments)
    try:
        status: int = COMMANDS[args.command].run(args)
        sys.stdout.flush()  # a reader who has left shows here, not while the interpreter ends
        return status
    except RodifError as error:
        print(f"rodif {args.command}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        if not _reader_left():
            raise
        return 1
    except OSError as error:
        if error.filename is None:
            raise  # no file of the user's is in the way, so that a traceback tells more
        print(f"rodif {args.command}: {error.filename}: {error.strerror}", file=sys.stderr)
        return 1


def _reader_left() -> bool:
    """Whether it is the standard output that nobody reads, as after `| head`; it is then given up,
    or Python would complain of it once more at the end."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)  # errors and hang-ups are told unasked
    left = any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
    if left:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return left


if __name__ == "__main__":
    sys.exit(main())
