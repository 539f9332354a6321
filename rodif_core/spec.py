"""Names and configurations that every room of the house shares. Imports neither torch nor mujoco.

All configurations are frozen, their ranges are checked when they are made, and they survive a trip
through JSON (`to_json` / `from_json`, which also checks types), so that a round can store exactly
what it ran with.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, TypeVar

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.json_config import JsonConfig


class TaskName(StrEnum):
    """Robot tasks that can be rolled out, labelled and fine-tuned."""

    AVOID = "avoid"
    PUSHING = "pushing"
    SORTING = "sorting"
    ALIGNING = "aligning"  # seen through two cameras
    STACKING = "stacking"  # the same
    ALIGNING_STATE = "aligning-state"  # the same task, with the objects' poses as observations
    STACKING_STATE = "stacking-state"


class Architecture(StrEnum):
    """Denoising networks of the paper."""

    UNET = "unet"  # convolutions over the action chunk (Avoid, Pushing)
    TRANSFORMER = "transformer"  # action chunks over an observation history (Sorting, Stacking)
    MLP = "mlp"  # single actions (Aligning)


class FinetuneMethod(StrEnum):
    """Fine-tuners that turn labels into a candidate policy."""

    RODIF_GUIDED = "rodif_guided"  # our default: RoDiF scores, guidance moves the policy
    RODIF = "rodif"  # the paper's robust loss (Eq. final_robust_loss)
    DP_DPO = "dp_dpo"  # the paper's baseline (Eq. dense_loss)
    IPO = "ipo"  # its further baselines: identity preference optimisation (Azar et al., 2024)
    CPO = "cpo"  # contrastive preference optimisation, with cloning (Xu et al., 2024)
    SIMPO = "simpo"  # simple preference optimisation, with a margin (Meng et al., 2024)


# Methods that run the RoDiF loss, whose threshold needs a conservativeness.
GATED_METHODS = frozenset({FinetuneMethod.RODIF_GUIDED, FinetuneMethod.RODIF})


class Reduction(StrEnum):
    """How the outer logistic of the RoDiF loss sees the votes (the paper writes `sum`)."""

    SUM = "sum"
    MEAN = "mean"
    GROUP = "group"  # one outer logistic per group of `group_size` consecutive pairs


class StepPairing(StrEnum):
    """Which decision steps of winner and loser are compared."""

    SAME_INDEX = "same_index"  # the paper: step t with step t, over min(T_w, T_l) steps
    MATCHED_STATE = "matched_state"  # the same, weighted by how far the two states still match


class Scorer(StrEnum):
    """What turns noisy labels into one utility per trajectory in `rodif_guided`."""

    NETWORK = "network"  # a few RoDiF updates on a throw-away copy; mean log-ratio
    GAUSSIAN_PROCESS = "gaussian_process"  # Bradley-Terry with a Gaussian-process prior on the path
    COMBINED = "combined"  # sum of both, each standardised


# Seeds of episodes. A fine-tuning of seed s rolls out from SELECTION_SEED + SEEDS_PER_ROUND · s on,
# each of its uses from SEEDS_PER_USE further on, and stays below the seeds of evaluations.
SELECTION_SEED, SEEDS_PER_ROUND, SEEDS_PER_USE = 7_000_000, 10_000, 1_000
EVALUATION_SEED = 1_000_000_000
LARGEST_SEED = (EVALUATION_SEED - SELECTION_SEED) // SEEDS_PER_ROUND - 1  # of a fine-tuning

NameT = TypeVar("NameT", bound=StrEnum)


def parse_name(names: type[NameT], value: str, kind: str) -> NameT:
    """Turn text into a member of `names`; raises UnknownNameError listing the legal ones."""
    try:
        return names(value)
    except ValueError:
        raise UnknownNameError(kind, value, [member.value for member in names]) from None


def _require(holds: bool, name: str, value: object, legal: str) -> None:
    if not holds:
        raise ValueOutOfRangeError(name, value, legal)


@dataclass(frozen=True)
class GuideConfig(JsonConfig):
    """Second half of `rodif_guided`: how the kept trajectories move the policy."""

    scorer: Scorer = Scorer.GAUSSIAN_PROCESS
    score_updates: int = 4  # full-batch RoDiF updates of the throw-away copy
    scales: tuple[float, ...] = (1.0, 2.0)  # guidance scales tried; fresh rollouts pick one
    updates: int = 150
    learning_rate: float = 1e-4
    batch_size: int = 256
    ema_decay: float = 0.98
    selection_rollouts: int = 100  # fresh rollouts per scale, for the choice among `scales`
    require_success: bool = True  # keep only trajectories that the simulation calls successful
    self_training_rounds: int = 2  # passes that imitate the policy's own liked cautious rollouts
    self_training_rollouts: int = 200  # of each pass
    self_training_noise: float = 0.8  # of those rollouts, in units of the sampler's own noise
    self_training_updates: int = 400

    def __post_init__(self) -> None:
        object.__setattr__(self, "scorer", parse_name(Scorer, self.scorer, "scorer"))
        object.__setattr__(self, "scales", tuple(float(s) for s in self.scales))
        _require(self.score_updates >= 1, "score_updates", self.score_updates, "at least 1")
        _require(
            len(self.scales) > 0 and all(0 < s <= 10 for s in self.scales),
            "scales",
            self.scales,
            "one or more numbers in (0, 10]",
        )
        _require(self.updates >= 1, "updates", self.updates, "at least 1")
        _require(0 < self.learning_rate <= 1, "learning_rate", self.learning_rate, "in (0, 1]")
        extra = self.self_training_updates
        _require(extra >= 1, "self_training_updates", extra, "at least 1")
        noise = self.self_training_noise
        _require(0 <= noise <= 1, "self_training_noise", noise, "in [0, 1]")
        _require(self.batch_size >= 1, "batch_size", self.batch_size, "at least 1")
        _require(0 <= self.ema_decay < 1, "ema_decay", self.ema_decay, "in [0, 1)")
        for name in ("selection_rollouts", "self_training_rollouts"):
            value = getattr(self, name)
            _require(10 <= value <= SEEDS_PER_USE, name, value, f"10 … {SEEDS_PER_USE}")
        _require(
            0 <= self.self_training_rounds <= 5,
            "self_training_rounds",
            self.self_training_rounds,
            "0 … 5",
        )


@dataclass(frozen=True)
class FinetuneConfig(JsonConfig):
    """Everything a fine-tuning round can be told; stored with the round.

    Defaults are the paper's Avoid column (Table hyperparameters) where it gives a value. It gives
    none for IPO, CPO and SimPO: theirs come from the papers that introduced them, untuned here.
    """

    method: FinetuneMethod = FinetuneMethod.RODIF_GUIDED
    conservativeness: float | None = None  # γ in [0, 1); None: estimated from the labels
    vote_temperature: float = 1.0  # α of the inner sigmoid
    outer_temperature: float = 1.0  # α of the outer sigmoid
    kl_coef: float = 0.1  # β
    vote_scale: float = 1.0  # ν ≈ 1
    ipo_target: float = 0.5  # of ΔQ; Azar et al.'s 1 / (2τ) of a log-ratio with their τ = β
    cpo_cloning_weight: float = 1.0  # per nat of -log π_θ(winner); Xu et al. weigh it like the rest
    simpo_scale: float = 2.0  # per nat of a mean log-probability; Meng et al., Llama-3-Base
    simpo_margin: float = 1.0  # of the scaled difference; the same
    reduction: Reduction = Reduction.SUM
    group_size: int = 64  # pairs per outer logistic when reduction = group
    step_pairing: StepPairing = StepPairing.SAME_INDEX
    matched_state_scale: float = 0.15  # length scale, normalised observation units
    executed_only: bool = False  # log-ratio over the executed part of the chunk only
    learning_rate: float = 3e-5
    updates: int = 12  # full-batch updates of every method but `rodif_guided`
    chunk_rows: int = 1024  # network rows per forward pass; memory only, not the result
    seed: int = 0
    guide: GuideConfig = field(default_factory=GuideConfig)

    def __post_init__(self) -> None:
        object.__setattr__(self, "method", parse_name(FinetuneMethod, self.method, "method"))
        object.__setattr__(self, "reduction", parse_name(Reduction, self.reduction, "reduction"))
        object.__setattr__(
            self, "step_pairing", parse_name(StepPairing, self.step_pairing, "step_pairing")
        )
        if isinstance(self.guide, Mapping):
            object.__setattr__(self, "guide", GuideConfig.from_json(self.guide))
        gamma = self.conservativeness
        _require(
            gamma is None or (math.isfinite(gamma) and 0 <= gamma < 1),
            "conservativeness",
            gamma,
            "in [0, 1), or null to estimate it from the labels",
        )
        self._check_losses()
        _require(0 < self.learning_rate <= 1, "learning_rate", self.learning_rate, "in (0, 1]")
        _require(
            self.matched_state_scale > 0, "matched_state_scale", self.matched_state_scale, "> 0"
        )
        for name in ("updates", "chunk_rows", "group_size"):
            _require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        _require(0 <= self.seed <= LARGEST_SEED, "seed", self.seed, f"0 … {LARGEST_SEED}")

    def _check_losses(self) -> None:
        above = ("vote_temperature", "outer_temperature", "kl_coef", "vote_scale", "ipo_target")
        for name in (*above, "simpo_scale"):
            value = getattr(self, name)
            _require(math.isfinite(value) and value > 0, name, value, "a finite number above 0")
        for name in ("cpo_cloning_weight", "simpo_margin"):
            value = getattr(self, name)
            legal = "a finite number, at least 0"
            _require(math.isfinite(value) and value >= 0, name, value, legal)


# Where a task's rounds differ from the defaults. In Stacking many failures come of the policy's own
# noise: its policies learn from rollouts with half as much, and from more of them. Sorting's fails
# once in hundreds of rollouts: what self-training wins in liking it loses in success.
_STEADIER = {"guide": {"self_training_noise": 0.5, "self_training_rollouts": 400}}
TASK_SETTINGS: Mapping[str, Mapping[str, Any]] = {
    TaskName.STACKING: _STEADIER,
    TaskName.STACKING_STATE: _STEADIER,
    TaskName.SORTING: {"guide": {"self_training_rounds": 0}},
}


def settings_for_task(task: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """`settings` of a FinetuneConfig, with the task's own where they say nothing."""
    usual = TASK_SETTINGS.get(task, {})
    filled = {**usual, **settings}
    guide = filled.get("guide")
    if isinstance(guide, Mapping):
        filled["guide"] = {**usual.get("guide", {}), **guide}
    return filled


@dataclass(frozen=True)
class RolloutConfig(JsonConfig):
    """A batch of rollouts: episode i uses seed `seed + i` for its start and its policy noise."""

    episodes: int = 100
    seed: int = 0
    # Simulations stepped together: memory and time. The network rounds otherwise with other rows
    # beside it, so paths differ in their last digits.
    max_parallel: int = 128

    def __post_init__(self) -> None:
        _require(1 <= self.episodes <= 100_000, "episodes", self.episodes, "1 … 100000")
        _require(0 <= self.seed < 2**62, "seed", self.seed, "in [0, 2^62)")
        _require(self.max_parallel >= 1, "max_parallel", self.max_parallel, "at least 1")
