"""One recorded episode as frozen arrays, and its file form (npz, never pickle).

Legend: N control steps, T decision steps, K denoising steps, To observation history,
Tp predicted chunk, O observation dims, A action dims, Q position dims of the physics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import TrajectoryFileError
from rodif_core.npz import read_archive, write_archive

FORMAT_VERSION = 1
_ARRAYS = {  # and their number of axes
    "observations": 2,
    "actions": 2,
    "qpos": 2,
    "paths": 2,
    "histories": 3,
    "chains": 4,
    "decision_steps": 1,
}


@dataclass(frozen=True, eq=False)
class Trajectory:
    """An episode: what was seen, what was done, and the full denoising chain of every decision.

    observations    (N + 1, O) float32; row 0 before the first action, row i after action i
    actions         (N, A) float32; executed actions in task units (metres for Avoid)
    qpos            (N + 1, Q) float32; physics positions, enough to draw every frame
    paths           (N + 1, 3) float32; end-effector position in metres
    histories       (T, To, O) float32; what the policy was conditioned on at each decision
    chains          (T, K + 1, Tp, A) float32; normalised, unclamped; [:, 0] = a^K, [:, K] = a^0
    decision_steps  (T,) int32; control step at which each chunk was chosen
    context         start of the episode (JSON types), as the task sampled it
    outcome         {"success": bool, "mode": str | None, "group": str | None, "reason": str, …}
    info            task, seed, checkpoint digest, mujoco version, control_dt …

    Scripted demonstrations have T = 0 decisions.
    """

    observations: NDArray[np.float32]
    actions: NDArray[np.float32]
    qpos: NDArray[np.float32]
    paths: NDArray[np.float32]
    histories: NDArray[np.float32]
    chains: NDArray[np.float32]
    decision_steps: NDArray[np.int32]
    context: dict[str, Any]
    outcome: dict[str, Any]
    info: dict[str, Any]

    def __post_init__(self) -> None:
        n = len(self.actions)
        for name in ("observations", "qpos", "paths"):
            if len(getattr(self, name)) != n + 1:
                raise TrajectoryFileError(
                    f"{name} has {len(getattr(self, name))} rows; {n} actions need {n + 1}"
                )
        t = len(self.decision_steps)
        if len(self.chains) != t or len(self.histories) != t:
            raise TrajectoryFileError(
                f"{t} decision steps, but {len(self.chains)} chains"
                f" and {len(self.histories)} histories"
            )
        for name in _ARRAYS:
            array = getattr(self, name)
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise TrajectoryFileError(f"{name} has values that are not finite")
            array.setflags(write=False)

    @property
    def success(self) -> bool:
        """Whether the task's goal was reached."""
        return bool(self.outcome["success"])

    def to_bytes(self) -> bytes:
        """The file form: an npz archive with a JSON header; `from_bytes` reads it back."""
        meta = {
            "format": FORMAT_VERSION,
            "context": self.context,
            "outcome": self.outcome,
            "info": self.info,
        }
        return write_archive(meta, {name: getattr(self, name) for name in _ARRAYS})

    @classmethod
    def from_bytes(cls, data: bytes) -> Trajectory:
        """Read the file form; raises TrajectoryFileError when it is damaged or foreign."""
        facts = {"context": dict, "outcome": dict, "info": dict}
        meta, arrays = read_archive(
            data, "the episode file", version=FORMAT_VERSION, facts=facts, ranks=_ARRAYS
        )
        context, outcome, info = (meta[name] for name in facts)
        return cls(**arrays, context=context, outcome=outcome, info=info)


def episode_without_decisions(
    *,
    observations: NDArray[np.float32],
    actions: NDArray[np.float32],
    qpos: NDArray[np.float32],
    paths: NDArray[np.float32],
    context: dict[str, Any],
    outcome: dict[str, Any],
    info: dict[str, Any],
) -> Trajectory:
    """An episode that no policy decided: T = 0, with the right ranks. Arrays as in Trajectory."""
    return Trajectory(
        observations=observations,
        actions=actions,
        qpos=qpos,
        paths=paths,
        histories=np.zeros((0, 1, observations.shape[1]), np.float32),
        chains=np.zeros((0, 1, 1, actions.shape[1]), np.float32),
        decision_steps=np.zeros(0, np.int32),
        context=context,
        outcome=outcome,
        info=info,
    )
