"""`rodif round` against the real API: what a round is asked for, and what is left to the server."""

from __future__ import annotations

import pytest

from rodif_core.spec import EVALUATION_SEED
from server.store.tables import Round
from tests.cli.running_api import RunningApi
from worker.cli.main import main
from worker.cli.simulate import SimulationConfig, simulate

OF_THE_CAMPAIGN = {"episodes": 200, "seed": EVALUATION_SEED}


@pytest.mark.parametrize(
    ("options", "given"),
    [
        ([], {}),
        (["--episodes", "40"], {"episodes": 40}),
        (["--seed", "7"], {"seed": 7}),
        (["--episodes", "40", "--seed", "0"], {"episodes": 40, "seed": 0}),
    ],
)
def test_evaluation_has_the_campaigns_values_where_the_command_gives_none(
    api: RunningApi,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    given: dict[str, int],
):
    campaign = api.make_campaign([(True, "left"), (True, "right")], "-".join(["round", *options]))
    with api.admin() as admin:
        simulate(admin, campaign, SimulationConfig(annotators=1, labels=1))
    where = ["--url", api.url, "--token", api.token, "--campaign", str(campaign["id"])]
    # No worker runs here, so the command gives up waiting; the round is there.
    assert main(["round", *where, "--minutes", "0", *options]) == 1
    assert "is still queued after 0 seconds" in capsys.readouterr().err
    with api.database.read() as session:
        (started,) = session.query(Round).filter_by(campaign_id=campaign["id"])
    assert started.evaluation == OF_THE_CAMPAIGN | given
