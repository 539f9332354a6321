"""A scripted demonstrator for Stacking: reacts to the observation alone, given its order.

There is no clock and no remembered phase: which block is next, whether it is held and whether the
jaws must open follows from where the blocks and the fingers are. Movements are funnels: how high
the jaws want to be depends smoothly on how far they are, to the side and in yaw, from where they
are going, and they only move sideways as far as they are high enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import UnknownNameError
from rodif_core.tasks.base import Array
from rodif_core.tasks.experts.jaws import jaw_kinematics
from rodif_core.tasks.experts.push import ramp
from rodif_core.tasks.stacking import (
    GRIPPER_LIMIT,
    LEVELS,
    NAMES,
    PAD,
    SYMMETRY,
    StackingTask,
)

SPEED = 0.013  # m per control step, at most
GAIN = 0.25  # share of the way left that is gone in a control step
TURN_SPEED = 0.045  # rad per control step, at most
TURN_GAIN = 0.2
TURN_ARM = 0.05  # m; a yaw error counts as this times its rad to the side

FUNNEL = (0.006, 0.04)  # m to the side: down at the goal below, at the cruising height above
CLIMB = 0.04  # m below the wanted height at which sideways movement stops, and …
CLIMB_EDGE = 0.025  # m … over which it comes back
CRUISE_OVER = 0.095  # m of the empty jaws over the centre of the highest other block
CARRY = 0.12  # m; lowest cruising height with a block
CARRY_OVER_PLACE = 0.05  # m over where the block belongs

IN_JAWS = (0.018, 0.020)  # m to the side, m up or down: a block there is between the fingers
CLOSE_WITHIN = (0.007, 0.008, 0.12)  # m to the side, m up or down, rad: the fingers may close
FIRM = (0.018, 0.030)  # m that the fingers are kept from their set-point: not held, firmly held
OPEN = (0.064, 0.078)  # m of the opening's set-point: still holding, free to leave
SET_ON_PAD = 0.03  # m to the side, a block that is this near to the pad's middle stays there
SET_ON_TOWER = 0.02  # m to the side of the block below
SET_HEIGHT = 0.004  # m up or down
RETREAT = 0.12  # m over the finished tower

# The hand's noise: rad per control step of every joint, m of the opening.
HAND_TREMBLE = (0.0012,) * 7 + (0.0,)


@dataclass(frozen=True, eq=False)
class _Scene:
    """What the expert reads from an observation; metres and rad."""

    joints: Array  # (7,) set-points
    opening: float  # set-point
    jaws: Array  # (3,)
    gap: float  # measured opening
    blocks: Array  # (3, 3)
    lacking: Array  # (3,) turn that a grasp of each block still lacks, the shortest

    @classmethod
    def read(cls, observation: NDArray[np.float32]) -> _Scene:
        values = np.asarray(observation, dtype=np.float64)
        seen = values[29:44].reshape(3, 5)
        return cls(
            joints=values[:7],
            opening=float(values[7]),
            jaws=values[8:11],
            gap=float(values[13]),
            blocks=values[14:29].reshape(3, 5)[:, :3],
            lacking=np.arctan2(seen[:, 3], seen[:, 4]) / SYMMETRY,
        )

    def holds(self, block: int) -> bool:
        """Whether the block is between the fingers, gripped or not."""
        dx, dy, dz = self.jaws - self.blocks[block]
        return math.hypot(dx, dy) < IN_JAWS[0] and abs(dz) < IN_JAWS[1]


@dataclass(frozen=True)
class StackingExpert:
    """Puts one block after the other on the tower, in the order of its mode.

    Raises UnknownNameError for a mode that the task has not.
    """

    mode: str
    tremble: ClassVar[Array] = np.array(HAND_TREMBLE)

    def __post_init__(self) -> None:
        if self.mode not in StackingTask.modes:
            raise UnknownNameError("mode", self.mode, StackingTask.modes)

    def act(self, observation: NDArray[np.float32]) -> Array:
        """The steady hand's action (8,) in rad and metres for an observation (59,)."""
        scene = _Scene.read(observation)
        kinematics = jaw_kinematics()
        yaw = kinematics.place(scene.joints)
        level = self._first_missing(scene)
        block = None if level == len(LEVELS) else self._order[level]
        velocity, turn, grip = np.zeros(3), 0.0, 1.0
        if block is None:
            velocity = _toward(scene.jaws, np.array([*scene.jaws[:2], LEVELS[-1] + RETREAT]))
        elif scene.holds(block):
            velocity, turn, grip = self._hold(scene, block, level, yaw)
        else:
            velocity, turn = _approach(scene, block, yaw)
        if any(scene.holds(other) for other in range(len(NAMES)) if other != block):
            # What is not to be carried is let go before the jaws move on.
            free = ramp(scene.opening, *OPEN)
            velocity, turn, grip = free * velocity, free * turn, 1.0
        joints = kinematics.joint_step(velocity, turn)
        return np.append(joints, GRIPPER_LIMIT * grip)

    def to_json(self) -> dict[str, Any]:
        """The parameters, for the record of a demonstration."""
        return {"mode": self.mode, "tremble": self.tremble.tolist()}

    @property
    def _order(self) -> list[int]:
        return [NAMES.index(name) for name in self.mode.split("-")]

    def _place(self, scene: _Scene, level: int) -> Array:
        """Where the block of that level belongs (3,)."""
        below = np.array(PAD) if level == 0 else scene.blocks[self._order[level - 1], :2]
        return np.array([*below, LEVELS[level]])

    def _first_missing(self, scene: _Scene) -> int:
        """The lowest level whose block is not where it belongs; 3: the tower is complete."""
        for level, block in enumerate(self._order):
            offset = scene.blocks[block] - self._place(scene, level)
            slack = SET_ON_PAD if level == 0 else SET_ON_TOWER
            if math.hypot(offset[0], offset[1]) > slack or abs(offset[2]) > SET_HEIGHT:
                return level
        return len(LEVELS)

    def _hold(
        self, scene: _Scene, block: int, level: int, yaw: float
    ) -> tuple[Array, float, float]:
        """Velocity, turn and grip with the block between the fingers: close them, then carry."""
        firm = ramp(scene.gap - scene.opening, *FIRM)
        velocity, turn = _approach(scene, block, yaw)
        dx, dy, dz = scene.jaws - scene.blocks[block]
        side, up, lacking = CLOSE_WITHIN
        ready = (
            math.hypot(dx, dy) < side and abs(dz) < up and abs(scene.lacking[block]) < lacking
        ) or firm > 0
        place = self._place(scene, level)
        goal = place + scene.jaws - scene.blocks[block]
        cruise = max(CARRY, place[2] + CARRY_OVER_PLACE)
        carry = _funnel(scene.jaws, goal, cruise, TURN_ARM * abs(yaw))
        carry_turn = _shorten(-TURN_GAIN * yaw, TURN_SPEED) * ramp(scene.jaws[2], 0.04, 0.07)
        return (
            (1 - firm) * velocity + firm * carry,
            (1 - firm) * turn + firm * carry_turn,
            -1.0 if ready else 1.0,
        )


