"""kill -9 of the worker tree in the middle of a job: the work completes, nothing is doubled."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import pytest

from server.states import JobKind, JobState, PairState, RoundState
from server.store.tables import Checkpoint, Episode, Job, Label, Pair, Round
from tests.acceptance.system import Site, kill_tree, running_site, wait_for

pytestmark = pytest.mark.slow

EPISODES, PAIRS, UPDATES = 60, 5, 20


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with running_site(tmp_path_factory.mktemp("kill")) as site:
        yield site


def _kill_worker(site: Site) -> None:
    old = site.system.pid("worker")
    kill_tree(old)
    wait_for(
        lambda: site.system.runs("worker") and site.system.pid("worker") != old,
        "the supervisor starts the worker again",
    )


def test_collect_completes_without_duplicates_when_the_worker_is_killed(site: Site) -> None:
    collect = {"episodes": EPISODES, "pairs": PAIRS, "strategy": "random"}
    job_id = site.post("/collect", collect)["id"]
    wait_for(lambda: len(site.rows(Episode)) > 0, "the first episodes are stored")
    _kill_worker(site)
    (job,) = site.rows(Job, id=job_id)
    assert (job.state, job.attempt) == (JobState.RUNNING, 1), "killed too late for this test"

    site.api.wait_for_job(job_id, seconds=180)
    (job,) = site.rows(Job, id=job_id)
    assert job.attempt >= 2
    seeds = Counter(episode.seed for episode in site.rows(Episode))
    assert seeds == Counter(range(EPISODES))
    shown = {frozenset((p.first_episode_id, p.second_episode_id)) for p in site.rows(Pair)}
    assert len(shown) == len(site.rows(Pair)) == PAIRS
    replay_jobs = site.rows(Job, kind=JobKind.REPLAY)
    assert Counter(job.pair_id for job in replay_jobs) == Counter(p.id for p in site.rows(Pair))
    wait_for(
        lambda: {pair.state for pair in site.rows(Pair)} == {PairState.READY}, "replays are made"
    )


def test_work_goes_on_when_the_broker_is_killed(site: Site) -> None:
    before = len(site.rows(Episode))
    collect = {"episodes": 25, "pairs": 1, "strategy": "random"}
    first = site.post("/collect", collect)["id"]
    wait_for(lambda: site.rows(Job, id=first)[0].state == JobState.RUNNING, "the job runs")
    kill_tree(site.system.pid("broker"))
    second = site.post("/collect", collect)["id"]  # the row is stored whatever the broker does
    for job_id in (first, second):
        site.api.wait_for_job(job_id, seconds=180)
    seeds = Counter(episode.seed for episode in site.rows(Episode))
    assert seeds == Counter(range(before + 50))
    wait_for(lambda: site.system.not_ready() is None, "all parts are ready again")


def test_finetune_completes_with_one_checkpoint_when_the_worker_is_killed(site: Site) -> None:
    site.label_pairs(PAIRS)
    config = {"method": "rodif", "updates": UPDATES, "conservativeness": 0.3, "vote_scale": 1.4}
    body = {
        "config": config | {"learning_rate": 1e-5},
        "publish_rule": "never",
        "evaluation": {"episodes": 10},
    }
    round_id = site.post("/rounds", body)["id"]
    curve = f"/rounds/{round_id}/curves"
    wait_for(lambda: len(site.api.get(curve)) >= 6, "some updates are done")
    _kill_worker(site)
    (job,) = site.rows(Job, round_id=round_id, kind=JobKind.FINETUNE)
    assert (job.state, job.attempt) == (JobState.RUNNING, 1), "killed too late for this test"

    ended = site.api.wait_for_round(round_id, seconds=180)
    assert ended["state"] == RoundState.KEPT
    (job,) = site.rows(Job, round_id=round_id, kind=JobKind.FINETUNE)
    assert job.attempt >= 2
    (candidate,) = site.rows(Checkpoint, round_id=round_id)
    fractions = [point["fraction"] for point in site.api.get(curve)]
    assert fractions == sorted(set(fractions)) and fractions[-1] == 1.0
    assert len(site.rows(Label)) == PAIRS
    assert len(site.rows(Round)) == 1
    for kind in (JobKind.FINETUNE, JobKind.EVALUATE, JobKind.PUBLISH):
        assert len(site.rows(Job, round_id=round_id, kind=kind)) == 1

    # The same round again, undisturbed: the killed one came to the same weights.
    again = site.post("/rounds", body | {"snapshot_digest": ended["snapshot_digest"]})["id"]
    site.api.wait_for_round(again, seconds=180)
    (calm,) = site.rows(Checkpoint, round_id=again)
    assert calm.digest == candidate.digest
