"""How quickly policies are rolled out, beside what the same work costs in its plainest forms.

All rates are in CPU seconds of the process that works, which depend little on what else the machine
does; with two processes those of the slower one count. The parts are measured on the same episodes:

* batch: `rollout`, n episodes together on one core; on two cores n on each
* plain: one simulation in a loop, the policy called for one row at a time
* physics: only the physics steps of those episodes, their joint positions replayed as targets
* network: only the policy's calls of those episodes, on the histories that it saw
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.shipped import shipped_checkpoint, shipped_tasks
from rodif_core.spec import RolloutConfig, TaskName

if TYPE_CHECKING:
    from rodif_core.policies.checkpoint import Checkpoint
    from rodif_core.trajectory import Trajectory

Made = TypeVar("Made")

CORES = (1, 2)
PLAIN_STEPS = 400  # control steps of the plain loop, which is slow
SEED = 40_000_000  # far from the seeds of other measurements
LEAST_SPEEDUP = 20.0  # wanted of two cores, in units of the plain loop on one
MOST_OVERHEAD = 2.0  # wanted: batch seconds in units of physics + network seconds


@dataclass(frozen=True)
class Row:
    """One task's figures.

    policy             "shipped", or "random": the CPU preset's network with fresh weights
    episodes           of one core
    steps              control steps of those together
    batch_s            CPU seconds of those on one core
    steps_per_s        control steps per CPU second by the number of cores
    plain_steps_per_s  the same of the plain loop
    physics_s          CPU seconds of the episodes' physics alone
    network_s          CPU seconds of their policy's calls alone
    """

    task: str
    policy: str
    episodes: int
    steps: int
    batch_s: float
    steps_per_s: Mapping[int, float]
    plain_steps_per_s: float
    physics_s: float
    network_s: float

    def episodes_per_s(self, cores: int) -> float:
        """Episodes per CPU second, of this mean length."""
        return self.steps_per_s[cores] * self.episodes / self.steps

    def speedup(self, cores: int) -> float:
        """Times as quick as the plain loop."""
        return self.steps_per_s[cores] / self.plain_steps_per_s

    @property
    def overhead(self) -> float:
        """Seconds on one core in units of those that physics and network take alone."""
        return self.batch_s / (self.physics_s + self.network_s)

    def to_json(self) -> dict[str, Any]:
        """The figures and what follows from them, as JSON types."""
        by_cores = {
            name: {str(cores): figure(cores) for cores in CORES}
            for name, figure in (
                ("steps_per_s", lambda cores: self.steps_per_s[cores]),
                ("episodes_per_s", self.episodes_per_s),
                ("speedup", self.speedup),
            )
        }
        return asdict(self) | by_cores | {"overhead": self.overhead}


def legal_tasks(names: Sequence[str] | None) -> list[TaskName]:
    """The named tasks, or all that can be timed; raises UnknownNameError for one that cannot."""
    from rodif_core.tasks import TASKS

    # With pictures, drawing and encoding them would be what is measured.
    legal = [name for name, task in TASKS.items() if not task.cameras]
    for name in names or []:
        if name not in legal:
            raise UnknownNameError("task without cameras", name, legal)
    return [name for name in legal if names is None or name in names]


def measure(task: TaskName, episodes: int, pool: ProcessPoolExecutor) -> Row:
    """Measure one task; `pool` is of max(CORES) processes."""
    from rodif_core.rollout import rollout
    from rodif_core.tasks import get_task

    if episodes < 2:
        raise ValueOutOfRangeError("episodes", episodes, "at least 2")
    checkpoint = policy_of(task)
    config = RolloutConfig(episodes, SEED, max_parallel=episodes)
    rollout(checkpoint, replace(config, episodes=2))  # what happens once only is not measured
    batch_s, made = timed(lambda: rollout(checkpoint, config))
    steps = sum(len(one.actions) for one in made)
    rates = {1: steps / batch_s}
    for cores in CORES[1:]:
        rates[cores] = _rate_in_processes(checkpoint, config, cores, pool)
    plain_s, plain_steps = timed(lambda: plain_loop(checkpoint, PLAIN_STEPS))
    return Row(
        task=task.value,
        policy="shipped" if task in shipped_tasks() else "random",
        episodes=episodes,
        steps=steps,
        batch_s=batch_s,
        steps_per_s=rates,
        plain_steps_per_s=plain_steps / plain_s,
        physics_s=physics_seconds(get_task(task), made),
        network_s=network_seconds(checkpoint, made),
    )


def timed(work: Callable[[], Made]) -> tuple[float, Made]:
    """CPU seconds of this process that the work takes, and what it makes."""
    started = time.process_time()
    made = work()
    return time.process_time() - started, made


def policy_of(task: TaskName) -> Checkpoint:
    """The task's shipped checkpoint; where there is none, its CPU preset with fresh weights."""
    import torch

    from rodif_core.policies.checkpoint import Checkpoint, SupportSet, load_checkpoint
    from rodif_core.policies.normaliser import Normaliser
    from rodif_core.policies.policy import DiffusionPolicy
    from rodif_core.presets import preset_for
    from rodif_core.tasks import get_task

    if task in shipped_tasks():
        return load_checkpoint(shipped_checkpoint(task))
    scene = get_task(task)
    config = preset_for(task, "cpu").policy_config(scene)
    middle, span = torch.zeros(scene.observation_dim), torch.ones(scene.observation_dim)
    limits = torch.tensor(scene.action_limits, dtype=torch.float32)
    scales = Normaliser(middle, span, torch.zeros(scene.action_dim), limits)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = DiffusionPolicy.build(config, scales)
    support = SupportSet(torch.zeros(1, scene.observation_dim), 1.0)
    return Checkpoint(task, policy, support, {"kind": "fresh weights"})


