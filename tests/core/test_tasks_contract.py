"""What every task must hold to, whatever it is: one test body, all tasks of TASKS."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rodif_core.demonstrations import make_demonstrations
from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.spec import TaskName
from rodif_core.tasks import TASKS, Task, get_task
from rodif_core.tasks.base import REASONS
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.experts import draw_expert
from rodif_core.trajectory import Trajectory

TASK_PARAMS = [pytest.param(task, id=name.value) for name, task in TASKS.items()]
STEPS = 12

pytestmark = pytest.mark.parametrize("task", TASK_PARAMS)


@dataclass(frozen=True)
class Mirror:
    """The scene's plane of symmetry x = `x` (m), and what it does to a mode.

    objects  the order in which the objects appear in the mirror: some exchange their colours
    """

    x: float
    mode: Callable[[str], str]
    objects: tuple[int, ...] = ()


def mirrored_gaps(mode: str) -> str:
    return f"{'R' if mode[0] == 'L' else 'L'}-{4 - int(mode[2])}{5 - int(mode[3])}"


def exchanged_cubes(mode: str) -> str:
    swap = {"red": "green", "green": "red", "blue": "blue"}
    return "-".join(swap[name] for name in mode.split("-"))


# Where there are two cubes and two places for them, the mirror also exchanges their colours.
# Stacking's starts have no plane of symmetry, but the tower has: the plane through the pad. There
# the two cubes, which are alike, exchange their colours; the cuboid has no like.
# A task whose scene has no plane of symmetry has None here.
MIRRORS: dict[TaskName, Mirror | None] = {
    TaskName.AVOID: Mirror(0.5, mirrored_gaps),
    TaskName.PUSHING: Mirror(0.525, lambda m: m.translate(str.maketrans("rg", "gr")), (1, 0)),
    TaskName.SORTING: Mirror(0.5125, lambda m: "-".join(reversed(m.split("-"))), (1, 0)),
    TaskName.ALIGNING_STATE: Mirror(0.5, lambda m: m, (0, 1)),
    TaskName.STACKING_STATE: Mirror(0.5, exchanged_cubes, (1, 0, 2)),
}
MIRRORS[TaskName.ALIGNING] = MIRRORS[TaskName.ALIGNING_STATE]
MIRRORS[TaskName.STACKING] = MIRRORS[TaskName.STACKING_STATE]


@cache
def demonstrations_of(task: Task) -> list[Trajectory]:
    """At least 24 demonstrations, the same number in every mode."""
    per_mode = max(1, 24 // len(task.modes))
    liked = sum(task.group_of(mode) == task.preferred_group for mode in task.modes)
    return make_demonstrations(
        task,
        episodes=per_mode * len(task.modes),
        seed=2,
        preferred_share=liked / len(task.modes),
    )


def test_group_of_a_mode_that_does_not_exist_names_the_legal_ones(task: Task) -> None:
    assert {task.group_of(mode) for mode in task.modes} == set(task.groups)
    for foreign in ("X-11", "L-99", ""):
        with pytest.raises(UnknownNameError, match=re.escape(repr(task.modes[0]))):
            task.group_of(foreign)


def contexts_of(task: Task, seeds: Sequence[int]) -> list[dict[str, Any]]:
    return [task.sample_context(np.random.default_rng(seed)) for seed in seeds]


def actions_of(task: Task, seeds: Sequence[int], steps: int = STEPS) -> NDArray[np.float32]:
    """Random actions (steps, len(seeds), A) that drift forward; a seed's column is its own."""
    columns = [
        np.random.default_rng(seed).uniform(-1, 1, (steps, task.action_dim)) for seed in seeds
    ]
    return np.asarray(task.action_limit * np.stack(columns, axis=1), dtype=np.float32)


def play(
    env: BatchEnv, contexts: Sequence[dict[str, Any]], actions: NDArray[Any]
) -> dict[str, Any]:
    """Everything that an environment hands out, after every step."""
    rows = {"observations": [env.reset(contexts)], "qpos": [env.qpos], "paths": [env.paths]}
    for action in actions:
        rows["observations"].append(env.step(action))
        rows["qpos"].append(env.qpos)
        rows["paths"].append(env.paths)
    return {name: np.stack(values, axis=1) for name, values in rows.items()}


