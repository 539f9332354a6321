"""Stacking: the gripper, starts, what a tower is, and the experts."""

from __future__ import annotations

from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rodif_core.demonstrations import make_demonstrations
from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.tasks.blocks import yaws
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.experts.jaws import JawKinematics
from rodif_core.tasks.experts.push import ramp
from rodif_core.tasks.experts.stacking import FUNNEL, SPEED, StackingExpert, _funnel, _nearest_grasp
from rodif_core.tasks.panda import ARM_JOINTS, FINGERS, MAX_OPENING, TOOL_SITE, gripper_scene
from rodif_core.tasks.stacking import (
    APART,
    AT_REST,
    JOINT_LIMIT,
    LEVELS,
    NAMES,
    ON_PAD,
    PAD,
    RELEASED,
    START_HEIGHT,
    StackingStateTask,
    first_pair,
    next_place,
    placed_levels,
    tower_height,
)
from rodif_core.trajectory import Trajectory

TASK = StackingStateTask()
AWAY = (0.525, 0.0, 0.30)  # m; the jaws, far from everything
STARTS = ((0.40, -0.20, 0.03), (0.40, -0.05, 0.03), (0.58, -0.10, 0.03))  # m; red, green, blue


def poses(*places: tuple[float, float, float]) -> NDArray[np.float64]:
    """Upright poses (3, 7) of red, green and blue."""
    rows = np.zeros((3, 7))
    rows[:, :3], rows[:, 3] = places, 1.0
    return rows


def on_pad(level: int, dx: float = 0.0) -> tuple[float, float, float]:
    return (PAD[0] + dx, PAD[1], float(LEVELS[level]))


def levels_of(objects: NDArray[np.float64], jaws: tuple[float, ...] = AWAY) -> list[int]:
    found: list[int] = placed_levels(objects[None], np.array([jaws]))[0].tolist()
    return found


@cache
def demonstration() -> Trajectory:
    return make_demonstrations(TASK, episodes=1, seed=5, preferred_share=1.0)[0]


def contexts(count: int) -> list[dict[str, Any]]:
    return [TASK.sample_context(np.random.default_rng(seed)) for seed in range(count)]


def test_the_arm_stands_still_over_its_start_and_the_blocks_lie_at_rest() -> None:
    env = BatchEnv(TASK, 6)
    first = env.reset(contexts(6))
    starts = np.array([context["start"] for context in contexts(6)])
    for _ in range(20):
        last = env.step(np.zeros((6, 8)))
    assert np.abs(last[:, 8:10] - starts).max() < 1e-3
    assert np.abs(last[:, 10] - START_HEIGHT).max() < 1e-3
    assert np.abs(last[:, 14:29] - first[:, 14:29]).max() < 1e-3
    assert np.allclose(last[:, [16, 21, 26]], 0.03, atol=1e-3)


def test_blocks_start_where_the_context_says_with_room_for_the_fingers() -> None:
    env = BatchEnv(TASK, 6)
    env.reset(contexts(6))
    objects = TASK.object_poses(env.qpos)
    for context, seen in zip(contexts(6), objects, strict=True):
        for index, name in enumerate(NAMES):
            x, y, yaw = context[name]
            assert np.allclose(seen[index, :2], (x, y), atol=2e-3)
            assert abs(float(yaws(seen[None])[0, index]) - yaw) < 0.02
            for other in range(index):
                assert np.linalg.norm(seen[index, :2] - seen[other, :2]) > APART - 4e-3


@pytest.mark.parametrize("place", [None, [0.4], [0.4, -0.2, 2.0], [0.5, -0.2, 0.0]])
def test_a_bad_block_is_refused_with_the_legal_range(place: Any) -> None:
    context = contexts(1)[0] | {"red": place}
    with pytest.raises(ValueOutOfRangeError, match=r"red is .*x in \[0.35, 0.45\].*0.12 m from"):
        BatchEnv(TASK, 1).reset([context])


def test_blocks_without_room_between_them_are_refused() -> None:
    context = contexts(1)[0] | {"red": [0.40, -0.15, 0.0], "green": [0.40, -0.05, 0.0]}
    with pytest.raises(ValueOutOfRangeError, match=r"green is .*0.12 m from any other"):
        BatchEnv(TASK, 1).reset([context])


