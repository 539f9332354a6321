"""Pushing and Sorting: starts, reach, contact, and the reading of modes from cube poses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.tasks.base import Task
from rodif_core.tasks.blocks import APART, HALF, MAX_REACH, clamp_reach, cube_features, push_frame
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.experts.push import KEEP_OUT, bend, go_round, steer
from rodif_core.tasks.experts.pushing import PushingExpert
from rodif_core.tasks.experts.sorting import SortingExpert
from rodif_core.tasks.pushing import REACHED, TARGETS, PushingTask
from rodif_core.tasks.sorting import PLATFORM_TOP, SortingTask

PUSHING, SORTING = PushingTask(), SortingTask()
BOTH = [pytest.param(PUSHING, id="pushing"), pytest.param(SORTING, id="sorting")]
RED_START, SECOND_START = (0.45, -0.10), (0.60, -0.10)  # m; far from targets and bins


def poses(*steps: tuple[tuple[float, ...], tuple[float, ...]]) -> NDArray[np.float64]:
    """Object poses (len(steps), 2, 7), upright; a place is (x, y) on the table or (x, y, z)."""
    rows = np.zeros((len(steps), 2, 7))
    rows[:, :, 3] = 1.0
    for row, step in zip(rows, steps, strict=True):
        for cube, place in zip(row, step, strict=True):
            cube[:3] = (*place, HALF)[:3]
    return rows


def outcome_of(task: Task, objects: NDArray[Any], reason: str = "finished") -> dict[str, Any]:
    return task.outcome(np.zeros((len(objects), 3)), objects, reason)


@pytest.mark.parametrize("task", BOTH)
def test_cubes_are_at_rest_when_an_episode_starts(task: Task) -> None:
    env = BatchEnv(task, 8)
    env.reset([task.sample_context(np.random.default_rng(seed)) for seed in range(8)])
    first = task.object_poses(env.qpos)
    for _ in range(20):
        env.step(np.zeros((8, 2)))
    assert np.abs(task.object_poses(env.qpos) - first).max() < 1e-4
    height = HALF + (PLATFORM_TOP if task is SORTING else 0.0)
    assert np.allclose(first[:, :, 2], height, atol=1e-3)


@pytest.mark.parametrize("task", BOTH)
def test_cubes_start_where_the_context_says(task: Task) -> None:
    contexts = [task.sample_context(np.random.default_rng(seed)) for seed in range(8)]
    env = BatchEnv(task, 8)
    observations = env.reset(contexts)
    for observation, context in zip(observations, contexts, strict=True):
        for index, name in enumerate(task.objects):
            x, y, yaw = context[name]
            expected = [x, y, np.sin(4 * yaw), np.cos(4 * yaw)]
            assert np.allclose(observation[4 + 4 * index : 8 + 4 * index], expected, atol=5e-3)


@pytest.mark.parametrize("task", BOTH)
def test_cubes_never_start_in_each_other(task: Task) -> None:
    for seed in range(200):
        context = task.sample_context(np.random.default_rng(seed))
        one, other = (np.array(context[name][:2]) for name in task.objects)
        assert np.linalg.norm(one - other) >= APART


@pytest.mark.parametrize("task", BOTH)
def test_touching_a_cube_moves_it_and_ends_nothing(task: Task) -> None:
    context = task.sample_context(np.random.default_rng(0))
    context["start"] = [0.525, -0.29]
    context["red"], context[task.objects[1]] = [0.50, -0.10, 0.0], [0.60, -0.10, 0.0]
    env = BatchEnv(task, 1)
    first = env.reset([context])[0]
    for _ in range(25):
        last = env.step(np.array([[-0.001, 0.008]]))[0]
    assert last[5] - first[5] > 0.02
    assert not env.done[0]


@pytest.mark.parametrize("task", BOTH)
@pytest.mark.parametrize("direction", [(1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (0, 1)])
def test_the_arm_stays_calm_when_it_is_pushed_against_its_reach(
    task: Task, direction: tuple[float, float]
) -> None:
    env = BatchEnv(task, 1)
    env.reset([task.sample_context(np.random.default_rng(3))])
    for _ in range(90):
        observation = env.step(task.action_limit * np.array([direction]))[0]
        assert np.hypot(*observation[:2]) <= MAX_REACH + 1e-6
        assert np.linalg.norm(observation[:2] - observation[2:4]) < 0.03
    assert np.linalg.norm(observation[:2] - observation[2:4]) < 0.01


BAD_PLACES = [
    None,
    "here",
    [0.45],
    [0.45, -0.1],
    [0.45, -0.1, float("nan")],
    [0.45, -0.1, 2.0],
    [0.2, -0.1, 0.0],
    [0.45, 0.3, 0.0],
]


@pytest.mark.parametrize("task", BOTH)
@pytest.mark.parametrize("place", BAD_PLACES)
def test_a_bad_cube_is_refused_with_its_value_and_the_legal_range(task: Task, place: Any) -> None:
    context = task.sample_context(np.random.default_rng(0)) | {"red": place}
    with pytest.raises(ValueOutOfRangeError, match=r"red is .*\[x, y, yaw\].*0\.4") as caught:
        BatchEnv(task, 1).reset([context])
    assert repr(place) in str(caught.value)


@pytest.mark.parametrize("task", BOTH)
def test_cubes_that_touch_each_other_are_refused(task: Task) -> None:
    context = task.sample_context(np.random.default_rng(0))
    second = task.objects[1]
    context |= {"red": [0.50, -0.10, 0.0], second: [0.56, -0.10, 0.0]}
    with pytest.raises(ValueOutOfRangeError, match=f"{second} is .*0.09 m from any other"):
        BatchEnv(task, 1).reset([context])


@pytest.mark.parametrize("task", BOTH)
@pytest.mark.parametrize("start", [None, [0.5], [0.5, float("inf")], [0.45, -0.10], "there"])
def test_a_bad_start_is_refused_with_its_value(task: Task, start: Any) -> None:
    context = task.sample_context(np.random.default_rng(0)) | {"start": start}
    with pytest.raises(ValueOutOfRangeError, match=r"start is .*\[x, y\] in metres with x in"):
        BatchEnv(task, 1).reset([context])


RED_TARGET, GREEN_TARGET = TARGETS


@pytest.mark.parametrize(
    ("mode", "steps"),
    [
        ("rr-gg", [(RED_TARGET, SECOND_START), (RED_TARGET, GREEN_TARGET)]),
        ("gg-rr", [(RED_START, GREEN_TARGET), (RED_TARGET, GREEN_TARGET)]),
        ("rg-gr", [(GREEN_TARGET, SECOND_START), (GREEN_TARGET, RED_TARGET)]),
        ("gr-rg", [(RED_START, RED_TARGET), (GREEN_TARGET, RED_TARGET)]),
        # Red crosses green's target on its way; what counts is where it ends.
        (
            "gg-rr",
            [(GREEN_TARGET, SECOND_START), (RED_START, GREEN_TARGET), (RED_TARGET, GREEN_TARGET)],
        ),
        # Pushed out again and brought back: the first arrival counts.
        (
            "rr-gg",
            [
                (RED_TARGET, SECOND_START),
                (RED_START, SECOND_START),
                (RED_START, GREEN_TARGET),
                (RED_TARGET, GREEN_TARGET),
            ],
        ),
    ],
)
def test_pushing_modes_follow_the_rule_worked_by_hand(mode: str, steps: Any) -> None:
    objects = poses((RED_START, SECOND_START), *steps)
    assert outcome_of(PUSHING, objects) == {
        "success": True,
        "mode": mode,
        "group": PUSHING.group_of(mode),
        "reason": "finished",
    }


def test_a_failed_push_keeps_its_group_but_earns_no_mode() -> None:
    objects = poses((RED_START, SECOND_START), (RED_START, RED_TARGET))
    assert outcome_of(PUSHING, objects, "time_limit") == {
        "success": False,
        "mode": None,
        "group": "green-to-red",
        "reason": "time_limit",
    }
    assert outcome_of(PUSHING, objects[:1], "time_limit")["group"] is None


def test_a_target_is_reached_at_five_centimetres() -> None:
    x, y = RED_TARGET
    for gap, reached in ((REACHED - 1e-4, "red-to-red"), (REACHED + 1e-4, None)):
        objects = poses(((x - gap, y), SECOND_START))
        assert outcome_of(PUSHING, objects, "time_limit")["group"] == reached


IN_RED_BIN, IN_BLUE_BIN = (0.40, 0.25, 0.03), (0.62, 0.25, 0.03)
ON_PLATFORM = ((0.45, -0.10, 0.13), (0.60, -0.10, 0.13))


@pytest.mark.parametrize(
    ("mode", "middle"),
    [("red-blue", (IN_RED_BIN, ON_PLATFORM[1])), ("blue-red", (ON_PLATFORM[0], IN_BLUE_BIN))],
)
def test_sorting_modes_are_the_order_of_the_cubes_in_their_bins(mode: str, middle: Any) -> None:
    objects = poses(ON_PLATFORM, middle, (IN_RED_BIN, IN_BLUE_BIN))
    found = outcome_of(SORTING, objects)
    assert (found["success"], found["mode"]) == (True, mode)
    assert found["group"] == SORTING.group_of(mode)
    started = outcome_of(SORTING, objects[:2], "time_limit")
    assert (started["mode"], started["group"]) == (None, found["group"])
    assert outcome_of(SORTING, objects[:1], "time_limit")["group"] is None


@pytest.mark.parametrize(
    "place",
    [(0.60, 0.25, 0.03), (0.40, 0.45, 0.03), (0.40, 0.25, 0.12)],
    ids=["other bin", "behind", "in the air"],
)
def test_a_cube_elsewhere_is_not_sorted(place: tuple[float, ...]) -> None:
    assert outcome_of(SORTING, poses((place, ON_PLATFORM[1])), "time_limit")["group"] is None


def test_a_cube_in_the_wrong_bin_ends_the_episode() -> None:
    context = SORTING.sample_context(np.random.default_rng(0))
    context |= {"red": [0.625, 0.05, 0.0], "blue": [0.45, -0.12, 0.0]}
    env, expert = BatchEnv(SORTING, 1), SortingExpert("blue-red")
    observation = env.reset([context])[0]
    while not env.done[0]:
        # As if the red cube were the blue one.
        swapped = np.concatenate([observation[:4], observation[8:12], observation[4:8]])
        observation = env.step(expert.act(swapped)[None])[0]
    assert env.outcomes()[0]["reason"] == "left_workspace"


def test_unknown_modes_are_refused_with_the_legal_ones() -> None:
    with pytest.raises(UnknownNameError, match="'rr'.*'rr-gg'.*'gg-rr'"):
        PushingExpert("rr")
    with pytest.raises(UnknownNameError, match="'gg-rr'.*'red-blue', 'blue-red'"):
        SortingExpert("gg-rr")
    for task in (PUSHING, SORTING):
        with pytest.raises(UnknownNameError, match="'up'"):
            task.group_of("up")


def test_push_frame_worked_by_hand() -> None:
    cube, target = np.array([[0.4, 0.1]]), np.array([[0.4, 0.3]])  # the push goes along y
    behind, left = np.array([[0.4, 0.04]]), np.array([[0.34, 0.1]])
    assert np.allclose(push_frame(behind, cube, target), [[-np.tanh(1.0), 0.0]])
    assert np.allclose(push_frame(left, cube, target), [[0.0, np.tanh(1.0)]])
    assert np.isfinite(push_frame(behind, target, target)).all()


def test_a_quarter_turn_of_a_cube_is_not_seen() -> None:
    def turned(yaw: float) -> NDArray[np.float64]:
        rows = poses((RED_START, SECOND_START))
        rows[0, 0, 3:] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        return cube_features(rows)

    assert np.allclose(turned(0.3), turned(0.3 + np.pi / 2), atol=1e-12)
    assert not np.allclose(turned(0.3), turned(0.5), atol=0.1)


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_a_clamped_point_is_within_reach_and_stays_there(x: float, y: float) -> None:
    once = clamp_reach(np.array([[x, y, 0.01]]))
    assert np.hypot(once[0, 0], once[0, 1]) <= MAX_REACH + 1e-12
    assert np.allclose(clamp_reach(once), once, atol=1e-12)
    assert once[0, 2] == 0.01


@given(st.floats(0.3, 0.72), st.floats(-0.4, 0.4))
def test_the_steering_field_is_finite_fast_enough_and_within_the_limit(x: float, y: float) -> None:
    velocity = steer((x, y), (0.45, -0.1), RED_TARGET, (0.60, -0.05))
    assert 0.003 < np.hypot(*velocity) <= PUSHING.action_limit


def test_the_field_has_no_jump_from_turning_in_to_pushing() -> None:
    """Along any line across the push's axis behind the cube neighbours differ a little only."""
    cube, target, far = (0.45, -0.1), (0.45, 0.3), (9.0, 9.0)
    for along in (-0.06, -0.075, -0.09, -0.12):
        across = np.linspace(-0.06, 0.06, 241)  # every half millimetre
        field = np.array([steer((0.45 - a, -0.1 + along), cube, target, far) for a in across])
        assert (
            np.linalg.norm(np.diff(field, axis=0), axis=1).max() < 0.002
        )  # a switch would be 0.014


