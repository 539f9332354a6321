"""Takeovers of a round of `rodif pretrain`: the policy drives, experts go on. Kept in a folder."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rodif_core.spec import RolloutConfig

if TYPE_CHECKING:
    from rodif_core.policies.checkpoint import Checkpoint
    from rodif_core.presets import PretrainConfig
    from rodif_core.trajectory import Trajectory

# Seeds of their own: takeovers start elsewhere than demonstrations and measurements.
RECOVERY_SEEDS = 500_000_000  # first seed of a run's takeovers, and …
ROUND_SEEDS = 1_000_000  # … how far the seeds of its rounds are apart


def round_folder(workspace: Path | None, number: int) -> Path | None:
    """Where a round keeps what it has done so far, if it is to."""
    if workspace is None:
        return None
    folder = workspace / f"round-{number}"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def take_over(
    args: argparse.Namespace, config: PretrainConfig, checkpoint: Checkpoint, number: int
) -> tuple[list[Trajectory], list[Trajectory]]:
    """What the policy did in its own rollouts, and how experts went on from there and, where the
    configuration wants that, from those of its steered copies.

    Both stay in the workspace: with pictures they take longer than a training.
    """
    from rodif_core.demonstrations import load_demonstrations, save_demonstrations
    from rodif_core.recoveries import make_recoveries
    from rodif_core.tasks import get_task
    from worker.parallel import parallel_rollout

    folder, files = round_folder(args.workspace, number), []
    if folder is not None:
        steered = f"+{config.steered_drives}" if config.steered_drives else ""
        sizes = f"{config.recoveries}x{config.drives}{steered}.npz"
        files = [folder / f"driven-{sizes}", folder / f"recoveries-{sizes}"]
    if files and all(file.exists() for file in files):
        driven, recoveries = (load_demonstrations(file) for file in files)
        if driven[0].info["checkpoint"] == checkpoint.digest:
            return driven, recoveries
    first_seed = RECOVERY_SEEDS + number * ROUND_SEEDS + args.seed
    own = RolloutConfig(episodes=config.recoveries * config.drives, seed=first_seed)
    driven = parallel_rollout(checkpoint, own, args.processes)
    by_copies: list[Trajectory] = []
    if config.steered_drives:
        settings = RolloutConfig(
            episodes=config.recoveries * config.steered_drives, seed=own.seed + own.episodes
        )
        by_copies = _drive_steered(checkpoint, driven, settings, args.processes)
    count = config.recoveries if config.drives + config.steered_drives > 1 else None
    recoveries = make_recoveries(
        get_task(args.task), [*driven, *by_copies], args.preferred_share, count
    )
    if recoveries:
        for file, episodes in zip(files, (driven, recoveries), strict=False):
            partial = file.with_suffix(".partial")  # a kill leaves no file that is cut short
            save_demonstrations(partial, episodes)
            os.replace(partial, file)
    return driven, recoveries


def _drive_steered(
    checkpoint: Checkpoint, driven: Sequence[Trajectory], settings: RolloutConfig, processes: int
) -> list[Trajectory]:
    """The rollouts of `settings`, shared out among copies of the policy that go a rare group's way.

    A copy of what the policy itself did has seen that way where it is easy only. So a second copy
    learns from the successes of the first one, too, which drives half of the rollouts.
    """
    from rodif_core.steered import rare_groups, steered_copy
    from worker.parallel import parallel_rollout

    groups = rare_groups(checkpoint, driven)
    made: list[Trajectory] = []
    seed, left = settings.seed, settings.episodes
    for index, group in enumerate(groups):
        share = left // (len(groups) - index)
        left -= share
        mine: list[Trajectory] = []
        for count in (share // 2, share - share // 2):
            if count:
                copy = steered_copy(checkpoint, group, [*driven, *mine], seed)
                mine += parallel_rollout(copy, RolloutConfig(count, seed), processes)
                seed += count
        made += mine
    return made
