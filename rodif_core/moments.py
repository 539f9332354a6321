"""What an image encoder learns from: pictures of single moments, and what they show.

Demonstrations begin with the objects in some hundred arrangements, and the gripper always comes to
an object straight. A picture costs no physics, so the same moment can also be drawn with the
objects that nobody has touched yet elsewhere: where another episode may begin with them, or a
little beside. The encoder then sees any number of arrangements, and hands that come askew.

Legend: R moments, Q physics positions, S observation dims of the task, P of them proprioception,
C cameras, H x W pixels, B objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.resnet import ImageConfig
from rodif_core.sight import draw
from rodif_core.tasks.base import Array, Task, View
from rodif_core.tasks.camera import Camera
from rodif_core.tasks.panda import TOOL_SITE
from rodif_core.trajectory import Trajectory

UNTOUCHED = 0.003  # m and quaternion units; an object nearer to its start has only come to rest
NUDGED = 0.3  # share of the untouched objects that stay near their place …
NUDGE = 0.02  # … and are moved by so much (m, standard deviation, both ways) …
NUDGE_TURN = 0.3  # … and turned by so much (rad, standard deviation)

Rows = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Moments:
    """frames (R, C, H, W, 3) uint8, felt (R, P) and hidden (R, S - P), both normalised: what the
    robot knows of itself, and what the pictures are to tell."""

    frames: Tensor
    felt: Tensor
    hidden: Tensor

    @classmethod
    def draw(
        cls,
        task: Task,
        episodes: Sequence[Trajectory],
        images: ImageConfig,
        states: Normaliser,
        count: int,
        elsewhere: int = 0,
        rng: np.random.Generator | None = None,
    ) -> Self:
        """`count` states as they were, or all if there are fewer, evenly spaced over the episodes;
        then `elsewhere` states with untouched objects put elsewhere, by `rng`.

        Raises GraphicsError where nothing can be drawn.
        """
        total = sum(len(one.qpos) for one in episodes)
        chosen = np.linspace(0, total - 1, min(count, total)).astype(int)
        qpos = np.concatenate([one.qpos for one in episodes])[chosen]
        observations = np.concatenate([one.observations for one in episodes])[chosen]
        if elsewhere:
            assert rng is not None  # whoever asks for chance brings it
            more = rearranged(task, episodes, elsewhere, rng)
            qpos, observations = (
                np.concatenate(pair) for pair in zip((qpos, observations), more, strict=True)
            )
        with Camera(task, images.pixels, images.pixels) as camera:
            frames = draw(camera, task, qpos)
        normalised = states.observation(torch.from_numpy(observations))
        felt, hidden = normalised.tensor_split([task.proprioception_dim], dim=1)
        return cls(torch.from_numpy(frames), felt, hidden)

    def pick(self, rows: Tensor, device: str) -> tuple[Tensor, Tensor, Tensor]:
        """Frames, felt and hidden of those rows, on the device."""
        return (
            self.frames[rows].to(device),
            self.felt[rows].to(device),
            self.hidden[rows].to(device),
        )

    def and_those(self, other: Moments) -> Moments:
        """Both one after the other."""
        return Moments(
            torch.cat([self.frames, other.frames]),
            torch.cat([self.felt, other.felt]),
            torch.cat([self.hidden, other.hidden]),
        )


def rearranged(
    task: Task, episodes: Sequence[Trajectory], count: int, rng: np.random.Generator
) -> tuple[Rows, Rows]:
    """Physics positions (count, Q) and observations (count, S) of states drawn from the episodes,
    with their untouched objects put elsewhere.

    An object is untouched while it lies where the episode's context put it. Nothing is simulated:
    an object may come to lie in another one or in the hand, where the picture still shows it.
    """
    lengths = np.array([len(one.qpos) for one in episodes])
    starts = [task.start_objects(one.context) for one in episodes]
    which = rng.choice(len(episodes), size=count, p=lengths / lengths.sum())
    qpos, paths, observations = [], [], []
    for index in which.tolist():
        one, step = episodes[index], int(rng.integers(lengths[index]))
        row = one.qpos[step].copy()
        poses = task.object_poses(row)  # a view into the row
        _put_elsewhere(task, poses, starts[index], rng)
        qpos.append(row)
        paths.append(one.paths[step])
        observations.append(one.observations[step])
    rows = np.stack(qpos)
    seen = _observed(task, rows, np.stack(paths))
    felt = np.stack(observations)[:, : task.proprioception_dim]
    return rows, np.concatenate([felt, seen[:, task.proprioception_dim :]], axis=1)


def _put_elsewhere(
    task: Task, poses: NDArray[np.floating], start: Array, rng: np.random.Generator
) -> None:
    """Change poses (B, 7) in place; heights stay, as objects have come to rest."""
    fresh = task.start_objects(task.sample_context(rng))
    flat = [0, 1, 3, 4, 5, 6]  # x, y and the quaternion
    for index, pose in enumerate(poses):
        if np.abs(pose[flat] - start[index, flat]).max() > UNTOUCHED:
            continue
        if rng.random() >= NUDGED:
            pose[flat] = fresh[index, flat]
            continue
        pose[:2] += rng.normal(0, NUDGE, 2)
        half = rng.normal(0, NUDGE_TURN) / 2
        turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        turned = np.empty(4)
        mujoco.mju_mulQuat(turned, turn, pose[3:].astype(np.float64))
        pose[3:] = turned


def _observed(task: Task, qpos: Rows, paths: Rows) -> Rows:
    """Observations (R, S) at physics positions (R, Q) with the end effector at `paths` (R, 3);
    what set-points tell in them is not right."""
    model = task.build_model()
    data = mujoco.MjData(model)
    site = model.site(TOOL_SITE).id
    rotations = np.empty((len(qpos), 3, 3))
    for row, rotation in zip(qpos, rotations, strict=True):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        rotation[:] = data.site_xmat[site].reshape(3, 3)
    objects = task.object_poses(qpos).astype(np.float64)
    view = View(
        setpoints=np.zeros((len(qpos), task.action_dim)),
        ends=paths.astype(np.float64),
        rotations=rotations,
        joints=qpos[:, : task.robot_joints].astype(np.float64),
        objects=objects,
        objects_before=objects,
    )
    return task.observe(view).astype(np.float32)
