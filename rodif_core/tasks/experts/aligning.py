"""A scripted demonstrator for Aligning: reacts to the observation alone, given its mode.

A rod that pushes a wall `offset` metres off its middle turns the box by -offset / FOOT_RADIUS^2 per
metre, so a pushed box is a vehicle that only drives forwards: its heading is the pushed wall's
normal, its curvature is the rod's offset on that wall. It is steered with the smooth law of Park
and Kuipers (ICRA 2011), which brings a vehicle to a pose. Four walls are four headings, and the
expert takes the one with the shortest way; a rod that is already at a wall rather stays there.

Legend: `heading` h of 0 … 3 points along h quarter turns in the box's frame; `ahead` and `aside`
are the rod's coordinates along the heading and to the left of it. Metres, radians, and metres per
control step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import UnknownNameError
from rodif_core.tasks.aligning import (
    FOOT,
    HALF,
    INNER,
    LOW,
    TOP,
    AligningStateTask,
)
from rodif_core.tasks.base import Array
from rodif_core.tasks.experts.push import HAND_TREMBLE, go_round, ramp, unit
from rodif_core.tasks.panda import ROD_RADIUS

Point = tuple[float, float]

FOOT_RADIUS = math.sqrt(2) * FOOT  # m from the middle of the box to its feet


@dataclass(frozen=True)
class Side:
    """How to push from one side of the walls.

    contact  where the rod's middle is when it pushes, ahead
    free     where it waits until its offset is right, ahead
    reach    largest offset
    """

    contact: float
    free: float
    reach: float


INSIDE = Side(INNER - ROD_RADIUS, 0.012, 0.026)
BEHIND = -0.085  # m ahead; outside the rod keeps this far behind the middle of the box
OUTSIDE = Side(-HALF - ROD_RADIUS, BEHIND, 0.038)

TURN = 0.05  # m of way per squared radian of turning, in the choice of the wall
MOVE = 1.5  # m of way that a metre of the rod's own way to a wall counts for
BEYOND = 0.035  # m behind the goal: what the box is steered to, so that it passes straight
SLACK = 0.006  # m; passing the goal at this distance is as good as through its middle
NEAREST = 0.04  # m; the steering law has no bound at its goal
BEND_BEARING, BEND_HEADING = 1.0, 2.0  # k1 and k2 of the steering law
OFFSET_WIDTH = 0.012  # m off its wanted place at which the rod pushes at 1/e of its speed
GAIN = 0.4  # of the way to its wanted place that the rod goes in one control step
GAP_GAIN = 0.3  # of the gap to the wall that it closes on top of the speed of the push
TOUCHING = 0.003  # m; a rod that is nearer to its wall goes along when the wall turns
FREE_SPEED = 0.0105  # m per control step
PUSH_SPEED = 0.0070  # m per control step
BACK_ANGLE, ROUND_ANGLE = 0.75, 1.05  # rad behind the box: no way round below, in full above
SLOW_BEFORE, SLOWEST = 0.05, 0.5  # m before the target the push slows down, to that of its speed
OVERLAP = HALF + ROD_RADIUS - 0.004  # m; nearer to the middle the rod is not beside the box
HOVER = TOP + 0.03  # m; the rod's tip is at this height on its way over a wall
OVER = (0.010, 0.022)  # m from the middle of the box, seen from above: go down below, hover above
NEAR_WALL = (0.12, 0.16)  # m from the middle: a rod that is farther need not be high yet
DEEP = 0.03  # m below the walls' edge: deep enough to push from within


@dataclass(frozen=True)
class AligningExpert:
    """Brings the box to its target from the inside or from the outside.

    Raises UnknownNameError for a mode that the task has not.
    """

    mode: str
    tremble: ClassVar[float] = HAND_TREMBLE

    def __post_init__(self) -> None:
        if self.mode not in AligningStateTask.modes:
            raise UnknownNameError("mode", self.mode, AligningStateTask.modes)

    def act(self, observation: NDArray[np.float32]) -> Array:
        """The steady hand's action (3,) in metres for an observation (20,)."""
        values = [float(value) for value in observation[:14]]
        height = values[5]
        sine, cosine = values[8], values[9]
        rod = _turned(values[3] - values[6], values[4] - values[7], cosine, -sine)
        goal = _turned(values[10] - values[6], values[11] - values[7], cosine, -sine)
        turn = math.atan2(values[12], values[13]) - math.atan2(sine, cosine)
        if self.mode == "inside":
            vx, vy, vz = inside(rod, height, goal, turn)
        else:
            vx, vy, vz = outside(rod, height, goal, turn)
        return np.array([*_turned(vx, vy, cosine, sine), vz])

    def to_json(self) -> dict[str, Any]:
        """The parameters, for the record of a demonstration."""
        return {"mode": self.mode, "tremble": self.tremble}


def inside(rod: Point, height: float, goal: Point, turn: float) -> tuple[float, float, float]:
    """Velocity in the box's frame: over the middle, down, and against a wall from within."""
    off = math.hypot(*rod)
    within = max(abs(rod[0]), abs(rod[1])) < INNER and height < TOP
    if within:
        vx, vy = push(rod, goal, turn, INSIDE)
        deep = ramp(TOP - height, 0.0, DEEP)
        return deep * vx, deep * vy, _climb(LOW - height)
    wanted = LOW + (HOVER - LOW) * ramp(off, *OVER)
    # Too low to come over the wall: up first.
    share = ramp(height, TOP - 0.01, TOP + 0.01) if off > OVER[1] else 1.0
    share = max(share, ramp(off, *NEAR_WALL))
    speed = share * min(FREE_SPEED, GAIN * off)
    ux, uy = unit(-rod[0], -rod[1])
    return speed * ux, speed * uy, _climb(wanted - height)


