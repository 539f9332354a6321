"""Roll a policy out in many simulations at once and keep every denoising chain.

Legend: B simulations stepped together, N control steps, T decision steps, K denoising steps,
To observation history, Tp predicted chunk, Te executed chunk, O observation dims, A action dims.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from rodif_core.diffusion.chain import noise_entries
from rodif_core.errors import LearningError, ValueOutOfRangeError
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.policies.policy import DiffusionPolicy, PolicyConfig
from rodif_core.sight import Sight
from rodif_core.spec import RolloutConfig
from rodif_core.tasks import get_task
from rodif_core.tasks.base import Task
from rodif_core.tasks.env import BatchEnv
from rodif_core.trajectory import Trajectory

EpisodeProgress = Callable[[int, int], None]  # episodes done, episodes in all


def rollout(
    checkpoint: Checkpoint,
    config: RolloutConfig,
    *,
    noise_scale: float = 1.0,
    progress: EpisodeProgress | None = None,
) -> list[Trajectory]:
    """Run `config.episodes` episodes; episode i draws start and policy noise from seed + i.

    noise_scale in [0, 1] shrinks the noise between denoising steps: 1 samples the policy, less
    makes it more decided. The same arguments give the same bits on the same machine. Raises
    LearningError when the policy's actions are not finite.
    """
    if not 0 <= noise_scale <= 1:
        raise ValueOutOfRangeError("noise_scale", noise_scale, "in [0, 1]")
    task = get_task(checkpoint.task)
    done: list[Trajectory] = []
    with Sight(task, checkpoint.policy.config, checkpoint.policy.encoder) as sight:
        for first in range(0, config.episodes, config.max_parallel):
            count = min(config.max_parallel, config.episodes - first)
            seeds = [config.seed + first + i for i in range(count)]
            done += _rollout_batch(checkpoint, sight, seeds, noise_scale)
            if progress is not None:
                progress(len(done), config.episodes)
    return done


class _Recorder:
    """Growing record of one episode. `rows` are what the policy reads, see `Sight`."""

    def __init__(self, observation: Any, qpos: Any, path: Any, row: Any) -> None:
        self.observations, self.qpos, self.paths = [observation], [qpos], [path]
        self.rows = [row]
        self.actions: list[NDArray[np.float32]] = []
        self.histories: list[NDArray[np.float32]] = []
        self.chains: list[NDArray[np.float32]] = []
        self.decision_steps: list[int] = []

    def history(self, steps: int) -> NDArray[np.float32]:
        """Last `steps` rows (To, O); before the start the first one is repeated."""
        recent = self.rows[-steps:]
        # A fifth of the time of np.stack, and this runs once a decision and episode.
        return np.array([recent[0]] * (steps - len(recent)) + recent)

    def decide(self, history: NDArray[np.float32], chain: NDArray[np.float32]) -> None:
        """Note a decision taken at the present control step."""
        self.decision_steps.append(len(self.actions))
        self.histories.append(history)
        self.chains.append(chain)

    def step(self, action: Any, observation: Any, qpos: Any, path: Any, row: Any) -> None:
        """Note one executed control step."""
        self.rows.append(row)
        self.actions.append(action)
        self.observations.append(observation)
        self.qpos.append(qpos)
        self.paths.append(path)


def _rollout_batch(
    checkpoint: Checkpoint, sight: Sight, seeds: list[int], noise_scale: float
) -> list[Trajectory]:
    task, policy = get_task(checkpoint.task), checkpoint.policy
    size = policy.config
    contexts = [task.sample_context(np.random.default_rng([seed, 0])) for seed in seeds]
    generators = [_noise_generator(seed) for seed in seeds]
    env = BatchEnv(task, len(seeds))
    observations = env.reset(contexts)
    qpos, paths = env.qpos, env.paths
    rows = sight.rows(observations, qpos)
    # `rows` is written to as the episodes go on; records keep copies.
    records = [
        _Recorder(observations[i], qpos[i], paths[i], rows[i].copy()) for i in range(len(seeds))
    ]
    chunks = np.zeros((len(seeds), size.executed_steps, size.action_dim), dtype=np.float32)
    step = 0
    while not env.done.all():
        active = np.flatnonzero(~env.done)
        offset = step % size.executed_steps
        if offset == 0:
            _decide(policy, records, generators, active, chunks, noise_scale)
        actions = task.clip(chunks[:, offset])
        observations = env.step(actions)
        qpos, paths, steps_done = env.qpos, env.paths, env.steps
        step += 1
        # A step in which the physics diverged never happened: its state is not finite.
        moved = active[steps_done[active] == step]
        # Other rows than the last before a decision are never read.
        if len(moved) and -step % size.executed_steps < size.observation_steps:
            rows[moved] = sight.rows(observations[moved], qpos[moved])
        for i in moved:
            records[i].step(actions[i].copy(), observations[i], qpos[i], paths[i], rows[i].copy())
    outcomes = env.outcomes()
    digest = checkpoint.digest  # hashes all weights
    return [
        _finish(record, digest, task, size, seed, context, outcome, noise_scale)
        for record, seed, context, outcome in zip(records, seeds, contexts, outcomes, strict=True)
    ]


def _noise_generator(seed: int) -> torch.Generator:
    # A stream of its own, so that the start of an episode and its policy noise are independent.
    state = np.random.SeedSequence([seed, 1]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


def _decide(
    policy: DiffusionPolicy,
    records: list[_Recorder],
    generators: list[torch.Generator],
    active: NDArray[np.intp],
    chunks: NDArray[np.float32],
    noise_scale: float,
) -> None:
    size = policy.config
    histories = np.array([records[i].history(size.observation_steps) for i in active])
    shape = (noise_entries(policy.schedule), size.predicted_steps, size.action_dim)
    noise = torch.stack([torch.randn(shape, generator=generators[i]) for i in active])
    noise[:, 1:] *= noise_scale  # the first entry is a^K, where the chain begins
    actions, chains = policy.act(torch.from_numpy(histories), noise)
    if not bool(chains.isfinite().all()):
        raise LearningError("the policy's action chunks are not finite: its weights are damaged")
    chunks[active] = actions.numpy()
    for row, i in enumerate(active):
        records[i].decide(histories[row], chains[row].numpy().copy())


def _finish(
    record: _Recorder,
    digest: str,
    task: Task,
    size: PolicyConfig,
    seed: int,
    context: dict[str, Any],
    outcome: dict[str, Any],
    noise_scale: float,
) -> Trajectory:
    # An episode whose physics diverged before the first decision has none.
    histories = np.array(record.histories, dtype=np.float32)
    chains = np.array(record.chains, dtype=np.float32)
    chunk = (size.denoising_steps + 1, size.predicted_steps, size.action_dim)
    return Trajectory(
        observations=np.stack(record.observations),
        actions=np.array(record.actions, dtype=np.float32).reshape(-1, task.action_dim),
        qpos=np.stack(record.qpos),
        paths=np.stack(record.paths),
        histories=histories.reshape(-1, size.observation_steps, size.observation_dim),
        chains=chains.reshape(-1, *chunk),
        decision_steps=np.asarray(record.decision_steps, dtype=np.int32),
        context=context,
        outcome=outcome,
        info={
            "task": task.name.value,
            "seed": seed,
            "checkpoint": digest,
            "mujoco_version": mujoco.__version__,
            "control_dt": task.control_dt,
            "noise_scale": noise_scale,
        },
    )
