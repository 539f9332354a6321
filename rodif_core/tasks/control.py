"""From set-points to servo targets, for many arms at once: with a rod and with the gripper.

The set-point of a rod is a point, which inverse kinematics turns into joint targets; that of the
gripper arm is the joint targets themselves and the opening of the fingers.

Inverse kinematics: damped least squares (Wampler 1986, Nakamura & Hanafusa 1986) on the
six-dimensional error of the tool, with a pull of the redundant joint towards the home posture. It
runs on the set-points only, never on measured joints, so that the joint targets do not depend on
how well the servos track.
"""

from __future__ import annotations

from typing import Protocol

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray

from rodif_core.tasks.panda import (
    ARM_JOINTS,
    GRIPPER_HOME_QPOS,
    HOME_QPOS,
    MAX_OPENING,
    TOOL_BODY,
    TOOL_SITE,
    gripper_scene,
    rod_scene,
)

Array = NDArray[np.float64]

DAMPING = 1e-4  # added to the diagonal of J J^T
POSTURE_GAIN = 0.02  # share of the way home per iteration, in the null space
MAX_POSITION_ERROR = 0.08  # m per iteration; without these three clamps it diverges from afar
MAX_ROTATION_ERROR = 0.2  # rad per iteration
MAX_JOINT_STEP = 0.2  # rad per iteration
TRACKING_ITERATIONS = 2  # per control step, warm-started: residual below 0.1 mm within reach
START_ITERATIONS = 60  # from the home posture to any start

# Rod straight down, flange turned by 45 degrees as the real gripper is mounted.
TOOL_DOWN = np.array(
    [[np.sqrt(0.5), -np.sqrt(0.5), 0.0], [-np.sqrt(0.5), -np.sqrt(0.5), 0.0], [0.0, 0.0, -1.0]]
)
# The gripper straight down: its fingers close along the world's y.
GRIPPER_DOWN = np.diag([1.0, -1.0, -1.0])


class Control(Protocol):
    """How a task's set-points become servo targets.

    Legend: m simulations, S set-point dims, U servos; the servos are those of the robot's joints,
    in the joints' order.
    """

    def start(self, points: Array) -> tuple[Array, Array]:
        """Set-points (m, S) and servo targets (m, U) that hold the end effectors at `points`
        (m, 3), in metres."""

    def targets(self, setpoints: Array, last: Array) -> Array:
        """Servo targets (m, U) for set-points (m, S), after the targets `last` (m, U)."""


class RodControl:
    """Set-points (m, 3) are places of the rod's tip, in metres; the rod stays upright."""

    def __init__(self, count: int, threads: int = 1) -> None:
        model = rod_scene("col").compile()
        self._kinematics = ArmKinematics(model, TOOL_DOWN, HOME_QPOS, count, threads)

    def start(self, points: Array) -> tuple[Array, Array]:
        return points, self._kinematics.start(points)

    def targets(self, setpoints: Array, last: Array) -> Array:
        return self._kinematics.solve(setpoints, last)


class GripperControl:
    """Set-points (m, 8) are seven joint positions in rad and the fingers' opening in metres."""

    def __init__(self, count: int, threads: int = 1) -> None:
        model = gripper_scene("col").compile()
        self._kinematics = ArmKinematics(model, GRIPPER_DOWN, GRIPPER_HOME_QPOS, count, threads)

    def start(self, points: Array) -> tuple[Array, Array]:
        """The fingers are open."""
        joints = self._kinematics.start(points)
        setpoints = np.concatenate([joints, np.full((len(joints), 1), MAX_OPENING)], axis=1)
        return setpoints, self.targets(setpoints, setpoints)

    def targets(self, setpoints: Array, last: Array) -> Array:  # noqa: ARG002 - nothing to solve
        halves = setpoints[:, ARM_JOINTS:] / 2
        return np.concatenate([setpoints[:, :ARM_JOINTS], halves, halves], axis=1)


class ArmKinematics:
    """Inverse kinematics of the tool for up to `count` arms in one call.

    rotation  (3, 3) of the tool, held throughout
    home      joint positions (7,) in rad that redundancy is resolved towards
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        rotation: Array,
        home: tuple[float, ...],
        count: int,
        threads: int = 1,
    ) -> None:
        self._batch = mujoco.batch.Batch(model, count, threads)
        self._qpos = self._batch.bind("qpos")
        self._tip = self._batch.bind("site_xpos")[:, model.site(TOOL_SITE).id]
        self._rotation = self._batch.bind("site_xmat")[:, model.site(TOOL_SITE).id]
        self._body = model.body(TOOL_BODY).id
        self._low, self._high = model.jnt_range[:ARM_JOINTS].T.copy()
        self._wanted = rotation
        self._home = np.array(home)
        self._identity = np.eye(ARM_JOINTS)

    def start(self, targets: Array) -> Array:
        """Joint positions (m, 7) in rad for tools at `targets` (m, 3) in metres, from home."""
        home = np.tile(self._home, (len(targets), 1))
        return self.solve(targets, home, START_ITERATIONS)

    def solve(self, targets: Array, joints: Array, iterations: int = TRACKING_ITERATIONS) -> Array:
        """Improve `joints` (m, 7) so that the tools reach `targets` (m, 3) at their rotation."""
        joints = joints.copy()
        ids = np.arange(len(joints))
        for _ in range(iterations):
            self._qpos[ids, :ARM_JOINTS] = joints
            self._batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_POS)
            tips = self._tip[ids]
            jac_position, jac_rotation = self._batch.jac(self._body, tips, ids)
            jacobian = np.concatenate([jac_position, jac_rotation], axis=1)[..., :ARM_JOINTS]
            step = self._step(targets - tips, self._rotation[ids], jacobian, joints)
            joints = np.clip(joints + step, self._low, self._high)
        return joints

    def _step(
        self, position_error: Array, rotation: Array, jacobian: Array, joints: Array
    ) -> Array:
        """One damped least-squares step (m, 7) in rad."""
        actual = rotation.reshape(-1, 3, 3)
        # Half the sum of the axes' cross products: the rotation vector for small angles.
        rotation_error = 0.5 * np.cross(actual, self._wanted, axis=1).sum(axis=2)
        error = np.concatenate(
            [
                _shorten(position_error, MAX_POSITION_ERROR),
                _shorten(rotation_error, MAX_ROTATION_ERROR),
            ],
            axis=1,
        )
        transposed = jacobian.transpose(0, 2, 1)
        gram = jacobian @ transposed + DAMPING * np.eye(6)
        inverse = transposed @ np.linalg.inv(gram)
        null_space = self._identity - inverse @ jacobian
        posture = POSTURE_GAIN * (self._home - joints)
        step = (inverse @ error[:, :, None] + null_space @ posture[:, :, None])[:, :, 0]
        return _shorten(step, MAX_JOINT_STEP)


def _shorten(vectors: Array, length: float) -> Array:
    """Scale rows of (m, d) that are longer than `length` down to it."""
    norms = np.sqrt((vectors * vectors).sum(axis=1, keepdims=True))
    return np.asarray(vectors * np.minimum(1.0, length / np.maximum(norms, 1e-12)))
