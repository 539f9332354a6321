"""Recoveries: a policy drives into its own mistakes, then the expert takes over (DAgger).

Demonstrations show few of the states that a policy gets itself into. As experts react to the
observation alone, they can go on from any state; what they do from there to the goal is a
demonstration of how to get out of it (Ross et al., AISTATS 2011, with whole takeovers instead of
single labels, because policies learn chunks of actions).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rodif_core.demonstrations import Recording, mode_shares
from rodif_core.tasks.base import Array, Task
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.experts import Expert, draw_expert
from rodif_core.trajectory import Trajectory

PARALLEL = 100  # simulations stepped together
LATEST = 0.7  # share of the task's time limit after which nobody takes over: too little is left
TIE = 1e-6  # relative; errors of experts that still do the same differ by rounding only
RECENT = 40  # control steps before the takeover that tell which mode the policy was after


@dataclass(frozen=True, eq=False)
class _Takeover:
    """What the policy did in one episode, and at which control step the expert takes over."""

    driven: Trajectory
    step: int
    expert: Expert


def make_recoveries(
    task: Task,
    driven: Sequence[Trajectory],
    preferred_share: float | None = None,
    count: int | None = None,
) -> list[Trajectory]:
    """What experts did after they took over from the policy, where it led to success.

    A rollout of `driven` is driven again up to a step drawn from those that the policy lasted, and
    the expert goes on from there. Takeovers that it cannot save are left out. A trajectory begins
    at the takeover; its context is that of the whole episode, and info["taken_over_at"] tells the
    step.

    preferred_share  share of the task's preferred group where the policy has not chosen yet, by
                     default the task's own
    count            takeovers tried, as many from the failures as from the successes of each group
                     (from one rollout several, at other steps); by default one a rollout
    """
    shares = mode_shares(task, task.preferred_share if preferred_share is None else preferred_share)
    asked = [(one, 0) for one in driven] if count is None else _spread(driven, count)
    made: list[Trajectory] = []
    for first in range(0, len(asked), PARALLEL):
        takeovers = [_draw(task, one, again, shares) for one, again in asked[first:][:PARALLEL]]
        made += _recover(task, takeovers)
    return made


def _spread(driven: Sequence[Trajectory], count: int) -> list[tuple[Trajectory, int]]:
    """`count` rollouts, and how often each was chosen before: evenly from the failures and from
    the successes of each group, in turn, each of them again from its first on."""
    kinds: dict[str | None, list[Trajectory]] = {}
    for one in driven:
        kinds.setdefault(one.outcome["group"] if one.success else None, []).append(one)
    chosen = []
    for number in range(count):
        turn, place = divmod(number, len(kinds))
        kind = list(kinds.values())[place]
        again, index = divmod(turn, len(kind))
        chosen.append((kind[index], again))
    return chosen


def _draw(task: Task, driven: Trajectory, again: int, shares: Array) -> _Takeover:
    # A stream of its own, apart from the episode's start and the policy's noise.
    rng = np.random.default_rng([driven.info["seed"], 2, *([again] if again else [])])
    latest = min(len(driven.actions), int(LATEST * task.max_steps))
    step = int(rng.integers(1, latest)) if latest > 1 else 0
    return _Takeover(driven, step, _likeliest_expert(task, driven, step, shares, rng))


def _likeliest_expert(
    task: Task, driven: Trajectory, step: int, shares: Array, rng: np.random.Generator
) -> Expert:
    """The expert whose actions are nearest to what the policy did before that step.

    Where modes have not parted yet several are equally near; one of them is drawn by its share
    among demonstrations, or the policy would learn modes in other shares.
    """
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
    tied = np.array(errors) <= min(errors) * (1 + TIE)
    weights = np.where(tied, shares + TIE, 0.0)  # also where no demonstration has such a mode
    return experts[int(rng.choice(len(experts), p=weights / weights.sum()))]


def _recover(task: Task, takeovers: Sequence[_Takeover]) -> list[Trajectory]:
    """Drive to the takeovers and let the experts go on; the successful ones."""
    env = BatchEnv(task, len(takeovers))
    recording = Recording(env, [one.driven.context for one in takeovers])
    step = 0
    while not env.done.all():
        actions = np.zeros((len(takeovers), task.action_dim), np.float32)
        for i in np.flatnonzero(~env.done).tolist():
            one = takeovers[i]
            if step < one.step:
                actions[i] = one.driven.actions[step]
            else:
                actions[i] = task.clip(one.expert.act(recording.observations[i]))
        recording.step(actions)
        step += 1
    infos = [
        {
            "seed": one.driven.info["seed"],
            "checkpoint": one.driven.info["checkpoint"],
            "expert": one.expert.to_json(),
            "taken_over_at": one.step,
        }
        for one in takeovers
    ]
    episodes = recording.episodes(infos, [one.step for one in takeovers])
    return [one for one in episodes if one.success]
