"""One simulation of a task as a Gymnasium environment."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rodif_core.tasks.base import LEFT_WORKSPACE, TIME_LIMIT, Task
from rodif_core.tasks.env import BatchEnv

Observation = NDArray[np.float32]
Action = NDArray[np.float32]


class GymEnv(gymnasium.Env[Observation, Action]):
    """Reward 1 for the control step that reaches the goal, else 0.

    `reset(seed=…)` draws the start from the seed; `options={"context": {…}}` sets it. The info of
    the last step is the outcome: success, mode, group, reason. Running out of time and leaving the
    workspace truncate an episode; contact, success and divergence terminate it.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, task: Task) -> None:
        self._task = task
        self._env = BatchEnv(task, 1)
        self.render_mode = None
        limits = task.action_limits.astype(np.float32)
        self.action_space = gymnasium.spaces.Box(-limits, limits, dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (task.observation_dim,), np.float32
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; raises ValueOutOfRangeError for a bad context in `options`."""
        super().reset(seed=seed)
        context = (options or {}).get("context")
        if context is None:
            context = self._task.sample_context(self.np_random)
        return self._env.reset([context])[0], {"context": context}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One control step."""
        observation = self._env.step(np.asarray(action)[None])[0]
        if not self._env.done[0]:
            return observation, 0.0, False, False, {}
        outcome = self._env.outcomes()[0]
        truncated = outcome["reason"] in (TIME_LIMIT, LEFT_WORKSPACE)
        return observation, float(outcome["success"]), not truncated, truncated, outcome
