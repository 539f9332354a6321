"""Stepping many simulations of one task together.

Every simulation gives the same bits whatever its neighbours, their number and the number of
threads. A finished simulation is frozen: it keeps its last values and costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.tasks.base import (
    COLLISION,
    DIVERGED,
    FINISHED,
    LEFT_WORKSPACE,
    TIME_LIMIT,
    Context,
    Task,
    View,
)
from rodif_core.tasks.panda import CONTACT_SENSOR, PHYSICS_DT, TOOL_SITE

REST_STEPS = 10  # control steps (about 0.35 s) in which objects come to rest before an episode


class BatchEnv:
    """Up to `n` simulations of a task, stepped together on `threads` threads.

    Legend: A action dims, O observation dims, Q position dims of the physics. All arrays that are
    handed out are copies.
    """

    def __init__(self, task: Task, n: int, threads: int = 1) -> None:
        if n < 1:
            raise ValueOutOfRangeError("n", n, "at least 1 simulation")
        if threads < 1:
            raise ValueOutOfRangeError("threads", threads, "at least 1")
        self.task = task
        self.n = n
        model = task.build_model("col")
        self._control = task.control(n, threads)
        self._physics_steps = round(task.control_dt / PHYSICS_DT)
        self._batch = mujoco.batch.Batch(model, n, threads)
        self._qpos = self._batch.bind("qpos")
        self._ctrl = self._batch.bind("ctrl")
        tool = model.site(TOOL_SITE).id
        self._tool = self._batch.bind("site_xpos")[:, tool]
        self._rotation = self._batch.bind("site_xmat")[:, tool]
        self._sensors = self._batch.bind("sensordata")
        self._contact = int(model.sensor(CONTACT_SENSOR).adr[0]) if task.contact_ends else None
        self._setpoints = np.zeros((n, 0))
        self._ends = np.zeros((n, 3))
        self._rotations = np.zeros((n, 3, 3))
        self._positions = np.zeros((n, model.nq))
        # float32, as trajectories store it: modes can be read again from what was stored.
        self._path_history = np.zeros((task.max_steps + 1, n, 3), dtype=np.float32)
        self._object_history = np.zeros(
            (task.max_steps + 1, n, len(task.objects), 7), dtype=np.float32
        )
        self._steps = np.zeros(n, dtype=np.int64)
        self._reasons: list[str | None] = [None] * n
        self._episodes = 0
        self._done = np.ones(n, dtype=bool)

    def reset(self, contexts: Sequence[Context]) -> NDArray[np.float32]:
        """Start one episode a context; returns the first observations (len(contexts), O) float32.

        With fewer contexts than n, the other simulations stay out: all arrays of this object then
        have len(contexts) rows. Raises ValueOutOfRangeError for a bad context.
        """
        count = len(contexts)
        if not 1 <= count <= self.n:
            raise ValueOutOfRangeError("number of contexts", count, f"1 … {self.n}")
        starts = np.stack([self.task.start_point(context) for context in contexts])
        objects = np.stack([self.task.start_objects(context) for context in contexts])
        ids = np.arange(count)
        setpoints, targets = self._control.start(starts)
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._qpos[ids] = np.concatenate([targets, objects.reshape(count, -1)], axis=1)
        self._ctrl[ids] = targets
        self._batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_POS)
        self._episodes = count
        self._steps = np.zeros(count, dtype=np.int64)
        self._reasons = [None] * count
        self._done = np.zeros(count, dtype=bool)
        if self.task.objects:
            for _ in range(REST_STEPS):
                _, failed = self._physics(ids)
                self._end(ids[failed], DIVERGED)
        self._setpoints = setpoints
        self._ends = self._tool[ids]
        self._rotations = self._rotation[ids].reshape(count, 3, 3)
        self._positions = self._qpos[ids]
        self._remember(ids)
        return self._observations()

    def step(
        self, actions: NDArray[np.floating[Any]], active: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float32]:
        """One control step with actions (m, A), clipped to the task's limits.

        active  (m,) bool: which simulations move; the others, and finished ones, stay as they are.

        Returns observations (m, O) float32. A simulation with a non-finite action or state is
        ended with reason "diverged"; the others go on.
        """
        wanted = np.array(actions, dtype=np.float64)
        shape = (self._episodes, self.task.action_dim)
        if wanted.shape != shape:
            raise ValueOutOfRangeError("shape of actions", wanted.shape, f"{shape}")
        moving = ~self._done if active is None else ~self._done & np.asarray(active, dtype=bool)
        finite = np.isfinite(wanted).all(axis=1)
        self._end(np.flatnonzero(moving & ~finite), DIVERGED)
        ids = np.flatnonzero(moving & finite)
        if len(ids):
            self._advance(ids, wanted[ids])
        return self._observations()

    def _advance(self, ids: NDArray[np.int64], actions: NDArray[np.float64]) -> None:
        """Move the simulations `ids` by one control step and see whether they end."""
        setpoints = self.task.move(self._setpoints[ids], self.task.clip(actions))
        self._ctrl[ids] = self._control.targets(setpoints, self._ctrl[ids])
        touched, failed = self._physics(ids)
        ends, positions = self._tool[ids], self._qpos[ids]
        rotations = self._rotation[ids].reshape(len(ids), 3, 3)
        failed |= ~np.isfinite(ends).all(axis=1) | ~np.isfinite(positions).all(axis=1)
        self._end(ids[failed], DIVERGED)
        good = ~failed
        ids, touched = ids[good], touched[good]
        self._setpoints[ids] = setpoints[good]
        self._ends[ids] = ends[good]
        self._rotations[ids] = rotations[good]
        self._positions[ids] = positions[good]
        self._steps[ids] += 1
        self._remember(ids)
        view = self._view(ids)
        # The first reason that holds counts: contact comes before everything else.
        self._end(ids[touched], COLLISION)
        self._end(ids[self.task.finished(view)], FINISHED)
        self._end(ids[~self.task.inside(view)], LEFT_WORKSPACE)
        self._end(ids[self._steps[ids] >= self.task.max_steps], TIME_LIMIT)

    def _physics(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """All physics steps of one control step; returns (touched, failed) of each simulation.

        Where contact does not end episodes, nothing counts as touched. A step's sensors describe
        the state before it, hence the look at the last state; that of the state before the first
        step is the previous control step's last.
        """
        self._batch.warning[ids] = 0
        record = np.zeros((len(ids), self._physics_steps, self._sensors.shape[1]))
        failed = np.zeros(len(ids), dtype=bool)
        try:
            out = {"sensordata": record}
            self._batch.rollout(self._physics_steps, record=("sensordata",), ids=ids, out=out)
        except mujoco.batch.SimulationError as error:
            failed |= np.isin(ids, error.ids)
        failed |= self._batch.warning[ids].reshape(len(ids), -1).any(axis=1)
        if not failed.all():
            self._batch.forward(ids[~failed], stage=mujoco.mjtStage.mjSTAGE_POS)
        if self._contact is None:
            return np.zeros(len(ids), dtype=bool), failed
        touched = (record[:, :, self._contact] > 0).any(axis=1)
        touched |= self._sensors[ids, self._contact] > 0
        return touched, failed

    def _end(self, ids: NDArray[np.int64], reason: str) -> None:
        for index in ids:
            if not self._done[index]:
                self._done[index] = True
                self._reasons[index] = reason

    def _remember(self, ids: NDArray[np.int64]) -> None:
        """Write the present state of the simulations `ids` into their histories."""
        self._path_history[self._steps[ids], ids] = self._ends[ids]
        self._object_history[self._steps[ids], ids] = self.task.object_poses(self._positions[ids])

    def _view(self, ids: NDArray[np.int64]) -> View:
        steps = self._steps[ids]
        return View(
            setpoints=self._setpoints[ids],
            ends=self._ends[ids],
            rotations=self._rotations[ids],
            joints=self._positions[ids, : self.task.robot_joints],
            objects=self._object_history[steps, ids].astype(np.float64),
            objects_before=self._object_history[np.maximum(steps - 1, 0), ids].astype(np.float64),
        )

    def _observations(self) -> NDArray[np.float32]:
        return self.task.observe(self._view(np.arange(self._episodes))).astype(np.float32)

    @property
    def done(self) -> NDArray[np.bool_]:
        """(m,) bool: which episodes have ended."""
        return self._done.copy()

    @property
    def steps(self) -> NDArray[np.int64]:
        """(m,) control steps done so far: N of the trajectory. A step that diverged is not one."""
        return self._steps.copy()

    @property
    def setpoints(self) -> NDArray[np.float64]:
        """(m, S) where the controller is told to be, as `Task.move` takes them."""
        return self._setpoints.copy()

    @property
    def qpos(self) -> NDArray[np.float32]:
        """(m, Q) float32 positions of the physics."""
        return self._positions.astype(np.float32)

    @property
    def paths(self) -> NDArray[np.float32]:
        """(m, 3) float32 end-effector positions in metres; the rows of a trajectory's `paths`."""
        return self._ends.astype(np.float32)

    def outcomes(self) -> list[dict[str, Any]]:
        """One outcome an episode; see `Task.outcome`. Raises ValueError before all have ended."""
        outcomes = []
        for index, reason in enumerate(self._reasons):
            if reason is None:
                raise ValueError(
                    f"episode {index} has not ended; step until `done` is true for all"
                )
            rows = slice(self._steps[index] + 1)
            path, objects = self._path_history[rows, index], self._object_history[rows, index]
            outcomes.append(self.task.outcome(path, objects, reason))
        return outcomes
