"""`rodif demo`: the whole loop on a task, from the shipped policy to a published, steered one.

Collect rollouts, make replays, let simulated annotators label by REST with some labels flipped,
run a round, evaluate, publish; the paper's RoDiF and DP-DPO run on the same labels beside it. Then
the site stays up with pairs left to label, or, with --headless, everything stops.
"""

from __future__ import annotations

import argparse
import json
import secrets
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import fields, replace
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from rodif_core.errors import RodifError
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import FinetuneMethod, TaskName
from worker.cli.loop import DemoConfig, DemoResult, play
from worker.cli.options import add_config_argument, names, output_file, read_settings

if TYPE_CHECKING:
    from rich.console import Console

    from server.settings import Settings
    from worker.cli.client import Client
    from worker.supervisor import System

PERSON = "annotator"  # account for the one who opens the site


def steering(api: Client, task: TaskName) -> str:
    """What the demo of a task does, in a few words."""
    (facts,) = (one for one in api.get("/tasks") if one["name"] == task.value)
    return f"{task.value.capitalize()}, steered to {facts['preferred_group']}"


def print_result(result: DemoResult, title: str, console: Console) -> None:
    """The table before and after, and how long all of it took."""
    from worker.cli.tables import evaluation_table

    names = {
        "before": "before",
        "after": f"after ({result.state})",
        FinetuneMethod.RODIF.value: "literal RoDiF",
        FinetuneMethod.DP_DPO.value: "DP-DPO",
    }
    rows = [(names[name], evaluation) for name, evaluation in result.evaluations.items()]
    console.print(evaluation_table(title, rows))
    labels = result.labels
    console.print(
        f"labels: {labels['total']} preferences, {labels['flipped']} of them flipped,"
        f" {labels['equal']} 'equal'; γ estimated from them: {result.conservativeness:.2f}"
        if result.conservativeness is not None
        else f"labels: {labels}",
        highlight=False,
    )
    minutes, seconds = divmod(round(result.seconds["total"]), 60)
    console.print(f"all of it took {minutes} min {seconds} s", highlight=False)


def sign_in_as_admin(system: System, password: str) -> str:
    """A bearer token of the admin account, got the way a browser signs in."""
    from worker.cli.client import Client

    with Client(system.url) as browser:
        browser.sign_in(system.prepared.admin, password)
        token: str = browser.post("/tokens", {"name": "demo", "days": 1})["token"]
    return token


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser("demo", help="the whole loop on a task, then the site")
    parser.add_argument(
        "task", nargs="?", choices=names(TaskName), default=TaskName.AVOID, help="default: avoid"
    )
    parser.add_argument(
        "--headless", action="store_true", help="stop at the end; exit 1 on failure"
    )
    parser.add_argument("--json", type=output_file, help="write the table to this file")
    parser.add_argument(
        "--state", type=Path, help="empty folder for all data (default: .rodif/demo-TIME)"
    )
    parser.add_argument("--host", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, help="port; 0 picks a free one (default: 8000)")
    for name, told in (
        ("episodes", "rollouts to collect"),
        ("pairs", "pairs to choose among them; more for tasks of many groups"),
        ("labels", "preferences to give; pairs that look alike are answered 'equal' besides"),
        ("annotators", "simulated annotators"),
        ("evaluation-episodes", "rollouts of each evaluation; Stacking: 200"),
        ("comparison-updates", "full-batch updates of literal RoDiF and DP-DPO; 4 on long tasks"),
        ("seed", "of the rollouts and the flips"),
    ):
        usual = getattr(DemoConfig, name.replace("-", "_"))
        parser.add_argument(f"--{name}", type=int, help=f"{told} (avoid: {usual})")
    add_config_argument(parser, "JSON file with settings of the round that publishes")
    parser.add_argument(
        "--flip-rate",
        type=float,
        help=f"share of the preferences that are flipped (default {DemoConfig.flip_rate})",
    )


def run(args: argparse.Namespace) -> int:
    """Start, play, print; then wait for Ctrl-C, or with --headless judge the result."""
    from rodif_core.tasks import get_task

    task = TaskName(args.task)
    given = {one.name: getattr(args, one.name) for one in fields(DemoConfig)}
    wishes = {name: value for name, value in given.items() if value is not None}
    config = replace(DemoConfig.for_task(get_task(task)), **wishes)
    shipped_checkpoint(task)  # says what to do when there is none, before anything starts
    settings = _settings(args)

    from rich.console import Console

    from worker.cli.client import Client
    from worker.supervisor import running_system

    console = Console()
    signal.signal(signal.SIGTERM, _like_ctrl_c)
    signal.signal(signal.SIGINT, _like_ctrl_c)  # a shell script's "&" would have it ignored
    password = secrets.token_urlsafe(9)
    started = time.monotonic()
    with running_system(settings, admin_password=password, first_campaign=task) as system:
        begun = time.monotonic() - started
        console.print(f"system ready at {system.url}: {begun:.1f} s", highlight=False)
        if not args.headless:
            console.print(
                f"  to watch it work, sign in as {system.prepared.admin}, password"
                f" [bold]{password}[/bold]",
                highlight=False,
            )
        token = sign_in_as_admin(system, password)
        with Client(system.url, token) as api:
            campaign = api.find_campaign(task.value)
            person_password = secrets.token_urlsafe(9)
            person = {"name": PERSON, "role": "annotator", "kind": "person"}
            api.post("/annotators", person | {"password": person_password})
            result = play(api, campaign, config, console)
            title = steering(api, task)
        result.seconds = {"start": begun} | result.seconds
        result.seconds["total"] = time.monotonic() - started
        print_result(result, title, console)
        if args.json is not None:
            args.json.write_text(json.dumps(result.to_json(), indent=2) + "\n")
        if args.headless:
            failures = result.failures()
            for sentence in failures:
                print(f"rodif demo: {sentence}", file=sys.stderr)
            return 1 if failures else 0
        accounts = ((system.prepared.admin, password), (PERSON, person_password))
        _leave_running(system, accounts, console)
    return 0


def _leave_running(system: System, accounts: Sequence[tuple[str, str]], console: Console) -> None:
    console.rule()
    console.print(f"The site is running at [bold]{system.url}[/bold]. Sign in as", highlight=False)
    for (name, password), told in zip(
        accounts, ("rounds, checkpoints, publishing", "label what is left"), strict=True
    ):
        console.print(f"  {name:<10} password [bold]{password}[/bold]   {told}", highlight=False)
    state = system.settings.state_dir
    console.print(
        f"Data and logs: {state}\n"
        f"Ctrl-C stops everything; rodif up --state {state} opens it again.",
        soft_wrap=True,
        highlight=False,
    )
    try:
        system.wait()
    except KeyboardInterrupt:
        console.print("\nStopping …")


def _settings(args: argparse.Namespace) -> Settings:
    state = args.state or Path(".rodif") / f"demo-{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    if state.exists() and any(state.iterdir()):
        raise RodifError(f"the demo wants an empty folder, but {str(state)!r} has files in it")
    # Everything inside the folder, whatever the environment says; when nobody will look at the
    # site, on any free port.
    given: dict[str, Any] = {"state_dir": state, "database_url": "", "broker_url": ""}
    if args.host is not None:
        given["host"] = args.host
    if args.port is not None or args.headless:
        given["port"] = args.port or 0
    return read_settings(**given, artifact_dir=None)


def _like_ctrl_c(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
