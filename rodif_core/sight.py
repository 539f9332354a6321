"""What a policy is given to see: the observation, or pictures of the simulation as features.

Legend: m simulations, N control steps, Q physics positions, S observation dims of the task,
P of them proprioception, O dims of the rows that the policy reads, C cameras of H x W pixels.
"""

from __future__ import annotations

from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.policies.policy import PolicyConfig
from rodif_core.policies.resnet import ImageEncoder
from rodif_core.tasks.base import Task
from rodif_core.tasks.camera import Camera

ENCODED_TOGETHER = 64  # rows of pictures in one call of the encoder


class Sight:
    """Turns observations and physics positions into the rows that a policy reads.

    A policy without an encoder reads the observation. One with an encoder reads proprioception and
    the features of what the task's cameras see; the pictures are drawn, encoded and forgotten. Use
    it in a `with`: the cameras hold an OpenGL context. Raises ValueOutOfRangeError when task and
    policy do not fit together.
    """

    def __init__(self, task: Task, config: PolicyConfig, encoder: ImageEncoder | None) -> None:
        self._task, self._encoder = task, encoder
        self._camera: Camera | None = None
        given, wanted = config.proprioception_dim, task.observation_dim
        if config.images is not None:
            wanted = task.proprioception_dim
            if config.images.cameras != len(task.cameras):
                raise ValueOutOfRangeError(
                    "cameras of the policy",
                    config.images.cameras,
                    f"{len(task.cameras)}, as task {task.name.value!r} has",
                )
            self._camera = Camera(task, config.images.pixels, config.images.pixels)
        if given != wanted:
            raise ValueOutOfRangeError(
                "observation dims of the policy",
                given,
                f"{wanted}, as task {task.name.value!r} has",
            )

    def rows(
        self, observations: NDArray[np.float32], qpos: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Rows (m, O) for observations (m, S) and physics positions (m, Q).

        Raises GraphicsError when pictures are needed and this machine cannot draw.
        """
        if self._camera is None:
            return observations.copy()
        assert self._encoder is not None  # a policy with images has one
        felt = torch.tensor(observations[:, : self._task.proprioception_dim])
        parts = []
        for first in range(0, len(qpos), ENCODED_TOGETHER):
            part = slice(first, first + ENCODED_TOGETHER)
            frames = torch.from_numpy(draw(self._camera, self._task, qpos[part]))
            with torch.no_grad():
                parts.append(self._encoder(felt[part, None], frames[:, None])[:, 0])
        return np.asarray(torch.cat(parts).numpy())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._camera is not None:
            self._camera.close()


def draw(camera: Camera, task: Task, qpos: NDArray[np.float32]) -> NDArray[np.uint8]:
    """What the task's cameras see at physics positions (m, Q): (m, C, H, W, 3) uint8 RGB."""
    return np.stack([[camera.picture(row, view) for view in task.cameras] for row in qpos])
