"""Recoveries: a policy drives into its own mistakes, then the expert takes over (DAgger).

Demonstrations show few of the states that a policy gets itself into. As experts react to the
observation alone, they can go on from any state; what they do from there to the goal is a
demonstration of how to get out of it (Ross et al., AISTATS 2011, with whole takeovers instead of
single labels, because policies learn chunks of actions).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from rodif_core.diffusion.chain import noise_entries
from rodif_core.errors import ValueOutOfRangeError
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.sight import Sight
from rodif_core.tasks import get_task
from rodif_core.tasks.base import Task
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.experts import Expert, draw_expert
from rodif_core.trajectory import Trajectory, episode_without_decisions

PARALLEL = 100  # simulations stepped together
LATEST = 0.7  # takeovers are uniform up to this share of the task's time limit
RECENT = 40  # control steps before the takeover that tell which mode the policy was after


@dataclass(eq=False)
class _Run:
    """One episode in the making. `expert` is None while the policy drives."""

    rng: np.random.Generator
    context: dict[str, Any]
    takeover: int
    rows: list[NDArray[np.float32]]  # what the policy reads
    observations: list[NDArray[np.float32]]
    qpos: list[NDArray[np.float32]]
    paths: list[NDArray[np.float32]]
    actions: list[NDArray[np.float32]]
    expert: Expert | None = None


def make_recoveries(checkpoint: Checkpoint, *, episodes: int, seed: int) -> list[Trajectory]:
    """What experts did after they took over from the policy, where it led to success.

    `episodes` are tried; the policy drives each up to a random step, and episodes that end before
    or that the expert cannot save are left out. A trajectory begins at the takeover; its context
    is that of the whole episode, and info["taken_over_at"] tells the step. Raises
    ValueOutOfRangeError for values out of range.
    """
    if episodes < 1:
        raise ValueOutOfRangeError("episodes", episodes, "at least 1")
    if seed < 0:
        raise ValueOutOfRangeError("seed", seed, "0 or more")
    task, policy = get_task(checkpoint.task), checkpoint.policy
    made: list[Trajectory] = []
    with Sight(task, policy.config, policy.encoder) as sight:
        for first in range(0, episodes, PARALLEL):
            indices = range(first, min(first + PARALLEL, episodes))
            made += _take_over(checkpoint, sight, seed, indices)
    return made


def _take_over(
    checkpoint: Checkpoint, sight: Sight, seed: int, indices: Sequence[int]
) -> list[Trajectory]:
    task = get_task(checkpoint.task)
    env = BatchEnv(task, len(indices))
    generators = [np.random.default_rng([seed, index]) for index in indices]
    contexts = [task.sample_context(rng) for rng in generators]
    observations = env.reset(contexts)
    qpos, paths = env.qpos, env.paths
    rows = sight.rows(observations, qpos)
    runs = [
        _Run(
            rng=rng,
            context=context,
            takeover=int(rng.integers(1, int(LATEST * task.max_steps))),
            rows=[rows[i].copy()],
            observations=[observations[i]],
            qpos=[qpos[i]],
            paths=[paths[i]],
            actions=[],
        )
        for i, (rng, context) in enumerate(zip(generators, contexts, strict=True))
    ]
    chunks = np.zeros(
        (len(runs), checkpoint.policy.config.executed_steps, task.action_dim), np.float32
    )
    while not env.done.all():
        active = np.flatnonzero(~env.done)
        actions = _actions(checkpoint, task, runs, active, chunks)
        observations = env.step(actions)
        qpos, paths, steps = env.qpos, env.paths, env.steps
        driving = [i for i in active if runs[i].expert is None]
        if driving:
            rows[driving] = sight.rows(observations[driving], qpos[driving])
        for i in active:
            run = runs[i]
            if steps[i] > len(run.actions):  # not so when the physics diverged
                run.actions.append(actions[i].copy())
                run.observations.append(observations[i])
                run.rows.append(rows[i].copy())
                run.qpos.append(qpos[i])
                run.paths.append(paths[i])
    outcomes = env.outcomes()
    return [
        _cut(task, run, outcome, {"seed": seed, "index": index, "checkpoint": checkpoint.digest})
        for run, outcome, index in zip(runs, outcomes, indices, strict=True)
        if run.expert is not None and outcome["success"] and len(run.actions) > run.takeover
    ]


def _actions(
    checkpoint: Checkpoint,
    task: Task,
    runs: Sequence[_Run],
    active: NDArray[np.intp],
    chunks: NDArray[np.float32],
) -> NDArray[np.float32]:
    """The next action of every simulation: the policy's before the takeover, then the expert's."""
    executed = chunks.shape[1]
    driving = [i for i in active if len(runs[i].actions) < runs[i].takeover]
    deciding = [i for i in driving if len(runs[i].actions) % executed == 0]
    if deciding:
        chunks[deciding] = _decide(checkpoint, [runs[i] for i in deciding])
    actions = np.zeros((len(runs), task.action_dim), np.float32)
    for i in active:
        run = runs[i]
        if i in driving:
            actions[i] = chunks[i, len(run.actions) % executed]
            continue
        if run.expert is None:
            run.expert = _likeliest_expert(task, run)
        actions[i] = run.expert.act(run.observations[-1])
    return task.clip(actions)


def _decide(checkpoint: Checkpoint, runs: Sequence[_Run]) -> NDArray[np.float32]:
    """New chunks (len(runs), Te, A) of the policy."""
    policy = checkpoint.policy
    size = policy.config
    histories = np.stack([_history(run, size.observation_steps) for run in runs])
    shape = (noise_entries(policy.schedule), size.predicted_steps, size.action_dim)
    noise = np.stack([run.rng.standard_normal(shape, dtype=np.float32) for run in runs])
    actions, _ = policy.act(torch.from_numpy(histories), torch.from_numpy(noise))
    return np.asarray(actions.numpy())


def _history(run: _Run, steps: int) -> NDArray[np.float32]:
    recent = run.rows[-steps:]
    return np.stack([recent[0]] * (steps - len(recent)) + recent)


def _likeliest_expert(task: Task, run: _Run) -> Expert:
    """The expert whose actions were nearest to what the policy did last."""
    experts = [draw_expert(task.name, mode, run.context, run.rng) for mode in task.modes]
    past = list(zip(run.observations[:-1], run.actions, strict=True))[-RECENT:]
    errors = [
        sum(float(((expert.act(seen) - done) ** 2).sum()) for seen, done in past)
        for expert in experts
    ]
    return experts[int(np.argmin(errors))]


def _cut(task: Task, run: _Run, outcome: dict[str, Any], info: dict[str, Any]) -> Trajectory:
    """The part of an episode after the takeover."""
    assert run.expert is not None
    return episode_without_decisions(
        observations=np.stack(run.observations[run.takeover :]),
        actions=np.stack(run.actions[run.takeover :]),
        qpos=np.stack(run.qpos[run.takeover :]),
        paths=np.stack(run.paths[run.takeover :]),
        context=run.context,
        outcome=outcome,
        info={
            "task": task.name.value,
            "mode": outcome["mode"],
            "control_dt": task.control_dt,
            "mujoco_version": mujoco.__version__,
            "expert": run.expert.to_json(),
            "taken_over_at": run.takeover,
            **info,
        },
    )
