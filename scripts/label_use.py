"""What answers "equal" are worth: the winners that `rodif_guided` keeps, with and without them.

    .venv/bin/python scripts/label_use.py pushing --draws 20

Rolls out the shipped policy as a demo does, asks an annotator who knows the criterion about pairs
until enough of them were judged, flips a share of the judgements, and compares the kept winners
with the truth. An answer "equal" is never wrong by itself; `--confused` makes it so.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from rodif_core.policies.checkpoint import load_checkpoint
from rodif_core.preferences.pairs import CROSS_GROUP, Preference, Tie, choose_pairs
from rodif_core.rollout import rollout
from rodif_core.scoring import PathFeatures, PathUtility
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import RolloutConfig, TaskName
from rodif_core.tasks import get_task
from worker.cli.loop import DemoConfig

Answers = tuple[list[Preference], list[Tie]]


def main() -> None:
    """Print precision and recall of the kept winners."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=list(TaskName))
    parser.add_argument("--draws", type=int, default=20, help="of pairs and flips")
    parser.add_argument("--flip-rate", type=float, default=0.3)
    parser.add_argument(
        "--confused", type=float, default=0.0, help="share of equal pairs answered by a coin"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the rollouts")
    args = parser.parse_args()
    task = get_task(args.task)
    sizes = DemoConfig.for_task(task)
    checkpoint = load_checkpoint(shipped_checkpoint(TaskName(args.task)))
    runs = rollout(checkpoint, RolloutConfig(episodes=sizes.episodes, seed=args.seed))
    features = PathFeatures.of(runs, task)
    groups = [run.outcome["group"] for run in runs]
    liked = [run.success and run.outcome["group"] == task.preferred_group for run in runs]
    truth = np.array(liked)
    print(f"{args.task}: {len(runs)} rollouts, {truth.sum()} successful as wanted")
    kept: dict[str, list[np.ndarray]] = {"without ties": [], "with ties": []}
    counts = []
    for draw in range(args.draws):
        rng = np.random.default_rng([args.seed, draw])
        preferences, ties = _ask(truth, groups, sizes, args.flip_rate, args.confused, rng)
        counts.append((len(preferences), len(ties)))
        for name, used in zip(kept, ([], ties), strict=True):
            fit = PathUtility.fit(features, preferences, used)
            cut = fit.cut(features.success)
            kept[name].append(features.success & (fit.utilities > cut))
    judged, tied = np.mean(counts, axis=0)
    print(f"{judged:.0f} preferences and {tied:.0f} ties a draw, {args.draws} draws")
    for name, draws in kept.items():
        precision = np.array([(one & truth).sum() / max(1, one.sum()) for one in draws])
        recall = np.array([(one & truth).sum() / truth.sum() for one in draws])
        print(
            f"{name:>13}: precision {precision.mean():.2f} (worst {precision.min():.2f}),"
            f" recall {recall.mean():.2f} (worst {recall.min():.2f})"
        )


def _ask(
    truth: np.ndarray,
    groups: Sequence[str | None],
    sizes: DemoConfig,
    flip_rate: float,
    confused: float,
    rng: np.random.Generator,
) -> Answers:
    """Answers about pairs in turn, until `sizes.labels` of them were judged."""
    pairs = choose_pairs(groups, count=sizes.pairs, strategy=CROSS_GROUP, random_share=0.2, rng=rng)
    preferences: list[Preference] = []
    ties: list[Tie] = []
    for pair in pairs:
        first, second = pair.first, pair.second
        if truth[first] == truth[second]:
            if rng.random() < confused:
                preferences.append(Preference(first, second))
            else:
                ties.append(Tie(first, second))
        else:
            better = truth[first] == (rng.random() >= flip_rate)
            preferences.append(Preference(first, second) if better else Preference(second, first))
        if len(preferences) == sizes.labels:
            break
    return preferences, ties


if __name__ == "__main__":
    main()
