"""The whole loop through the public API: collect, replay, label, run rounds, evaluate, publish.

Simulated annotators label with some labels flipped; the paper's RoDiF and DP-DPO run on the same
labels beside the round that publishes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.spec import EVALUATION_SEED, FinetuneMethod
from server.states import PublishRule

if TYPE_CHECKING:
    from rich.console import Console

    from rodif_core.tasks.base import Task
    from worker.cli.client import Client
    from worker.cli.simulate import SimulationReport

# A demo that steers less has failed; where the policy mostly does what is preferred already, two
# fifths of what was missing are enough.
ALIGNMENT_GAIN, GAP_SHARE = 0.30, 0.4
MEASURES = ("success", "alignment", "alignment_of_successes", "off_support", "n", "intervals")
COMPARED = (FinetuneMethod.RODIF, FinetuneMethod.DP_DPO)
# For one stage. Work that fails says so at once; this only ends a demo that hangs, and must not end
# one on a slow or busy machine, where a round of a hard task takes the better part of an hour.
PATIENCE_SECONDS = 4 * 3600.0
Say = Callable[[str], None]


# With more groups, fewer of the pairs have a rollout of the wanted one: so many more for each group
# beyond Avoid's two let about as many pairs be judged.
PAIRS_PER_GROUP = 30
LONG_TASK, VERY_LONG_TASK = 200, 500  # control steps


@dataclass(frozen=True)
class DemoConfig:
    """Sizes of the demo; the defaults are Avoid's and take some minutes on 2 cores."""

    episodes: int = 120
    pairs: int = 180
    labels: int = 100  # preferences; pairs that cannot be told apart are answered "equal" besides
    annotators: int = 5
    flip_rate: float = 0.3
    evaluation_episodes: int = 400
    comparison_updates: int = 10  # full-batch updates of literal RoDiF and DP-DPO
    seed: int = 0
    # Settings of the round that publishes, by their names in FinetuneConfig; others are as usual.
    finetune: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # All of these are looked at before anything starts, not when the loop comes to them.
        for name in ("pairs", "labels", "annotators", "comparison_updates"):
            if getattr(self, name) < 1:
                raise ValueOutOfRangeError(name, getattr(self, name), "at least 1")
        # The API takes no fewer; a seed below 0 no generator.
        for name, least in (("episodes", 2), ("evaluation_episodes", 10), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueOutOfRangeError(name, getattr(self, name), f"at least {least}")
        if not 0 <= self.flip_rate < 0.5:
            raise ValueOutOfRangeError("flip_rate", self.flip_rate, "in [0, 0.5)")
        method = self.finetune.get("method", FinetuneMethod.RODIF_GUIDED.value)
        if method != FinetuneMethod.RODIF_GUIDED.value:
            raise ValueOutOfRangeError(
                "method", method, f"{FinetuneMethod.RODIF_GUIDED.value!r}; the others run beside it"
            )

    @classmethod
    def for_task(cls, task: Task) -> DemoConfig:
        """Usual sizes for a task: more pairs where there are many groups; where rollouts take long,
        fewer updates of the literal methods, and where they take longest, fewer to measure."""
        usual = cls(pairs=cls.pairs + PAIRS_PER_GROUP * (len(task.groups) - 2))
        if task.max_steps > LONG_TASK:
            usual = replace(usual, comparison_updates=4)
        if task.max_steps > VERY_LONG_TASK:
            usual = replace(usual, evaluation_episodes=200)
        return usual


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
        wanted = min(ALIGNMENT_GAIN, GAP_SHARE * (1 - before["alignment"]))
        if after["alignment"] - before["alignment"] < wanted:
            found.append(
                f"alignment went from {before['alignment']:.3f} to {after['alignment']:.3f};"
                f" a rise of at least {wanted:.2f} was expected"
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

    evaluation = {"episodes": config.evaluation_episodes, "seed": EVALUATION_SEED}
    guided = rounds.launch(
        api,
        campaign_id,
        method=FinetuneMethod.RODIF_GUIDED,
        publish_rule=PublishRule.AUTO,
        evaluation=evaluation,
        settings=config.finetune,
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
