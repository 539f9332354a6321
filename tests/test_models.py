"""The page of shipped policies tells of the files that are shipped, and of today's presets."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import Any

import pytest

from rodif_core.policies.checkpoint import load_checkpoint
from rodif_core.presets import preset_for
from rodif_core.shipped import shipped_checkpoint, shipped_tasks
from rodif_core.spec import TaskName
from scripts import model_cards

MOST_BYTES = 20_000_000  # larger files do not belong into the repository
# The paper's own pretrained policies; ours may not be worse.
LEAST_SUCCESS = {
    task: model_cards.PAPER_SUCCESS.get(task.removesuffix("-state"), 0) / 100 for task in TaskName
}


def test_page_of_models_is_made_from_the_shipped_files():
    assert model_cards.PAGE.read_text() == model_cards.page()


@pytest.mark.parametrize("task", shipped_tasks())
def test_a_shipped_policy_was_trained_with_todays_preset(task: TaskName):
    card = load_checkpoint(shipped_checkpoint(task)).card
    # What went on from a file began with the preset's policy.
    trained = dict(card.get("began_with", card)["preset"])
    today = json.loads(json.dumps(asdict(preset_for(task, "cpu"))))
    if "channels" in trained:  # Avoid's card, of a time when there was one architecture only
        trained["size"] = today["size"] | {"channels": trained.pop("channels")}
    assert _known(today, trained) == trained


def _known(today: dict[str, Any], trained: dict[str, Any]) -> dict[str, Any]:
    """Today's settings as far as a card knows them.

    Those that came later are missing on older cards, and must not have changed a thing.
    """
    return {
        name: _known(today[name], was) if isinstance(was, dict) else today.get(name)
        for name, was in trained.items()
    }


@pytest.mark.parametrize("task", shipped_tasks())
def test_a_shipped_policy_is_small_good_and_undecided(task: TaskName):
    blob = shipped_checkpoint(task)
    assert len(blob) < MOST_BYTES
    measured = model_cards.measurement(load_checkpoint(blob))
    assert measured["n"] >= (200 if task in ("aligning", "stacking") else 500)
    assert measured["success"] >= LEAST_SUCCESS[task]
    assert len(measured["modes"]) >= 2


def test_card_of_a_policy_that_got_eyes_tells_what_it_began_with():
    shipped = load_checkpoint(shipped_checkpoint(TaskName.ALIGNING))
    preset = asdict(preset_for(TaskName.ALIGNING, "cpu"))
    preset |= {"begin_with": "aligning-state", "looks": 3, "rounds": 1}
    preset["encoder"] |= {
        "moments": 2_000,
        "rearranged": 500,
        "updates": 4_000,
        "round_updates": 70,
    }
    told = {"preset": preset, "recoveries": 90, "rounds": 1, "demonstrations": 490}
    card = model_cards._card(replace(shipped, card=shipped.card | told))
    assert "Begins with the shipped `aligning-state`" in card
    assert "400 scripted demonstrations and what experts did after takeovers (90 in all)" in card
    assert "3 trainings of the encoder alone, then 1 rounds of 8,000 updates" in card
    assert "saw 2,500 moments in 4,000 updates of 64, then 3 times as many in 70." in card


def test_card_of_a_policy_that_went_on_from_a_file_tells_both_commands():
    shipped = load_checkpoint(shipped_checkpoint(TaskName.PUSHING))
    origin = {"preset": shipped.card["preset"], "rounds": 0, "digest": "ab" * 32}
    further = {"rounds": 1, "recoveries": 30, "drives": 1, "steered_drives": 2}
    preset = shipped.card["preset"] | further | {"round_updates": 700}
    told = {"began_with": origin, "preset": preset, "recoveries": 20, "demonstrations": 2_020}
    card = model_cards._card(replace(shipped, card=shipped.card | told))
    assert "With that policy (digest `abababababababab`) began 1 more of 700 updates" in card
    assert "takeovers (20) from it and from 60 rollouts of copies" in card
    assert "--demonstrations 2000 --out before.safetensors\n" in card
    options = "--rounds 1 --recoveries 30 --drives 1 --steered-drives 2 --round-updates 700"
    last = "--evaluate 500 --out pushing.safetensors"
    assert f"--begin-with before.safetensors --demonstrations 2000 {options} {last}" in card
