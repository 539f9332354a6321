"""Passwords, sessions, tokens, and requests that other sites' pages make a browser send."""

from __future__ import annotations

import hashlib

import pytest
from sqlalchemy import select
from starlette.testclient import TestClient

from server.passwords import hash_password
from server.sign_in import (
    MAX_FAILURES_PER_ADDRESS,
    MAX_FAILURES_PER_NAME_AND_ADDRESS,
    source_of,
)
from server.store.tables import AuditEntry, BrowserSession
from tests.factories import PASSWORD, add_account
from tests.server.world import World

SIGN_IN = "/api/v1/session"
RIGHT = {"name": "ann", "password": PASSWORD}
WRONG = {"name": "ann", "password": "wrong horse"}


def test_signing_in_sets_a_cookie_that_scripts_cannot_read(world: World) -> None:
    browser = world.browser()
    answer = browser.post(SIGN_IN, json=RIGHT)
    assert answer.status_code == 200
    assert answer.json()["annotator"] == {
        "id": world.ids["ann"],
        "name": "ann",
        "role": "annotator",
        "kind": "person",
    }
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=lax" in cookie and "max-age=43200" in cookie
    secret = browser.cookies["rodif_session"]
    with world.database.read() as session:
        stored = session.scalars(select(BrowserSession.token_sha256)).one()
    assert stored == hashlib.sha256(secret.encode()).hexdigest()
    assert browser.get("/api/v1/me").json()["name"] == "ann"


def test_signing_out_ends_the_session_for_good(sqlite_world: World) -> None:
    browser = sqlite_world.signed_in("ann")
    secret = browser.cookies["rodif_session"]
    assert browser.delete(SIGN_IN).status_code == 204
    assert "rodif_session" not in browser.cookies
    thief = sqlite_world.browser()
    thief.cookies.set("rodif_session", secret)
    answer = thief.get("/api/v1/me")
    assert answer.status_code == 401
    assert "revoked" in answer.json()["detail"]


def test_a_session_expires(sqlite_world: World) -> None:
    browser = sqlite_world.signed_in("ann")
    sqlite_world.clock.advance(hours=11.9)
    assert browser.get("/api/v1/me").status_code == 200
    sqlite_world.clock.advance(hours=0.2)
    answer = browser.get("/api/v1/me")
    assert answer.status_code == 401
    assert "expired at 2026-11-23T00:00:00+00:00" in answer.json()["detail"]


OWN_PASSWORD = "/api/v1/me/password"
CHANGE = {"current": PASSWORD, "password": "a better one"}


def test_changing_the_own_password_ends_every_other_way_in(world: World) -> None:
    here, elsewhere, script = (world.signed_in("ann"), world.signed_in("ann"), world.client("ann"))
    assert here.put(OWN_PASSWORD, json=CHANGE).status_code == 204
    assert here.get("/api/v1/me").json()["name"] == "ann"  # with the cookie of the answer
    assert elsewhere.get("/api/v1/me").status_code == 401
    assert script.get("/me").status_code == 401
    stranger = world.browser()
    assert stranger.post(SIGN_IN, json=RIGHT).status_code == 401
    changed = RIGHT | {"password": CHANGE["password"]}
    assert stranger.post(SIGN_IN, json=changed).status_code == 200
    with world.database.read() as session:
        entry = session.scalars(select(AuditEntry).order_by(AuditEntry.id.desc())).first()
    assert entry is not None
    assert (entry.actor_id, entry.action) == (world.ids["ann"], "annotator.change")
    assert "better" not in str(entry.details)


@pytest.mark.parametrize(
    ("body", "status"),
    [({"current": "wrong horse"}, 403), ({"password": "short"}, 422)],
    ids=["wrong current password", "too short a new one"],
)
def test_a_refused_change_of_the_own_password_changes_nothing(
    sqlite_world: World, body: dict[str, str], status: int
) -> None:
    browser = sqlite_world.signed_in("ann")
    assert browser.put(OWN_PASSWORD, json=CHANGE | body).status_code == status
    assert browser.get("/api/v1/me").status_code == 200
    assert sqlite_world.browser().post(SIGN_IN, json=RIGHT).status_code == 200


