"""Aligning: starts, thresholds, the reading of modes from paths made by hand, and the experts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rodif_core.demonstrations import make_demonstrations
from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.tasks.aligning import (
    FLOOR,
    HALF,
    HIGH,
    INNER,
    LOW,
    MIN_REACH,
    REACHED_WITHIN,
    TOP,
    TURNED,
    AligningStateTask,
    aligned,
    in_box_frame,
    read_mode,
    within_reach,
)
from rodif_core.tasks.base import View
from rodif_core.tasks.blocks import MAX_REACH
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.experts.aligning import (
    INSIDE,
    OUTSIDE,
    AligningExpert,
    Side,
    inside,
    outside,
    push,
    steer,
)
from rodif_core.tasks.panda import ROD_RADIUS

TASK = AligningStateTask()
BOX, TARGET = (0.5, -0.2), (0.5, 0.3)  # m


def view_of(setpoints: NDArray[Any], ends: NDArray[Any], objects: NDArray[Any]) -> View:
    """A view of simulations whose arm, which Aligning does not look at, is at rest."""
    rows = len(ends)
    return View(
        setpoints=setpoints,
        ends=ends,
        rotations=np.tile(np.eye(3), (rows, 1, 1)),
        joints=np.zeros((rows, 7)),
        objects=objects,
        objects_before=objects,
    )


def pose(place: tuple[float, float], yaw: float = 0.0, height: float = 0.0) -> list[float]:
    return [*place, height, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def objects_of(box: list[float], target: list[float] | None = None) -> NDArray[np.float64]:
    """Poses (1, 2, 7) of a box and its target."""
    return np.array([[box, pose(TARGET) if target is None else target]])


def outcome_of(path: list[tuple[float, float, float]], reason: str = "finished") -> dict[str, Any]:
    """Outcome of an episode in which the box stands at BOX, turned by 0.4 rad, and the rod is at
    `path`, given in the box's frame."""
    sine, cosine = math.sin(0.4), math.cos(0.4)
    points = [
        (BOX[0] + cosine * x - sine * y, BOX[1] + sine * x + cosine * y, z) for x, y, z in path
    ]
    objects = np.repeat(objects_of(pose(BOX, 0.4)), len(path), axis=0)
    return TASK.outcome(np.array(points), objects, reason)


def contexts(count: int) -> list[dict[str, Any]]:
    return [TASK.sample_context(np.random.default_rng(seed)) for seed in range(count)]


def test_box_and_target_start_at_rest_where_the_context_says() -> None:
    drawn = contexts(8)
    env = BatchEnv(TASK, 8)
    env.reset(drawn)
    first = TASK.object_poses(env.qpos)
    for index, name in enumerate(TASK.objects):
        expected = np.array([context[name] for context in drawn])
        assert np.allclose(first[:, index, :2], expected[:, :2], atol=1e-3)
        yaw = 2 * np.arctan2(first[:, index, 6], first[:, index, 3])
        assert np.allclose(yaw, expected[:, 2], atol=5e-3)
    for _ in range(20):
        env.step(np.zeros((8, 3)))
    assert np.abs(TASK.object_poses(env.qpos) - first).max() < 1e-4


def test_the_target_never_moves_not_even_when_the_box_stands_in_it() -> None:
    for one in make_demonstrations(TASK, episodes=4, seed=5, preferred_share=0.5):
        target = TASK.object_poses(one.qpos)[:, 1]
        assert target.tobytes() == np.repeat(target[:1], len(target), axis=0).tobytes()


def test_the_rod_goes_through_the_target_without_touching_it() -> None:
    context = contexts(1)[0]
    moved = {}
    for name, place in (("away", [0.6, 0.35, 0.0]), ("in the way", [0.525, 0.2, 0.0])):
        env = BatchEnv(TASK, 1)
        env.reset([context | {"box": [0.4, -0.1, 0.0], "target": place}])
        for _ in range(70):
            env.step(np.array([[0.0, 0.0105, -0.0105]]))
        moved[name] = env.paths
    assert np.array_equal(moved["away"], moved["in the way"])
    assert moved["away"][0, 1] > 0.25


