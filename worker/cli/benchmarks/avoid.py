"""The Avoid benchmark: one fine-tuning run per (seed, design, corruption, method).

A seed decides the labelled data, the flips and the fine-tuner's own draws; the shipped checkpoint
stays the same. 20 winners are successful rollouts of the preferred group, 20 losers any others, as
the policy happens to make them. Designs: "product" labels all 20 x 20 pairs (the paper's protocol),
"sparse" 60 of them drawn at random (what people give). An exact share of the labels is flipped.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from rodif_core.errors import LearningError, UnknownNameError, ValueOutOfRangeError
from rodif_core.spec import FinetuneConfig, FinetuneMethod, RolloutConfig, TaskName

if TYPE_CHECKING:
    import numpy as np

    from rodif_core.policies.checkpoint import Checkpoint
    from rodif_core.preferences.noise import Comparison
    from rodif_core.trajectory import Trajectory

DESIGNS = ("product", "sparse")
# What is compared unless methods are named; the paper's further baselines run on request.
METHODS = (FinetuneMethod.RODIF_GUIDED, FinetuneMethod.RODIF, FinetuneMethod.DP_DPO)
WINNERS = LOSERS = 20
SPARSE_PAIRS = 60
ANNOTATORS = 5  # who "gave" the labels, in turn; only the noise estimate looks at it
# γ that the paper sets by the true corruption rate (caption of its noise figure, Avoid).
PAPER_CONSERVATIVENESS = {0.0: 0.0, 0.2: 0.3, 0.3: 0.4, 0.4: 0.45}
# The paper's table of main results, Avoid: success and alignment of RoDiF in per cent. Its policy,
# demonstrations and losers are not ours.
PAPER_ROW = {0.0: 88, 0.2: 86, 0.3: 84}
PRETRAINED = "pretrained"  # method of the rows that measure the starting policy

# Episode seeds: far apart for each use and each benchmark seed, and from the fine-tuner's own.
COLLECT_SEED, EVALUATE_SEED, SEED_STRIDE = 10_000_000, 20_000_000, 10_000
COLLECT_BATCH, COLLECT_MOST = 128, 4096


@dataclass(frozen=True)
class Run:
    """One row to make. method None: measure the starting policy."""

    seed: int
    design: str
    corruption: float
    method: FinetuneMethod | None
    episodes: int
    updates: int | None = None  # full-batch updates of the literal methods; None: the default

    def __post_init__(self) -> None:
        if self.design not in DESIGNS and self.method is not None:
            raise UnknownNameError("design", self.design, DESIGNS)
        if not 0 <= self.corruption < 0.5:
            raise ValueOutOfRangeError("corruption", self.corruption, "in [0, 0.5)")
        if not 0 <= self.seed < 300:  # above, the seeds of different uses would meet
            raise ValueOutOfRangeError("seed", self.seed, "0 … 299")

    def key(self) -> tuple[Any, ...]:
        """What a finished row of this run has in common with it."""
        name = PRETRAINED if self.method is None else self.method.value
        return (name, self.design, self.corruption, self.seed, self.episodes, self.updates)


def key_of_row(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """The key of the run that made a row."""
    names = ("method", "design", "corruption", "seed", "n", "updates")
    return tuple(row[name] for name in names)


def plan(
    seeds: Sequence[int],
    designs: Sequence[str],
    corruptions: Sequence[float],
    methods: Sequence[FinetuneMethod],
    episodes: int,
    updates: int | None,
) -> list[Run]:
    """All runs in the order of their seeds, the starting policy first."""
    runs = []
    for seed in seeds:
        runs.append(Run(seed, "none", 0.0, None, episodes))
        runs += [
            Run(seed, design, corruption, method, episodes, updates)
            for design in designs
            for corruption in corruptions
            for method in methods
        ]
    return runs


def execute(run: Run) -> dict[str, Any]:
    """Make one row. Runs in a process of its own, with one numerical thread."""
    import torch

    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    from rodif_core.evaluate import evaluate

    started = time.monotonic()
    checkpoint = _shipped()
    details: dict[str, Any] = {"labels": 0}
    if run.method is not None:
        checkpoint, details = _finetuned(checkpoint, run, run.method)
    seed = EVALUATE_SEED + run.seed * SEED_STRIDE
    measured = evaluate(checkpoint, RolloutConfig(episodes=run.episodes, seed=seed)).to_json()
    name, design, corruption, _, _, updates = run.key()
    wanted = ("success", "alignment", "alignment_of_successes", "off_support", "n", "intervals")
    return {
        "method": name,
        "corruption": corruption,
        "design": design,
        "seed": run.seed,
        **details,
        **{field: measured[field] for field in wanted},
        "updates": updates,
        "checkpoint": _shipped().digest,
        "seconds": round(time.monotonic() - started, 1),
    }


@functools.lru_cache(maxsize=1)
def _shipped() -> Checkpoint:
    from rodif_core.policies.checkpoint import load_checkpoint
    from rodif_core.shipped import shipped_checkpoint

    return load_checkpoint(shipped_checkpoint(TaskName.AVOID))


@functools.lru_cache(maxsize=1)
def collect(seed: int) -> tuple[Trajectory, ...]:
    """20 winners, then 20 losers, the first that the shipped policy makes from the seed on.

    Raises LearningError when the policy hardly ever does what is preferred.
    """
    from rodif_core.rollout import rollout
    from rodif_core.tasks import get_task

    preferred = get_task(TaskName.AVOID).preferred_group
    winners: list[Trajectory] = []
    losers: list[Trajectory] = []
    for first in range(0, COLLECT_MOST, COLLECT_BATCH):
        start = COLLECT_SEED + seed * SEED_STRIDE + first
        for trajectory in rollout(_shipped(), RolloutConfig(COLLECT_BATCH, start)):
            good = trajectory.success and trajectory.outcome["group"] == preferred
            (winners if good else losers).append(trajectory)
        if len(winners) >= WINNERS and len(losers) >= LOSERS:
            return (*winners[:WINNERS], *losers[:LOSERS])
    raise LearningError(
        f"{COLLECT_MOST} rollouts gave {len(winners)} winners and {len(losers)} losers;"
        f" {WINNERS} and {LOSERS} are needed"
    )


def label(design: str, corruption: float, rng: np.random.Generator) -> list[Comparison]:
    """Corrupted labels on trajectories 0 … 19 (winners) and 20 … 39 (losers), on random sides."""
    from rodif_core.preferences.corruption import exact_flips
    from rodif_core.preferences.noise import Comparison
    from rodif_core.preferences.pairs import product_pairs

    pairs = product_pairs(range(WINNERS), range(WINNERS, WINNERS + LOSERS))
    if design == "sparse":
        pairs = [pairs[i] for i in rng.permutation(len(pairs))[:SPARSE_PAIRS]]
    flips = exact_flips(len(pairs), corruption, rng)
    comparisons = []
    for number, ((winner, loser), flipped) in enumerate(zip(pairs, flips, strict=True)):
        winner_first, first_left = rng.random(2) < 0.5
        comparisons.append(
            Comparison(
                first=winner if winner_first else loser,
                second=loser if winner_first else winner,
                choice="first" if winner_first != flipped else "second",
                annotator=number % ANNOTATORS,
                first_was_left=bool(first_left),
            )
        )
    return comparisons


def _finetuned(
    checkpoint: Checkpoint, run: Run, method: FinetuneMethod
) -> tuple[Checkpoint, dict[str, Any]]:
    import numpy as np

    from rodif_core.finetune import finetune
    from rodif_core.preferences.noise import estimate_noise
    from rodif_core.preferences.pairs import Preference

    # The same flips for all methods and, as far as they go, for all rates.
    rng = np.random.default_rng([run.seed, DESIGNS.index(run.design)])
    comparisons = label(run.design, run.corruption, rng)
    preferences = [
        Preference(item.first, item.second)
        if item.choice == "first"
        else Preference(item.second, item.first)
        for item in comparisons
    ]
    gamma = PAPER_CONSERVATIVENESS.get(run.corruption)
    if method is FinetuneMethod.RODIF_GUIDED or gamma is None:
        gamma = estimate_noise(comparisons).conservativeness
    config = FinetuneConfig(method=method, conservativeness=gamma, seed=run.seed)
    if run.updates is not None:
        config = replace(config, updates=run.updates)
    result = finetune(checkpoint, collect(run.seed), preferences, config)
    return result.checkpoint, {"labels": len(preferences), "conservativeness": gamma}


@dataclass(frozen=True)
class Target:
    """What the default method must reach on a design and a corruption, as a mean over seeds."""

    design: str
    corruption: float
    alignment: float


TARGETS = (
    Target("product", 0.0, 0.90),
    Target("product", 0.2, 0.90),
    Target("product", 0.3, 0.90),
    Target("product", 0.4, 0.85),
    Target("sparse", 0.3, 0.85),
)
OFF_SUPPORT_RATIO = 1.5  # largest off-support share, in units of the starting policy's


def shortfalls(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Where the default method misses its targets, a sentence each; empty when all hold."""
    pretrained = {row["seed"]: row for row in rows if row["method"] == PRETRAINED}
    found = []
    for target in TARGETS:
        cell = [
            row
            for row in rows
            if row["method"] == FinetuneMethod.RODIF_GUIDED
            and (row["design"], row["corruption"]) == (target.design, target.corruption)
        ]
        if not cell:
            continue
        where = f"{target.design}, {target.corruption:.0%} corruption"
        mean = sum(row["alignment"] for row in cell) / len(cell)
        if mean < target.alignment:
            found.append(f"{where}: mean alignment {mean:.3f} is below {target.alignment}")
        for row in cell:
            at, start = f"{where}, seed {row['seed']}", pretrained.get(row["seed"])
            if row["alignment_of_successes"] <= 0.5:
                found.append(f"{at}: the policy goes the wrong way")
            if start is None:
                continue
            if row["success"] < start["success"]:
                found.append(
                    f"{at}: success {row['success']:.3f} is below the start's"
                    f" {start['success']:.3f}"
                )
            if row["off_support"] > OFF_SUPPORT_RATIO * start["off_support"]:
                found.append(
                    f"{at}: off-support {row['off_support']:.4f} is above {OFF_SUPPORT_RATIO}"
                    f" x {start['off_support']:.4f}"
                )
    return found
