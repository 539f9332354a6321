"""Demonstrations of D3IL (Jia et al., ICLR 2024) as ours, for who has its files.

A file holds one episode: arrays of N rows, one a control step, under names of the robot and of the
objects. Its robot follows absolute set-points. Ours are told to go where those say, from the same
start, in our simulation: observations, actions, positions and modes are then those of our tasks.
D3IL's arm follows its set-points more loosely, so not every episode ends as it did there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rodif_core.demonstrations import Recording
from rodif_core.errors import DemonstrationFileError, UnknownNameError, ValueOutOfRangeError
from rodif_core.plain_pickle import StoredArray, read_plain_pickle
from rodif_core.spec import TaskName
from rodif_core.tasks import Task
from rodif_core.tasks.base import Array
from rodif_core.tasks.blocks import yaws
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.panda import MAX_OPENING
from rodif_core.trajectory import Trajectory

PARALLEL = 100  # simulations stepped together; changes the time, not the result
ROD_BELOW = 0.12  # m; D3IL's rod ends this far below the point that its files give
# Our model's sixth and seventh joints are this far off the real arm's, which D3IL uses.
JOINT_OFFSETS = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -np.pi / 2, -np.pi / 4])  # rad
OPEN_ABOVE = 0.075  # m; wider than this the gripper is told to open, else to close, as D3IL

REFUSED_START = "start outside the task's ranges"


@dataclass(frozen=True, eq=False)
class D3ilEpisode:
    """What an import needs of a file: our start of the episode, and set-points.

    context    as our task takes it
    setpoints  (N, A) where to be, row by row, in our task's terms
    """

    name: str
    context: dict[str, Any]
    setpoints: Array


@dataclass(frozen=True)
class Rejection:
    """An episode that is not in the set, and why: REFUSED_START, or how its replay ended."""

    name: str
    reason: str


class _Record:
    """The arrays of a file, by the name of the thing and of the quantity."""

    def __init__(self, name: str, content: object) -> None:
        self.name, self._content = name, content

    def rows(self, thing: str, quantity: str, width: int) -> Array:
        """(N, width) finite numbers, at least two rows; raises DemonstrationFileError."""
        part = self._content.get(thing) if isinstance(self._content, dict) else None
        stored = part.get(quantity) if isinstance(part, dict) else None
        if not isinstance(stored, StoredArray):
            raise DemonstrationFileError(
                f"{self.name} has no array {quantity!r} of {thing!r}; it is no episode of this task"
            )
        value = stored.value.astype(np.float64)
        value = value[:, None] if value.ndim == 1 else value
        if value.ndim != 2 or value.shape[1] < width or len(value) < 2:
            raise DemonstrationFileError(
                f"{self.name}: {quantity!r} of {thing!r} has shape {stored.value.shape}, but must"
                f" have 2 or more rows of {width} or more numbers"
            )
        if not np.isfinite(value).all():
            raise DemonstrationFileError(f"{self.name}: {quantity!r} of {thing!r} is not finite")
        return value[:, :width]


def _planar(record: _Record) -> Array:
    return record.rows("robot", "des_c_pos", 2)


def _spatial(record: _Record) -> Array:
    return record.rows("robot", "des_c_pos", 3) - (0.0, 0.0, ROD_BELOW)


def _joints(record: _Record) -> Array:
    joints = record.rows("robot", "des_j_pos", len(JOINT_OFFSETS)) + JOINT_OFFSETS
    width = record.rows("robot", "gripper_width", 1)
    if len(width) != len(joints):
        raise DemonstrationFileError(
            f"{record.name}: 'gripper_width' of 'robot' has {len(width)} rows, but must have"
            f" {len(joints)}, as 'des_j_pos' has"
        )
    return np.concatenate([joints, np.where(width > OPEN_ABOVE, MAX_OPENING, 0.0)], axis=1)


@dataclass(frozen=True)
class Format:
    """Which of a file's objects are which of the context's places, and its set-points."""

    places: Mapping[str, str]
    setpoints: Callable[[_Record], Array]


_ALIGNING = Format({"box": "push-box", "target": "target-box"}, _spatial)
_STACKING = Format({"red": "red-box", "green": "green-box", "blue": "blue-box"}, _joints)
# Of the tasks that D3IL has, by their names here.
FORMATS: dict[TaskName, Format] = {
    TaskName.AVOID: Format({}, _planar),
    TaskName.PUSHING: Format({"red": "red-box", "green": "green-box"}, _planar),
    TaskName.SORTING: Format({"red": "red-box1", "blue": "blue-box1"}, _planar),
    TaskName.ALIGNING: _ALIGNING,
    TaskName.STACKING: _STACKING,
    TaskName.ALIGNING_STATE: _ALIGNING,
    TaskName.STACKING_STATE: _STACKING,
}


def episode_files(paths: Sequence[Path]) -> list[Path]:
    """The files themselves, and all `.pkl` files in folders, in the order of their names.

    Raises DemonstrationFileError for a path that does not exist or a folder without such files.
    """
    found: list[Path] = []
    for path in paths:
        inside = sorted(path.rglob("*.pkl")) if path.is_dir() else [path]
        if not path.exists() or not inside:
            what = "has no .pkl files" if path.is_dir() else "does not exist"
            raise DemonstrationFileError(f"{path} {what}")
        found += inside
    return found


def read_episode(task: TaskName, path: Path) -> D3ilEpisode:
    """Read one file; raises DemonstrationFileError when it is damaged, holds more than plain data
    or is of another task, and UnknownNameError for a task that D3IL has not."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DemonstrationFileError(f"cannot read {path}: {error.strerror}") from error
    if task not in FORMATS:
        raise UnknownNameError("task with D3IL files", task.value, FORMATS)
    record = _Record(str(path), read_plain_pickle(data, str(path)))
    start = record.rows("robot", "des_c_pos", 2)[0]
    context: dict[str, Any] = {"start": start.tolist()}
    for ours, theirs in FORMATS[task].places.items():
        position, quaternion = record.rows(theirs, "pos", 3)[0], record.rows(theirs, "quat", 4)[0]
        yaw = yaws(np.concatenate([position, quaternion])[None])[0]
        context[ours] = [float(position[0]), float(position[1]), float(yaw)]
    return D3ilEpisode(str(path), context, FORMATS[task].setpoints(record))