def _approach(scene: _Scene, block: int, yaw: float) -> tuple[Array, float]:
    """Velocity and turn of the empty jaws to where they can close around a block."""
    lacking = _nearest_grasp(float(scene.lacking[block]), yaw, float(SYMMETRY[block]))
    cruise = max(scene.blocks[other, 2] for other in range(len(NAMES)) if other != block)
    aside = TURN_ARM * abs(lacking)
    velocity = _funnel(scene.jaws, scene.blocks[block], cruise + CRUISE_OVER, aside)
    return velocity, _shorten(TURN_GAIN * lacking, TURN_SPEED)


def _nearest_grasp(lacking: float, yaw: float, symmetry: float) -> float:
    """Among all turns that lead to a grasp the shortest; a little for those that end untwisted, so
    that the choice is clear where two are equally short, and stays once the jaws have begun."""
    step = 2 * math.pi / symmetry
    turns = [lacking + k * step for k in (-1, 0, 1)]
    return min(turns, key=lambda turn: abs(turn) + 0.3 * abs(yaw + turn))


def _funnel(jaws: Array, goal: Array, cruise: float, aside: float) -> Array:
    """Velocity (3,) to `goal` (3,): over at the height `cruise`, then down.

    aside  m to the side that other errors count as
    """
    dx, dy = goal[0] - jaws[0], goal[1] - jaws[1]
    side = math.hypot(dx, dy)
    height = goal[2] + (max(cruise, goal[2]) - goal[2]) * ramp(math.hypot(side, aside), *FUNNEL)
    free = ramp(jaws[2] - height + CLIMB, 0.0, CLIMB_EDGE)
    # Near the goal small corrections to the side are always allowed.
    free = max(free, 1.0 - ramp(side, *FUNNEL))
    velocity = _toward(jaws, np.array([goal[0], goal[1], height]))
    return np.asarray(velocity * np.array([free, free, 1.0]))


def _toward(point: Array, goal: Array) -> Array:
    """Velocity (3,) to a goal: a share of the way, at most SPEED."""
    way = GAIN * (goal - point)
    return np.asarray(way * min(1.0, SPEED / max(float(np.linalg.norm(way)), 1e-9)))


def _shorten(value: float, limit: float) -> float:
    return min(limit, max(-limit, value))