def assert_same_bits(first: dict[str, Any], second: dict[str, Any]) -> None:
    for name, values in first.items():
        assert values.tobytes() == second[name].tobytes(), name


def test_observations_are_finite_and_of_the_promised_size(task: Task) -> None:
    record = play(BatchEnv(task, 3), contexts_of(task, [1, 2, 3]), actions_of(task, [1, 2, 3]))

    assert record["observations"].shape == (3, STEPS + 1, task.observation_dim)
    assert record["observations"].dtype == np.float32
    assert record["paths"].shape == (3, STEPS + 1, 3)
    assert record["qpos"].dtype == np.float32
    assert all(np.isfinite(values).all() for values in record.values())


def test_same_context_and_actions_give_the_same_bits_when_an_environment_is_used_again(
    task: Task,
) -> None:
    env = BatchEnv(task, 2)
    contexts, actions = contexts_of(task, [1, 2]), actions_of(task, [1, 2])
    first = play(env, contexts, actions)
    play(env, contexts_of(task, [5, 6]), actions_of(task, [5, 6]))

    assert_same_bits(first, play(env, contexts, actions))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("count", [2, 7, 33])
def test_an_episode_has_the_same_bits_alone_and_among_others(
    task: Task, count: int, threads: int
) -> None:
    seeds = list(range(count))
    together = play(
        BatchEnv(task, count, threads), contexts_of(task, seeds), actions_of(task, seeds)
    )
    alone = BatchEnv(task, 1)
    for index in {0, count // 2, count - 1}:
        single = play(alone, contexts_of(task, [index]), actions_of(task, [index]))
        assert_same_bits(single, {name: rows[index][None] for name, rows in together.items()})


def test_a_smaller_batch_in_a_larger_environment_changes_no_bit(task: Task) -> None:
    seeds = [4, 5, 6]
    exact = play(BatchEnv(task, 3), contexts_of(task, seeds), actions_of(task, seeds))
    roomy = play(BatchEnv(task, 10), contexts_of(task, seeds), actions_of(task, seeds))

    assert_same_bits(exact, roomy)


def test_simulations_that_are_not_active_stay_as_they_are(task: Task) -> None:
    env = BatchEnv(task, 2)
    start = env.reset(contexts_of(task, [1, 2]))
    actions = actions_of(task, [1, 2])
    for action in actions:
        end = env.step(action, active=np.array([True, False]))

    assert end[1].tobytes() == start[1].tobytes()
    assert env.steps.tolist() == [STEPS, 0]
    alone = play(BatchEnv(task, 1), contexts_of(task, [1]), actions[:, :1])
    assert end[0].tobytes() == alone["observations"][0, -1].tobytes()


def test_returned_arrays_are_copies(task: Task) -> None:
    env = BatchEnv(task, 2)
    contexts = contexts_of(task, [1, 2])
    handed_out = [env.reset(contexts), env.qpos, env.paths, env.steps, env.done]
    before = [array.copy() for array in handed_out]
    action = actions_of(task, [1, 2])[0]
    after = env.step(action)
    for array, old in zip(handed_out, before, strict=True):
        assert array.tobytes() == old.tobytes()

    for array in (after, env.qpos, env.paths, env.steps, env.done):
        array.fill(1)
    again = BatchEnv(task, 2)
    again.reset(contexts)
    again.step(action)
    assert env.step(action).tobytes() == again.step(action).tobytes()


def test_a_caller_that_reuses_its_action_array_changes_nothing_afterwards(task: Task) -> None:
    env = BatchEnv(task, 1)
    env.reset(contexts_of(task, [1]))
    action = actions_of(task, [1])[0]
    observation = env.step(action)
    kept = observation.copy()
    action.fill(np.nan)
    assert observation.tobytes() == kept.tobytes()
    assert not env.done[0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_non_finite_action_ends_only_its_own_episode(task: Task, bad: float) -> None:
    seeds = [1, 2, 3]
    contexts, actions = contexts_of(task, seeds), actions_of(task, seeds)
    clean = play(BatchEnv(task, 3), contexts, actions)
    actions[4, 1, 0] = bad
    env = BatchEnv(task, 3)
    record = play(env, contexts, actions)

    assert env.done.tolist() == [False, True, False]
    assert env.steps.tolist() == [STEPS, 4, STEPS]
    for name in clean:
        assert record[name][[0, 2]].tobytes() == clean[name][[0, 2]].tobytes()
        assert np.isfinite(record[name]).all()
        assert record[name][1, 4:].tobytes() == np.repeat(record[name][1, 4:5], 9, 0).tobytes()


def test_physics_that_blows_up_ends_only_its_own_episode(task: Task) -> None:
    seeds = [1, 2, 3]
    contexts, actions = contexts_of(task, seeds), actions_of(task, seeds)
    clean = play(BatchEnv(task, 3), contexts, actions)
    env = BatchEnv(task, 3)
    env.reset(contexts)
    env._batch.bind("qvel")[1] = 1e12
    for action in actions:
        observation = env.step(action)

    assert env.done.tolist() == [False, True, False]
    assert observation[[0, 2]].tobytes() == clean["observations"][[0, 2], -1].tobytes()
    assert np.isfinite(observation).all() and np.isfinite(env.qpos).all()
    hold = np.zeros((3, task.action_dim))
    while not env.done.all():
        env.step(hold)
    outcome = env.outcomes()[1]
    assert outcome["reason"] == "diverged" and not outcome["success"]


def test_an_episode_that_gets_nowhere_ends_at_the_time_limit(task: Task) -> None:
    env = BatchEnv(task, 1)
    env.reset(contexts_of(task, [1]))
    for _ in range(task.max_steps - 1):
        env.step(np.zeros((1, task.action_dim)))
    assert not env.done[0]
    env.step(np.zeros((1, task.action_dim)))

    assert env.done[0]
    assert env.outcomes() == [
        {"success": False, "mode": None, "group": None, "reason": "time_limit"}
    ]


def test_every_mode_is_reached_by_its_expert(task: Task) -> None:
    made = demonstrations_of(task)
    assert Counter(one.outcome["mode"] for one in made) == dict.fromkeys(
        task.modes, len(made) // len(task.modes)
    )
    for one in made:
        assert one.success and one.outcome["mode"] == one.info["expert"]["mode"]
        assert one.outcome["group"] == task.group_of(one.outcome["mode"])


def test_at_least_95_percent_of_first_draws_succeed_in_the_wanted_mode(task: Task) -> None:
    attempts = [one.info["attempt"] for one in demonstrations_of(task)]
    assert attempts.count(0) / len(attempts) >= 0.95


def test_outcomes_can_be_read_again_from_what_was_stored(task: Task) -> None:
    for one in demonstrations_of(task):
        objects = task.object_poses(one.qpos)
        assert task.outcome(one.paths, objects, one.outcome["reason"]) == one.outcome


def test_a_mirrored_trajectory_has_the_mirrored_mode(task: Task) -> None:
    assert task.name in MIRRORS, "enter the scene's plane of symmetry, or None, in MIRRORS"
    mirror = MIRRORS[task.name]
    if mirror is None:
        pytest.skip("the scene has no plane of symmetry")
    for one in demonstrations_of(task):
        path, objects = one.paths.astype(np.float64), task.object_poses(one.qpos).copy()
        path[:, 0] = 2 * mirror.x - path[:, 0]
        objects[..., 0] = 2 * mirror.x - objects[..., 0]
        objects[..., 3:] *= (1, 1, -1, -1)  # rotations about y and z turn the other way
        objects = objects[:, list(mirror.objects)]
        found = task.outcome(path, objects, one.outcome["reason"])
        assert found["mode"] == mirror.mode(one.outcome["mode"])


def test_demonstrations_played_again_give_the_same_bits(task: Task) -> None:
    one = demonstrations_of(task)[0]
    env = BatchEnv(task, 1)
    observations = [env.reset([one.context])]
    observations += [env.step(action[None]) for action in one.actions]
    assert np.concatenate(observations).tobytes() == one.observations.tobytes()
    assert env.outcomes() == [one.outcome]


def test_an_expert_of_an_unknown_mode_is_refused(task: Task) -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(UnknownNameError, match=f"'sideways'.*'{task.modes[0]}'"):
        draw_expert(task.name, "sideways", task.sample_context(rng), rng)


def test_a_context_without_its_values_is_refused(task: Task) -> None:
    whole = contexts_of(task, [1])[0]
    for name in whole:
        with pytest.raises(ValueOutOfRangeError, match=f"{name} is None, but must be "):
            BatchEnv(task, 1).reset([{k: v for k, v in whole.items() if k != name}])


def test_the_model_has_the_robot_first_and_then_the_objects(task: Task) -> None:
    model = task.build_model()
    assert model.nq == task.robot_joints + 7 * len(task.objects)
    assert model.nu == task.robot_joints
    for index, name in enumerate(task.objects):
        joint = model.body(name).jntadr[0]
        assert model.jnt_qposadr[joint] == task.robot_joints + 7 * index


def test_outcomes_are_refused_before_all_episodes_have_ended(task: Task) -> None:
    env = BatchEnv(task, 1)
    env.reset(contexts_of(task, [1]))
    with pytest.raises(ValueError, match="episode 0 has not ended"):
        env.outcomes()


def test_actions_of_the_wrong_shape_are_refused(task: Task) -> None:
    env = BatchEnv(task, 2)
    env.reset(contexts_of(task, [1, 2]))
    with pytest.raises(ValueOutOfRangeError, match=rf"\(1, {task.action_dim}\).*\(2, "):
        env.step(np.zeros((1, task.action_dim)))


@pytest.mark.parametrize("count", [0, 3])
def test_a_wrong_number_of_contexts_is_refused(task: Task, count: int) -> None:
    with pytest.raises(ValueOutOfRangeError, match=rf"contexts is {count}.*1 … 2"):
        BatchEnv(task, 2).reset(contexts_of(task, list(range(count))))


@pytest.mark.parametrize(("n", "threads"), [(0, 1), (1, 0), (-1, 1)])
def test_an_environment_needs_a_simulation_and_a_thread(task: Task, n: int, threads: int) -> None:
    with pytest.raises(ValueOutOfRangeError, match="at least 1"):
        BatchEnv(task, n, threads)


def test_contexts_survive_json_and_depend_on_the_seed_alone(task: Task) -> None:
    first, second, other = contexts_of(task, [1, 1, 2])
    assert first == second
    assert first != other
    assert json.loads(json.dumps(first)) == first


def test_constants_agree_with_each_other(task: Task) -> None:
    assert TASKS[task.name] is task
    assert len(set(task.modes)) == len(task.modes)
    assert task.preferred_group in task.groups
    assert task.criterion.endswith(".")
    limits = task.action_limits
    assert limits.shape == (task.action_dim,) and (limits > 0).all()
    assert np.array_equal(task.clip(-2 * limits), -limits)
    assert np.array_equal(task.clip(np.full(task.action_dim, np.inf)), limits)
    assert task.control_dt > 0


def test_scene_shapes_survive_json(task: Task) -> None:
    shapes = task.scene_shapes()
    assert json.loads(json.dumps(shapes)) == shapes
    assert all("type" in shape for shape in shapes)


def test_both_meshes_are_the_same_physics(task: Task) -> None:
    low, detailed = task.build_model("col"), task.build_model("viz")
    assert detailed.nmeshface > 10 * low.nmeshface
    assert np.array_equal(low.body_mass, detailed.body_mass)
    assert np.allclose(low.body_inertia, detailed.body_inertia, rtol=1e-12)
    assert np.array_equal(low.actuator_gainprm, detailed.actuator_gainprm)


def test_get_task_finds_a_task_by_its_text(task: Task) -> None:
    assert get_task(task.name.value) is task


def test_an_unknown_task_is_refused_with_the_legal_names(task: Task) -> None:
    with pytest.raises(UnknownNameError, match=rf"'juggle'.*'{task.name.value}'"):
        get_task("juggle")


def test_an_unknown_reason_is_refused(task: Task) -> None:
    with pytest.raises(UnknownNameError, match=f"'tired'.*'{REASONS[0]}'"):
        task.outcome(np.zeros((1, 3)), np.zeros((1, len(task.objects), 7)), "tired")