def _rate_in_processes(
    checkpoint: Checkpoint, config: RolloutConfig, cores: int, pool: ProcessPoolExecutor
) -> float:
    """Control steps of all processes per CPU second of the slowest, with `config` on each."""
    from rodif_core.policies.checkpoint import save_checkpoint

    blob = save_checkpoint(checkpoint)
    parts = [replace(config, seed=config.seed + i * config.episodes) for i in range(cores)]
    measured = list(pool.map(_timed_rollout, [blob] * cores, parts))
    return sum(steps for steps, _ in measured) / max(seconds for _, seconds in measured)


def _timed_rollout(checkpoint: bytes, config: RolloutConfig) -> tuple[int, float]:
    """Control steps, and the CPU seconds that they took."""
    import torch

    from rodif_core.policies.checkpoint import load_checkpoint
    from rodif_core.rollout import rollout

    torch.set_num_threads(1)
    loaded = load_checkpoint(checkpoint)
    rollout(loaded, replace(config, episodes=2))
    seconds, made = timed(lambda: rollout(loaded, config))
    return sum(len(one.actions) for one in made), seconds


def plain_loop(checkpoint: Checkpoint, least_steps: int) -> int:
    """Whole episodes in a plain loop until `least_steps` control steps are done; returns them.

    What one would write first: one environment, one row of the policy at a time, nothing kept.
    """
    import numpy as np
    import torch

    from rodif_core.diffusion.chain import noise_entries
    from rodif_core.tasks import get_task
    from rodif_core.tasks.gym_env import GymEnv

    policy, size = checkpoint.policy, checkpoint.policy.config
    shape = (1, noise_entries(policy.schedule), size.predicted_steps, size.action_dim)
    env = GymEnv(get_task(checkpoint.task))
    generator = torch.Generator().manual_seed(SEED)
    steps, seed = 0, SEED
    while steps < least_steps:
        observation, _ = env.reset(seed=seed)
        history, ended, seed = [observation] * size.observation_steps, False, seed + 1
        while not ended:
            seen = torch.from_numpy(np.stack(history)[None])
            actions, _ = policy.act(seen, torch.randn(shape, generator=generator))
            for action in actions[0].numpy():
                observation, _, terminated, truncated, _ = env.step(action)
                history = [*history[1:], observation]
                steps += 1
                ended = terminated or truncated
                if ended:
                    break
    return steps


def physics_seconds(task: Any, episodes: Sequence[Trajectory]) -> float:
    """CPU seconds of nothing but the physics steps of these episodes, on one thread."""
    import mujoco
    import mujoco.batch
    import numpy as np

    model = task.build_model("col")
    batch = mujoco.batch.Batch(model, len(episodes), 1)
    qpos, ctrl = batch.bind("qpos"), batch.bind("ctrl")
    # Every servo of the arm holds a joint, so the positions reached are targets that give the same
    # motion and contacts.
    joints = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    physics_steps = round(task.control_dt / model.opt.timestep)
    lengths = np.array([len(one.actions) for one in episodes])
    batch.reset(np.arange(len(episodes)), stage=mujoco.mjtStage.mjSTAGE_NONE)
    qpos[:] = np.stack([one.qpos[0] for one in episodes])
    total = 0.0
    for step in range(int(lengths.max())):
        ids = np.flatnonzero(lengths > step)
        ctrl[ids] = np.stack([episodes[int(i)].qpos[step + 1][joints] for i in ids])
        total += timed(functools.partial(batch.step, ids, physics_steps))[0]
    return total


def network_seconds(checkpoint: Checkpoint, episodes: Sequence[Trajectory]) -> float:
    """CPU seconds of nothing but the policy's calls of these episodes, on one thread."""
    import numpy as np
    import torch

    from rodif_core.diffusion.chain import noise_entries

    policy, size = checkpoint.policy, checkpoint.policy.config
    shape = (noise_entries(policy.schedule), size.predicted_steps, size.action_dim)
    total = 0.0
    for decision in range(max(len(one.histories) for one in episodes)):
        rows = [one.histories[decision] for one in episodes if decision < len(one.histories)]
        histories, noise = torch.from_numpy(np.stack(rows)), torch.randn(len(rows), *shape)
        total += timed(functools.partial(policy.act, histories, noise))[0]
    return total


def shortfalls(rows: Sequence[Row]) -> list[str]:
    """Where a task misses what is wanted, a sentence each; empty when all hold."""
    found = []
    for row in rows:
        speedup = row.speedup(max(CORES))
        if speedup < LEAST_SPEEDUP:
            found.append(
                f"{row.task}: {speedup:.1f} times the plain loop on {max(CORES)} cores, less than"
                f" {LEAST_SPEEDUP:.0f}"
            )
        if row.overhead > MOST_OVERHEAD:
            found.append(
                f"{row.task}: {row.overhead:.2f} times the sum of its parts, more than"
                f" {MOST_OVERHEAD:.0f}"
            )
    return found
