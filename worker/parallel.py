"""Rollouts in several processes: on P cores about P times as many a second."""

from __future__ import annotations

import multiprocessing
import os
import signal
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from typing import TYPE_CHECKING

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.spec import RolloutConfig
from worker.leash import end_with_parent

if TYPE_CHECKING:
    from rodif_core.policies.checkpoint import Checkpoint
    from rodif_core.rollout import EpisodeProgress
    from rodif_core.trajectory import Trajectory


def parallel_rollout(
    checkpoint: Checkpoint,
    config: RolloutConfig,
    processes: int,
    *,
    progress: EpisodeProgress | None = None,
) -> list[Trajectory]:
    """As `rodif_core.rollout.rollout`, the episodes shared out among fresh processes.

    With 1 process it is that function. With more, fewer simulations are stepped together, of which
    the network's last bits depend: the same number of processes gives the same bits. Raises
    ValueOutOfRangeError for fewer than 1.
    """
    if processes < 1:
        raise ValueOutOfRangeError("processes", processes, "at least 1")
    from rodif_core.rollout import rollout

    if processes == 1:
        return rollout(checkpoint, config, progress=progress)
    with pool_of(processes) as pool:
        return _spread(pool, processes, checkpoint, config, progress=progress)


def pool_of(processes: int) -> ProcessPoolExecutor:
    """Processes with one numerical thread each, which end when this one does."""
    # Read by the children when they start: two processes with two threads each get in each
    # other's way.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return ProcessPoolExecutor(
        processes,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=end_with_parent,
        initargs=(signal.SIGTERM,),
    )


def _spread(
    pool: ProcessPoolExecutor,
    shares: int,
    checkpoint: Checkpoint,
    config: RolloutConfig,
    *,
    progress: EpisodeProgress | None = None,
) -> list[Trajectory]:
    """The episodes in their order, made by the pool in at least `shares` batches of equal size."""
    from rodif_core.policies.checkpoint import save_checkpoint

    blob = save_checkpoint(checkpoint)
    size = min(config.max_parallel, -(-config.episodes // shares))
    parts = [
        replace(config, episodes=min(size, config.episodes - first), seed=config.seed + first)
        for first in range(0, config.episodes, size)
    ]
    futures = {pool.submit(_rollout, blob, part): part for part in parts}
    made: dict[int, list[Trajectory]] = {}
    try:
        for future in as_completed(futures):
            # What comes from another process can be written to; `replace` freezes it again.
            made[futures[future].seed] = [replace(one) for one in future.result()]
            if progress is not None:
                progress(sum(len(batch) for batch in made.values()), config.episodes)
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    return [one for part in parts for one in made[part.seed]]


def _rollout(checkpoint: bytes, config: RolloutConfig) -> list[Trajectory]:
    from rodif_core.policies.checkpoint import load_checkpoint
    from rodif_core.rollout import rollout

    return rollout(load_checkpoint(checkpoint), config)