def test_the_current_password_cannot_be_guessed_without_end(sqlite_world: World) -> None:
    browser = sqlite_world.signed_in("ann")
    wrong = CHANGE | {"current": "wrong horse"}
    for _ in range(MAX_FAILURES_PER_NAME_AND_ADDRESS):
        assert browser.put(OWN_PASSWORD, json=wrong).status_code == 403
    assert browser.put(OWN_PASSWORD, json=CHANGE).status_code == 429


@pytest.mark.parametrize(
    "body",
    [WRONG, {"name": "nobody", "password": PASSWORD}],
    ids=["wrong password", "unknown name"],
)
def test_wrong_credentials_say_the_same(sqlite_world: World, body: dict[str, str]) -> None:
    answer = sqlite_world.browser().post(SIGN_IN, json=body)
    assert answer.status_code == 401
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["detail"] == "name or password is wrong, or the account is not active"
    assert "set-cookie" not in answer.headers


def _at(browser: TestClient, address: str) -> TestClient:
    """The same application, asked from another address."""
    return TestClient(browser.app, headers=browser.headers, client=(address, 50000))


def test_guessing_a_password_is_throttled_and_then_forgiven(world: World) -> None:
    browser = world.browser()
    for _ in range(MAX_FAILURES_PER_NAME_AND_ADDRESS):
        assert browser.post(SIGN_IN, json=WRONG).status_code == 401
    answer = browser.post(SIGN_IN, json=RIGHT)  # even the right one now
    assert answer.status_code == 429
    assert 0 < int(answer.headers["retry-after"]) <= 901
    assert "10 failed sign-ins within 15 minutes" in answer.json()["detail"]
    assert world.signed_in("bob").get("/api/v1/me").status_code == 200  # others are not locked out
    world.clock.advance(minutes=15, seconds=1)
    assert browser.post(SIGN_IN, json=RIGHT).status_code == 200
    assert browser.post(SIGN_IN, json=WRONG).status_code == 401  # counting starts anew


def test_nobody_is_locked_out_by_guesses_from_elsewhere(sqlite_world: World) -> None:
    guesser = _at(sqlite_world.browser(), "203.0.113.7")
    for _ in range(MAX_FAILURES_PER_NAME_AND_ADDRESS):
        assert guesser.post(SIGN_IN, json=WRONG).status_code == 401
    owner = _at(sqlite_world.browser(), "192.0.2.1")
    assert owner.post(SIGN_IN, json=RIGHT).status_code == 200
    assert guesser.post(SIGN_IN, json=RIGHT).status_code == 429


def test_guessing_many_names_is_throttled_by_address(sqlite_world: World) -> None:
    browser = sqlite_world.browser()
    for index in range(MAX_FAILURES_PER_ADDRESS):
        body = {"name": f"guess{index}", "password": PASSWORD}
        assert browser.post(SIGN_IN, json=body).status_code == 401
    assert browser.post(SIGN_IN, json=RIGHT).status_code == 429
    assert _at(browser, "192.0.2.1").post(SIGN_IN, json=RIGHT).status_code == 200


