"""`rodif demo`: the whole loop on Avoid, from the shipped policy to a published, steered one.

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from rodif_core.errors import RodifError, ValueOutOfRangeError
from rodif_core.spec import FinetuneMethod, RolloutConfig
from server.settings import Settings
from server.states import PublishRule

if TYPE_CHECKING:
    from rich.console import Console

    from worker.cli.client import Client
    from worker.cli.simulate import SimulationReport
    from worker.supervisor import System

PERSON = "annotator"  # account for the one who opens the site
ALIGNMENT_GAIN = 0.30  # a demo that steers less has failed
MEASURES = ("success", "alignment", "alignment_of_successes", "off_support", "n", "intervals")
COMPARED = (FinetuneMethod.RODIF, FinetuneMethod.DP_DPO)
PATIENCE_SECONDS = 1800.0  # for one stage
Say = Callable[[str], None]


@dataclass(frozen=True)
class DemoConfig:
    """Sizes of the demo; the defaults take some minutes on 2 cores."""

    episodes: int = 120
    pairs: int = 180
    labels: int = 100  # preferences; pairs that cannot be told apart are answered "equal" besides
    annotators: int = 5
    flip_rate: float = 0.3
    evaluation_episodes: int = 400
    comparison_updates: int = 10  # full-batch updates of literal RoDiF and DP-DPO
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("episodes", "pairs", "labels", "annotators", "comparison_updates"):
            if getattr(self, name) < 1:
                raise ValueOutOfRangeError(name, getattr(self, name), "at least 1")
        if not 0 <= self.flip_rate < 0.5:
            raise ValueOutOfRangeError("flip_rate", self.flip_rate, "in [0, 0.5)")


@dataclass
class DemoResult:
    """The four evaluations, the labels and the wall time of each stage."""

    evaluations: dict[str, dict[str, Any]] = field(default_factory=dict)
    labels: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    state: str = ""  # of the publishing round
    conservativeness: float | None = None

    def to_json(self) -> dict[str, Any]:
        """The table as JSON; rates in 0–1."""
        rows = {
            name: {measure: evaluation[measure] for measure in MEASURES}
            for name, evaluation in self.evaluations.items()
        }
        return {
            **rows,
            "labels": self.labels,
            "seconds": {name: round(value, 1) for name, value in self.seconds.items()},
            "round": {"state": self.state, "conservativeness": self.conservativeness},
        }

    def failures(self) -> list[str]:
        """Why the demo did not show what it is for; empty when it did."""
        before, after = self.evaluations["before"], self.evaluations["after"]
        found = []
        if after["alignment"] - before["alignment"] < ALIGNMENT_GAIN:
            found.append(
                f"alignment went from {before['alignment']:.3f} to {after['alignment']:.3f};"
                f" a rise of at least {ALIGNMENT_GAIN} was expected"
            )
        if after["success"] < before["success"]:
            found.append(f"success fell from {before['success']:.3f} to {after['success']:.3f}")
        if self.state != "published":
            found.append(f"the steered policy was not published: the round is {self.state}")
        return found

    @contextmanager
    def stage(self, name: str, console: Console, told: str) -> Iterator[Say]:
        """Time a stage; what is said meanwhile stands behind its name."""
        started = time.monotonic()
        with console.status(f"{told} …") as status:
            yield lambda text: status.update(f"{told} … {text}")
        self.seconds[name] = time.monotonic() - started
        console.print(f"{told}: {self.seconds[name]:.1f} s", highlight=False)


def play(
    api: Client, campaign: Mapping[str, Any], config: DemoConfig, console: Console
) -> DemoResult:
    """All stages on a running system; raises WaitError or ApiError when one fails."""
    result = DemoResult()
    told = f"{config.episodes} rollouts of the shipped policy"
    with result.stage("collect", console, told) as say:
        collect = {"episodes": config.episodes, "pairs": config.pairs, "seed": config.seed}
        job = api.post(f"/campaigns/{campaign['id']}/collect", collect)
        api.wait_for_job(
            job["id"],
            seconds=PATIENCE_SECONDS,
            progress=lambda now: say(f"{now['progress']:.0%}"),
        )
    with result.stage("replays", console, f"{config.pairs} replays of pairs") as say:
        wait_for_replays(api, campaign["id"], say)
    with result.stage("labels", console, f"{config.annotators} simulated annotators by REST"):
        report = _label(api, campaign, config)
    result.labels = {"total": report.total, "flipped": report.flipped, "equal": report.equal}
    with result.stage("rounds", console, "three rounds on the same labels") as say:
        ended = run_rounds(api, campaign["id"], config, say)
    guided = ended[FinetuneMethod.RODIF_GUIDED]
    result.state = guided["state"]
    result.conservativeness = (guided["noise"] or {}).get("conservativeness")
    result.evaluations = {"before": guided["result"]["before"], "after": guided["result"]["after"]}
    for method in COMPARED:
        result.evaluations[method.value] = ended[method]["result"]["after"]
    for method, one in ended.items():
        for stage, seconds in one["result"]["seconds"].items():
            result.seconds[f"{stage} {method.value}"] = seconds
    return result


def _label(api: Client, campaign: Mapping[str, Any], config: DemoConfig) -> SimulationReport:
    from worker.cli.simulate import SimulationConfig, simulate

    asked = SimulationConfig(
        annotators=config.annotators,
        labels=config.labels,
        flip_rate=config.flip_rate,
        seed=config.seed,
    )
    return simulate(api, campaign, asked)


def wait_for_replays(api: Client, campaign_id: int, say: Say) -> None:
    """Until no pair waits for its replay; raises WaitError when one failed or it takes too long."""
    from worker.cli.client import POLL_SECONDS, WaitError

    deadline = time.monotonic() + PATIENCE_SECONDS
    while (pairs := api.get(f"/campaigns/{campaign_id}/stats")["pairs"])["waiting"]:
        if time.monotonic() > deadline:
            raise WaitError(f"{pairs['waiting']} replays are still missing")
        say(f"{pairs['waiting']} left")
        time.sleep(POLL_SECONDS)
    if pairs["failed"]:
        raise WaitError(f"{pairs['failed']} replays could not be made; see `rodif doctor`")


def run_rounds(
    api: Client, campaign_id: int, config: DemoConfig, say: Say
) -> dict[FinetuneMethod, dict[str, Any]]:
    """The publishing round, and the comparison rounds on its snapshot; all from one parent."""
    from worker.cli import round as rounds

    evaluation = RolloutConfig(episodes=config.evaluation_episodes, seed=1_000_000_000)
    guided = rounds.launch(
        api,
        campaign_id,
        method=FinetuneMethod.RODIF_GUIDED,
        publish_rule=PublishRule.AUTO,
        evaluation=evaluation,
    )
    # At once, not one after the other: they start from the policy that is published now.
    started = {FinetuneMethod.RODIF_GUIDED: guided}
    for method in COMPARED:
        started[method] = rounds.launch(
            api,
            campaign_id,
            method=method,
            publish_rule=PublishRule.NEVER,
            evaluation=evaluation,
            snapshot_digest=guided["snapshot_digest"],
            updates=config.comparison_updates,
        )
    return {
        method: api.wait_for_round(
            one["id"],
            seconds=PATIENCE_SECONDS,
            progress=lambda now: say(f"{now['config']['method']} {now['state']}"),
        )
        for method, one in started.items()
    }


def print_result(result: DemoResult, console: Console) -> None:
    """The table before and after, and what it took."""
    from worker.cli.tables import evaluation_table

    names = {
        "before": "before",
        "after": f"after ({result.state})",
        FinetuneMethod.RODIF.value: "literal RoDiF",
        FinetuneMethod.DP_DPO.value: "DP-DPO",
    }
    rows = [(names[name], evaluation) for name, evaluation in result.evaluations.items()]
    console.print(evaluation_table("Avoid, steered to the left", rows))
    labels = result.labels
    console.print(
        f"labels: {labels['total']} preferences, {labels['flipped']} of them flipped,"
        f" {labels['equal']} 'equal'; γ estimated from them: {result.conservativeness:.2f}"
        if result.conservativeness is not None
        else f"labels: {labels}",
        highlight=False,
    )
    stages = ", ".join(f"{name} {seconds:.0f}" for name, seconds in result.seconds.items())
    console.print(f"seconds: {stages}", highlight=False)


def sign_in_as_admin(system: System, password: str) -> str:
    """A bearer token of the admin account, got the way a browser signs in."""
    from worker.cli.client import Client

    with Client(system.url) as browser:
        browser.sign_in(system.prepared.admin, password)
        token: str = browser.post("/tokens", {"name": "demo", "days": 1})["token"]
    return token


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    sizes = DemoConfig()
    parser = subparsers.add_parser("demo", help="the whole loop on Avoid, then the site")
    parser.add_argument(
        "--headless", action="store_true", help="stop at the end; exit 1 on failure"
    )
    parser.add_argument("--json", type=Path, help="write the table to this file")
    parser.add_argument(
        "--state", type=Path, help="empty folder for all data (default: .rodif/demo-TIME)"
    )
    parser.add_argument("--host", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, help="port; 0 picks a free one (default: 8000)")
    for name, told in (
        ("episodes", "rollouts to collect"),
        ("pairs", "pairs to choose among them"),
        ("labels", "preferences to give; pairs that look alike are answered 'equal' besides"),
        ("annotators", "simulated annotators"),
        ("evaluation-episodes", "rollouts of each evaluation"),
        ("comparison-updates", "full-batch updates of literal RoDiF and DP-DPO"),
        ("seed", "of the rollouts and the flips"),
    ):
        default = getattr(sizes, name.replace("-", "_"))
        parser.add_argument(
            f"--{name}", type=int, default=default, help=f"{told} (default %(default)s)"
        )
    parser.add_argument(
        "--flip-rate",
        type=float,
        default=sizes.flip_rate,
        help="share of the preferences that are flipped (default %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    """Start, play, print; then wait for Ctrl-C, or with --headless judge the result."""
    config = DemoConfig(
        episodes=args.episodes,
        pairs=args.pairs,
        labels=args.labels,
        annotators=args.annotators,
        flip_rate=args.flip_rate,
        evaluation_episodes=args.evaluation_episodes,
        comparison_updates=args.comparison_updates,
        seed=args.seed,
    )
    settings = _settings(args)

    from rich.console import Console

    from worker.cli.client import Client
    from worker.supervisor import running_system

    console = Console()
    signal.signal(signal.SIGTERM, _like_ctrl_c)
    password = secrets.token_urlsafe(9)
    started = time.monotonic()
    with running_system(settings, admin_password=password) as system:
        begun = time.monotonic() - started
        console.print(f"system ready at {system.url}: {begun:.1f} s", highlight=False)
        token = sign_in_as_admin(system, password)
        with Client(system.url, token) as api:
            campaign = api.find_campaign(None)
            person_password = secrets.token_urlsafe(9)
            person = {"name": PERSON, "role": "annotator", "kind": "person"}
            api.post("/annotators", person | {"password": person_password})
            result = play(api, campaign, config, console)
        result.seconds = {"start": begun} | result.seconds
        result.seconds["total"] = time.monotonic() - started
        print_result(result, console)
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
    console.print(f"Data and logs: {system.settings.state_dir}. Ctrl-C stops everything.")
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
    return Settings(**given, artifact_dir=None)


def _like_ctrl_c(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
