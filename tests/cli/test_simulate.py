"""Simulated annotators against the real API: who labels what, what is flipped, what is kept."""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

import pytest

from rodif_core.errors import RodifError, ValueOutOfRangeError
from server.store.tables import Episode, Label, Pair, SimulatedTruth
from tests.cli.running_api import RunningApi
from worker.cli.main import main
from worker.cli.simulate import SimulationConfig, simulate, true_choice, utility

GOOD, FAILED, OTHER = (True, "left"), (False, "left"), (True, "right")
# Neighbours are pairs: each GOOD has two pairs that can be told apart, FAILED-OTHER is equal.
OUTCOMES = [GOOD, OTHER, FAILED] * 20


def rows_of(api: RunningApi, campaign: Any) -> list[tuple[Label, SimulatedTruth, Pair]]:
    with api.database.read() as session:
        found = (
            session.query(Label, SimulatedTruth, Pair)
            .join(SimulatedTruth, SimulatedTruth.label_id == Label.id)
            .join(Pair, Pair.id == Label.pair_id)
            .filter(Label.campaign_id == campaign["id"])
        )
        return list(found)


def run(api: RunningApi, campaign: Any, **config: Any) -> Any:
    with api.admin() as admin:
        return simulate(admin, campaign, SimulationConfig(**config))


def test_exact_share_of_the_preferences_is_flipped_and_the_truth_is_on_record(api: RunningApi):
    campaign = api.make_campaign(OUTCOMES, "exact share")
    report = run(api, campaign, annotators=3, labels=30, flip_rate=0.3, seed=1)
    assert (report.total, report.flipped) == (30, 9)
    rows = rows_of(api, campaign)
    preferences = [row for row in rows if row[0].choice != "equal"]
    assert len(preferences) == 30
    assert len(rows) - 30 == report.equal
    with api.database.read() as session:
        good = {
            episode.id: episode.success and episode.group == "left"
            for episode in session.query(Episode).filter_by(campaign_id=campaign["id"])
        }
    for label, truth, pair in rows:
        better = good[pair.first_episode_id] - good[pair.second_episode_id]
        assert truth.true_choice == {1: "first", -1: "second", 0: "equal"}[better]
        assert truth.corrupted == (label.choice != truth.true_choice)
    assert sum(truth.corrupted for _, truth, _ in rows) == 9
    with api.admin() as admin:
        counts = admin.get(f"/campaigns/{campaign['id']}/truth")
    assert counts == {"total": len(rows), "flipped": 9}


def test_each_annotator_labels_with_an_account_of_its_own(api: RunningApi):
    campaign = api.make_campaign(OUTCOMES, "own accounts")
    run(api, campaign, annotators=4, labels=36, name="crew")
    with api.admin() as admin:
        accounts = {a["name"]: a for a in admin.pages("/annotators") if a["name"][:4] == "crew"}
    assert set(accounts) == {"crew-1", "crew-2", "crew-3", "crew-4"}
    assert {a["kind"] for a in accounts.values()} == {"simulated"}
    by_account = Counter(label.annotator_id for label, _, _ in rows_of(api, campaign))
    assert set(by_account) <= {a["id"] for a in accounts.values()}
    assert len(by_account) >= 2
    assert {label.source for label, _, _ in rows_of(api, campaign)} == {"simulated"}


def test_tokens_are_revoked_when_all_is_labelled_and_when_it_fails(api: RunningApi):
    campaign = api.make_campaign(OUTCOMES, "tokens")
    run(api, campaign, annotators=3, labels=6, name="token")
    with api.admin() as admin:
        person = {"name": "token-4", "role": "annotator", "kind": "person"}
        admin.post("/annotators", person | {"password": "long enough"})
        with pytest.raises(RodifError, match="'token-4' is a person"):
            simulate(admin, campaign, SimulationConfig(name="token", annotators=4))
        mine = {a["id"] for a in admin.pages("/annotators") if a["name"][:6] == "token-"}
        tokens = [token for token in admin.pages("/tokens") if token["annotator_id"] in mine]
    assert len(tokens) == 6
    assert all(token["revoked_at"] for token in tokens)


def test_no_pair_is_labelled_twice_and_a_second_call_gives_the_rest(api: RunningApi):
    campaign = api.make_campaign(OUTCOMES, "the rest")
    first = run(api, campaign, annotators=2, labels=25, seed=3)
    second = run(api, campaign, annotators=2, labels=1000, flip_rate=1.0, seed=4)
    assert first.total == 25
    # 20 GOOD episodes: the first has one neighbour, the others two; 39 pairs can be told apart.
    assert (second.total, second.flipped) == (14, 14)
    pairs = Counter(label.pair_id for label, _, _ in rows_of(api, campaign))
    assert max(pairs.values()) == 1


def test_command_fails_when_it_gave_fewer_labels_than_asked_for(
    api: RunningApi, capsys: pytest.CaptureFixture[str]
):
    campaign = api.make_campaign(OUTCOMES, "too few")  # 39 pairs can be told apart
    where = ["--url", api.url, "--token", api.token, "--campaign", str(campaign["id"]), "--json"]
    assert main(["simulate", *where, "--labels", "30"]) == 0
    told = capsys.readouterr()
    assert (json.loads(told.out)["total"], told.err) == (30, "")
    assert main(["simulate", *where, "--labels", "10"]) == 1
    told = capsys.readouterr()
    assert json.loads(told.out)["total"] == 9
    assert "fewer than the 10 asked for: collect more pairs first" in told.err


def test_durations_look_like_a_persons(api: RunningApi):
    campaign = api.make_campaign(OUTCOMES, "durations")
    run(api, campaign, annotators=2, labels=30)
    seconds = [(label.duration_ms or 0) / 1000 for label, _, _ in rows_of(api, campaign)]
    assert len(set(seconds)) > 10
    assert all(0.5 < value < 60 for value in seconds)


def test_account_of_a_person_is_never_used(api: RunningApi):
    campaign = api.make_campaign(OUTCOMES, "person")
    with api.admin() as admin:
        person = {"name": "maria-1", "role": "annotator", "kind": "person"}
        admin.post("/annotators", person | {"password": "long enough"})
        with pytest.raises(RodifError, match="'maria-1' is a person"):
            simulate(admin, campaign, SimulationConfig(name="maria"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"flip_rate": 1.2}, r"flip_rate is 1.2, but must be in \[0, 1\]"),
        ({"name": " "}, r"name is . ., but must be text that is not blank"),
        ({"labels": 0}, "labels is 0, but must be at least 1"),
        ({"annotators": 0}, "annotators is 0"),
        ({"corruption": "adversary"}, "'adversary', but must be exact or independent"),
    ],
)
def test_wrong_configuration_names_the_legal_values(change: dict[str, Any], message: str):
    with pytest.raises(ValueOutOfRangeError, match=message):
        SimulationConfig(**change)


def test_utility_is_one_only_for_success_in_the_preferred_group():
    def outcome(success: bool, group: str | None) -> dict[str, Any]:
        return {"success": success, "group": group}

    assert utility(outcome(True, "left"), "left") == 1
    for other in (outcome(True, "right"), outcome(False, "left"), outcome(False, None)):
        assert utility(other, "left") == 0
        assert true_choice(outcome(True, "left"), other, "left") == "left"
        assert true_choice(other, outcome(True, "left"), "left") == "right"
        assert true_choice(other, outcome(True, "right"), "left") == "equal"