def replay(
    task: Task,
    episodes: Sequence[D3ilEpisode],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[Trajectory], list[Rejection]]:
    """Demonstrations of those that succeed in our simulation, and why the others are not.

    progress  called with (done, of) from time to time
    """
    possible, rejected = [], []
    for episode in episodes:
        try:
            task.start_point(episode.context)
            task.start_objects(episode.context)
        except ValueOutOfRangeError:
            rejected.append(Rejection(episode.name, REFUSED_START))
        else:
            possible.append(episode)
    made: list[Trajectory] = []
    for first in range(0, len(possible), PARALLEL):
        batch = possible[first : first + PARALLEL]
        for episode, trajectory in zip(batch, _replay_batch(task, batch), strict=True):
            if trajectory.success:
                made.append(trajectory)
            else:
                rejected.append(Rejection(episode.name, str(trajectory.outcome["reason"])))
        if progress is not None:
            progress(len(made) + len(rejected), len(episodes))
    return made, rejected


def _replay_batch(task: Task, batch: Sequence[D3ilEpisode]) -> list[Trajectory]:
    """One trajectory an episode, successful or not."""
    env = BatchEnv(task, len(batch))
    recording = Recording(env, [episode.context for episode in batch])
    last = np.array([len(episode.setpoints) - 1 for episode in batch])
    row = 0
    while not env.done.all():
        # After its last row an episode holds still: the arm is still on its way.
        row += 1
        rows = np.minimum(row, last)
        wanted = np.stack([one.setpoints[i] for one, i in zip(batch, rows, strict=True)])
        moves = wanted - env.setpoints[:, : task.action_dim]
        recording.step(task.clip(moves.astype(np.float32)))
    return recording.episodes(
        [{"source": "d3il", "file": Path(episode.name).name} for episode in batch]
    )
