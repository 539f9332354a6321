"""Min-max scaling of observations and actions to [-1, 1]; lives inside the checkpoint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

MIN_SPAN = 1e-4  # a dimension that never moves would otherwise divide by zero


@dataclass(frozen=True, eq=False)
class Normaliser:
    """Affine map per dimension: normalised = (value - centre) / scale."""

    observation_centre: Tensor  # (O,)
    observation_scale: Tensor  # (O,)
    action_centre: Tensor  # (A,)
    action_scale: Tensor  # (A,)

    @classmethod
    def fit(
        cls, observations: Sequence[NDArray[np.float32]], actions: Sequence[NDArray[np.float32]]
    ) -> Normaliser:
        """From the rows of all demonstrations: the extremes map to ±1."""

        def centre_and_scale(rows: NDArray[np.float32]) -> tuple[Tensor, Tensor]:
            low, high = rows.min(axis=0), rows.max(axis=0)
            half = np.maximum((high - low) / 2, MIN_SPAN / 2)
            return torch.from_numpy((low + high) / 2), torch.from_numpy(half)

        observation = centre_and_scale(np.concatenate(observations))
        action = centre_and_scale(np.concatenate(actions))
        return cls(*observation, *action)

    def observation(self, values: Tensor) -> Tensor:
        """(…, O) task units → normalised."""
        return (values - self.observation_centre) / self.observation_scale

    def action(self, values: Tensor) -> Tensor:
        """(…, A) task units → normalised."""
        return (values - self.action_centre) / self.action_scale

    def to_task_action(self, values: Tensor) -> Tensor:
        """(…, A) normalised → task units."""
        return values * self.action_scale + self.action_centre

    def tensors(self, prefix: str = "normaliser.") -> dict[str, Tensor]:
        """Named tensors for the checkpoint file."""
        return {prefix + name: value for name, value in vars(self).items()}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor], prefix: str = "normaliser.") -> Normaliser:
        """Inverse of `tensors`."""
        return cls(**{name: tensors[prefix + name] for name in cls.__dataclass_fields__})
