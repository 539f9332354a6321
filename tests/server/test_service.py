"""The service as a whole: what it imports, what it documents, how it takes odd requests."""

from __future__ import annotations

import subprocess
import sys
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis.checks import not_a_server_error
from schemathesis.schemas import APIOperation
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from sqlalchemy import select
from starlette.testclient import TestClient

from server import pages
from server.bootstrap import ensure_admin, register_checkpoint
from server.errors import ConflictError
from server.store.artifacts import ArtifactStore
from server.store.session import Database
from server.store.tables import Annotator
from tests import factories
from tests.factories import NOW
from tests.server.world import World

ROOT = Path(__file__).parents[2]
LABEL = '{"pair_id": 1, "choice": "left", "ui_version": "t", "replay_events": %s}'


def test_the_server_needs_neither_torch_nor_mujoco_nor_viser() -> None:
    heavy = "{'torch', 'mujoco', 'viser', 'plotly', 'labeling_ui', 'worker'}"
    code = f"import sys, server.app, server.bootstrap; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_use_cases_and_store_know_no_web_framework() -> None:
    modules = (
        "server.rounds, server.labeling, server.campaigns, server.bootstrap, server.store.jobs"
    )
    code = f"import sys, {modules}; print('fastapi' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_every_endpoint_is_named_in_the_documentation(sqlite_world: World) -> None:
    text = (ROOT / "docs" / "api.md").read_text()
    paths = sqlite_world.app.openapi()["paths"]
    missing = [
        f"{method.upper()} {path.removeprefix('/api/v1')}"
        for path, methods in paths.items()
        for method in methods
        if f"`{method.upper()} {path.removeprefix('/api/v1')}`" not in text
    ]
    assert missing == []


def test_every_page_and_file_route_is_named_in_the_documentation() -> None:
    text = (ROOT / "docs" / "api.md").read_text()
    routes = {getattr(route, "path", "") for route in pages.router.routes}
    assert {path for path in routes if f"`{path}`" not in text} == set()


def test_errors_outside_the_endpoints_are_problems_too(sqlite_world: World) -> None:
    client = sqlite_world.client("ada")
    for method, path, status in (
        ("GET", "/nothing", 404),
        ("DELETE", "/campaigns", 405),
        ("GET", "/campaigns/0", 422),
        ("GET", f"/campaigns/{2**31}", 422),
        ("GET", "/campaigns/one", 422),
    ):
        answer = client.request(method, path)
        assert answer.status_code == status
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["status"] == status and answer.json()["title"]


@pytest.mark.parametrize("content", [b"{nope", b"", b"\xff\xfe", b"[1]"])
def test_bodies_that_are_no_json_object_are_refused(sqlite_world: World, content: bytes) -> None:
    headers = {"Content-Type": "application/json"}
    answer = sqlite_world.client("ada").post("/annotators", content=content, headers=headers)
    assert answer.status_code in (400, 422)
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    ("path", "body", "words"),
    [
        ("/session", '{"name": "\\ud800", "password": "x"}', "surrogates not allowed"),
        ("/session", '{"name": "x", "password": "\\ud800"}', "surrogates not allowed"),
        ("/session", '{"name": "x\\u0000", "password": "x"}', "NUL"),
        ("/labels", LABEL % "[NaN]", "nan is not a finite number"),
        ("/labels", LABEL % '[{"t": 1e400}]', "inf is not a finite number"),
        ("/labels", LABEL % '["\\ud800"]', "surrogates not allowed"),
        ("/labels", LABEL % '[{"\\u0000": 1}]', "NUL"),
        ("/labels", LABEL % ("[" * 50 + "]" * 50), "nested more than 8 levels"),
        ("/campaigns/1/rounds", '{"config": {"\\ud800": 1}}', "unknown FinetuneConfig field"),
    ],
)
def test_json_that_no_database_takes_is_refused(
    sqlite_world: World, path: str, body: str, words: str
) -> None:
    sqlite_world.add_campaign(pairs=1)
    headers = {"Content-Type": "application/json", "Idempotency-Key": "k"}
    answer = sqlite_world.client("ada").post(path, content=body, headers=headers)
    assert answer.status_code == 422
    assert words in answer.json()["detail"]


@pytest.mark.parametrize(
    ("path", "body", "told"),
    [
        ("/campaigns/1/collect", {"episodes": 1}, "or equal to 2 (given: 1)"),
        ("/campaigns/1/collect", {"strategy": "best"}, "'random' (given: 'best')"),
        ("/campaigns/1/collect", {"random_share": True}, "valid number (given: True)"),
        ("/campaigns", {"name": "", "task": "avoid"}, "1 character (given: '')"),
        ("/campaigns/1/rounds", {"evaluation": {"episodes": 9}}, "or equal to 10 (given: 9)"),
    ],
)
def test_a_wrong_field_names_its_value_and_the_legal_ones(
    sqlite_world: World, path: str, body: dict[str, Any], told: str
) -> None:
    sqlite_world.add_campaign()
    answer = sqlite_world.client("ada").post(path, json=body)
    assert answer.status_code == 422
    assert told in answer.json()["detail"] and told in answer.json()["errors"][0]["message"]


