"""The REST client says what the API said."""

from __future__ import annotations

import pytest

from rodif_core.errors import UnknownNameError
from rodif_core.spec import FinetuneConfig, FinetuneMethod, GuideConfig
from server.store.tables import Label
from tests.cli.running_api import RunningApi
from worker.cli import client as client_module
from worker.cli import round as rounds
from worker.cli.client import ApiError, Client
from worker.cli.simulate import SimulationConfig, simulate


def test_campaign_is_found_by_name_number_or_alone(api: RunningApi):
    with api.admin() as admin, pytest.raises(UnknownNameError, match="unknown campaign"):
        admin.find_campaign(None)
    made = api.make_campaign([], "found")
    with api.admin() as admin:
        for name in (None, "found", str(made["id"])):
            assert admin.find_campaign(name)["id"] == made["id"]
        with pytest.raises(UnknownNameError, match="unknown campaign 'lost'.*'found'"):
            admin.find_campaign("lost")


def test_pages_are_followed_to_the_end(api: RunningApi):
    campaign = api.make_campaign([(True, "left")] * 8, "pages")
    with api.admin() as admin:
        rows = list(admin.pages(f"/campaigns/{campaign['id']}/pairs?limit=3"))
    assert len({row["id"] for row in rows}) == 7


def test_refusal_carries_status_and_sentence(api: RunningApi):
    with Client(api.url, "rdf_unknown") as stranger, pytest.raises(ApiError) as caught:
        stranger.get("/campaigns")
    assert caught.value.status == 401
    with api.admin() as admin, pytest.raises(ApiError, match="404.*99"):
        admin.get("/campaigns/99")


def test_round_without_labels_is_refused_with_the_reason(api: RunningApi):
    campaign = api.make_campaign([(True, "left"), (True, "right")], "no labels")
    with api.admin() as admin, pytest.raises(ApiError, match="label") as caught:
        rounds.launch(admin, campaign["id"], method=FinetuneMethod.RODIF)
    assert caught.value.status == 409
    with api.database.read() as session:
        assert session.query(Label).filter_by(campaign_id=campaign["id"]).count() == 0


def test_round_with_an_illegal_gamma_names_the_legal_ones(api: RunningApi):
    campaign = api.make_campaign([(True, "left"), (True, "right")], "gamma")
    with api.admin() as admin, pytest.raises(ApiError, match=r"1\.5.*\[0, 1\)") as caught:
        rounds.launch(admin, campaign["id"], conservativeness=1.5)
    assert caught.value.status == 422
    assert str(caught.value).count("1.5") == 1, "said once"


def test_settings_of_a_round_are_kept_with_it_and_a_named_option_goes_before_them(api: RunningApi):
    campaign = api.make_campaign([(True, "left"), (True, "right")], "settings")
    settings = {"conservativeness": 0.1, "guide": {"self_training_rounds": 0}}
    with api.admin() as admin:
        simulate(admin, campaign, SimulationConfig(annotators=1, labels=1))
        started = rounds.launch(admin, campaign["id"], conservativeness=0.4, settings=settings)
        kept = admin.get(f"/rounds/{started['id']}")["config"]
    assert kept["conservativeness"] == 0.4
    assert (
        kept["guide"]
        == FinetuneConfig(guide=GuideConfig(self_training_rounds=0)).to_json()["guide"]
    )


def test_silent_address_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(client_module, "RETRIES", 1)
    message = r"no answer from http://127\.0\.0\.1:9"
    with Client("http://127.0.0.1:9") as nobody, pytest.raises(ApiError, match=message):
        nobody.get("/me")
