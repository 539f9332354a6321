"""Checkpoints and episodes as files to take away."""

from __future__ import annotations

import hashlib

import pytest

from server.store.tables import Checkpoint, Episode
from tests.server.world import World

WEIGHTS = bytes(range(256)) * 40


def keep(world: World, kind: type[Checkpoint] | type[Episode], data: bytes) -> int:
    """Let the first row of the kind have a file; gives its id."""
    world.add_campaign(pairs=1)
    sha256 = world.app.state.services.artifacts.put(data)
    with world.database.write() as session:
        row = session.query(kind).order_by(kind.id).first()
        assert row is not None
        row.artifact_sha256 = sha256
        return row.id


@pytest.mark.parametrize("name", ["ada", "sam"])
def test_a_checkpoint_is_taken_away_as_its_file(world: World, name: str) -> None:
    number = keep(world, Checkpoint, WEIGHTS)
    answer = world.client(name).get(f"/checkpoints/{number}/file")
    assert (answer.status_code, answer.content) == (200, WEIGHTS)
    disposition = 'attachment; filename="avoid-pretrained.safetensors"'
    assert answer.headers["content-disposition"] == disposition
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["cache-control"] == "private, max-age=31536000, immutable"
    assert answer.headers["etag"] == f'"{hashlib.sha256(WEIGHTS).hexdigest()}"'


def test_an_episode_is_taken_away_as_its_file(sqlite_world: World) -> None:
    number = keep(sqlite_world, Episode, b"npz")
    answer = sqlite_world.client("sam").get(f"/episodes/{number}/file")
    assert (answer.status_code, answer.content) == (200, b"npz")
    assert answer.headers["content-disposition"] == f'attachment; filename="episode-{number}.npz"'


def test_a_known_file_is_not_sent_again_and_a_part_is_sent_alone(sqlite_world: World) -> None:
    path = f"/checkpoints/{keep(sqlite_world, Checkpoint, WEIGHTS)}/file"
    client = sqlite_world.client("ada")
    tag = client.get(path).headers["etag"]
    for known in (tag, f'"other", {tag}'):
        again = client.get(path, headers={"If-None-Match": known})
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
    assert client.get(path, headers={"If-None-Match": '"other"'}).status_code == 200
    part = client.get(path, headers={"Range": "bytes=0-9", "If-Range": tag})
    assert (part.status_code, part.content) == (206, WEIGHTS[:10])


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("../../etc/passwd", "etc-passwd.safetensors"),
        ('round "7"\r\nX: y', "round-7-X-y.safetensors"),
        ("links, dann rechts – gut", "links-dann-rechts-gut.safetensors"),
        ("…", "checkpoint-1.safetensors"),
    ],
)
def test_the_files_name_is_one_that_every_system_takes(
    sqlite_world: World, name: str, file: str
) -> None:
    number = keep(sqlite_world, Checkpoint, WEIGHTS)
    with sqlite_world.database.write() as session:
        session.get_one(Checkpoint, number).name = name
    answer = sqlite_world.client("ada").get(f"/checkpoints/{number}/file")
    assert answer.headers["content-disposition"] == f'attachment; filename="{file}"'


def test_a_row_that_is_not_there_and_a_file_that_is_lost_are_told_apart(
    sqlite_world: World,
) -> None:
    sqlite_world.add_campaign(pairs=1)  # rows without files
    client = sqlite_world.client("ada")
    for path, no_row, lost in (
        (
            "checkpoints",
            "no checkpoint 99",
            f"the file of checkpoint 1 is lost: artifact {'a' * 64}",
        ),
        ("episodes", "no episode 99", f"the file of episode 1 is lost: artifact {'e' * 64}"),
    ):
        for number, message in ((99, no_row), (1, lost)):
            answer = client.get(f"/{path}/{number}/file")
            assert answer.status_code == 404
            assert message in answer.json()["detail"]
