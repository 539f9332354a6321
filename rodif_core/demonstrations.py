"""Scripted demonstrations: many simulations at once, failures drawn again, one file a set."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import LearningError, TrajectoryFileError, ValueOutOfRangeError
from rodif_core.npz import read_archive, write_archive
from rodif_core.tasks import Task
from rodif_core.tasks.env import BatchEnv
from rodif_core.tasks.experts import draw_expert
from rodif_core.trajectory import Trajectory, episode_without_decisions

TREMBLE_MEMORY = 0.8  # share of the hand's noise that stays from one control step to the next
PARALLEL = 100  # simulations stepped together; changes the time, not the result
MAX_ATTEMPTS = 20  # draws for one demonstration before we say that something is wrong

_FORMAT = 1
_ARRAYS = {"observations": 2, "actions": 2, "qpos": 2, "paths": 2}  # and their number of axes
_FACTS = {"context", "outcome", "info"}  # of an episode, in the header


@dataclass(frozen=True)
class _Assignment:
    """One demonstration to make: its place in the set, its mode, and which draw this is."""

    index: int
    mode: str
    attempt: int

    def generator(self, seed: int) -> np.random.Generator:
        return np.random.default_rng([seed, self.index, self.attempt])


def make_demonstrations(
    task: Task,
    *,
    episodes: int,
    seed: int,
    preferred_share: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Trajectory]:
    """Successful demonstrations in their intended modes.

    Demonstration i depends on (seed, i) and its mode only, not on how many run together.

    preferred_share  share of the task's preferred group, by default the task's own; its modes are
                     balanced, and so are all others
    progress         called with (made, episodes) from time to time

    Raises ValueOutOfRangeError for values out of range and LearningError when the expert keeps
    failing.
    """
    if episodes < 1:
        raise ValueOutOfRangeError("episodes", episodes, "at least 1")
    if seed < 0:
        raise ValueOutOfRangeError("seed", seed, "0 or more")
    share = task.preferred_share if preferred_share is None else preferred_share
    if not 0 <= share <= 1:
        raise ValueOutOfRangeError("preferred_share", share, "in [0, 1]")
    made: dict[int, Trajectory] = {}
    ends: Counter[str] = Counter()  # of the failures, to tell what an expert does wrong
    env = BatchEnv(task, min(PARALLEL, episodes))
    waiting = [
        _Assignment(i, mode, 0) for i, mode in enumerate(assign_modes(task, episodes, share))
    ]
    while waiting:
        batch, waiting = waiting[:PARALLEL], waiting[PARALLEL:]
        for assignment, trajectory in zip(batch, _demonstrate(env, batch, seed), strict=True):
            if trajectory.success and trajectory.outcome["mode"] == assignment.mode:
                made[assignment.index] = trajectory
                continue
            ends[_failure(trajectory)] += 1
            if assignment.attempt + 1 == MAX_ATTEMPTS:
                told = ", ".join(f"{end} {count}" for end, count in ends.most_common())
                raise LearningError(
                    f"the expert failed {MAX_ATTEMPTS} times in mode {assignment.mode!r}; the"
                    f" failures of all modes so far: {told}"
                )
            waiting.append(_Assignment(assignment.index, assignment.mode, assignment.attempt + 1))
        if progress is not None:
            progress(len(made), episodes)
    return [made[index] for index in range(episodes)]


def _failure(trajectory: Trajectory) -> str:
    """How a demonstration went wrong, in words."""
    if trajectory.success:
        return f"succeeded in mode {trajectory.outcome['mode']!r} instead"
    return str(trajectory.outcome["reason"]).replace("_", " ")


def assign_modes(task: Task, episodes: int, preferred_share: float) -> list[str]:
    """The mode of each demonstration: the preferred group spread evenly, modes in turn."""
    liked = [mode for mode in task.modes if task.group_of(mode) == task.preferred_group]
    others = [mode for mode in task.modes if mode not in liked]
    counts = np.floor(np.arange(episodes + 1) * preferred_share + 0.5).astype(int)
    modes = []
    for index in range(episodes):
        is_liked = counts[index + 1] > counts[index]
        turn = counts[index] if is_liked else index - counts[index]
        choices = liked if is_liked else others
        modes.append(choices[turn % len(choices)])
    return modes


def mode_shares(task: Task, preferred_share: float) -> NDArray[np.float64]:
    """The share of each of the task's modes (modes,) among many demonstrations."""
    liked = np.array([task.group_of(mode) == task.preferred_group for mode in task.modes])
    shares = np.where(liked, preferred_share / liked.sum(), 0.0)
    if not liked.all():
        shares += np.where(liked, 0.0, (1 - preferred_share) / (~liked).sum())
    return np.asarray(shares)


def _demonstrate(env: BatchEnv, batch: Sequence[_Assignment], seed: int) -> list[Trajectory]:
    """One trajectory an assignment, successful or not."""
    task = env.task
    generators = [assignment.generator(seed) for assignment in batch]
    contexts = [task.sample_context(rng) for rng in generators]
    experts = [
        draw_expert(task.name, assignment.mode, context, rng)
        for assignment, context, rng in zip(batch, contexts, generators, strict=True)
    ]
    recording = Recording(env, contexts)
    tremble = np.zeros((len(batch), task.action_dim))
    while not env.done.all():
        action = np.zeros((len(batch), task.action_dim), dtype=np.float32)
        for i in np.flatnonzero(~env.done):
            # Scaled so that the standard deviation stays at the expert's tremble.
            fresh = experts[i].tremble * np.sqrt(1 - TREMBLE_MEMORY**2)
            kick = generators[i].normal(0.0, fresh, task.action_dim)
            tremble[i] = TREMBLE_MEMORY * tremble[i] + kick
            action[i] = task.clip(experts[i].act(recording.observations[i]) + tremble[i])
        recording.step(action)
    return recording.episodes(
        [
            {
                "seed": seed,
                "index": assignment.index,
                "attempt": assignment.attempt,
                "expert": expert.to_json(),
            }
            for assignment, expert in zip(batch, experts, strict=True)
        ]
    )


