"""`rodif simulate`: simulated annotators that label through the public REST API only.

The true criterion they share is a utility of an episode:

    1  the episode succeeded and belongs to the campaign's preferred behaviour group
    0  anything else

A pair of different utilities gets a preference, which corruption may flip; a pair of equal ones is
answered "equal" and never flipped. What was true goes to its own table, which neither the learner
nor the noise estimate reads.
"""

from __future__ import annotations

import argparse
import json
import queue
import sys
import threading
import time
import uuid
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from rodif_core.errors import RodifError, ValueOutOfRangeError
from worker.cli.options import add_connection_arguments, connect

if TYPE_CHECKING:
    import numpy as np

    from worker.cli.client import Client

CRITERION = "successful and in the preferred group beats anything else; otherwise equal"
CORRUPTIONS = ("exact", "independent")
UI_VERSION = "simulate/1"
EMPTY_WAIT_SECONDS = 60.0  # an annotator with nothing to label waits this long for replays
EMPTY_POLL_SECONDS = 0.5
# Time people take for a pair in pairwise labelling of short clips: a median of some seconds with a
# long tail, drawn from a log-normal.
MEDIAN_SECONDS, LOG_SPREAD = 6.0, 0.5
ANSWERS = {"left": "right", "right": "left"}  # a preference → its flip


@dataclass(frozen=True)
class SimulationConfig:
    """What `simulate` is asked for."""

    annotators: int = 5
    labels: int = 100  # preferences to give; "equal" answers come on top
    flip_rate: float = 0.0
    corruption: str = "exact"  # one of CORRUPTIONS
    seed: int = 0
    name: str = "simulated"  # accounts are called <name>-1, <name>-2, …

    def __post_init__(self) -> None:
        for field in ("annotators", "labels"):
            if getattr(self, field) < 1:
                raise ValueOutOfRangeError(field, getattr(self, field), "at least 1")
        if self.seed < 0:
            raise ValueOutOfRangeError("seed", self.seed, "at least 0")
        if not self.name.strip():
            raise ValueOutOfRangeError("name", self.name, "text that is not blank")
        if not 0 <= self.flip_rate <= 1:
            raise ValueOutOfRangeError("flip_rate", self.flip_rate, "in [0, 1]")
        if self.corruption not in CORRUPTIONS:
            raise ValueOutOfRangeError("corruption", self.corruption, " or ".join(CORRUPTIONS))


@dataclass(frozen=True)
class SimulationReport:
    """What was given. total: preferences; equal: further answers without direction."""

    total: int = 0
    flipped: int = 0
    equal: int = 0
    seconds: float = 0.0


def utility(outcome: Mapping[str, Any], preferred_group: str) -> float:
    """The true criterion's value of one episode, 1 or 0."""
    return float(bool(outcome["success"]) and outcome["group"] == preferred_group)


def true_choice(left: Mapping[str, Any], right: Mapping[str, Any], preferred_group: str) -> str:
    """What a flawless annotator answers to two outcomes: "left", "right" or "equal"."""
    difference = utility(left, preferred_group) - utility(right, preferred_group)
    return "equal" if difference == 0 else "left" if difference > 0 else "right"


def simulate(
    admin: Client, campaign: Mapping[str, Any], config: SimulationConfig
) -> SimulationReport:
    """Label `config.labels` pairs of a campaign, each annotator in a thread and with an account.

    With corruption "exact", round(flip_rate * labels) of the preferences are flipped, at random
    places; when fewer pairs can be told apart than asked for, it is that share of those. Raises
    ApiError when the API refuses.
    """
    import numpy as np

    from rodif_core.preferences.corruption import exact_flips, independent_flips

    rng = np.random.default_rng(config.seed)
    started = time.monotonic()
    truth = TrueChoices(admin, campaign)
    labels = min(config.labels, truth.count_missing_preferences())
    draw = exact_flips if config.corruption == "exact" else independent_flips
    tickets: queue.SimpleQueue[bool] = queue.SimpleQueue()
    for flip in draw(labels, config.flip_rate, rng):
        tickets.put(bool(flip))
    with annotator_tokens(admin, config) as tokens, ThreadPoolExecutor(len(tokens)) as pool:
        runs = [
            pool.submit(_label_until_done, admin.url, token, campaign, truth, tickets, stream)
            for token, stream in zip(tokens, rng.spawn(len(tokens)), strict=True)
        ]
        parts = [run.result() for run in runs]
    return SimulationReport(
        total=sum(part.total for part in parts),
        flipped=sum(part.flipped for part in parts),
        equal=sum(part.equal for part in parts),
        seconds=time.monotonic() - started,
    )


