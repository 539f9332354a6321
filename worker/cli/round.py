"""`rodif round`: start a fine-tuning round by REST and follow it to its end."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.spec import FinetuneMethod
from server.states import PublishRule
from worker.cli.options import add_config_argument, add_connection_arguments, connect, names

if TYPE_CHECKING:
    from worker.cli.client import Client

DEFAULT_PATIENCE_MINUTES = 60.0


def launch(
    api: Client,
    campaign_id: int,
    *,
    method: FinetuneMethod | None = None,
    publish_rule: PublishRule | None = None,
    evaluation: Mapping[str, int] | None = None,
    snapshot_digest: str | None = None,
    updates: int | None = None,
    conservativeness: float | None = None,
    settings: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Start a round; what is not given is taken from the campaign. Raises ApiError (409, 422).

    `evaluation` may hold "episodes", "seed" or both. `settings` are further ones of the fine-tuner,
    by their names in FinetuneConfig.
    """
    given = {"method": method, "updates": updates, "conservativeness": conservativeness}
    config = {name: value for name, value in given.items() if value is not None}
    body: dict[str, Any] = {"config": {**(settings or {}), **config}}
    if publish_rule is not None:
        body["publish_rule"] = publish_rule
    if evaluation:
        body["evaluation"] = dict(evaluation)
    if snapshot_digest is not None:
        body["snapshot_digest"] = snapshot_digest
    started: dict[str, Any] = api.post(f"/campaigns/{campaign_id}/rounds", body)
    return started


def finished_tables(ended: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The evaluations of a round's result, by what to call them."""
    result = ended["result"]
    return {"before": result["before"], f"after ({ended['state']})": result["after"]}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("round", help="start a fine-tuning round and follow it")
    add_connection_arguments(parser)
    parser.add_argument(
        "--method", choices=names(FinetuneMethod), help="default: what the campaign says"
    )
    parser.add_argument(
        "--publish", choices=names(PublishRule), help="default: what the campaign says"
    )
    parser.add_argument(
        "--episodes", type=int, help="rollouts of the evaluation; default: what the campaign says"
    )
    parser.add_argument(
        "--seed",
        type=int,
        help="first seed of the evaluation; default: one that all rounds share, above those of the"
        " rollouts that are labelled",
    )
    parser.add_argument("--updates", type=int, help="full-batch updates of the literal methods")
    parser.add_argument(
        "--conservativeness", type=float, help="γ in [0, 1); default: estimated from the labels"
    )
    add_config_argument(parser, "JSON file with further settings of the fine-tuner")
    parser.add_argument("--snapshot", help="digest of frozen labels to use again")
    parser.add_argument("--json", action="store_true", help="print the finished round as JSON")
    parser.add_argument(
        "--minutes",
        type=float,
        default=DEFAULT_PATIENCE_MINUTES,
        help="stop waiting after this long; the round goes on (default %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    """Start, follow, print; 1 when the gate refused the candidate."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from worker.cli.tables import evaluation_table

    if not args.minutes >= 0:  # before the round is started, which nobody would then follow
        raise ValueOutOfRangeError("minutes", args.minutes, "at least 0")
    # What is not given must not be sent: zero is a seed of rollouts that were labelled.
    given = {"episodes": args.episodes, "seed": args.seed}
    evaluation = {name: value for name, value in given.items() if value is not None}
    with connect(args) as api:
        started = launch(
            api,
            api.find_campaign(args.campaign)["id"],
            method=args.method,
            publish_rule=args.publish,
            evaluation=evaluation,
            snapshot_digest=args.snapshot,
            updates=args.updates,
            conservativeness=args.conservativeness,
            settings=args.finetune,
        )
        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            row = bar.add_task(f"round {started['id']}", total=1.0)

            def show(state: Mapping[str, Any]) -> None:
                newest = api.get(f"/jobs?campaign_id={state['campaign_id']}")
                ours = [job for job in newest if job["round_id"] == state["id"]]
                stage, done = (ours[0]["stage"], ours[0]["progress"]) if ours else ("", 0.0)
                text = f"round {state['id']} {state['state']} {stage}"
                bar.update(row, description=text, completed=done)

            ended = api.wait_for_round(started["id"], seconds=60 * args.minutes, progress=show)
    if args.json:
        print(json.dumps(ended))
    else:
        rows = list(finished_tables(ended).items())
        Console().print(evaluation_table(f"round {ended['id']}", rows))
        if ended.get("stopped"):
            print(f"fine-tuning: {ended['stopped']}")
    if ended["result"]["gate"].get("unchanged"):
        print("nothing was learned: the candidate has its parent's weights", file=sys.stderr)
    if ended["state"] == "rejected":
        print(f"the gate refused: {ended['result'].get('gate')}", file=sys.stderr)
        return 1
    return 0
