"""A demonstration set out of a file, looked at before anybody trains on it."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rodif_core.demonstrations import load_demonstrations
from rodif_core.errors import DemonstrationFileError
from rodif_core.tasks.base import Task
from rodif_core.trajectory import Trajectory

SCRIPTED = "scripted"  # by our experts; imported episodes name their own source
TAKEOVER = "takeover"  # an expert went on from what a policy had done
POLICY = "policy"  # a rollout


def read_set(task: Task, path: Path) -> tuple[list[Trajectory], dict[str, Any]]:
    """The demonstrations of a file, and what a card tells of it: {file, sha256, episodes, sources,
    mujoco_versions}, and seeds or checkpoints where there are any.

    A set has all that a training needs, with pictures, too: these are drawn from the positions
    that it holds. Raises TrajectoryFileError for a file that is none, and DemonstrationFileError
    for one of another task, with failures, or with other observations than the task has now.
    """
    made = load_demonstrations(path)
    if not made:
        raise DemonstrationFileError(f"{path} holds 0 episodes, but must hold at least 1")
    for number, one in enumerate(made):
        _check(task, one, f"{path}, episode {number}")
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    return made, {"file": path.name, "sha256": sha256, "episodes": len(made)} | provenance(made)


def provenance(demonstrations: Sequence[Trajectory]) -> dict[str, Any]:
    """Where they come from: how many of each source, and which MuJoCo recorded them."""
    sources = Counter(_source(one.info) for one in demonstrations)
    told: dict[str, Any] = {
        "sources": dict(sorted(sources.items())),
        "mujoco_versions": sorted({str(one.info.get("mujoco_version")) for one in demonstrations}),
    }
    seeds = {one.info.get("seed") for one in demonstrations if _source(one.info) == SCRIPTED}
    checkpoints = {one.info["checkpoint"] for one in demonstrations if "checkpoint" in one.info}
    if seeds:
        told["seeds"] = sorted(seeds, key=str)
    if checkpoints:
        told["checkpoints"] = sorted(checkpoints)
    return told


def _source(info: dict[str, Any]) -> str:
    if "source" in info:
        return str(info["source"])
    if "taken_over_at" in info:
        return TAKEOVER
    return POLICY if "checkpoint" in info else SCRIPTED


def _check(task: Task, one: Trajectory, where: str) -> None:
    found = one.info.get("task")
    if found != task.name.value:
        raise DemonstrationFileError(
            f"{where} is of task {found!r}, but must be of {task.name.value!r}"
        )
    if not one.outcome.get("success"):
        raise DemonstrationFileError(
            f"{where} failed ({one.outcome.get('reason')!r}); demonstrations must succeed"
        )
    dims = {"observations": task.observation_dim, "actions": task.action_dim}
    dims["qpos"] = task.robot_joints + 7 * len(task.objects)
    for name, legal in dims.items():
        width = getattr(one, name).shape[1]
        if width != legal:
            raise DemonstrationFileError(
                f"{where} has {name} of {width} numbers, but task {task.name.value!r} has {legal};"
                " make or import the set again"
            )