def test_a_wrong_field_of_settings_or_of_the_address_names_its_value(sqlite_world: World) -> None:
    sqlite_world.add_campaign()
    client = sqlite_world.client("ada")
    partly = client.patch("/campaigns/1", json={"settings": {"collect": {"pairs": 0}}})
    assert "or equal to 1 (given: 0)" in partly.json()["detail"]
    assert "(given: 'one')" in client.get("/campaigns/one").json()["detail"]
    assert "(given: '5000')" in client.get("/campaigns/1/rounds?limit=5000").json()["detail"]
    long = client.post("/campaigns", json={"name": "x" * 500, "task": "avoid"}).json()["detail"]
    assert len(long) < 200 and "(given: 'xxx" in long


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/annotators", {"name": "eve", "role": "annotator", "password": "hunter2"}),
        ("PATCH", "/annotators/4", {"password": "hunter2"}),
        ("POST", "/session", {"name": "eve", "passwort": "hunter2"}),
        ("POST", "/session", {"password": "hunter2"}),
        ("POST", "/session", {"name": {"password": "hunter2"}, "password": "hunter2"}),
        ("POST", "/session", "hunter2"),
        ("POST", "/session", ["hunter2"]),
        ("DELETE", "/tokens/hunter2", None),
    ],
)
def test_what_is_secret_or_may_be_is_not_repeated(
    sqlite_world: World, method: str, path: str, body: Any
) -> None:
    answer = sqlite_world.client("ada").request(method, path, json=body)
    assert answer.status_code == 422
    assert answer.json()["errors"] and "hunter2" not in answer.text


def test_a_huge_body_is_refused(sqlite_world: World) -> None:
    content = b'{"name": "' + b"x" * 3_000_000 + b'"}'
    headers = {"Content-Type": "application/json"}
    answer = sqlite_world.client("ada").post("/annotators", content=content, headers=headers)
    assert answer.status_code == 413


def test_an_unexpected_error_is_a_problem_without_details(
    sqlite_world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("secret detail")

    monkeypatch.setattr("server.api.campaigns.campaigns.campaign_stats", broken)
    campaign_id, _ = sqlite_world.add_campaign()
    headers = sqlite_world.client("ada").headers
    client = TestClient(sqlite_world.app, headers=headers, raise_server_exceptions=False)
    answer = client.get(f"/api/v1/campaigns/{campaign_id}/stats")
    assert answer.status_code == 500
    assert answer.headers["content-type"] == "application/problem+json"
    assert "secret" not in answer.text


def test_bootstrapping_twice_changes_nothing(database: Database, tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path / "artifacts")

    def register(blob: bytes, digest: str) -> int:
        with database.write() as session:
            return register_checkpoint(
                session,
                NOW,
                store,
                task="avoid",
                name="avoid-pretrained",
                blob=blob,
                digest=digest,
                config={"task_facts": factories.TASK_FACTS},
                metrics={},
                code_version="0.1.0",
            ).id

    assert register(b"weights", "1" * 64) == register(b"weights", "1" * 64)
    with pytest.raises(ConflictError, match="checkpoints are immutable"):
        register(b"other weights", "2" * 64)
    with database.write() as session:
        password = ensure_admin(session, NOW, cheap=True)
        assert password is not None and len(password) >= 16
        assert ensure_admin(session, NOW + timedelta(days=1), cheap=True) is None
        assert ensure_admin(session, NOW, password="given by hand", cheap=True) == "given by hand"
        admin = session.scalars(select(Annotator)).one()
        admin.active = False
        assert ensure_admin(session, NOW, cheap=True) is None and not admin.active
        assert ensure_admin(session, NOW, password="by hand again", cheap=True) and admin.active
        factories.add_account(session, "ann")
        with pytest.raises(ConflictError, match="'ann' has role 'annotator'"):
            ensure_admin(session, NOW, name="ann")


CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]
TESTED_ELSEWHERE = {  # streams do not end; readiness is a server error when nothing else runs
    "/api/v1/rounds/{round_id}/events",
    "/api/v1/campaigns/{campaign_id}/events",
    "/api/v1/ready",
}


def test_random_requests_get_documented_answers_and_never_a_server_error(world: World) -> None:
    """Every endpoint, as an admin, with requests that fit its schema."""
    world.add_campaign(pairs=2)
    schema = schemathesis.openapi.from_asgi("/api/v1/openapi.json", world.app)
    tried = set()
    for found in schema.get_all_operations():
        operation = found.ok()
        tried.add(operation.path)
        if operation.path not in TESTED_ELSEWHERE:
            _try_at_random(world, operation)
    assert tried > TESTED_ELSEWHERE and len(tried) > 30


def _try_at_random(world: World, operation: APIOperation) -> None:
    with world.database.write() as session:  # a fresh one: revoking tokens is tried, too
        token = factories.add_token(session, world.ids["ada"])

    @given(case=operation.as_strategy())
    @settings(
        max_examples=3,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    def check(case: schemathesis.Case) -> None:
        # Small ids, so that they meet rows.
        case.path_parameters = {k: v % 3 + 1 for k, v in (case.path_parameters or {}).items()}
        headers = {"Authorization": f"Bearer {token}"}
        case.call_and_validate(headers=headers, checks=CHECKS)

    check()
