"""Configurations: round trip through JSON, clear errors."""

from __future__ import annotations

import json
import math

import pytest

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.spec import (
    EVALUATION_SEED,
    LARGEST_SEED,
    SEEDS_PER_ROUND,
    SEEDS_PER_USE,
    SELECTION_SEED,
    TASK_SETTINGS,
    FinetuneConfig,
    GuideConfig,
    RolloutConfig,
    TaskName,
    parse_name,
    settings_for_task,
)


@pytest.mark.parametrize(
    "config",
    [
        FinetuneConfig(),
        FinetuneConfig(conservativeness=0.4, guide=GuideConfig(scales=(2.0,))),
        RolloutConfig(7, 3),
    ],
)
def test_config_survives_json(config: FinetuneConfig | RolloutConfig) -> None:
    assert type(config).from_json(json.loads(json.dumps(config.to_json()))) == config


def test_configuration_of_a_round_from_before_a_loss_has_its_defaults() -> None:
    # What a round stored when `rodif`, `dp_dpo` and `rodif_guided` were all there was.
    stored = FinetuneConfig(method="dp_dpo", updates=3, kl_coef=0.2).to_json()
    for name in ("ipo_target", "cpo_cloning_weight", "simpo_scale", "simpo_margin"):
        del stored[name]
    assert FinetuneConfig.from_json(stored) == FinetuneConfig("dp_dpo", updates=3, kl_coef=0.2)


@pytest.mark.parametrize("gamma", [-0.01, 1.0, 2.0, math.nan, math.inf])
def test_gamma_outside_its_range_names_value_and_range(gamma: float) -> None:
    with pytest.raises(ValueOutOfRangeError, match=r"conservativeness is .*in \[0, 1\)"):
        FinetuneConfig(conservativeness=gamma)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"updates": 1.5}, "updates is 1.5.*a whole number"),
        ({"updates": "12"}, "updates is '12'.*a whole number"),
        ({"seed": True}, "seed is True.*a whole number"),
        ({"conservativeness": "0.3"}, "conservativeness is '0.3'.*a finite number or null"),
        ({"kl_coef": None}, "kl_coef is None.*a finite number"),
        ({"executed_only": 1}, "executed_only is 1.*true or false"),
        ({"guide": 5}, "guide is 5.*an object"),
        ({"guide": None}, "guide is None.*an object"),
        ({"guide": {"scales": 3}}, "scales is 3.*a list of finite numbers"),
        ({"guide": {"scales": [1, "2"]}}, "scales is .*a list of finite numbers"),
    ],
)
def test_value_of_another_type_is_named_with_the_legal_one(data: dict, words: str) -> None:
    with pytest.raises(ValueOutOfRangeError, match=words):
        FinetuneConfig.from_json(data)


def test_seeds_of_a_fine_tunings_rollouts_stay_below_those_of_evaluations() -> None:
    uses = 1 + 5  # the choice among scales, and the most self-training passes that are legal
    last = SELECTION_SEED + SEEDS_PER_ROUND * LARGEST_SEED + SEEDS_PER_USE * uses
    assert last < EVALUATION_SEED
    assert uses * SEEDS_PER_USE <= SEEDS_PER_ROUND


def test_unknown_method_lists_the_legal_ones() -> None:
    with pytest.raises(UnknownNameError, match="'ppo'.*'rodif_guided', 'rodif', 'dp_dpo'"):
        FinetuneConfig.from_json({"method": "ppo"})


def test_unknown_task_lists_the_legal_ones() -> None:
    with pytest.raises(UnknownNameError, match="'juggling'.*'avoid'"):
        parse_name(TaskName, "juggling", "task")


def test_unknown_field_lists_the_legal_ones() -> None:
    with pytest.raises(UnknownNameError, match="'gamma'.*'conservativeness'"):
        FinetuneConfig.from_json({"gamma": 0.3})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("kl_coef", 0.0),
        ("vote_temperature", -1.0),
        ("outer_temperature", math.inf),
        ("vote_scale", 0.0),
        ("learning_rate", 0.0),
        ("updates", 0),
        ("chunk_rows", 0),
        ("group_size", 0),
        ("seed", -1),
        ("matched_state_scale", 0.0),
        ("ipo_target", 0.0),
        ("cpo_cloning_weight", -0.1),
        ("cpo_cloning_weight", math.nan),
        ("simpo_scale", 0.0),
        ("simpo_margin", -0.1),
        ("simpo_margin", math.inf),
    ],
)
def test_finetune_value_out_of_range_is_named(field: str, value: float) -> None:
    with pytest.raises(ValueOutOfRangeError, match=field):
        FinetuneConfig(**{field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("scales", ()),
        ("scales", (0.0,)),
        ("score_updates", 0),
        ("updates", 0),
        ("learning_rate", 2.0),
        ("batch_size", 0),
        ("self_training_updates", 0),
        ("self_training_rollouts", 9),
        ("self_training_noise", 1.1),
        ("ema_decay", 1.0),
        ("selection_rollouts", 1),
        ("self_training_rounds", 9),
    ],
)
def test_guide_value_out_of_range_is_named(field: str, value: object) -> None:
    with pytest.raises(ValueOutOfRangeError, match=field):
        GuideConfig(**{field: value})


@pytest.mark.parametrize(("field", "value"), [("episodes", 0), ("seed", -1), ("max_parallel", 0)])
def test_rollout_value_out_of_range_is_named(field: str, value: int) -> None:
    with pytest.raises(ValueOutOfRangeError, match=field):
        RolloutConfig(**{field: value})


def test_to_json_gives_plain_types_at_every_depth() -> None:
    data = FinetuneConfig().to_json()
    assert json.loads(json.dumps(data)) == data
    assert type(data["guide"]["scales"]) is list
    assert type(data["guide"]["scorer"]) is str


@pytest.mark.parametrize("task", TASK_SETTINGS)
def test_a_tasks_own_settings_are_legal_and_differ_from_the_defaults(task: str) -> None:
    config = FinetuneConfig.from_json(settings_for_task(TaskName(task), {}))
    assert config != FinetuneConfig()


def test_a_tasks_own_settings_fill_only_what_was_not_given() -> None:
    given = {"updates": 3, "guide": {"self_training_noise": 1.0}}
    filled = FinetuneConfig.from_json(settings_for_task(TaskName.STACKING, given))
    assert filled.updates == 3
    assert (filled.guide.self_training_noise, filled.guide.self_training_rollouts) == (1.0, 400)
    assert settings_for_task(TaskName.AVOID, given) == given
    assert given == {"updates": 3, "guide": {"self_training_noise": 1.0}}


def test_a_guide_that_is_no_object_is_refused_whatever_the_task() -> None:
    with pytest.raises(ValueOutOfRangeError, match="guide is 7"):
        FinetuneConfig.from_json(settings_for_task(TaskName.STACKING, {"guide": 7}))
