"""How a rod pushes a cube to a target: one smooth field of velocities, without phases.

A rod that first orbits a cube and then, by a switch, pushes it cannot be imitated: beside the
switch two opposite velocities are both right. Here the rod always heads for one point on the axis
of the push (the line through target and cube). Far off the axis the point lies behind the cube, on
the axis it lies ahead of it, and in between it slides along, so that turning in and pushing blend.

Legend: all positions are (x, y) in metres, all velocities metres per control step. The push frame
has its origin in the cube; `along` is towards the target, `across` to the left of that.
"""

from __future__ import annotations

import math

Point = tuple[float, float]

BEHIND = 0.085  # m; where a rod that is off the axis heads for, behind the cube's centre
AHEAD = 0.10  # m; where a rod on the axis heads for
AXIS_WIDTH = 0.011  # m off the axis at which the aim has fallen to 1/e of AHEAD, beside the cube
AXIS_OPENING = 0.25  # how much that widens per metre farther behind than BEHIND
KEEP_OUT = (
    0.075  # m; the rod goes round a cube's centre at this distance: half diagonal + rod + 1 cm
)
KEEP_OUT_EDGE = 0.035  # m; the way round begins to bend this far outside KEEP_OUT
FREE_ANGLE, ROUND_ANGLE = 0.55, 0.95  # rad behind the cube: no way round below, in full above
DETOUR = 0.105  # m; a pushed cube passes the other one's centre at this distance
SQUEEZE = (0.07, 0.11)  # m from the place behind the cube: nearer, the other cube is not avoided
ROOM_X = (0.36, 0.66)  # m; a cube farther out cannot be pushed back inwards: no detours there
# m per control step: standard deviation of the hand's noise in demonstrations. It takes the rod to
# where a policy's own errors will, and the expert shows the way back from there. Measured on 1,000
# demonstrations of Pushing with a small regression network: 86 % success with 0.0008, with this
# 100 % (docs/tasks.md).
HAND_TREMBLE = 0.002
FREE_SPEED = 0.0105  # m per control step
PUSH_SPEED = 0.0070
SLOW_BEFORE = 0.04  # m before the target the push slows down, to SLOWEST of its speed
SLOWEST = 0.5


def steer(rod: Point, cube: Point, target: Point, other: Point) -> Point:
    """Velocity of the rod that brings `cube` to `target` and goes round `other`."""
    left = math.dist(cube, target)
    ux, uy = bend(cube, target, other)
    rx, ry = rod[0] - cube[0], rod[1] - cube[1]
    along, across = rx * ux + ry * uy, ux * ry - uy * rx
    distance = math.hypot(rx, ry)

    width = AXIS_WIDTH + AXIS_OPENING * max(0.0, -along - BEHIND)
    on_axis = math.exp(-((across / width) ** 2)) if along < 0 else 0.0
    aim = -BEHIND + on_axis * (BEHIND + AHEAD)
    vx, vy = unit((aim - along) * ux + across * uy, (aim - along) * uy - across * ux)

    angle = math.atan2(abs(across), -along)  # from straight behind the cube
    off = ramp(angle, FREE_ANGLE, ROUND_ANGLE)
    vx, vy = go_round(vx, vy, rx, ry, off, turn=1.0 if across > 0 else -1.0)
    ox, oy = rod[0] - other[0], rod[1] - other[1]
    # Where the other cube leaves no room behind this one, the rod shoves it aside.
    squeeze = math.hypot(along + BEHIND, across)
    vx, vy = go_round(vx, vy, ox, oy, ramp(squeeze, *SQUEEZE), turn=None)

    push = PUSH_SPEED * max(SLOWEST, min(1.0, left / SLOW_BEFORE))
    speed = push + (FREE_SPEED - push) * max(ramp(distance, 0.085, 0.14), off)
    return speed * vx, speed * vy


def bend(cube: Point, target: Point, other: Point) -> Point:
    """Direction of the push: to the target, or past the other cube where that is in the way."""
    ux, uy = unit(target[0] - cube[0], target[1] - cube[1])
    ox, oy = other[0] - cube[0], other[1] - cube[1]
    ahead, aside = ox * ux + oy * uy, ux * oy - uy * ox
    room = math.dist(cube, target) - ahead
    wanted = max(0.0, DETOUR - abs(aside)) * ramp(ahead, 0.0, 0.05) * ramp(room, -0.02, 0.04)
    if wanted == 0.0:
        return ux, uy
    reach = max(ahead, 0.06)
    sign = -1.0 if aside > 0 else 1.0  # to the side where the other one is not
    passing = other[0] - sign * DETOUR * uy
    if not ROOM_X[0] < passing < ROOM_X[1]:
        sign = -sign
    return unit(reach * ux - sign * wanted * uy, reach * uy + sign * wanted * ux)


def go_round(
    vx: float, vy: float, rx: float, ry: float, weight: float, *, turn: float | None
) -> Point:
    """Bend a unit velocity so that it does not lead nearer to a cube than KEEP_OUT.

    rx, ry  from the cube's centre to the rod
    weight  0: leave the velocity alone; 1: in full
    turn    way round: 1 counter-clockwise, -1 clockwise, None whichever is nearer
    """
    distance = max(math.hypot(rx, ry), 1e-6)
    near = weight * ramp(KEEP_OUT + KEEP_OUT_EDGE - distance, 0.0, KEEP_OUT_EDGE)
    ex, ey = rx / distance, ry / distance
    inward = -(vx * ex + vy * ey)
    if near == 0.0 or inward <= 0.0:
        return vx, vy
    tangential = vy * ex - vx * ey
    if turn is None:
        turn = 1.0 if tangential > 0 else -1.0
    # What is lost inwards goes on along the circle; too near, the rod also backs out.
    outward = max(0.0, min(0.5, (KEEP_OUT - distance) / 0.02)) * near
    round_speed = (1 - near) * tangential + near * turn * max(abs(tangential), inward)
    inward = (1 - near) * inward - outward
    return unit(-inward * ex - round_speed * ey, -inward * ey + round_speed * ex)


def ramp(value: float, low: float, high: float) -> float:
    """0 below `low`, 1 above `high`, smooth in between."""
    share = min(1.0, max(0.0, (value - low) / (high - low)))
    return share * share * (3 - 2 * share)


def unit(x: float, y: float) -> Point:
    """(x, y) at length 1; the zero vector stays."""
    length = math.hypot(x, y)
    return (x / length, y / length) if length > 1e-12 else (0.0, 0.0)
