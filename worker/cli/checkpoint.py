"""`rodif checkpoint`: policies into the system and out of it, as files."""

from __future__ import annotations

import argparse
import dataclasses
import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from server.settings import Settings
from worker.cli.options import add_json_argument, give_json

if TYPE_CHECKING:
    from worker.registry import Registered


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("checkpoint", help="bring a trained policy into the system")
    kinds = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    add = kinds.add_parser("add", help="make a checkpoint file a policy that campaigns start from")
    add.add_argument("file", type=Path, help="a .safetensors file, as `rodif pretrain` writes it")
    add.add_argument("--name", help="what to call it (default: the file's name and its digest)")
    add.add_argument("--state", type=Path, help="folder of the system's data (default: .rodif)")
    add_json_argument(add)


def run(args: argparse.Namespace) -> int:
    """Register the file in the database, and say how a campaign starts from it."""
    from worker.registry import add_checkpoint

    given: dict[str, Any] = {} if args.state is None else {"state_dir": args.state}
    settings = Settings(**given)
    found = add_checkpoint(settings, args.file, args.name)
    if not give_json(dataclasses.asdict(found), args.json):
        print(_told(found, settings))
    return 0


def _told(found: Registered, settings: Settings) -> str:
    state = "added" if found.added else "is there already"
    body = {"name": found.name, "task": found.task, "start_checkpoint_id": found.id}
    return (
        f"checkpoint {found.id}, {found.name!r} of task {found.task!r}, {state}"
        f" (digest {found.digest})\n"
        "Start a campaign from it: New campaign on the site, Policy to start from; or\n"
        'curl -H "Authorization: Bearer $T" -H "Content-Type: application/json" \\\n'
        f"     -d {shlex.quote(json.dumps(body))} http://{settings.host}:{settings.port}/api/v1/campaigns"
    )
