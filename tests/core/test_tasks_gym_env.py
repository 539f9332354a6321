"""One simulation as a Gymnasium environment."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.tasks import TASKS, Task
from rodif_core.tasks.avoid import AvoidTask
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.gym_env import GymEnv


@pytest.mark.parametrize(
    "task", [pytest.param(task, id=name.value) for name, task in TASKS.items()]
)
def test_gymnasiums_checker_accepts_the_environment(task: Task) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box observation space.*infinity")
        warnings.filterwarnings("ignore", message=".*spec.*")
        check_env(GymEnv(task), skip_render_check=True)


def test_it_steps_as_the_batch_does() -> None:
    task = AvoidTask()
    context = {"start": [0.52, -0.28]}
    env, batch = GymEnv(task), BatchEnv(task, 1)
    observation, info = env.reset(options={"context": context})
    assert info["context"] == context
    assert observation.tobytes() == batch.reset([context])[0].tobytes()
    action = np.array([0.01, 0.005], dtype=np.float32)
    observation, reward, terminated, truncated, info = env.step(action)
    assert observation.tobytes() == batch.step(action[None])[0].tobytes()
    assert (reward, terminated, truncated, info) == (0.0, False, False, {})


@pytest.mark.parametrize(
    ("action", "reason", "terminated"),
    [
        ([0, 0.01], "collision", True),
        ([-0.01, 0], "left_workspace", False),
        ([0, 0], "time_limit", False),
    ],
)
def test_the_last_step_tells_the_outcome(
    action: list[float], reason: str, terminated: bool
) -> None:
    env = GymEnv(AvoidTask())
    env.reset(options={"context": {"start": [0.5, -0.28]}})
    ended = False
    while not ended:
        _, reward, done, truncated, info = env.step(np.array(action, dtype=np.float32))
        ended = done or truncated
    assert (done, truncated, reward, info["reason"]) == (terminated, not terminated, 0.0, reason)


def test_reaching_the_finish_is_rewarded_once() -> None:
    env = GymEnv(AvoidTask())
    observation, _ = env.reset(options={"context": {"start": [0.3, -0.28]}})
    rewards, ended = [], False
    while not ended:
        # Along the left of the field, keeping away from the base.
        wanted = 0.36 if abs(observation[1]) < 0.12 else 0.295
        action = np.array([np.clip(wanted - observation[0], -0.0125, 0.0125), 0.008])
        observation, reward, done, truncated, info = env.step(action.astype(np.float32))
        rewards.append(reward)
        ended = done or truncated
    assert info == {"success": True, "mode": "L-11", "group": "left", "reason": "finished"}
    assert rewards[-1] == 1.0 and sum(rewards) == 1.0


def test_a_bad_context_is_refused() -> None:
    with pytest.raises(ValueOutOfRangeError, match="start is"):
        GymEnv(AvoidTask()).reset(options={"context": {"start": [9, 9]}})
