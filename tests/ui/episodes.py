"""Real episodes for the tests of this room: a scripted rod, stepped by the real physics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rodif_core.spec import TaskName
from rodif_core.tasks import get_task
from rodif_core.tasks.env import BatchEnv
from rodif_core.trajectory import Trajectory

LEFT_WAY = ((0.44, -0.10), (0.36, 0.08), (0.30, 0.26), (0.30, 0.40))
RIGHT_WAY = ((0.57, -0.10), (0.645, 0.08), (0.575, 0.26), (0.575, 0.40))
COLLIDING_WAY = ((0.5, -0.10),)


def scripted_episode(way: Sequence[tuple[float, float]], seed: int = 0) -> Trajectory:
    """One Avoid episode that follows way-points (x, y) in metres at full speed."""
    task = get_task(TaskName.AVOID)
    env = BatchEnv(task, 1)
    env.reset([task.sample_context(np.random.default_rng(seed))])
    observation = env.reset([task.sample_context(np.random.default_rng(seed))])
    observations, actions, qpos, paths = [observation[0]], [], [env.qpos[0]], [env.paths[0]]
    targets = list(way)
    while not env.done[0]:
        here = observations[-1][:2].astype(np.float64)
        step = np.array(targets[0]) - here
        if len(targets) > 1 and np.linalg.norm(step) < 0.015:
            targets.pop(0)
        step *= min(1.0, task.action_limit / max(float(np.linalg.norm(step)), 1e-9))
        actions.append(step.astype(np.float32))
        observations.append(env.step(step[None])[0])
        qpos.append(env.qpos[0])
        paths.append(env.paths[0])
    return Trajectory(
        observations=np.stack(observations),
        actions=np.stack(actions),
        qpos=np.stack(qpos),
        paths=np.stack(paths),
        histories=np.zeros((0, 2, task.observation_dim), np.float32),
        chains=np.zeros((0, 21, 16, task.action_dim), np.float32),
        decision_steps=np.zeros(0, np.int32),
        context={"seed": seed},
        outcome=env.outcomes()[0],
        info={"task": str(task.name), "seed": seed, "control_dt": task.control_dt},
    )
