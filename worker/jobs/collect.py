"""Roll out a checkpoint, store the episodes, choose pairs, ask for their replays.

Episode i of a collect job has seed `seed + i`, and (campaign, checkpoint, seed) is unique: a
second attempt rolls out only the seeds that are missing, and two attempts store the same rows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from rodif_core.evaluate import thin_path
from rodif_core.policies.checkpoint import Checkpoint as Policy
from rodif_core.policies.checkpoint import load_checkpoint
from rodif_core.preferences.pairs import choose_pairs
from rodif_core.rollout import rollout
from rodif_core.spec import RolloutConfig
from rodif_core.trajectory import Trajectory
from server.states import JobKind, PairState
from server.store import jobs
from server.store.tables import Checkpoint, Episode, Pair
from worker.attempt import Attempt

BATCH = 20  # episodes per transaction: what at most is lost when the worker dies
PAIR_BATCH = 200  # pairs per transaction, a third of a second of SQLite's only writer
PAIR_STREAM, SIDE_STREAM = 2, 3  # random streams of a job beside those of its rollouts


@dataclass(frozen=True)
class CollectPlan:
    """The payload of a collect job."""

    episodes: int
    seed: int
    checkpoint_id: int
    pairs: int
    strategy: str
    random_share: float

    @property
    def seeds(self) -> range:
        """Seeds of the job's episodes."""
        return range(self.seed, self.seed + self.episodes)

    def batches(self) -> list[range]:
        """The seeds in fixed portions: rounding in the network depends on the size of a batch, so
        a second attempt makes the very same batches."""
        return [self.seeds[i : i + BATCH] for i in range(0, self.episodes, BATCH)]


def run(attempt: Attempt) -> None:
    """Do the job, or what is left of it."""
    plan = CollectPlan(**attempt.facts.payload)
    with attempt.bench.database.read() as session:
        checkpoint = session.get_one(Checkpoint, plan.checkpoint_id)
        stored = {episode.seed for episode in _episodes(session, attempt, plan)}
    policy = load_checkpoint(attempt.bench.artifacts.get(checkpoint.artifact_sha256))
    attempt.progress("rollouts", len(stored) / plan.episodes)
    for seeds in plan.batches():
        if not stored.issuperset(seeds):
            _store(attempt, plan, policy, seeds, stored)
            stored.update(seeds)
            attempt.progress("rollouts", len(stored) / plan.episodes)
    with attempt.bench.database.read() as session:
        episodes = _episodes(session, attempt, plan)
        known = _known_pairs(session, attempt.facts.campaign_id)
    chosen = _choose_pairs(attempt, plan, episodes)
    # What earlier attempts at this job have stored is the job's own.
    own = [pair for pair in chosen if not _is_older(known.get(_ends(pair)), attempt)]
    missing = [pair for pair in own if _ends(pair) not in known]
    for first in range(0, len(missing), PAIR_BATCH):
        with attempt.step() as session:
            _add_pairs(session, attempt, missing[first : first + PAIR_BATCH])
        attempt.progress("pairs", min(1.0, (first + PAIR_BATCH) / len(missing)))
    groups = Counter(episode.group or "none" for episode in episodes)
    with attempt.step() as session:
        attempt.finish(
            session,
            {
                "episodes": len(episodes),
                "pairs": len(own),
                "groups": dict(sorted(groups.items())),
                "seconds": attempt.seconds(),
            },
        )


def _store(
    attempt: Attempt, plan: CollectPlan, policy: Policy, seeds: range, stored: set[int]
) -> None:
    """Roll a whole batch out and store those of its episodes that are missing."""
    trajectories = rollout(policy, RolloutConfig(episodes=len(seeds), seed=seeds.start))
    missing = [item for item in zip(seeds, trajectories, strict=True) if item[0] not in stored]
    files = [attempt.bench.artifacts.put(trajectory.to_bytes()) for _, trajectory in missing]
    with attempt.step() as session:
        session.add_all(
            _episode(attempt, plan, seed, trajectory, file)
            for (seed, trajectory), file in zip(missing, files, strict=True)
        )


def _episode(
    attempt: Attempt, plan: CollectPlan, seed: int, trajectory: Trajectory, file: str
) -> Episode:
    outcome: dict[str, Any] = trajectory.outcome
    return Episode(
        campaign_id=attempt.facts.campaign_id,
        checkpoint_id=plan.checkpoint_id,
        job_id=attempt.facts.id,
        seed=seed,
        artifact_sha256=file,
        steps=len(trajectory.actions),
        success=trajectory.success,
        mode=outcome["mode"],
        group=outcome["group"],
        outcome=outcome,
        path=thin_path(trajectory),
        mujoco_version=trajectory.info["mujoco_version"],
        created_at=attempt.bench.clock(),
    )


def _episodes(session: Session, attempt: Attempt, plan: CollectPlan) -> Sequence[Episode]:
    """The job's episodes that are stored, by seed."""
    return session.scalars(
        select(Episode)
        .where(
            Episode.campaign_id == attempt.facts.campaign_id,
            Episode.checkpoint_id == plan.checkpoint_id,
            Episode.seed >= plan.seeds.start,
            Episode.seed < plan.seeds.stop,
        )
        .order_by(Episode.seed)
    ).all()


def _choose_pairs(attempt: Attempt, plan: CollectPlan, episodes: Sequence[Episode]) -> list[Pair]:
    """The job's pairs in their order, not stored yet; every attempt chooses the same ones."""
    chosen = choose_pairs(
        [episode.group for episode in episodes],
        count=plan.pairs,
        strategy=plan.strategy,
        random_share=plan.random_share,
        rng=np.random.default_rng([plan.seed, PAIR_STREAM]),
    )
    sides = np.random.default_rng([plan.seed, SIDE_STREAM]).random(len(chosen)) < 0.5
    now = attempt.bench.clock()
    return [
        Pair(
            campaign_id=attempt.facts.campaign_id,
            first_episode_id=episodes[item.first].id,
            second_episode_id=episodes[item.second].id,
            first_is_left=bool(left),
            reason=item.reason,
            state=PairState.WAITING,
            created_at=now,
        )
        for item, left in zip(chosen, sides, strict=True)
    ]


def _add_pairs(session: Session, attempt: Attempt, pairs: Sequence[Pair]) -> None:
    """Store pairs with one replay job each."""
    session.add_all(pairs)
    session.flush()
    for pair in pairs:
        jobs.enqueue(
            session,
            attempt.bench.clock(),
            kind=JobKind.REPLAY,
            campaign_id=attempt.facts.campaign_id,
            payload={},
            pair_id=pair.id,
            dedupe_key=f"replay:{pair.id}",
        )


def _ends(pair: Pair) -> frozenset[int]:
    return frozenset((pair.first_episode_id, pair.second_episode_id))


def _is_older(stored_at: datetime | None, attempt: Attempt) -> bool:
    return stored_at is not None and stored_at < attempt.facts.started_at


def _known_pairs(session: Session, campaign_id: int) -> dict[frozenset[int], datetime]:
    """Episode ids of all pairs of the campaign, in either order, and when they were stored."""
    columns = (Pair.first_episode_id, Pair.second_episode_id, Pair.created_at)
    rows = session.execute(select(*columns).where(Pair.campaign_id == campaign_id))
    return {frozenset((first, second)): stored_at for first, second, stored_at in rows}
