"""`rodif checkpoint`: policies into the system and out of it, as files."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rodif_core.errors import CheckpointFileError, RodifError
from worker.cli.options import (
    add_connection_arguments,
    add_json_argument,
    connect,
    give_json,
    output_file,
    read_settings,
)

if TYPE_CHECKING:
    from server.settings import Settings
    from worker.registry import Registered


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser(
        "checkpoint", help="bring a policy into the system, or take one out"
    )
    kinds = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    add = kinds.add_parser("add", help="make a checkpoint file a policy that campaigns start from")
    add.add_argument("file", type=Path, help="a .safetensors file, as `rodif pretrain` writes it")
    add.add_argument("--name", help="what to call it (default: the file's name and its digest)")
    add.add_argument("--state", type=Path, help="folder of the system's data (default: .rodif)")
    add_json_argument(add)
    get = kinds.add_parser("get", help="write a policy of the system to a file, by REST")
    get.add_argument(
        "id", type=int, nargs="?", help="its number (default: what the campaign publishes)"
    )
    get.add_argument("--out", type=output_file, required=True, help="file to write (.safetensors)")
    add_connection_arguments(get)
    add_json_argument(get)


def run(args: argparse.Namespace) -> int:
    """Add or get, as the first argument says."""
    return _add(args) if args.what == "add" else _get(args)


def _add(args: argparse.Namespace) -> int:
    """Register the file in the database, and say how a campaign starts from it."""
    from worker.registry import add_checkpoint

    given: dict[str, Any] = {} if args.state is None else {"state_dir": args.state}
    settings = read_settings(**given)
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


def _get(args: argparse.Namespace) -> int:
    """Fetch the file, compare its hash with the row's, write it."""
    if args.id is not None and args.campaign is not None:
        raise RodifError(
            f"checkpoint {args.id} and --campaign {args.campaign!r} both say which; give one"
        )
    with connect(args) as api:
        number = args.id
        if number is None:
            number = api.find_campaign(args.campaign)["published_checkpoint_id"]
        row = api.get(f"/checkpoints/{number}")
        blob = api.request("GET", f"/checkpoints/{number}/file").content
    sha256 = hashlib.sha256(blob).hexdigest()
    if sha256 != row["artifact_sha256"]:
        raise CheckpointFileError(
            f"the file of checkpoint {number} came damaged: {len(blob)} bytes with SHA-256"
            f" {sha256}, but must have {row['artifact_sha256']}"
        )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_bytes(blob)
    facts = {name: row[name] for name in ("id", "name", "task", "digest")}
    if not give_json(facts | {"file": str(args.out), "bytes": len(blob)}, args.json):
        print(f"{args.out}  {len(blob)} bytes  digest {row['digest']}")
        print(f"rodif rollout {row['task']} --checkpoint {shlex.quote(str(args.out))}")
    return 0