def test_the_rod_can_stand_in_the_box_without_touching_its_floor() -> None:
    env = BatchEnv(TASK, 1)
    context = contexts(1)[0] | {"start": [0.525, -0.35], "box": [0.525, -0.2, 0.3]}
    first = env.reset([context])[0]
    for _ in range(20):
        env.step(np.array([[0.0, 0.0075, 0.0]]))
    for _ in range(30):
        last = env.step(np.array([[0.0, 0.0, -0.0105]]))[0]
    assert last[5] == pytest.approx(LOW, abs=2e-3) and last[5] > FLOOR
    assert np.allclose(last[6:10], first[6:10], atol=1e-3)  # the box stayed


@pytest.mark.parametrize("mode", TASK.modes)
def test_pushing_a_wall_moves_the_box_and_ends_nothing(mode: str) -> None:
    env, expert = BatchEnv(TASK, 1), AligningExpert(mode)
    observation = env.reset(contexts(1))[0]
    start = observation[6:8].copy()
    for _ in range(80):
        observation = env.step(expert.act(observation)[None])[0]
    assert np.linalg.norm(observation[6:8] - start) > 0.05
    assert not env.done[0]


@pytest.mark.parametrize(
    ("offset", "turn", "reached"),
    [
        ((0.0, 0.0, 0.0), 0.0, True),
        ((REACHED_WITHIN - 1e-4, 0.0, 0.0), 0.0, True),
        ((REACHED_WITHIN + 1e-4, 0.0, 0.0), 0.0, False),
        ((0.013, 0.013, 0.0), 0.0, False),  # 18.4 mm
        ((0.012, 0.0, 0.014), 0.0, False),  # height counts
        ((0.0, 0.0, 0.0), math.radians(8.5), True),
        ((0.0, 0.0, 0.0), math.radians(-8.5), True),
        ((0.0, 0.0, 0.0), math.radians(8.8), False),
        ((0.0, 0.0, 0.0), math.radians(90), False),  # the walls have colours
        ((0.0, 0.0, 0.0), math.radians(360), True),
    ],
)
def test_success_needs_place_and_yaw(
    offset: tuple[float, float, float], turn: float, reached: bool
) -> None:
    box = pose((TARGET[0] + offset[0], TARGET[1] + offset[1]), 1.2 + turn, offset[2])
    objects = objects_of(box, pose(TARGET, 1.2))
    assert aligned(objects).tolist() == [reached]
    assert TASK.finished(view_of(np.zeros((1, 3)), np.zeros((1, 3)), objects)).tolist() == [reached]


def test_a_tilted_box_is_not_aligned() -> None:
    half = math.radians(9) / 2
    tilted = [*TARGET, 0.0, math.cos(half), math.sin(half), 0.0, 0.0]
    assert not aligned(objects_of(tilted)).any()


def test_thresholds_are_those_of_d3il() -> None:
    assert REACHED_WITHIN == 0.018
    assert TURNED / math.pi == pytest.approx(0.048)


@pytest.mark.parametrize(
    "box",
    [[0.5, 0.0, -0.05, 1.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.05, math.sqrt(0.5), math.sqrt(0.5), 0, 0]],
    ids=["fallen", "toppled"],
)
def test_a_box_that_cannot_be_brought_back_has_left(box: list[float]) -> None:
    here = view_of(np.zeros((1, 3)), np.zeros((1, 3)), objects_of(pose(BOX)))
    gone = view_of(np.zeros((1, 3)), np.zeros((1, 3)), objects_of(box))
    assert TASK.inside(here).tolist() == [True]
    assert TASK.inside(gone).tolist() == [False]


AT_INNER_WALL, AT_OUTER_WALL = INNER - ROD_RADIUS, HALF + ROD_RADIUS
WITHIN = [(AT_INNER_WALL, 0.01, LOW), (-0.02, AT_INNER_WALL, LOW)]
BESIDE = [(0.0, -AT_OUTER_WALL, LOW), (-AT_OUTER_WALL - 0.002, 0.03, LOW)]
ABOVE = [(AT_INNER_WALL, 0.0, TOP + 0.005), (0.0, AT_OUTER_WALL, TOP + 0.005)]
FREE = [(0.0, 0.0, LOW), (0.2, 0.0, LOW), (0.0, 0.075, LOW)]  # in the middle, away, near


