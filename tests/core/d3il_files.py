"""Small files in D3IL's layout, made from demonstrations of our own."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np

from rodif_core.d3il import FORMATS, JOINT_OFFSETS, ROD_BELOW
from rodif_core.tasks import Task
from rodif_core.tasks.env import BatchEnv
from rodif_core.trajectory import Trajectory


def d3il_record(task: Task, demonstration: Trajectory) -> dict[str, Any]:
    """What D3IL's recorder would have written of this episode."""
    env = BatchEnv(task, 1)
    env.reset([demonstration.context])
    rows = [env.setpoints[0]]
    for action in demonstration.actions:
        env.step(action[None])
        rows.append(env.setpoints[0])
    setpoints = np.stack(rows)
    robot = {"c_pos": demonstration.paths.astype(np.float64), "des_c_pos": setpoints[:, :3].copy()}
    if task.name.startswith("stacking"):
        robot["des_c_pos"] = robot["c_pos"]
        robot["des_j_pos"] = setpoints[:, :7] - JOINT_OFFSETS
        robot["gripper_width"] = setpoints[:, 7]
    elif task.name.startswith("aligning"):
        robot["des_c_pos"][:, 2] += ROD_BELOW
    poses = task.object_poses(demonstration.qpos).astype(np.float64)
    record: dict[str, Any] = {"robot": robot}
    for ours, theirs in FORMATS[task.name].places.items():
        pose = poses[:, task.objects.index(ours)]
        record[theirs] = {"pos": pose[:, :3], "quat": pose[:, 3:]}
    return record


def write_record(path: Path, record: Any) -> Path:
    """As D3IL writes its files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(record))
    return path
