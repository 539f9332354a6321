"""A diffusion policy: denoiser + schedule + normaliser + chunking, as one value.

Legend: B rows, K denoising steps, To observation history, Tp predicted chunk, Te executed chunk,
O observation dims, A action dims; with images C cameras, P proprioception dims, frames of H x W.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from rodif_core.diffusion.chain import sample_chain
from rodif_core.diffusion.schedule import NoiseSchedule
from rodif_core.errors import LearningError, UnknownNameError, ValueOutOfRangeError
from rodif_core.policies.mlp import MlpDenoiser, MlpSize
from rodif_core.policies.normaliser import Normaliser
from rodif_core.policies.resnet import ImageConfig, ImageEncoder
from rodif_core.policies.transformer import TransformerDenoiser, TransformerSize
from rodif_core.policies.unet import ConditionalUnet1d, UnetSize
from rodif_core.spec import Architecture, parse_name

Size = UnetSize | TransformerSize | MlpSize
DenoiserModule = ConditionalUnet1d | TransformerDenoiser | MlpDenoiser
ARCHITECTURES: dict[Architecture, type[Size]] = {
    Architecture.UNET: UnetSize,
    Architecture.TRANSFORMER: TransformerSize,
    Architecture.MLP: MlpSize,
}


@dataclass(frozen=True)
class PolicyConfig:
    """Shape of a policy. Defaults: the paper's Avoid (U-Net, K = 20, To = 2, Tp = 16).

    observation_dim (O) is what the denoiser reads at each step: proprioception and object states,
    or with `images` proprioception followed by `images.feature_dim` features.
    """

    observation_dim: int
    action_dim: int
    observation_steps: int = 2  # To
    predicted_steps: int = 16  # Tp
    executed_steps: int = 8  # Te, receding horizon
    denoising_steps: int = 20  # K
    size: Size = UnetSize()  # widths; its type is the architecture
    images: ImageConfig | None = None
    clip: float = 1.0
    std_floor: float = 0.0

    def __post_init__(self) -> None:
        for name in ("action_dim", "observation_steps", "predicted_steps"):
            if getattr(self, name) < 1:
                raise ValueOutOfRangeError(name, getattr(self, name), "at least 1")
        if not 1 <= self.executed_steps <= self.predicted_steps:
            raise ValueOutOfRangeError(
                "executed_steps", self.executed_steps, f"1 … {self.predicted_steps}"
            )
        if isinstance(self.size, UnetSize) and self.predicted_steps % self.size.chunk_multiple:
            raise ValueOutOfRangeError(
                "predicted_steps", self.predicted_steps, f"a multiple of {self.size.chunk_multiple}"
            )
        if self.proprioception_dim < 1:
            features = self.observation_dim - self.proprioception_dim
            raise ValueOutOfRangeError(
                "observation_dim", self.observation_dim, f"above the {features} image features"
            )

    @property
    def architecture(self) -> Architecture:
        """Which denoiser it is."""
        return next(name for name, size in ARCHITECTURES.items() if isinstance(self.size, size))

    @property
    def proprioception_dim(self) -> int:
        """Observation dims that do not come from images."""
        return self.observation_dim - (self.images.feature_dim if self.images else 0)

    def to_json(self) -> dict[str, Any]:
        """Plain JSON types: one flat object, with the sizes that this architecture has.

        A U-Net names no architecture, as in files from before there were others: their digests
        must not change.
        """
        plain = asdict(self)
        sizes, images = plain.pop("size"), plain.pop("images")
        if self.architecture is not Architecture.UNET:
            plain["architecture"] = self.architecture.value
        if images is not None:
            # Nor those from before pictures could be told as a state.
            plain["images"] = {k: v for k, v in images.items() if k != "told" or v}
        return plain | {k: list(v) if isinstance(v, tuple) else v for k, v in sizes.items()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> PolicyConfig:
        """Inverse of `to_json`; raises UnknownNameError for names that do not exist."""
        rest = dict(data)
        name = rest.pop("architecture", Architecture.UNET.value)
        size = ARCHITECTURES[parse_name(Architecture, name, "architecture")]
        images = rest.pop("images", None)
        sizes = {item.name: rest.pop(item.name) for item in fields(size) if item.name in rest}
        own = [item.name for item in fields(cls) if item.name != "size"]
        legal = ["architecture", *own, *(item.name for item in fields(size))]
        for key in rest:
            if key not in legal:
                raise UnknownNameError(f"{name} policy field", key, legal)
        return cls(**rest, size=size(**sizes), images=ImageConfig(**images) if images else None)


def build_denoiser(config: PolicyConfig) -> DenoiserModule:
    """The network of a configuration, with fresh weights from torch's current random state.

    To add one, write it here, in `ARCHITECTURES`, `Size` and `DenoiserModule`
    (docs/architectures.md).
    """
    dims = {
        "action_dim": config.action_dim,
        "observation_dim": config.observation_dim,
        "observation_steps": config.observation_steps,
    }
    match config.size:
        case UnetSize():
            return ConditionalUnet1d(**dims, size=config.size)
        case TransformerSize():
            return TransformerDenoiser(
                **dims, predicted_steps=config.predicted_steps, size=config.size
            )
        case MlpSize():
            return MlpDenoiser(**dims, predicted_steps=config.predicted_steps, size=config.size)


@dataclass(frozen=True, eq=False)
class DiffusionPolicy:
    """Weights and constants that turn an observation history into an action chunk.

    The encoder is there when the policy sees images. It makes the observation rows (`observe`);
    fine-tuning starts from rows and moves only the denoiser.
    """

    config: PolicyConfig
    denoiser: DenoiserModule
    schedule: NoiseSchedule
    normaliser: Normaliser
    encoder: ImageEncoder | None = None

    @classmethod
    def build(cls, config: PolicyConfig, normaliser: Normaliser) -> DiffusionPolicy:
        """A policy with fresh weights (from torch's current random state)."""
        denoiser = build_denoiser(config)
        encoder = None
        if config.images is not None:
            encoder = ImageEncoder(config.images, config.proprioception_dim)
        schedule = NoiseSchedule(config.denoising_steps, config.clip, config.std_floor)
        return cls(config, denoiser, schedule, normaliser, encoder)

    def copy(self) -> DiffusionPolicy:
        """Same constants, own denoiser weights."""
        return replace(self, denoiser=copy.deepcopy(self.denoiser))

    def observe(self, proprioception: Tensor, frames: Tensor) -> Tensor:
        """Observation rows of a policy with images, in task units, each frame encoded once.

        proprioception (B, T, P) in task units, frames uint8 RGB (B, T, C, H, W, 3) → (B, T, O).
        Differentiable. Raises LearningError for a policy without images.
        """
        if self.encoder is None:
            raise LearningError("this policy has no image encoder: its config has no `images`")
        rows: Tensor = self.encoder(proprioception, frames)
        return rows

    @torch.no_grad()
    def act(self, histories: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Choose chunks.

        histories (B, To, O) in task units; noise (B, `noise_entries`, Tp, A) standard normal.
        Returns the executed actions (B, Te, A) in task units and the chains (B, K + 1, Tp, A).
        """
        chain = sample_chain(
            self.denoiser, self.schedule, self.normaliser.observation(histories), noise
        )
        executed = chain[:, -1, : self.config.executed_steps]
        return self.normaliser.to_task_action(executed), chain
