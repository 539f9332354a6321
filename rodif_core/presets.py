"""How policies are pretrained: the sizes and settings of every task, by name.

Legend: K denoising steps, To observation history, Tp predicted and Te executed chunk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from rodif_core.encoder_training import EncoderConfig
from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.policies.mlp import MlpSize
from rodif_core.policies.policy import PolicyConfig, Size
from rodif_core.policies.resnet import ImageConfig
from rodif_core.policies.transformer import TransformerSize
from rodif_core.policies.unet import UnetSize
from rodif_core.spec import Architecture, TaskName
from rodif_core.tasks.base import Task


@dataclass(frozen=True)
class PretrainConfig:
    """How a policy is pretrained: its shape, but for the task's dims, and the training.

    Defaults: the CPU preset of the U-Net, with which Avoid's shipped checkpoint was trained.
    """

    size: Size = UnetSize()  # widths; its type is the architecture
    observation_steps: int = 2  # To
    predicted_steps: int = 16  # Tp
    executed_steps: int = 8  # Te: control steps between two decisions of the policy
    denoising_steps: int = 20  # K
    updates: int = 10_000
    batch_size: int = 128
    learning_rate: float = 1e-3
    weight_decay: float = 1e-6
    warm_up: int = 200
    ema_decay: float = 0.999
    rounds: int = 0  # of training on, also on what experts did after they took over
    recoveries: int = 300  # takeovers tried a round
    drives: int = 1  # rollouts for each of them; from 2 on, failures and every group get as many
    steered_drives: int = 0  # further rollouts for each, by copies that each go a rarer group's way
    round_updates: int = 8_000
    held_out: float = 0.1  # share of demonstrations kept for the held-out loss and the support
    images: ImageConfig | None = None  # for tasks with cameras
    encoder: EncoderConfig = EncoderConfig()  # how their encoder is trained
    begin_with: TaskName | None = None  # no first training: go on from this shipped policy, …
    looks: int = 0  # … with so many trainings of the encoder alone before the rounds
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.held_out < 0.5:
            raise ValueOutOfRangeError("held_out", self.held_out, "in (0, 0.5)")
        if not 0 < self.learning_rate <= 1:
            raise ValueOutOfRangeError("learning_rate", self.learning_rate, "in (0, 1]")
        if not 0 <= self.ema_decay < 1:
            raise ValueOutOfRangeError("ema_decay", self.ema_decay, "in [0, 1)")
        least = {"updates": 1, "round_updates": 1, "recoveries": 1, "drives": 1}
        least |= {"rounds": 0, "batch_size": 1, "steered_drives": 0}
        if self.looks < 0 or (self.looks and self.begin_with is None):
            legal = "at least 0, and 0 without a policy to begin with"
            raise ValueOutOfRangeError("looks", self.looks, legal)
        if self.begin_with is not None and self.looks + self.rounds < 1:
            legal = "at least 1, as there is no first training"
            raise ValueOutOfRangeError("looks and rounds together", 0, legal)
        for name, value in (least | {"warm_up": 0, "weight_decay": 0}).items():
            if getattr(self, name) < value:
                raise ValueOutOfRangeError(name, getattr(self, name), f"at least {value}")

    def policy_config(self, task: Task) -> PolicyConfig:
        """The policy's shape for a task.

        Raises ValueOutOfRangeError for pictures of a task without cameras, the reverse, and
        pictures that tell more or less than the task hides.
        """
        cameras = self.images.cameras if self.images else 0
        if cameras != len(task.cameras):
            raise ValueOutOfRangeError(
                "number of cameras",
                cameras,
                f"{len(task.cameras)}, as task {task.name.value!r} has",
            )
        rows = task.observation_dim
        if self.images is not None:
            hidden = task.observation_dim - task.proprioception_dim
            if self.images.told not in (0, hidden):
                raise ValueOutOfRangeError("told", self.images.told, f"0 or {hidden}")
            rows = task.proprioception_dim + self.images.feature_dim
        return PolicyConfig(
            rows,
            task.action_dim,
            self.observation_steps,
            self.predicted_steps,
            self.executed_steps,
            self.denoising_steps,
            self.size,
            self.images,
        )


# The architecture of each task, by name (paper, Table 1); in the CPU preset Stacking has another.
TASK_ARCHITECTURES: dict[str, Architecture] = {
    "avoid": Architecture.UNET,
    "pushing": Architecture.UNET,
    "sorting": Architecture.TRANSFORMER,
    "aligning": Architecture.MLP,
    "aligning-state": Architecture.MLP,
    "stacking": Architecture.TRANSFORMER,
    "stacking-state": Architecture.TRANSFORMER,
}

# To, Tp and K are the paper's (appendix, architectures and training hyperparameters); Te is ours
# but for the single action. Where the sizes come from is told in docs/architectures.md.
_TRANSFORMER = PretrainConfig(
    size=TransformerSize(),
    observation_steps=5,
    denoising_steps=16,
    updates=40_000,
    learning_rate=5e-4,
    warm_up=500,
)
_MLP = PretrainConfig(
    size=MlpSize(),
    observation_steps=1,
    predicted_steps=1,
    executed_steps=1,
    denoising_steps=4,
    updates=60_000,
    batch_size=512,
)
_PAPER: dict[str, Any] = {  # what a GPU is for: wide, long, large batches
    "updates": 60_000,
    "batch_size": 256,
    "learning_rate": 1e-4,
    "warm_up": 500,
}
PRESETS = {
    Architecture.UNET: {
        "cpu": PretrainConfig(),
        "paper": PretrainConfig(size=UnetSize(channels=(256, 512, 1024)), **_PAPER),
    },
    Architecture.TRANSFORMER: {
        "cpu": _TRANSFORMER,
        "paper": replace(
            _TRANSFORMER,
            size=TransformerSize(
                width=512, heads=8, encoder_layers=4, decoder_layers=7, feedforward=3200
            ),
            **_PAPER,
        ),
    },
    Architecture.MLP: {
        "cpu": _MLP,
        "paper": replace(_MLP, size=MlpSize(width=256, blocks=4), **_PAPER | {"batch_size": 1024}),
    },
}


# On two cores the transformer of the paper's preset sees too few rows to learn Stacking; single
# actions train an order of magnitude faster (docs/tasks.md has the figures). Missed grasps are what
# demonstrations do not show, so that takeovers count for more than more demonstrations.
_CPU_STACKING = replace(_MLP, size=MlpSize(width=256, blocks=4), updates=16_000, rounds=5)
_OWN_BASES = {("stacking", "cpu"): _CPU_STACKING, ("stacking-state", "cpu"): _CPU_STACKING}

# Pushing needs wider layers and more updates than Avoid, and both look again sooner: a cube that
# turned away from the rod is lost within eight control steps.
_TASK_CHANGES: dict[tuple[str, str], dict[str, Any]] = {
    ("pushing", "cpu"): {
        "size": UnetSize(channels=(32, 64, 128)),
        "executed_steps": 4,
        "updates": 25_000,
    },
    ("pushing", "paper"): {"executed_steps": 4},
    ("sorting", "cpu"): {
        "executed_steps": 4,
        "updates": 30_000,
        "rounds": 3,
        "recoveries": 900,
        "drives": 4,
    },
    ("sorting", "paper"): {"executed_steps": 4},
    ("aligning-state", "cpu"): {"updates": 30_000},
    ("aligning", "cpu"): {
        "images": ImageConfig(told=14),
        "encoder": EncoderConfig(moments=32_000, updates=5_000, round_updates=2_000),
        "begin_with": TaskName.ALIGNING_STATE,
        "looks": 3,
        "rounds": 2,
    },
    ("stacking", "cpu"): {
        "images": ImageConfig(told=45),
        "encoder": EncoderConfig(
            moments=25_000, rearranged=25_000, updates=6_000, round_updates=2_500
        ),
        "begin_with": TaskName.STACKING_STATE,
        "looks": 8,
        "rounds": 0,
        "recoveries": 200,
    },
    **{
        (task, "paper"): {
            "images": ImageConfig(width=64),
            "encoder": EncoderConfig(
                moments=100_000, updates=40_000, batch_size=256, learning_rate=3e-4
            ),
        }
        for task in ("aligning", "stacking")
    },
}


def preset_for(task: TaskName, name: str) -> PretrainConfig:
    """How a task's policy is pretrained.

    Raises UnknownNameError for an unknown preset, and for a task that has none, listing the legal.
    """
    if task not in TASK_ARCHITECTURES:
        raise UnknownNameError("task with presets", task, TASK_ARCHITECTURES)
    presets = PRESETS[TASK_ARCHITECTURES[task]]
    if name not in presets:
        raise UnknownNameError("preset", name, presets)
    key = (task.value, name)
    return replace(_OWN_BASES.get(key, presets[name]), **_TASK_CHANGES.get(key, {}))
