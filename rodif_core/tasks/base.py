"""What a robot task is: constants, geometry and the reading of modes. Stepping is in `env`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from rodif_core.spec import TaskName
from rodif_core.tasks.panda import Mesh

Array = NDArray[np.float64]
Context = Mapping[str, Any]

# How an episode can end; the outcome's "reason".
FINISHED = "finished"
COLLISION = "collision"
LEFT_WORKSPACE = "left_workspace"
TIME_LIMIT = "time_limit"
DIVERGED = "diverged"
REASONS = (FINISHED, COLLISION, LEFT_WORKSPACE, TIME_LIMIT, DIVERGED)


class Task(ABC):
    """One task: its numbers, its scene, its starts, and what counts as success and as a mode.

    A task holds no state: one instance serves any number of simulations. In all methods m is the
    number of simulations, positions are in metres in the robot's base frame, and an *end* is the
    position of the end effector.
    """

    name: ClassVar[TaskName]
    observation_dim: ClassVar[int]
    action_dim: ClassVar[int]
    action_limit: ClassVar[float]  # m per control step and axis; larger actions are clipped
    control_dt: ClassVar[float]  # s
    max_steps: ClassVar[int]  # control steps; longer episodes fail
    modes: ClassVar[tuple[str, ...]]  # codes of all ways to succeed
    groups: ClassVar[tuple[str, ...]]  # coarse modes that annotators can prefer
    preferred_group: ClassVar[str]
    criterion: ClassVar[str]  # what annotators are asked

    @abstractmethod
    def build_model(self, mesh: Mesh = "col") -> mujoco.MjModel:
        """Compile the scene; `mesh` chooses low-poly ("col") or detailed ("viz") arm drawings."""

    @abstractmethod
    def sample_context(self, rng: np.random.Generator) -> dict[str, Any]:
        """Draw the start of one episode, as JSON types."""

    @abstractmethod
    def start_point(self, context: Context) -> Array:
        """First set-point (3,) of an episode.

        Raises ValueOutOfRangeError when the context lacks a value or has one outside its range.
        """

    @abstractmethod
    def move(self, setpoints: Array, actions: Array) -> Array:
        """Next set-points (m, 3) from the last (m, 3) and clipped actions (m, A), within reach."""

    @abstractmethod
    def observe(self, setpoints: Array, ends: Array) -> Array:
        """Observations (m, O) from set-points (m, 3) and ends (m, 3)."""

    @abstractmethod
    def finished(self, ends: Array) -> NDArray[np.bool_]:
        """Which simulations (m,) have reached the goal."""

    @abstractmethod
    def inside(self, ends: Array) -> NDArray[np.bool_]:
        """Which simulations (m,) are within the workspace limits."""

    @abstractmethod
    def outcome(self, path: NDArray[np.floating[Any]], reason: str) -> dict[str, Any]:
        """Outcome of an episode with end positions `path` (N + 1, 3) that ended for `reason`.

        {"success": bool, "mode": str | None, "group": str | None, "reason": str}. The mode is None
        until it is earned by success; the group is kept as soon as the path has settled it.
        """

    @abstractmethod
    def scene_shapes(self) -> list[dict[str, Any]]:
        """Facts for top-down plots, as JSON types; see the task for the shapes' keys."""
