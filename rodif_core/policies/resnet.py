"""Camera images as features: one ResNet-18 a camera (He et al. 2016), trained from scratch.

Legend: N images, B rows, T frames in a row, C cameras, P proprioception dims. Group instead of
batch normalisation, because batches are small and weights are averaged; spatial soft-argmax (Finn
et al. 2016) instead of pooling, because the task is to know *where* things are: each feature map
becomes its expected image coordinate. These are the features, or what a head tells of the state
from them (`telling.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rodif_core.errors import ValueOutOfRangeError
from rodif_core.policies.telling import Telling

GROUP_CHANNELS = 16  # channels that share a normalisation; all of them where there are fewer
STAGES = ((1, 1), (2, 2), (4, 2), (8, 2))  # width factor and stride of ResNet-18's four stages
# On processors with AVX2 and no more, the backward convolution of torch 2.13 (oneDNN) writes past
# its memory with 4 channels, and the process dies; with 8 it does not.
LEAST_WIDTH = 8
SHRINK = 32  # one entry of the last feature map stands for this many pixels


@dataclass(frozen=True)
class ImageConfig:
    """What a policy sees besides proprioception. Width 64 is ResNet-18, 16 its CPU preset."""

    cameras: int = 2
    pixels: int = 96  # height and width
    width: int = 16  # channels of the first stage
    keypoints: int = 32  # feature maps whose coordinates are the features
    told: int = 0  # numbers of the state that are told from the keypoints and are then the features

    def __post_init__(self) -> None:
        for name in ("cameras", "keypoints"):
            if getattr(self, name) < 1:
                raise ValueOutOfRangeError(name, getattr(self, name), "at least 1")
        if self.told < 0:
            raise ValueOutOfRangeError("told", self.told, "at least 0")
        if self.pixels < 2 * SHRINK or self.pixels % SHRINK:
            legal = f"a multiple of {SHRINK}, at least {2 * SHRINK}"
            raise ValueOutOfRangeError("pixels", self.pixels, legal)
        if self.width != LEAST_WIDTH and (self.width < 1 or self.width % GROUP_CHANNELS):
            raise ValueOutOfRangeError(
                "width", self.width, f"{LEAST_WIDTH} or a multiple of {GROUP_CHANNELS}"
            )

    @property
    def coordinates(self) -> int:
        """Of the keypoints of all cameras together."""
        return 2 * self.keypoints * self.cameras

    @property
    def feature_dim(self) -> int:
        """What a policy reads of the pictures: what they tell, or the keypoints' coordinates."""
        return self.told or self.coordinates


def normalisation(channels: int) -> nn.GroupNorm:
    """Group normalisation with about `GROUP_CHANNELS` channels a group."""
    return nn.GroupNorm(max(1, channels // GROUP_CHANNELS), channels)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions beside the identity: (N, C_in, H, W) → (N, C_out, H / s, W / s)."""

    def __init__(self, channels_in: int, channels: int, stride: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(channels_in, channels, 3, stride, padding=1, bias=False),
            normalisation(channels),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1, bias=False),
            normalisation(channels),
        )
        self.skip = nn.Sequential()
        if stride != 1 or channels_in != channels:
            self.skip.append(nn.Conv2d(channels_in, channels, 1, stride, bias=False))
            self.skip.append(normalisation(channels))

    def forward(self, maps: Tensor) -> Tensor:
        """(N, C_in, H, W) → (N, C_out, H / stride, W / stride)."""
        result: Tensor = (self.layers(maps) + self.skip(maps)).relu()
        return result


class ResNet18(nn.Sequential):
    """ResNet-18 without its classifier: (N, 3, H, W) → (N, 8 width, H / 32, W / 32)."""

    def __init__(self, width: int) -> None:
        super().__init__(
            nn.Conv2d(3, width, 7, stride=2, padding=3, bias=False),
            normalisation(width),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2, padding=1),
        )
        channels = width
        for factor, stride in STAGES:
            self.append(BasicBlock(channels, factor * width, stride))
            self.append(BasicBlock(factor * width, factor * width, 1))
            channels = factor * width


class SpatialSoftArgmax(nn.Module):
    """Expected coordinate of each keypoint map, in -1 … 1: (N, C, H, W) → (N, 2 keypoints)."""

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        # A bias would shift a whole map, which the softmax does not see.
        self.maps = nn.Conv2d(channels, keypoints, 1, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        """x of all keypoints (left to right), then y (top to bottom)."""
        maps = self.maps(features)
        share = maps.flatten(2).softmax(-1).view_as(maps)
        height, width = maps.shape[-2:]
        x = share.sum(-2) @ torch.linspace(-1, 1, width).to(share)
        y = share.sum(-1) @ torch.linspace(-1, 1, height).to(share)
        return torch.cat([x, y], dim=1)


class ImageEncoder(nn.Module):
    """Proprioception and camera frames as the observation rows that every denoiser reads.

    Call it once for the frames of a window: neither the K denoising steps of a chain nor several
    noise draws for one window need the images again. `felt`: how many numbers proprioception has;
    only an encoder that tells the state needs to know.
    """

    def __init__(self, config: ImageConfig, felt: int = 0) -> None:
        super().__init__()
        self.config = config
        self.cameras = nn.ModuleList(
            nn.Sequential(
                ResNet18(config.width), SpatialSoftArgmax(8 * config.width, config.keypoints)
            )
            for _ in range(config.cameras)
        )
        self.telling = Telling(felt, config.coordinates, config.told) if config.told else None

    def look(self, frames: Tensor) -> Tensor:
        """Keypoints (B, T, `coordinates`) in -1 … 1 of uint8 RGB (B, T, C, H, W, 3).

        Raises ValueOutOfRangeError for frames of another type or shape.
        """
        batch, steps = frames.shape[:2]
        pixels = self.config.pixels
        shape = (batch, steps, self.config.cameras, pixels, pixels, 3)
        if frames.dtype != torch.uint8 or tuple(frames.shape) != shape:
            raise ValueOutOfRangeError(
                "frames", f"{frames.dtype} {tuple(frames.shape)}", f"torch.uint8 {shape}"
            )
        # To the weights' type and device, and to -1 … 1.
        images = frames.flatten(0, 1).permute(1, 0, 4, 2, 3).to(next(self.parameters())) / 127.5 - 1
        found = [camera(view) for camera, view in zip(self.cameras, images, strict=True)]
        return torch.cat(found, dim=1).unflatten(0, (batch, steps))

    def forward(self, proprioception: Tensor, frames: Tensor) -> Tensor:
        """(B, T, P) in task units and uint8 RGB (B, T, C, H, W, 3) → (B, T, P + features), P first.

        Raises ValueOutOfRangeError for frames of another type or shape.
        """
        seen = self.look(frames)
        if self.telling is not None:
            seen = self.telling(proprioception, seen)
        return torch.cat([proprioception, seen], dim=-1)
