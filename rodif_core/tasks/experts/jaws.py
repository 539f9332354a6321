"""From the velocity of the jaws to the change of the arm's joint set-points, one arm at a time."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np

from rodif_core.tasks.base import Array
from rodif_core.tasks.control import DAMPING, GRIPPER_DOWN, POSTURE_GAIN
from rodif_core.tasks.panda import ARM_JOINTS, GRIPPER_HOME_QPOS, TOOL_SITE, gripper_scene

UPRIGHT_GAIN = 0.2  # share of a tilt that is taken back in a control step


class JawKinematics:
    """Where the jaws of one arm are turned, and which joint steps move them."""

    def __init__(self) -> None:
        self._model = gripper_scene("col").compile()
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site(TOOL_SITE).id
        self._home = np.array(GRIPPER_HOME_QPOS)
        self._jacobian = np.zeros((6, self._model.nv))

    def place(self, joints: Array) -> float:
        """Take the joint positions (7,) in rad; returns the jaws' yaw in rad."""
        self._data.qpos[:ARM_JOINTS] = joints
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        rotation = self._data.site_xmat[self._site]
        return float(np.arctan2(rotation[3], rotation[0]))

    def joint_step(self, velocity: Array, turn: float) -> Array:
        """Joint changes (7,) in rad that move the jaws placed last by `velocity` (3,) in metres and
        `turn` in rad about the vertical, and bring them nearer to straight down and to the home
        posture."""
        position, rotation = self._jacobian[:3], self._jacobian[3:]
        mujoco.mj_jacSite(self._model, self._data, position, rotation, self._site)
        jacobian = self._jacobian[:, :ARM_JOINTS]
        down = self._data.site_xmat[self._site].reshape(3, 3)[:, 2]
        tilt = np.cross(down, GRIPPER_DOWN[:, 2])
        twist = np.concatenate([velocity, UPRIGHT_GAIN * tilt])
        twist[5] += turn
        gram = jacobian @ jacobian.T + DAMPING * np.eye(6)
        inverse = np.linalg.solve(gram, jacobian).T
        posture = POSTURE_GAIN * (self._home - self._data.qpos[:ARM_JOINTS])
        return np.asarray(inverse @ twist + posture - inverse @ (jacobian @ posture))


@cache
def jaw_kinematics() -> JawKinematics:
    """This process's own; compiling it takes a third of a second."""
    return JawKinematics()