@pytest.mark.parametrize(
    ("host", "source"),
    [
        ("192.0.2.1", "192.0.2.1"),
        ("::ffff:192.0.2.1", "192.0.2.1"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("testclient", "testclient"),
        (None, "unknown"),
    ],
)
def test_attempts_are_counted_by_what_one_host_has(host: str | None, source: str) -> None:
    assert source_of(host) == source


def test_a_deactivated_account_is_out_at_once_everywhere(world: World) -> None:
    browser, script = world.signed_in("ann"), world.client("ann")
    assert script.get("/me").status_code == 200
    patch = world.client("ada").patch(f"/annotators/{world.ids['ann']}", json={"active": False})
    assert patch.status_code == 200 and patch.json()["active"] is False
    assert browser.get("/api/v1/me").status_code == 401
    assert script.get("/me").status_code == 401
    assert world.browser().post(SIGN_IN, json=RIGHT).status_code == 401
    path = f"/annotators/{world.ids['ann']}"
    assert world.client("ada").patch(path, json={"active": True}).status_code == 200
    assert browser.get("/api/v1/me").status_code == 401
    assert "this token was revoked" in script.get("/me").json()["detail"]
    assert world.browser().post(SIGN_IN, json=RIGHT).status_code == 200


def test_a_new_password_ends_sessions_and_tokens_of_this_account_only(world: World) -> None:
    browser, script = world.signed_in("ann"), world.client("ann")
    admin = world.client("ada")
    path = f"/annotators/{world.ids['ann']}"
    assert admin.patch(path, json={"role": "annotator"}).status_code == 200
    assert script.get("/me").status_code == 200
    assert admin.patch(path, json={"password": "quite another one"}).status_code == 200
    assert browser.get("/api/v1/me").status_code == 401
    assert "this token was revoked" in script.get("/me").json()["detail"]
    assert world.client("bob").get("/me").status_code == 200
    assert world.browser().post(SIGN_IN, json=RIGHT).status_code == 401
    body = {"name": "ann", "password": "quite another one"}
    assert world.browser().post(SIGN_IN, json=body).status_code == 200


def test_others_can_write_while_a_password_is_hashed(
    sqlite_world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashed = []

    def hash_while_others_write(password: str, *, cheap: bool) -> str:
        with sqlite_world.database.write() as session:  # SQLite has one writer at a time
            add_account(session, f"other {len(hashed)}")
        hashed.append(password)
        return hash_password(password, cheap=cheap)

    monkeypatch.setattr("server.api.accounts.hash_password", hash_while_others_write)
    admin = sqlite_world.client("ada")
    body = {"name": "new", "role": "annotator", "password": "secret-secret"}
    made = admin.post("/annotators", json=body)
    assert made.status_code == 201
    changed = admin.patch(f"/annotators/{made.json()['id']}", json={"password": "other-secret"})
    assert changed.status_code == 200
    assert hashed == ["secret-secret", "other-secret"]


def test_the_last_admin_cannot_be_locked_out(world: World) -> None:
    admin, path = world.client("ada"), f"/annotators/{world.ids['ada']}"
    for body in ({"active": False}, {"role": "annotator"}):
        answer = admin.patch(path, json=body)
        assert answer.status_code == 409
        assert "last active admin" in answer.json()["detail"]


def test_a_token_is_shown_once_and_works_until_it_expires_or_is_revoked(world: World) -> None:
    admin = world.client("ada")
    body = {"annotator_id": world.ids["sam"], "name": "nightly", "days": 2}
    issued = admin.post("/tokens", json=body).json()
    assert issued["token"].startswith("rdf_") and len(issued["token"]) >= 4 + 43
    world.tokens["nightly"] = issued["token"]
    script = world.client("nightly")
    assert script.get("/me").json()["name"] == "sam"
    listed = {row["id"]: row for row in admin.get("/tokens").json()["items"]}
    assert issued["token"] not in str(listed)
    assert listed[issued["id"]]["last_used_at"] is not None
    world.clock.advance(days=2, seconds=1)
    answer = script.get("/me")
    assert answer.status_code == 401
    assert "this token expired at 2026-11-24T12:00:00+00:00" in answer.json()["detail"]
    assert answer.headers["www-authenticate"] == "Bearer"


def test_a_revoked_token_is_refused(sqlite_world: World) -> None:
    script = sqlite_world.client("ann")
    own = script.get("/tokens").json()["items"]
    assert [row["annotator_id"] for row in own] == [sqlite_world.ids["ann"]]
    assert script.delete(f"/tokens/{own[0]['id']}").status_code == 204
    assert "revoked" in script.get("/me").json()["detail"]


def test_annotators_handle_their_own_tokens_only(sqlite_world: World) -> None:
    ann = sqlite_world.client("ann")
    assert ann.post("/tokens", json={"name": "mine", "days": 90}).status_code == 201
    for_years = ann.post("/tokens", json={"name": "mine", "days": 3650})
    assert for_years.status_code == 422
    assert "days is 3650.0, but must be at most 90" in for_years.json()["detail"]
    body = {"name": "theirs", "days": 3650, "annotator_id": sqlite_world.ids["ann"]}
    issued = sqlite_world.client("ada").post("/tokens", json=body)
    assert issued.status_code == 201
    assert ann.delete(f"/tokens/{issued.json()['id']}").status_code == 204
    other = {"annotator_id": sqlite_world.ids["bob"], "name": "not mine"}
    assert ann.post("/tokens", json=other).status_code == 403
    bobs = sqlite_world.client("bob").get("/tokens?mine=true").json()["items"][0]["id"]
    assert ann.delete(f"/tokens/{bobs}").status_code == 403
    assert len(sqlite_world.client("ada").get("/tokens").json()["items"]) == 6
    assert len(sqlite_world.client("ada").get("/tokens?mine=true").json()["items"]) == 1


@pytest.mark.parametrize("token", ["rdf_unknown", "", "rdf_" + "ä" * 8])
def test_an_unknown_token_is_refused(sqlite_world: World, token: str) -> None:
    headers = {"Authorization": f"Bearer {token}".encode()}
    assert sqlite_world.client().get("/me", headers=headers).status_code == 401


@pytest.mark.parametrize(
    ("headers", "allowed"),
    [
        ({"Sec-Fetch-Site": "same-origin"}, True),
        ({"Sec-Fetch-Site": "none"}, True),
        ({"Origin": "http://testserver"}, True),
        ({"Sec-Fetch-Site": "cross-site"}, False),
        ({"Sec-Fetch-Site": "same-site"}, False),
        ({"Sec-Fetch-Site": "cross-site", "Origin": "http://testserver"}, False),
        ({"Origin": "http://evil.example"}, False),
        ({"Origin": "http://testserver.evil.example"}, False),
        ({"Origin": "null"}, False),
        ({}, False),
        ({"Authorization": "Basic YWRhOnNlY3JldA==", "Sec-Fetch-Site": "cross-site"}, False),
        ({"Authorization": "Basic YWRhOnNlY3JldA==", "Sec-Fetch-Site": "same-origin"}, True),
        ({"Authorization": "Bearer", "Sec-Fetch-Site": "cross-site"}, False),
        ({"Authorization": "Bearer ", "Origin": "http://evil.example"}, False),
    ],
)
def test_a_cookie_counts_only_on_requests_from_our_own_pages(
    sqlite_world: World, headers: dict[str, str], allowed: bool
) -> None:
    browser = sqlite_world.signed_in("ada")
    del browser.headers["Sec-Fetch-Site"]
    body = {"name": "new", "role": "annotator"}
    answer = browser.post("/api/v1/annotators", json=body, headers=headers)
    assert answer.status_code == (201 if allowed else 403)
    assert browser.get("/api/v1/me", headers=headers).status_code == 200  # reading is harmless


def test_another_site_cannot_sign_a_browser_in(sqlite_world: World) -> None:
    headers = {"Sec-Fetch-Site": "cross-site"}
    assert sqlite_world.browser().post(SIGN_IN, json=RIGHT, headers=headers).status_code == 403


def test_scripts_with_tokens_need_no_origin(sqlite_world: World) -> None:
    answer = sqlite_world.client("ada").post("/annotators", json={"name": "n", "role": "annotator"})
    assert answer.status_code == 201


def test_changes_of_accounts_are_audited_without_secrets(world: World) -> None:
    admin = world.client("ada")
    body = {"name": "new", "role": "annotator", "password": "secret-secret"}
    created = admin.post("/annotators", json=body).json()
    assert created["labels"] == 0 and created["active"] is True
    admin.patch(f"/annotators/{created['id']}", json={"role": "service"})
    again = admin.post("/annotators", json=body)
    assert again.status_code == 409 and "'new' already" in again.json()["detail"]
    assert "new" in [row["name"] for row in admin.get("/annotators").json()["items"]]
    items = admin.get("/audit?limit=2").json()["items"]
    assert [item["action"] for item in items] == ["annotator.change", "annotator.create"]
    assert {item["actor_id"] for item in items} == {world.ids["ada"]}
    with world.database.read() as session:
        details = str([row.details for row in session.scalars(select(AuditEntry))])
    assert "secret-secret" not in details and "argon2" not in details
