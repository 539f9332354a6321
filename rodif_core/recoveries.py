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

import numpy as np
from numpy.typing import NDArray

from rodif_core.demonstrations import recorded_episode
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.rollout import rollout
from rodif_core.spec import RolloutConfig
from rodif_core.tasks import get_task
from rodif_core.tasks.base import Task
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.experts import Expert, draw_expert
from rodif_core.trajectory import Trajectory

PARALLEL = 100  # simulations stepped together
LATEST = 0.7  # share of the task's time limit after which nobody takes over: too little is left
RECENT = 40  # control steps before the takeover that tell which mode the policy was after


@dataclass(frozen=True, eq=False)
class _Takeover:
    """What the policy did in one episode, and at which control step the expert takes over."""

    driven: Trajectory
    step: int
    expert: Expert


def make_recoveries(checkpoint: Checkpoint, *, episodes: int, seed: int) -> list[Trajectory]:
    """What experts did after they took over from the policy, where it led to success.

    The policy drives `episodes` of them, from seed on; each is driven again up to a step drawn from
    those that it lasted, and the expert goes on from there. Takeovers that it cannot save are left
    out. A trajectory begins at the takeover; its context is that of the whole episode, and
    info["taken_over_at"] tells the step. Raises ValueOutOfRangeError for values out of range.
    """
    task = get_task(checkpoint.task)
    driven = rollout(checkpoint, RolloutConfig(episodes=episodes, seed=seed))
    made: list[Trajectory] = []
    for first in range(0, episodes, PARALLEL):
        made += _recover(task, [_draw(task, one) for one in driven[first : first + PARALLEL]])
    return made


def _draw(task: Task, driven: Trajectory) -> _Takeover:
    # A stream of its own, apart from the episode's start and the policy's noise.
    rng = np.random.default_rng([driven.info["seed"], 2])
    latest = min(len(driven.actions), int(LATEST * task.max_steps))
    step = min(latest, int(rng.integers(1, max(latest, 2))))
    return _Takeover(driven, step, _likeliest_expert(task, driven, step, rng))


def _likeliest_expert(
    task: Task, driven: Trajectory, step: int, rng: np.random.Generator
) -> Expert:
    """The expert whose actions are nearest to what the policy did before that step."""
    experts = [draw_expert(task.name, mode, driven.context, rng) for mode in task.modes]
    past = slice(max(0, step - RECENT), step)
    seen, done = driven.observations[past], driven.actions[past]
    errors = [
        sum(
            float(((expert.act(row) - action) ** 2).sum())
            for row, action in zip(seen, done, strict=True)
        )
        for expert in experts
    ]
    return experts[int(np.argmin(errors))]


def _recover(task: Task, takeovers: Sequence[_Takeover]) -> list[Trajectory]:
    """Drive to the takeovers and let the experts go on; the successful ones."""
    env = BatchEnv(task, len(takeovers))
    observations = [env.reset([one.driven.context for one in takeovers])]
    qpos, paths = [env.qpos], [env.paths]
    actions: list[NDArray[np.float32]] = []
    while not env.done.all():
        action = np.zeros((len(takeovers), task.action_dim), np.float32)
        for i in np.flatnonzero(~env.done).tolist():
            action[i] = _action(takeovers[i], len(actions), observations[-1][i])
        actions.append(task.clip(action))
        observations.append(env.step(actions[-1]))
        qpos.append(env.qpos)
        paths.append(env.paths)
    columns = [np.stack(rows) for rows in (observations, actions, qpos, paths)]
    outcomes, steps = env.outcomes(), env.steps
    return [
        _cut(task, one, [column[one.step :, i] for column in columns], int(steps[i]), outcomes[i])
        for i, one in enumerate(takeovers)
        if outcomes[i]["success"] and steps[i] > one.step
    ]


def _action(takeover: _Takeover, step: int, observation: NDArray[np.float32]) -> Any:
    if step < takeover.step:
        return takeover.driven.actions[step]
    return takeover.expert.act(observation)


def _cut(
    task: Task,
    takeover: _Takeover,
    columns: Sequence[NDArray[np.float32]],
    steps: int,
    outcome: dict[str, Any],
) -> Trajectory:
    """The part of an episode of `steps` control steps after the takeover."""
    driven = takeover.driven.info
    return recorded_episode(
        task,
        columns=columns,
        length=steps - takeover.step,
        context=takeover.driven.context,
        outcome=outcome,
        info={
            "seed": driven["seed"],
            "checkpoint": driven["checkpoint"],
            "expert": takeover.expert.to_json(),
            "taken_over_at": takeover.step,
        },
    )