@pytest.mark.parametrize(
    ("path", "mode"),
    [
        (FREE + WITHIN, "inside"),
        (FREE + BESIDE, "outside"),
        (WITHIN + BESIDE + BESIDE, "outside"),
        (BESIDE + WITHIN + WITHIN, "inside"),
        (WITHIN + ABOVE + ABOVE, "inside"),
        (BESIDE + ABOVE + FREE, "outside"),
        # What D3IL would call inside by the last step alone.
        (BESIDE * 3 + WITHIN[:1], "outside"),
        # At the corner the rod is as near as at a wall.
        ([(0.057, 0.057, LOW)], "outside"),
    ],
)
def test_modes_are_where_the_rod_was_in_most_steps_of_contact(path: Any, mode: str) -> None:
    assert outcome_of(path) == {
        "success": True,
        "mode": mode,
        "group": mode,
        "reason": "finished",
    }
    failed = outcome_of(path, "time_limit")
    assert (failed["success"], failed["mode"], failed["group"]) == (False, None, mode)


@pytest.mark.parametrize("path", [FREE, ABOVE, [(0.075, 0.075, LOW)]])
def test_without_contact_there_is_no_group(path: Any) -> None:
    assert outcome_of(path, "time_limit")["group"] is None


@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-3.1, 3.1))
def test_the_reading_of_a_mode_does_not_depend_on_where_the_box_is(
    x: float, y: float, yaw: float
) -> None:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    for steps, mode in ((WITHIN, "inside"), (BESIDE, "outside"), (FREE, None)):
        path = [(x + cosine * a - sine * b, y + sine * a + cosine * b, c) for a, b, c in steps]
        boxes = np.array([pose((x, y), yaw)] * len(path))
        assert read_mode(np.array(path), boxes) == mode


def test_observations_worked_by_hand() -> None:
    # The box looks along y; the target is straight ahead of it, turned by a quarter to its right.
    objects = objects_of(pose(BOX, math.pi / 2), pose(TARGET, 0.0))
    view = view_of(np.array([[0.4, -0.3, 0.2]]), np.array([[0.47, -0.2, 0.1]]), objects)
    expected = [0.4, -0.3, 0.2, 0.47, -0.2, 0.1]
    expected += [*BOX, 1.0, 0.0, *TARGET, 0.0, 1.0]
    expected += [0.0, math.tanh(0.03 / 0.06), math.tanh(0.5 / 0.1), 0.0, -1.0, 0.0]
    assert np.allclose(TASK.observe(view), [expected], atol=1e-12)
    assert np.isfinite(TASK.observe(view_of(view.setpoints, view.ends, objects[:, [0, 0]]))).all()


def test_box_frame_worked_by_hand() -> None:
    boxes = np.array([pose((0.5, 0.1), math.pi / 2)])
    assert np.allclose(in_box_frame(np.array([[0.5, 0.3]]), boxes), [[0.2, 0.0]])
    assert np.allclose(in_box_frame(np.array([[0.4, 0.1]]), boxes), [[0.0, 0.1]])


@pytest.mark.parametrize("direction", [(1, 1, 1), (1, -1, -1), (-1, 1, 0), (-1, -1, 1), (0, 1, -1)])
def test_the_arm_stays_calm_when_it_is_pushed_against_its_reach(
    direction: tuple[int, int, int],
) -> None:
    env = BatchEnv(TASK, 1)
    env.reset([contexts(1)[0] | {"box": [0.6, -0.1, 0.0]}])
    for _ in range(90):
        observation = env.step(TASK.action_limit * np.array([direction]))[0]
        assert LOW - 1e-6 <= observation[2] <= HIGH + 1e-6
        assert np.linalg.norm(observation[:3] - observation[3:6]) < 0.035
    assert np.linalg.norm(observation[:3] - observation[3:6]) < 0.01


BAD_PLACES = [None, "here", [0.5, -0.2], [0.5, -0.2, math.nan], [0.5, -0.2, 2.0], [0.3, -0.2, 0.0]]


@pytest.mark.parametrize("name", ["box", "target"])
@pytest.mark.parametrize("place", [*BAD_PLACES, [0.5, 0.05, 0.0]])
def test_a_bad_place_is_refused_with_its_value_and_the_legal_range(name: str, place: Any) -> None:
    with pytest.raises(ValueOutOfRangeError, match=rf"{name} is .*\[x, y, yaw\].*0\.4") as caught:
        BatchEnv(TASK, 1).reset([contexts(1)[0] | {name: place}])
    assert repr(place) in str(caught.value)


