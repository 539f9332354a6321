"""Who may call what: every endpoint, every role."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.server.world import World, make_world

ALL = {"ada", "sam", "ann"}
STAFF = {"ada", "sam"}
ADMIN = {"ada"}
SHA = "0" * 64
COLLECT = {"episodes": 2, "pairs": 1}
LABEL = {"pair_id": 1, "choice": "left", "ui_version": "t"}
TRUTH = {"true_choice": "left", "corruption": "none", "criterion": "x"}

# method, path, body, who may (ada: admin, sam: service, ann: annotator)
ENDPOINTS: list[tuple[str, str, Any, set[str]]] = [
    ("GET", "/me", None, ALL),
    ("PUT", "/me/password", {"current": "?", "password": "long enough"}, ALL),
    ("GET", "/annotators", None, ADMIN),
    ("POST", "/annotators", {"name": "x", "role": "annotator"}, ADMIN),
    ("PATCH", "/annotators/4", {"active": True}, ADMIN),
    ("GET", "/tokens", None, ALL),
    ("POST", "/tokens", {"name": "x"}, ALL),
    ("DELETE", "/tokens/999", None, ALL),
    ("GET", "/tasks", None, STAFF),
    ("GET", "/campaigns", None, ALL),
    ("POST", "/campaigns", {"name": "x", "task": "avoid"}, STAFF),
    ("GET", "/campaigns/1", None, ALL),
    ("PATCH", "/campaigns/1", {"name": "y"}, STAFF),
    ("GET", "/campaigns/1/stats", None, STAFF),
    ("POST", "/campaigns/1/collect", COLLECT, STAFF),
    ("GET", "/campaigns/1/episodes", None, STAFF),
    ("GET", "/campaigns/1/pairs", None, STAFF),
    ("GET", "/pairs/1", None, STAFF),
    ("GET", "/pairs/1/episodes", None, STAFF),
    ("POST", "/campaigns/1/next", {}, ALL),
    ("POST", "/leases/999/release", {"reason": "skipped"}, ALL),
    ("GET", "/campaigns/1/releases", None, STAFF),
    ("POST", "/labels", LABEL, ALL),
    ("POST", "/labels/999/undo", None, ALL),
    ("GET", "/campaigns/1/labels", None, ADMIN),
    ("PUT", "/labels/999/truth", TRUTH, {"sam"}),
    ("GET", "/campaigns/1/truth", None, STAFF),
    ("GET", "/campaigns/1/rounds", None, STAFF),
    ("POST", "/campaigns/1/rounds", {}, STAFF),
    ("GET", "/rounds/999", None, STAFF),
    ("POST", "/rounds/999/cancel", None, STAFF),
    ("GET", "/rounds/999/events", None, STAFF),
    ("GET", "/rounds/999/curves", None, STAFF),
    ("GET", "/campaigns/999/events", None, STAFF),
    ("GET", "/checkpoints", None, STAFF),
    ("GET", "/checkpoints/1", None, STAFF),
    ("GET", "/checkpoints/1/lineage", None, STAFF),
    ("GET", "/checkpoints/1/labels", None, STAFF),
    ("GET", "/checkpoints/1/file", None, STAFF),
    ("GET", "/episodes/1/file", None, STAFF),
    ("POST", "/campaigns/1/publish", {"checkpoint_id": 1, "reason": ""}, ADMIN),
    ("POST", "/campaigns/1/rollback", {"reason": ""}, ADMIN),
    ("GET", "/campaigns/1/publications", None, ADMIN),
    ("GET", "/jobs", None, STAFF),
    ("GET", "/jobs/1", None, STAFF),
    ("POST", "/jobs/1/retry", None, STAFF),
    ("POST", "/jobs/1/cancel", None, ADMIN),
    ("GET", "/audit", None, ADMIN),
]
OPEN = {("POST", "/session"), ("DELETE", "/session"), ("GET", "/health"), ("GET", "/ready")}


@pytest.fixture(scope="module")
def shared_world(
    sqlite_template: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[World]:
    """One world for the whole table: it is only asked who may."""
    folder = tmp_path_factory.mktemp("roles")
    shutil.copy(sqlite_template, folder / "rodif.sqlite3")
    with make_world(f"sqlite:///{folder / 'rodif.sqlite3'}", folder) as made:
        made.add_campaign(pairs=1)
        yield made


@pytest.mark.parametrize(
    ("method", "path", "body", "allowed"), ENDPOINTS, ids=[f"{e[0]} {e[1]}" for e in ENDPOINTS]
)
def test_only_the_right_roles_get_through(
    shared_world: World, method: str, path: str, body: Any, allowed: set[str]
) -> None:
    headers = {"Idempotency-Key": "k"}
    for name in (None, *sorted(ALL)):
        client = shared_world.client(name)
        answer = client.request(method, path, json=body, headers=headers)
        if name is None:
            assert answer.status_code == 401
        elif name not in allowed:
            assert answer.status_code == 403, (name, answer.text)
            assert "this needs role" in answer.json()["detail"]
        else:
            refused = answer.status_code == 403 and "this needs role" in answer.text
            assert answer.status_code != 401 and not refused, (name, answer.text)
            assert answer.status_code < 500


def test_the_table_above_has_every_endpoint(shared_world: World) -> None:
    paths = shared_world.app.openapi()["paths"]
    served = {
        (method.upper(), path.removeprefix("/api/v1").replace("{", "").replace("}", ""))
        for path, methods in paths.items()
        for method in methods
    }

    def shape(path: str) -> tuple[str, ...]:
        parts = path.split("/")
        return tuple("id" if p.isdigit() or p.endswith("_id") else p for p in parts)

    listed = {(method, shape(path)) for method, path, *_ in ENDPOINTS}
    listed |= {(method, shape(path)) for method, path in OPEN}
    assert {(method, shape(path)) for method, path in served} == listed


@pytest.mark.parametrize("path", [f"/replays/{SHA}.viser", f"/thumbnails/{SHA}.webp"])
def test_replays_need_a_session(shared_world: World, path: str) -> None:
    assert shared_world.browser().get(path).status_code == 401
    assert shared_world.signed_in("ann").get(path).status_code == 404
