"""Inverse kinematics for many arms at once: rod-tip set-points to joint targets.

Damped least squares (Wampler 1986, Nakamura & Hanafusa 1986) on the six-dimensional tip error, with
a pull of the redundant joint towards the home posture. It runs on the set-points only, never on
measured joints, so that the joint targets do not depend on how well the servos track.
"""

from __future__ import annotations

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray

from rodif_core.tasks.panda import HOME_QPOS, TOOL_BODY, TOOL_SITE, rod_scene

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


class RodKinematics:
    """Inverse kinematics of the rod tip for up to `count` arms in one call."""

    def __init__(self, count: int, threads: int = 1) -> None:
        model = rod_scene("col").compile()
        self._batch = mujoco.batch.Batch(model, count, threads)
        self._qpos = self._batch.bind("qpos")
        self._tip = self._batch.bind("site_xpos")[:, model.site(TOOL_SITE).id]
        self._rotation = self._batch.bind("site_xmat")[:, model.site(TOOL_SITE).id]
        self._body = model.body(TOOL_BODY).id
        self._low, self._high = model.jnt_range.T.copy()
        self._home = np.array(HOME_QPOS)
        self._identity = np.eye(7)

    def start(self, targets: Array) -> Array:
        """Joint positions (m, 7) in rad for tip positions `targets` (m, 3) in metres, from home."""
        home = np.tile(self._home, (len(targets), 1))
        return self.solve(targets, home, START_ITERATIONS)

    def solve(self, targets: Array, joints: Array, iterations: int = TRACKING_ITERATIONS) -> Array:
        """Improve `joints` (m, 7) so that the tips reach `targets` (m, 3), rod straight down."""
        joints = joints.copy()
        ids = np.arange(len(joints))
        for _ in range(iterations):
            self._qpos[ids] = joints
            self._batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_POS)
            tips = self._tip[ids]
            jac_position, jac_rotation = self._batch.jac(self._body, tips, ids)
            jacobian = np.concatenate([jac_position, jac_rotation], axis=1)
            step = self._step(targets - tips, self._rotation[ids], jacobian, joints)
            joints = np.clip(joints + step, self._low, self._high)
        return joints

    def _step(
        self, position_error: Array, rotation: Array, jacobian: Array, joints: Array
    ) -> Array:
        """One damped least-squares step (m, 7) in rad."""
        actual = rotation.reshape(-1, 3, 3)
        # Half the sum of the axes' cross products: the rotation vector for small angles.
        rotation_error = 0.5 * np.cross(actual, TOOL_DOWN, axis=1).sum(axis=2)
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