class TrueChoices:
    """True answers to the pairs of a campaign; shared by the annotators' threads."""

    def __init__(self, api: Client, campaign: Mapping[str, Any]) -> None:
        self._api, self._campaign = api, campaign
        tasks = {task["name"]: task for task in api.get("/tasks")}
        self._preferred_group: str = tasks[campaign["task"]]["preferred_group"]
        path = f"/campaigns/{campaign['id']}"
        episodes = {row["id"]: row for row in api.pages(f"{path}/episodes?limit=500")}
        self._known = {
            pair["id"]: self._answer(
                pair, episodes[pair["first_episode_id"]], episodes[pair["second_episode_id"]]
            )
            for pair in api.pages(f"{path}/pairs?limit=500")
            if pair["state"] != "failed"
        }
        self._lock = threading.Lock()

    def _answer(
        self, pair: Mapping[str, Any], first: Mapping[str, Any], second: Mapping[str, Any]
    ) -> str:
        left, right = (first, second) if pair["first_is_left"] else (second, first)
        return true_choice(left, right, self._preferred_group)

    def of(self, pair_id: int) -> str:
        """ "left", "right" or "equal" for a pair as it stands on the screen."""
        with self._lock:
            if pair_id not in self._known:  # made since
                both = self._api.get(f"/pairs/{pair_id}/episodes")
                self._known[pair_id] = self._answer(both, both["first"], both["second"])
            return self._known[pair_id]

    def count_missing_preferences(self) -> int:
        """How many more preferences the campaign's pairs can take."""
        path = f"/campaigns/{self._campaign['id']}/labels?in_force=true&limit=500"
        given = Counter(row["pair_id"] for row in self._api.pages(path))
        wanted: int = self._campaign["settings"]["labels_per_pair"]
        return sum(
            max(0, wanted - given[pair_id])
            for pair_id, answer in self._known.items()
            if answer != "equal"
        )


@contextmanager
def annotator_tokens(admin: Client, config: SimulationConfig) -> Iterator[list[str]]:
    """A bearer token for each simulated annotator, revoked afterwards; accounts are made when they
    do not exist."""
    accounts = {account["name"]: account for account in admin.pages("/annotators")}
    issued = []
    try:
        for number in range(1, config.annotators + 1):
            name = f"{config.name}-{number}"
            account = accounts.get(name)
            if account is None:
                account = admin.post(
                    "/annotators", {"name": name, "role": "service", "kind": "simulated"}
                )
            if account["kind"] != "simulated":
                raise RodifError(
                    f"account {name!r} is a {account['kind']}, not simulated; choose another --name"
                )
            asked = {"annotator_id": account["id"], "name": "simulate", "days": 1}
            issued.append(admin.post("/tokens", asked))
        yield [token["token"] for token in issued]
    finally:
        for token in issued:
            admin.request("DELETE", f"/tokens/{token['id']}")