class Recording:
    """Episodes without decisions, recorded while `env` runs all m of them together."""

    def __init__(self, env: BatchEnv, contexts: Sequence[dict[str, Any]]) -> None:
        self._env, self._contexts = env, contexts
        self._observations = [env.reset(contexts)]
        self._qpos, self._paths = [env.qpos], [env.paths]
        self._actions: list[NDArray[np.float32]] = []

    @property
    def observations(self) -> NDArray[np.float32]:
        """The latest (m, O)."""
        return self._observations[-1]

    def step(self, actions: NDArray[np.float32]) -> None:
        """One control step with actions (m, A) within the task's limits."""
        self._actions.append(actions)
        self._observations.append(self._env.step(actions))
        self._qpos.append(self._env.qpos)
        self._paths.append(self._env.paths)

    def episodes(
        self, infos: Sequence[dict[str, Any]], begins: Sequence[int] | None = None
    ) -> list[Trajectory]:
        """All episodes, once all have ended.

        infos   where each comes from; the task's facts are added
        begins  the control step that each is kept from, by default all of it
        """
        ends = zip(self._contexts, self._env.outcomes(), self._env.steps, infos, strict=True)
        return [
            self._episode(i, begins[i] if begins else 0, int(steps), context, outcome, info)
            for i, (context, outcome, steps, info) in enumerate(ends)
        ]

    def _episode(
        self,
        index: int,
        begin: int,
        end: int,
        context: dict[str, Any],
        outcome: dict[str, Any],
        info: dict[str, Any],
    ) -> Trajectory:
        def cut(rows: list[NDArray[np.float32]], end: int) -> NDArray[np.float32]:
            return np.array([row[index] for row in rows[begin:end]], dtype=np.float32)

        task = self._env.task
        return episode_without_decisions(
            observations=cut(self._observations, end + 1),
            actions=cut(self._actions, end).reshape(-1, task.action_dim),
            qpos=cut(self._qpos, end + 1),
            paths=cut(self._paths, end + 1),
            context=context,
            outcome=outcome,
            info={
                "task": task.name.value,
                "mode": outcome["mode"],
                "control_dt": task.control_dt,
                "mujoco_version": mujoco.__version__,
                **info,
            },
        )


def save_demonstrations(path: Path, demonstrations: Sequence[Trajectory]) -> None:
    """Write a set to one npz file: episodes' arrays end to end, and a JSON header. No pickle.

    Equal sets give equal bytes. Raises ValueOutOfRangeError for an empty set.
    """
    if not demonstrations:
        raise ValueOutOfRangeError("number of demonstrations", 0, "at least 1")
    header = {
        "format": _FORMAT,
        "lengths": [len(one.actions) for one in demonstrations],
        "episodes": [
            {"context": one.context, "outcome": one.outcome, "info": one.info}
            for one in demonstrations
        ],
    }
    arrays = {
        name: np.concatenate([getattr(one, name) for one in demonstrations]) for name in _ARRAYS
    }
    path.write_bytes(write_archive(header, arrays))


def load_demonstrations(path: Path) -> list[Trajectory]:
    """Read a set back; raises TrajectoryFileError when the file is missing or damaged."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TrajectoryFileError(f"{path} is not readable: {error}") from error
    facts = {"lengths": list, "episodes": list}
    header, columns = read_archive(
        data, f"the demonstration set {path}", version=_FORMAT, facts=facts, ranks=_ARRAYS
    )
    if not all(isinstance(length, int) and length >= 0 for length in header["lengths"]):
        raise TrajectoryFileError(f"{path}: lengths in its header are not counts")
    for episode in header["episodes"]:
        if not isinstance(episode, dict) or not episode.keys() >= _FACTS:
            raise TrajectoryFileError(
                f"{path}: an episode in its header is {episode!r}, without {sorted(_FACTS)}"
            )
    lengths = np.array(header["lengths"], dtype=int)
    for name, column in columns.items():
        rows = int(lengths.sum()) + (0 if name == "actions" else len(lengths))
        if len(column) != rows or len(header["episodes"]) != len(lengths):
            raise TrajectoryFileError(
                f"{path}: {name} has {len(column)} rows, but its header tells of {rows}"
            )
    return _cut(lengths, columns, header["episodes"])


def _cut(
    lengths: NDArray[np.int_], columns: dict[str, NDArray[Any]], episodes: list[dict[str, Any]]
) -> list[Trajectory]:
    """Cut columns that hold episodes end to end into trajectories."""
    pieces = {
        name: np.split(column, np.cumsum(lengths if name == "actions" else lengths + 1)[:-1])
        for name, column in columns.items()
    }
    return [
        episode_without_decisions(
            **{name: pieces[name][i].copy() for name in _ARRAYS},
            context=episode["context"],
            outcome=episode["outcome"],
            info=episode["info"],
        )
        for i, episode in enumerate(episodes)
    ]
