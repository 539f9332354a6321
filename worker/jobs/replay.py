"""Make the 3-D recording and the thumbnail of one pair; equal episodes give equal files."""

from __future__ import annotations

from labeling_ui.replay import make_replay, make_thumbnail
from rodif_core.spec import TaskName, parse_name
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory
from server.states import PairState
from server.store.tables import Campaign, Episode, Pair
from worker.attempt import Attempt


def run(attempt: Attempt) -> None:
    """Do the job; a second attempt writes the same files and the same row."""
    assert attempt.facts.pair_id is not None
    artifacts = attempt.bench.artifacts
    with attempt.bench.database.read() as session:
        pair = session.get_one(Pair, attempt.facts.pair_id)
        first = session.get_one(Episode, pair.first_episode_id)
        second = session.get_one(Episode, pair.second_episode_id)
        name = session.get_one(Campaign, pair.campaign_id).task
    task = get_task(parse_name(TaskName, name, "task"))
    shown = (first, second) if pair.first_is_left else (second, first)
    left, right = (Trajectory.from_bytes(artifacts.get(e.artifact_sha256)) for e in shown)
    replay = artifacts.put(make_replay(task, left, right))
    thumbnail = artifacts.put(make_thumbnail(task, left, right))
    with attempt.step() as session:
        pair = session.get_one(Pair, attempt.facts.pair_id)
        pair.replay_sha256, pair.thumbnail_sha256 = replay, thumbnail
        pair.state = PairState.READY
        attempt.finish(session, {"replay": replay, "thumbnail": thumbnail})