def outside(rod: Point, height: float, goal: Point, turn: float) -> tuple[float, float, float]:
    """Velocity in the box's frame: down beside the box, round it, and against a wall."""
    if max(abs(rod[0]), abs(rod[1])) < OVERLAP:  # over the box or in it: get out first
        ux, uy = unit(*rod)
        speed = FREE_SPEED * ramp(height, TOP - 0.01, TOP + 0.01)
        return speed * ux, speed * uy, _climb(HOVER - height)
    vx, vy = push(rod, goal, turn, OUTSIDE)
    deep = 1 - ramp(height, TOP - 0.02, TOP + 0.04)
    return deep * vx, deep * vy, _climb(LOW - height)


def push(rod: Point, goal: Point, turn: float, side: Side) -> Point:
    """Velocity of a rod at the height of the walls that pushes the box towards its goal."""
    heading = min(range(4), key=lambda h: way(h, rod, goal, turn, side))
    cosine, sine = _QUARTERS[heading]
    ahead, aside = _turned(*rod, cosine, -sine)
    distance = math.hypot(*goal)
    wanted = offset(heading, goal, turn, side)
    error = wanted - aside
    on = math.exp(-((error / OFFSET_WIDTH) ** 2))
    speed = PUSH_SPEED * max(SLOWEST, min(1.0, distance / SLOW_BEFORE))
    gap = max(0.0, side.contact - ahead)
    forward = on * min(FREE_SPEED, speed + GAP_GAIN * gap)
    forward += (1 - on) * _clip(GAIN * (side.free - ahead), FREE_SPEED)
    # The wall turns with the box; the rod goes along.
    carried = -wanted / FOOT_RADIUS**2 * side.contact * on * speed if gap < TOUCHING else 0.0
    sideways = _clip(GAIN * error, FREE_SPEED) + carried
    if side is OUTSIDE:
        forward, sideways = _round(ahead, aside, forward, sideways)
    return _turned(forward, sideways, cosine, sine)


def _round(ahead: float, aside: float, forward: float, sideways: float) -> Point:
    """Round the box to the wall behind its middle."""
    angle = math.atan2(abs(aside), -ahead)
    off = ramp(angle, BACK_ANGLE, ROUND_ANGLE)
    if off == 0.0:
        return forward, sideways
    ux, uy = unit(BEHIND - ahead, -aside)
    ux, uy = go_round(ux, uy, ahead, aside, 1.0, turn=1.0 if aside > 0 else -1.0)
    return (
        (1 - off) * forward + off * FREE_SPEED * ux,
        (1 - off) * sideways + off * FREE_SPEED * uy,
    )


def way(heading: int, rod: Point, goal: Point, turn: float, side: Side) -> float:
    """Estimate of the way to the goal by pushing along `heading`, in metres."""
    bearing, final, distance = _angles(heading, goal, turn)
    cosine, sine = _QUARTERS[heading]
    ahead, aside = _turned(*rod, cosine, -sine)
    travel = math.hypot(ahead - side.contact, aside - offset(heading, goal, turn, side))
    return distance + TURN * (bearing**2 + final**2) + MOVE * travel


def offset(heading: int, goal: Point, turn: float, side: Side) -> float:
    """Where on the wall to push, aside of its middle."""
    return _clip(-steer(heading, goal, turn) * FOOT_RADIUS**2, side.reach)


def steer(heading: int, goal: Point, turn: float) -> float:
    """Curvature in 1/m of the way to the goal (Park and Kuipers 2011, eq. 14)."""
    bearing, final, distance = _angles(heading, goal, turn)
    distance = max(distance, NEAREST)
    wanted = math.atan(-BEND_BEARING * final)
    bend = 1 + BEND_BEARING / (1 + (BEND_BEARING * final) ** 2)
    return -(BEND_HEADING * (bearing - wanted) + bend * math.sin(bearing)) / distance


def _angles(heading: int, goal: Point, turn: float) -> tuple[float, float, float]:
    """Present and final heading as seen from the line of sight to a point that lies BEYOND the
    goal, in +- pi, and the distance of that point."""
    final = heading * math.pi / 2 + turn
    cosine, sine = math.cos(final), math.sin(final)
    aside = cosine * goal[1] - sine * goal[0]
    slack = _clip(aside, SLACK)
    x, y = goal[0] + BEYOND * cosine + slack * sine, goal[1] + BEYOND * sine - slack * cosine
    sight = math.atan2(y, x)
    now = heading * math.pi / 2 - sight
    return _wrap(now), _wrap(now + turn), math.hypot(x, y)


_QUARTERS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))  # cosine and sine


def _turned(x: float, y: float, cosine: float, sine: float) -> Point:
    return cosine * x - sine * y, sine * x + cosine * y


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)


def _clip(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def _climb(error: float) -> float:
    """Vertical speed that takes the rod's tip `error` metres up."""
    return _clip(GAIN * error, FREE_SPEED)
