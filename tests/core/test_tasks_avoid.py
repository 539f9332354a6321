"""Avoid: contact, limits, tracking, and the reading of modes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.tasks.avoid import (
    FINISH_Y,
    MAX_X,
    MIN_REACH,
    MIN_X,
    MIN_Y,
    ROD_HEIGHT,
    ROWS,
    START,
    AvoidTask,
    passed_gaps,
)
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.panda import ROD_RADIUS

TASK = AvoidTask()
NO_OBJECTS = np.zeros((1, 0, 7))
LIMIT = TASK.action_limit


def drive(
    starts: list[list[float]], action: Any, steps: int = TASK.max_steps
) -> tuple[NDArray[np.float32], list[dict[str, Any]]]:
    """Hold one action per simulation; returns paths (steps + 1, n, 3) and outcomes."""
    env = BatchEnv(TASK, len(starts))
    env.reset([{"start": start} for start in starts])
    actions = np.broadcast_to(np.asarray(action, dtype=np.float64), (len(starts), 2))
    paths = [env.paths]
    for _ in range(steps):
        if env.done.all():
            break
        env.step(actions)
        paths.append(env.paths)
    while not env.done.all():
        env.step(np.zeros((len(starts), 2)))
    return np.stack(paths), env.outcomes()


def test_an_observation_is_the_set_point_and_the_rod_after_the_step() -> None:
    env = BatchEnv(TASK, 1)
    first = env.reset([{"start": list(START)}])[0]
    assert np.allclose(first, [*START, *START], atol=2e-5)
    second = env.step(np.array([[0.01, -0.005]]))[0]

    assert np.allclose(second[:2], [START[0] + 0.01, START[1] - 0.005], atol=1e-6)
    assert np.array_equal(second[2:], env.paths[0, :2])
    moved = second[2:] - first[2:]
    assert 0 < moved[0] < 0.01 and -0.005 < moved[1] < 0


def test_actions_are_clipped_to_the_limit_on_each_axis() -> None:
    env = BatchEnv(TASK, 2)
    env.reset([{"start": list(START)}] * 2)
    seen = env.step(np.array([[1.0, -0.002], [LIMIT, -0.002]]))
    assert seen[0].tobytes() == seen[1].tobytes()


def test_the_rod_stays_within_a_millimetre_when_it_holds_still() -> None:
    paths, outcomes = drive([list(START)], [0.0, 0.0])
    drift = np.linalg.norm(paths[:, 0] - [*START, ROD_HEIGHT], axis=1)
    assert len(paths) == TASK.max_steps + 1
    assert drift.max() < 0.001
    assert outcomes[0]["reason"] == "time_limit"


@pytest.mark.parametrize("direction", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (1.0, 0.3)])
def test_the_rod_follows_within_12_mm_when_it_moves_at_full_speed(
    direction: tuple[float, float],
) -> None:
    env = BatchEnv(TASK, 1)
    env.reset([{"start": [0.5, -0.33]}])
    errors, heights = [], []
    for _ in range(14):
        setpoint, end = env.step(LIMIT * np.array([direction]))[0].reshape(2, 2)
        errors.append(np.linalg.norm(setpoint - end))
        heights.append(env.paths[0, 2])
    assert max(errors) < 0.012
    assert np.abs(np.array(heights) - ROD_HEIGHT).max() < 0.001


def test_driving_straight_on_hits_the_first_cylinder_at_its_edge() -> None:
    paths, outcomes = drive([[0.5, -0.28]], [0.0, LIMIT])
    assert outcomes[0]["reason"] == "collision" and not outcomes[0]["success"]
    last = paths[-1, 0, :2] - ROWS[0][0][:2]
    contact = ROWS[0][0][2] + ROD_RADIUS
    assert contact - 0.003 < np.linalg.norm(last) < contact + 0.001


def test_a_graze_between_two_control_steps_is_a_collision() -> None:
    """Contacts that are over before the control step ends were invisible to a check per step."""
    x, y, radius = ROWS[0][0]
    contact = radius + ROD_RADIUS
    offsets, phases = np.meshgrid(np.linspace(-0.0006, 0.0006, 7), np.arange(8) * LIMIT / 8)
    starts = [
        [x + contact + offset, -0.28 + phase]
        for offset, phase in zip(offsets.ravel(), phases.ravel(), strict=True)
    ]
    paths, outcomes = drive(starts, [0.0, LIMIT], steps=24)
    distances = np.hypot(paths[..., 0] - x, paths[..., 1] - y)
    hidden, missed = 0, 0
    for index, outcome in enumerate(outcomes):
        nearest = distances[:, index].min()
        if outcome["reason"] == "collision":
            hidden += nearest > contact + 1e-4
        else:
            missed += nearest < contact - 1e-4
    assert hidden >= 1, "no start grazes between control steps; widen the search"
    assert missed == 0


@pytest.mark.parametrize(
    ("start", "action"),
    [
        ([0.40, -0.28], [-LIMIT, 0.0]),  # left limit
        ([0.60, -0.28], [LIMIT, 0.0]),  # right limit
        ([0.50, -0.30], [0.0, -LIMIT]),  # towards the robot's right
        ([0.31, -0.15], [0.0, 0.006]),  # too near to the base
    ],
)
def test_leaving_the_workspace_is_a_failure(start: list[float], action: list[float]) -> None:
    paths, outcomes = drive([start], action)
    assert outcomes[0] == {
        "success": False,
        "mode": None,
        "group": outcomes[0]["group"],
        "reason": "left_workspace",
    }
    x, y = paths[-1, 0, :2]
    assert x < MIN_X or x > MAX_X or y < MIN_Y or np.hypot(x, y) < MIN_REACH


def test_the_arm_stays_calm_when_it_is_pushed_against_its_reach() -> None:
    env = BatchEnv(TASK, 1)
    env.reset([{"start": [0.70, -0.20]}])
    for _ in range(TASK.max_steps):
        setpoint, end = env.step(np.array([[LIMIT, LIMIT]]))[0].reshape(2, 2)
        assert np.linalg.norm(setpoint - end) < 0.02
    assert env.outcomes()[0]["reason"] == "left_workspace"


def test_a_failed_episode_keeps_its_group_but_earns_no_mode() -> None:
    path = np.array([[0.44, -0.28, 0.03], [0.44, -0.10, 0.03], [0.425, 0.03, 0.03]])
    assert TASK.outcome(path, NO_OBJECTS, "collision") == {
        "success": False,
        "mode": None,
        "group": "left",
        "reason": "collision",
    }
    assert TASK.outcome(path[:1], NO_OBJECTS, "time_limit")["group"] is None


@pytest.mark.parametrize(
    ("x1", "x2", "x3", "mode", "group"),
    [
        (0.44, 0.40, 0.30, "L-11", "left"),
        (0.44, 0.50, 0.42, "L-22", "left"),
        (0.49, 0.60, 0.58, "L-33", "left"),
        (0.51, 0.42, 0.70, "R-14", "right"),
        (0.56, 0.58, 0.40, "R-32", "right"),
        (0.56, 0.57, 0.66, "R-24", "right"),
    ],
)
def test_modes_follow_the_rule_worked_by_hand(
    x1: float, x2: float, x3: float, mode: str, group: str
) -> None:
    """First step with |y + 0.10| <= 0.03, then |y - 0.08| <= 0.03, then y >= 0.26."""
    path = np.array(
        [
            [0.525, -0.28],
            [0.9, -0.14],  # 4 cm before the first row: does not count
            [x1, -0.125],
            [1.0 - x1, -0.10],  # still in the band: too late
            [0.9, 0.04],
            [x2, 0.06],
            [0.9, 0.25],
            [x3, 0.27],
            [0.5, FINISH_Y + 0.01],
        ]
    )
    outcome = TASK.outcome(path, NO_OBJECTS, "finished")
    assert (outcome["success"], outcome["mode"], outcome["group"]) == (True, mode, group)


def test_there_are_24_modes_half_of_them_left() -> None:
    assert len(TASK.modes) == 24
    assert sum(mode.startswith("L") for mode in TASK.modes) == 12


@given(
    st.lists(
        st.floats(0.27, 0.73).filter(lambda x: min(abs(x - e) for e in MIRROR_EDGES) > 1e-9),
        min_size=3,
        max_size=3,
    ),
    st.integers(1, 3),
)
def test_a_mirrored_path_has_the_mirrored_mode(xs: list[float], rows: int) -> None:
    path = np.array([[0.5, -0.28], *zip(xs, (-0.10, 0.08, 0.27), strict=True)])[: rows + 1]
    mirrored = path * [-1, 1] + [1, 0]
    gaps, other = passed_gaps(path), passed_gaps(mirrored)
    for gap, mirror, count in zip(gaps, other, (2, 3, 4), strict=True):
        assert (gap is None) == (mirror is None)
        if gap is not None and mirror is not None:
            assert gap + mirror == count + 1


MIRROR_EDGES = [x for row in ROWS for x, _, _ in row]


@pytest.mark.parametrize(
    "context",
    [
        {},
        {"start": None},
        {"start": "left"},
        {"start": [0.5]},
        {"start": [0.5, float("nan")]},
        {"start": [0.2, -0.28]},
        {"start": [0.5, 0.2]},
        {"start": [0.5, -0.5]},
        {"start": [0.74, -0.28]},
    ],
)
def test_a_bad_start_is_refused_with_its_value_and_the_legal_range(context: dict[str, Any]) -> None:
    with pytest.raises(ValueOutOfRangeError) as caught:
        BatchEnv(TASK, 1).reset([context])
    assert repr(context.get("start")) in str(caught.value)
    assert f"[{MIN_X}, {MAX_X}]" in str(caught.value)


def test_scene_shapes_tell_the_geometry_of_the_physics() -> None:
    model = TASK.build_model()
    shapes = TASK.scene_shapes()
    drawn = sorted((s["x"], s["y"], s["radius"]) for s in shapes if s["type"] == "cylinder")
    simulated = sorted(
        (*model.geom_pos[i][:2].tolist(), float(model.geom_size[i][0]))
        for i in range(model.ngeom)
        if model.geom(i).name.startswith("cylinder")
    )
    assert len(drawn) == 6
    assert np.allclose(drawn, simulated)
    assert next(s for s in shapes if s["type"] == "finish")["y"] == FINISH_Y
