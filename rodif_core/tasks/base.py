"""What a robot task is: constants, geometry and the reading of modes. Stepping is in `env`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.spec import TaskName
from rodif_core.tasks.control import Control, RodControl
from rodif_core.tasks.panda import ARM_JOINTS, Mesh

Array = NDArray[np.float64]
Context = Mapping[str, Any]
ActionT = TypeVar("ActionT", np.float32, np.float64)

# How an episode can end; the outcome's "reason".
FINISHED = "finished"
COLLISION = "collision"
LEFT_WORKSPACE = "left_workspace"
TIME_LIMIT = "time_limit"
DIVERGED = "diverged"
REASONS = (FINISHED, COLLISION, LEFT_WORKSPACE, TIME_LIMIT, DIVERGED)


@dataclass(frozen=True, eq=False)
class View:
    """What a task sees of m simulations after a control step; positions in metres.

    setpoints       (m, S) as the task's control takes them
    ends            (m, 3) end effectors
    rotations       (m, 3, 3) of the end effectors; columns are its axes
    joints          (m, R) measured positions of the robot's joints, rad and m
    objects         (m, B, 7) poses x, y, z and quaternion w, x, y, z of the B movable objects,
                    rounded to float32 as trajectories store them: what is read from a stored
                    trajectory is what was read while it ran
    objects_before  (m, B, 7) the same one control step earlier; at the start, those of the start
    """

    setpoints: Array
    ends: Array
    rotations: Array
    joints: Array
    objects: Array
    objects_before: Array


class Task(ABC):
    """One task: its numbers, its scene, its starts, and what counts as success and as a mode.

    A task holds no state: one instance serves any number of simulations. In all methods m is the
    number of simulations, B that of the movable objects, positions are in metres in the robot's
    base frame, and an *end* is the position of the end effector.

    The model of a task has the robot's joints first and then one free joint an object, in the order
    of `objects`.
    """

    name: ClassVar[TaskName]
    observation_dim: ClassVar[int]
    # Views that policies see (of the model's cameras); none: policies see the whole observation.
    # A policy that sees pictures gets the first `proprioception_dim` numbers of it besides: what
    # a robot knows of itself. The rest tells scripted experts and the drift measure the state.
    cameras: ClassVar[tuple[str, ...]] = ()
    proprioception_dim: ClassVar[int] = 0  # of a task with cameras
    action_dim: ClassVar[int]
    # Per control step, in the unit of each axis (m, rad); one number: of all axes. Larger actions
    # are clipped.
    action_limit: ClassVar[float | tuple[float, ...]]
    control_dt: ClassVar[float]  # s
    max_steps: ClassVar[int]  # control steps; longer episodes fail
    robot_joints: ClassVar[int] = ARM_JOINTS  # R: the arm's, and the fingers' where there are any
    objects: ClassVar[tuple[str, ...]] = ()  # names of the movable bodies
    contact_ends: ClassVar[bool]  # whether the rod's first contact ends the episode as a failure
    modes: ClassVar[tuple[str, ...]]  # codes of all ways to succeed
    groups: ClassVar[tuple[str, ...]]  # coarse modes that annotators can prefer
    preferred_group: ClassVar[str]
    preferred_share: ClassVar[float] = 0.2  # of the preferred group in scripted demonstrations
    criterion: ClassVar[str]  # what annotators are asked
    # How much of the end effector's path replays keep in view; None: all, where modes are ways.
    trail_seconds: ClassVar[float | None] = None

    @abstractmethod
    def build_model(self, mesh: Mesh = "col") -> mujoco.MjModel:
        """Compile the scene; `mesh` chooses low-poly ("col") or detailed ("viz") arm drawings."""

    @abstractmethod
    def sample_context(self, rng: np.random.Generator) -> dict[str, Any]:
        """Draw the start of one episode, as JSON types."""

    def control(self, count: int, threads: int = 1) -> Control:
        """What turns set-points of up to `count` simulations into servo targets."""
        return RodControl(count, threads)

    @property
    def action_limits(self) -> Array:
        """`action_limit` axis by axis (A,)."""
        return np.full(self.action_dim, self.action_limit, dtype=np.float64)

    def clip(self, actions: NDArray[ActionT]) -> NDArray[ActionT]:
        """Actions (…, A) within +- action_limit, in their own precision."""
        limit = np.asarray(self.action_limit, dtype=actions.dtype)
        return np.clip(actions, -limit, limit)

    @abstractmethod
    def start_point(self, context: Context) -> Array:
        """First position (3,) of the end effector in an episode, which the set-point holds.

        Raises ValueOutOfRangeError when the context lacks a value or has one outside its range.
        """

    def start_objects(self, context: Context) -> Array:  # noqa: ARG002 - none by default
        """First poses (B, 7) of the objects; the scene comes to rest from there.

        Raises ValueOutOfRangeError as `start_point` does.
        """
        return np.zeros((0, 7))

    @abstractmethod
    def group_of(self, mode: str) -> str:
        """The group that a mode belongs to."""

    @abstractmethod
    def move(self, setpoints: Array, actions: Array) -> Array:
        """Next set-points (m, S) from the last (m, S) and clipped actions (m, A), within reach."""

    @abstractmethod
    def observe(self, view: View) -> Array:
        """Observations (m, O)."""

    @abstractmethod
    def finished(self, view: View) -> NDArray[np.bool_]:
        """Which simulations (m,) have reached the goal."""

    @abstractmethod
    def inside(self, view: View) -> NDArray[np.bool_]:
        """Which simulations (m,) are within the workspace limits."""

    @abstractmethod
    def outcome(
        self, path: NDArray[np.floating[Any]], objects: NDArray[np.floating[Any]], reason: str
    ) -> dict[str, Any]:
        """Outcome of an episode with end positions `path` (N + 1, 3) and object poses `objects`
        (N + 1, B, 7) that ended for `reason`. Raises UnknownNameError for a foreign reason.

        {"success": bool, "mode": str | None, "group": str | None, "reason": str}. The mode is None
        until it is earned by success; the group is kept as soon as the episode has settled it.
        """

    def object_poses(self, qpos: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Object poses (…, B, 7) in physics positions (…, Q), such as a trajectory's `qpos`."""
        poses = qpos[..., self.robot_joints :]
        return poses.reshape(*poses.shape[:-1], len(self.objects), 7)

    @abstractmethod
    def scene_shapes(self) -> list[dict[str, Any]]:
        """Facts for top-down plots, as JSON types; see the task for the shapes' keys."""


def read_numbers(context: Context, name: str, count: int, legal: str) -> Array:
    """`count` finite numbers of a context; raises ValueOutOfRangeError naming `legal`."""
    value = context.get(name)
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueOutOfRangeError(name, value, legal)
    return numbers