def _label_until_done(
    url: str,
    token: str,
    campaign: Mapping[str, Any],
    truth: TrueChoices,
    tickets: queue.SimpleQueue[bool],
    rng: np.random.Generator,
) -> SimulationReport:
    """One annotator: a ticket says whether the next preference is flipped; none left, done."""
    from worker.cli.client import Client

    report = SimulationReport()
    with Client(url, token) as api:
        while True:
            try:
                flip = tickets.get_nowait()
            except queue.Empty:
                return report
            # Pairs that cannot be told apart use up no ticket.
            while (lease := _next_pair(api, campaign["id"])) is not None:
                answer = truth.of(lease["pair"]["id"])
                if answer == "equal":
                    _give(api, lease, answer, answer, rng)
                    report = replace(report, equal=report.equal + 1)
                    continue
                given = ANSWERS[answer] if flip else answer
                _give(api, lease, given, answer, rng)
                report = replace(report, total=report.total + 1, flipped=report.flipped + int(flip))
                break
            else:
                tickets.put(flip)
                return report


def _next_pair(api: Client, campaign_id: int) -> dict[str, Any] | None:
    """A lease on the next pair; None when there is nothing more for this annotator."""
    deadline = time.monotonic() + EMPTY_WAIT_SECONDS
    while True:
        response = api.request("POST", f"/campaigns/{campaign_id}/next", {})
        if response.status_code != 204:
            lease: dict[str, Any] = response.json()
            return lease
        reason = response.headers.get("X-Reason")
        if reason != "replays_waiting" or time.monotonic() > deadline:
            return None
        time.sleep(EMPTY_POLL_SECONDS)


def _give(
    api: Client, lease: Mapping[str, Any], given: str, true: str, rng: np.random.Generator
) -> None:
    milliseconds = int(1000 * rng.lognormal(0.0, LOG_SPREAD) * MEDIAN_SECONDS)
    body = {
        "pair_id": lease["pair"]["id"],
        "lease_id": lease["lease_id"],
        "choice": given,
        "duration_ms": milliseconds,
        "active_ms": milliseconds,
        "ui_version": UI_VERSION,
    }
    key = {"Idempotency-Key": uuid.uuid4().hex}
    label = api.request("POST", "/labels", body, headers=key).json()
    truth = {
        "true_choice": true,
        "corruption": "none" if given == true else "flip",
        "criterion": CRITERION,
    }
    api.request("PUT", f"/labels/{label['id']}/truth", truth)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments."""
    parser = subparsers.add_parser(
        "simulate",
        help="simulated annotators label through the REST API",
        description=f"True criterion: {CRITERION}.",
    )
    add_connection_arguments(parser)
    parser.add_argument(
        "--annotators", type=int, default=5, help="accounts, each in a thread (default %(default)s)"
    )
    parser.add_argument(
        "--labels",
        type=int,
        default=100,
        help="preferences to give; 'equal' comes on top (default %(default)s)",
    )
    parser.add_argument(
        "--flip-rate",
        type=float,
        default=0.0,
        help="share of the preferences that are flipped, 0 to 1 (default %(default)s)",
    )
    parser.add_argument(
        "--corruption",
        choices=CORRUPTIONS,
        default="exact",
        help="an exact share of the preferences, or each on its own (default %(default)s)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of the flips and the times (default %(default)s)"
    )
    parser.add_argument(
        "--name", default="simulated", help="accounts are NAME-1, NAME-2, … (default %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Label, then print what was given; 1 when that is less than was asked for."""
    config = SimulationConfig(
        annotators=args.annotators,
        labels=args.labels,
        flip_rate=args.flip_rate,
        corruption=args.corruption,
        seed=args.seed,
        name=args.name,
    )
    with connect(args) as admin:
        report = simulate(admin, admin.find_campaign(args.campaign), config)
    if args.json:
        print(json.dumps(asdict(report)))
    else:
        print(
            f"{report.total} preferences, {report.flipped} of them flipped, and {report.equal}"
            f" 'equal' answers from {config.annotators} annotators in {report.seconds:.1f} s"
        )
    if report.total < config.labels:
        print(
            f"fewer than the {config.labels} asked for: collect more pairs first",
            file=sys.stderr,
        )
        return 1
    return 0