def test_joint_actions_move_the_setpoints_and_the_arm_follows() -> None:
    env = BatchEnv(TASK, 1)
    first = env.reset(contexts(1))[0]
    action = np.zeros((1, 8))
    action[0, 0] = 2 * JOINT_LIMIT  # more than is allowed
    for _ in range(5):
        env.step(action)
    for _ in range(15):
        last = env.step(np.zeros((1, 8)))[0]
    assert last[0] - first[0] == pytest.approx(5 * JOINT_LIMIT, abs=1e-5)
    assert np.allclose(last[1:8], first[1:8], atol=1e-6)
    assert env.qpos[0, 0] == pytest.approx(last[0], abs=2e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_setpoints_stay_within_the_joints_ranges(sign: float) -> None:
    setpoints = np.zeros((1, 8))
    for _ in range(80):
        setpoints = TASK.move(setpoints, sign * np.array([TASK.action_limit]))
    model = TASK.build_model()
    low, high = model.jnt_range[:ARM_JOINTS].T
    assert (low <= setpoints[0, :7]).all() and (setpoints[0, :7] <= high).all()
    assert setpoints[0, 7] == (MAX_OPENING if sign > 0 else 0.0)


def test_the_gripper_closes_in_ten_steps_and_opens_again() -> None:
    env = BatchEnv(TASK, 1)
    opened = env.reset(contexts(1))[0]
    action = np.zeros((1, 8))
    action[0, 7] = -1.0
    for step in range(25):
        closed = env.step(action)[0]
        if step == 9:
            assert closed[7] == pytest.approx(0.0, abs=1e-6)
    for _ in range(25):
        again = env.step(-action)[0]
    assert opened[13] == pytest.approx(MAX_OPENING, abs=1e-3)
    assert closed[13] == pytest.approx(0.0, abs=1e-3)
    assert again[13] == pytest.approx(MAX_OPENING, abs=1e-3)


def test_both_fingers_are_equally_far_from_the_middle_and_close_along_y() -> None:
    model = gripper_scene().compile()
    data = mujoco.MjData(model)
    data.qpos[7:] = 0.02
    mujoco.mj_forward(model, data)
    pads = [data.geom(f"{name}_pad").xpos - data.site(TOOL_SITE).xpos for name in FINGERS]
    frame = data.site(TOOL_SITE).xmat.reshape(3, 3)
    left, right = (frame.T @ pad for pad in pads)
    assert np.allclose(left, -right, atol=1e-4)
    assert abs(left[1]) == pytest.approx(0.02 + 0.0075, abs=1e-4)  # the pad is 15 mm thick
    assert np.allclose(left[[0, 2]], 0.0, atol=1e-4)


def test_levels_of_a_tower_worked_by_hand() -> None:
    assert levels_of(poses(*STARTS)) == [-1, -1, -1]
    assert levels_of(poses(on_pad(0), STARTS[1], STARTS[2])) == [0, -1, -1]
    assert levels_of(poses(on_pad(1), STARTS[1], on_pad(0))) == [1, -1, 0]
    assert levels_of(poses(on_pad(1), on_pad(2), on_pad(0))) == [1, 2, 0]
    # Nothing below it: held there, or something else is in the way.
    assert levels_of(poses(on_pad(1), STARTS[1], STARTS[2])) == [-1, -1, -1]
    assert levels_of(poses(on_pad(0), STARTS[1], on_pad(2))) == [0, -1, -1]
    # D3IL's rule (heights that differ by more than 3 cm) would call this a tower.
    x, y, z = on_pad(2)
    assert levels_of(poses(on_pad(0), on_pad(1), (x, y, z + 0.03))) == [0, 1, -1]


def test_a_block_is_in_the_tower_within_its_slack_only() -> None:
    for dx, level in ((ON_PAD - 1e-4, 0), (ON_PAD + 1e-4, -1)):
        assert levels_of(poses(on_pad(0, dx), STARTS[1], STARTS[2]))[0] == level
    x, y, z = on_pad(0)
    for dz, level in ((0.009, 0), (0.011, -1), (-0.011, -1)):
        assert levels_of(poses((x, y, z + dz), STARTS[1], STARTS[2]))[0] == level


def test_a_block_in_the_jaws_is_not_placed_yet() -> None:
    tower = poses(on_pad(0), STARTS[1], on_pad(1))
    x, y, z = on_pad(1)
    assert levels_of(tower, (x, y, z + RELEASED + 1e-4)) == [0, -1, 1]
    assert levels_of(tower, (x, y, z + RELEASED - 1e-4)) == [0, -1, -1]


def test_the_next_place_is_on_top_of_what_stands() -> None:
    for objects, expected in (
        (poses(*STARTS), on_pad(0)),
        (poses(on_pad(0, 0.02), STARTS[1], STARTS[2]), on_pad(1, 0.02)),
        (poses(on_pad(0, 0.02), STARTS[1], on_pad(1, 0.03)), on_pad(2, 0.03)),
    ):
        levels = placed_levels(objects[None], np.array([AWAY]))
        assert np.allclose(next_place(objects[None], levels), [expected])


def test_success_needs_release_and_standstill() -> None:
    """A real tower, with the jaws around the top block, then away, then with the top sliding."""
    env = BatchEnv(TASK, 1)
    env.reset(contexts(1))
    view = env._view(np.array([0]))
    tower = poses(on_pad(0), on_pad(2), on_pad(1))[None]
    moving = tower.copy()
    moving[0, 1, 0] += 2 * AT_REST

    def finished(jaws: tuple[float, ...], before: NDArray[np.float64]) -> bool:
        values = {**vars(view), "objects": tower, "objects_before": before}
        return bool(TASK.finished(type(view)(**{**values, "ends": np.array([jaws])}))[0])

    assert finished(AWAY, tower)
    assert not finished(on_pad(2), tower)
    assert not finished(AWAY, moving)


@pytest.mark.parametrize("mode", TASK.modes)
def test_the_mode_is_the_order_from_the_bottom_to_the_top(mode: str) -> None:
    order = mode.split("-")
    steps = [poses(*STARTS)]
    for level, name in enumerate(order):
        after = steps[-1].copy()
        after[NAMES.index(name), :3] = on_pad(level)
        steps += [after, after]  # twice: it rests
    path = np.tile(AWAY, (len(steps), 1))
    found = TASK.outcome(path, np.stack(steps), "finished")
    assert found == {"success": True, "mode": mode, "group": mode, "reason": "finished"}
    # Two that stand settle the order; one does not; none is a mode before success.
    two = TASK.outcome(path[:5], np.stack(steps[:5]), "time_limit")
    assert two == {"success": False, "mode": None, "group": mode, "reason": "time_limit"}
    assert TASK.outcome(path[:3], np.stack(steps[:3]), "time_limit")["group"] is None


def test_two_blocks_that_only_pass_each_other_settle_nothing() -> None:
    start, pair = poses(*STARTS), poses(on_pad(0), on_pad(1), STARTS[2])
    moving = pair.copy()
    moving[1, 0] += 0.002
    path = np.tile(AWAY, (3, 1))
    assert first_pair(np.stack([start, pair, moving]), path) is None
    assert first_pair(np.stack([start, pair, pair]), path) == "red-green-blue"


def test_a_block_off_the_table_ends_the_episode() -> None:
    env = BatchEnv(TASK, 1)
    env.reset(contexts(1))
    env._batch.bind("qpos")[0, 9:11] = (0.5, 0.62)  # red, beside the table
    hold = np.zeros((1, 8))
    for _ in range(20):
        env.step(hold)
    assert env.outcomes()[0]["reason"] == "left_workspace"


def test_a_demonstration_stores_everything_that_a_replay_needs() -> None:
    one = demonstration()
    assert one.success and one.qpos.shape[1] == 9 + 7 * 3
    model = TASK.build_model()
    data = mujoco.MjData(model)
    for row in (0, len(one.qpos) // 2, -1):
        data.qpos[:] = one.qpos[row]
        mujoco.mj_kinematics(model, data)
        assert np.allclose(data.site(TOOL_SITE).xpos, one.paths[row], atol=1e-5)
    assert tower_height(placed_levels(TASK.object_poses(one.qpos[-1:]), one.paths[-1:]))[0] == 3


def test_an_expert_finishes_what_another_has_begun() -> None:
    """The first of "red-green-blue" is the first of "red-blue-green", and so is what it knows."""
    env = BatchEnv(TASK, 1)
    observation = env.reset(contexts(1))[0]
    one, other = StackingExpert("red-green-blue"), StackingExpert("red-blue-green")
    for _ in range(100):
        observation = env.step(one.act(observation)[None])[0]
    while not env.done[0]:
        observation = env.step(other.act(observation)[None])[0]
    assert env.outcomes()[0]["mode"] == "red-blue-green"


def test_an_expert_lets_go_of_a_block_that_is_not_its_next() -> None:
    env = BatchEnv(TASK, 1)
    observation = env.reset(contexts(1))[0]
    one, other = StackingExpert("red-green-blue"), StackingExpert("blue-red-green")
    while observation[16] < 0.08:  # until red is in the air
        observation = env.step(one.act(observation)[None])[0]
    while not env.done[0]:
        observation = env.step(other.act(observation)[None])[0]
    assert env.outcomes()[0]["mode"] == "blue-red-green"


def test_unknown_orders_are_refused_with_the_legal_ones() -> None:
    with pytest.raises(UnknownNameError, match="'red-red-blue'.*'red-green-blue'"):
        StackingExpert("red-red-blue")
    with pytest.raises(UnknownNameError, match="'up'.*'blue-green-red'"):
        TASK.group_of("up")


def test_joint_steps_move_the_jaws_as_asked() -> None:
    kinematics = JawKinematics()
    model = gripper_scene().compile()
    data = mujoco.MjData(model)

    def jaws(joints: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        data.qpos[:7] = joints
        mujoco.mj_kinematics(model, data)
        frame = data.site(TOOL_SITE).xmat
        return data.site(TOOL_SITE).xpos.copy(), float(np.arctan2(frame[3], frame[0]))

    joints = np.array([0.2, 0.18, 0.15, -2.25, -0.04, 0.86, 0.4])
    place, yaw = jaws(joints)
    assert kinematics.place(joints) == pytest.approx(yaw)
    velocity, turn = np.array([0.004, -0.003, 0.002]), 0.02
    moved, turned = jaws(joints + kinematics.joint_step(velocity, turn))
    assert np.allclose(moved - place, velocity, atol=2e-4)
    assert turned - yaw == pytest.approx(turn, abs=1e-3)


@given(st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.sampled_from([2.0, 4.0]))
def test_the_chosen_turn_is_a_grasp_and_stays_the_choice_on_the_way(
    lacking: float, yaw: float, symmetry: float
) -> None:
    lacking /= symmetry
    turn = _nearest_grasp(lacking, yaw, symmetry)
    steps = (turn - lacking) * symmetry / (2 * np.pi)
    assert steps == pytest.approx(round(steps), abs=1e-9)
    assert abs(yaw + turn) <= max(abs(yaw + lacking), np.pi / symmetry) + 1.6
    # Half-way there the same grasp is still the nearest.
    rest = _nearest_grasp(turn / 2, yaw + turn / 2, symmetry)
    assert abs(rest) <= abs(turn / 2) + 1e-9 or abs(rest - turn / 2) < 1e-9


@given(st.floats(0.3, 0.65), st.floats(-0.3, 0.3), st.floats(0.03, 0.35))
def test_a_funnel_is_never_faster_than_allowed_and_never_low_far_from_its_goal(
    x: float, y: float, z: float
) -> None:
    goal, cruise = np.array([0.45, 0.0, 0.03]), 0.13
    velocity = _funnel(np.array([x, y, z]), goal, cruise, 0.0)
    assert np.linalg.norm(velocity) <= SPEED + 1e-12
    side = float(np.hypot(x - goal[0], y - goal[1]))
    if side > FUNNEL[1] and z < cruise - 0.04:
        assert velocity[2] > 0 and np.allclose(velocity[:2], 0.0)
    if side < FUNNEL[0] and z > goal[2] + 0.001:
        assert velocity[2] < 0
    assert 0.0 <= ramp(side, *FUNNEL) <= 1.0