def test_unknown_modes_are_refused_with_the_legal_ones() -> None:
    with pytest.raises(UnknownNameError, match="'within'.*'inside', 'outside'"):
        AligningExpert("within")
    with pytest.raises(UnknownNameError, match="'up'.*'inside'"):
        TASK.group_of("up")


def test_steering_turns_towards_the_goal_and_goes_straight_when_it_lies_ahead() -> None:
    assert steer(0, (0.3, 0.0), 0.0) == pytest.approx(0.0, abs=1e-12)
    assert steer(0, (0.3, 0.1), 0.0) > 0 > steer(0, (0.3, -0.1), 0.0)
    # Turned towards +x at the end: a way that swings out to the other side first.
    assert steer(1, (0.0, 0.3), -0.8) > 0 > steer(1, (0.0, 0.3), 0.8)


@pytest.mark.parametrize("side", [INSIDE, OUTSIDE])
def test_a_rod_at_its_place_pushes_straight(side: Side) -> None:
    forward, sideways = push((side.contact, 0.0), (0.3, 0.0), 0.0, side)
    assert forward > 0.004
    assert sideways == pytest.approx(0.0, abs=1e-9)


@given(
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    st.floats(LOW, HIGH),
    st.floats(-0.5, 0.5),
    st.floats(-0.5, 0.5),
    st.floats(-3.1, 3.1),
)
def test_the_experts_field_is_finite_and_within_the_limit(
    x: float, y: float, z: float, goal_x: float, goal_y: float, turn: float
) -> None:
    for field in (inside, outside):
        velocity = field((x, y), z, (goal_x, goal_y), turn)
        assert max(abs(part) for part in velocity) <= TASK.action_limit * math.sqrt(2)


@pytest.mark.parametrize("mode", TASK.modes)
def test_the_expert_is_equivariant_under_a_quarter_turn_of_the_scene(mode: str) -> None:
    """It reads the scene in the box's frame only."""
    expert = AligningExpert(mode)
    ends, boxes, targets = (
        np.array([[0.45, -0.1, 0.05]]),
        pose((0.5, -0.15), 0.3),
        pose(TARGET, 1.0),
    )
    view = view_of(ends, ends, objects_of(boxes, targets))
    turned_ends = np.array([[0.1, 0.45, 0.05]])  # (x, y) becomes (-y, x)
    turned = objects_of(
        pose((0.15, 0.5), 0.3 + math.pi / 2), pose((-TARGET[1], TARGET[0]), 1.0 + math.pi / 2)
    )
    first = expert.act(TASK.observe(view).astype(np.float32)[0])
    second = expert.act(
        TASK.observe(view_of(turned_ends, turned_ends, turned)).astype(np.float32)[0]
    )
    assert np.allclose(second, [-first[1], first[0], first[2]], atol=1e-5)


@pytest.mark.parametrize("mode", TASK.modes)
def test_the_expert_takes_over_wherever_it_is_left(mode: str) -> None:
    """From states off its own way: the rod was led astray for a while before."""
    env, expert, rng = BatchEnv(TASK, 6), AligningExpert(mode), np.random.default_rng(0)
    observations = env.reset(contexts(6))
    for step in range(TASK.max_steps):
        if env.done.all():
            break
        actions = np.stack([expert.act(row) for row in observations])
        if 60 <= step < 66:
            actions[:, :2] = rng.uniform(-TASK.action_limit, TASK.action_limit, (6, 2))
        observations = env.step(actions)
    outcomes = env.outcomes()
    assert sum(one["mode"] == mode for one in outcomes) >= 5


@given(st.floats(-1, 1.5), st.floats(-1, 1), st.floats(-1, 1))
def test_a_clamped_point_is_within_reach_and_stays_there(x: float, y: float, z: float) -> None:
    once = within_reach(np.array([[x, y, z]]))
    assert MIN_REACH - 1e-12 <= np.hypot(once[0, 0], once[0, 1]) <= MAX_REACH + 1e-12
    assert LOW <= once[0, 2] <= HIGH
    assert np.allclose(within_reach(once), once, atol=1e-12)