def test_a_rod_in_front_of_a_cube_goes_round_it() -> None:
    rod, cube, target = np.array([0.47, 0.15]), (0.45, 0.0), (0.45, 0.3)
    distances = []
    for _ in range(80):
        rod = rod + steer((rod[0], rod[1]), cube, target, (9.0, 9.0))
        distances.append(float(np.hypot(rod[0] - cube[0], rod[1] - cube[1])))
        if rod[1] < cube[1] and abs(rod[0] - cube[0]) < 0.015:
            break
    assert rod[1] < -0.06 and abs(rod[0] - cube[0]) < 0.015
    assert min(distances) > KEEP_OUT - 0.01


def test_a_push_passes_a_cube_that_stands_in_its_way() -> None:
    straight = bend((0.52, -0.1), (0.52, 0.3), (9.0, 9.0))
    assert straight == pytest.approx((0.0, 1.0))
    for x, sign in ((0.51, 1), (0.53, -1)):
        assert sign * bend((0.52, -0.1), (0.52, 0.3), (x, 0.02))[0] > 0.3


def test_a_push_makes_no_detour_to_where_a_cube_cannot_be_fetched() -> None:
    outer = bend((0.62, -0.1), (0.62, 0.3), (0.61, 0.02))
    assert outer[0] < -0.3


def test_going_round_keeps_what_leads_outwards() -> None:
    assert go_round(1.0, 0.0, 0.05, 0.0, 1.0, turn=None) == (1.0, 0.0)
    bent = go_round(-1.0, 0.0, KEEP_OUT, 0.001, 1.0, turn=1.0)
    assert bent[1] > 0.99
