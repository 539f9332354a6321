"""Pages, their guards, and the files they load. What the pages do is tested in a browser."""

from __future__ import annotations

import base64
import hashlib
import re

import pytest

from rodif_core.spec import FinetuneMethod
from server.store.tables import Pair
from tests.server.world import World

PAGES = ["/label", "/label/1", "/admin", "/admin/campaigns/1"]


@pytest.mark.parametrize("path", ["/", *PAGES])
def test_strangers_are_sent_to_sign_in_and_back(sqlite_world: World, path: str) -> None:
    answer = sqlite_world.browser().get(path, follow_redirects=False)
    assert answer.status_code == 303
    assert answer.headers["location"] == f"/sign-in?next={path}"


def test_what_an_address_asks_for_survives_the_sign_in(sqlite_world: World) -> None:
    answer = sqlite_world.browser().get("/label/1?view=top&x=a b", follow_redirects=False)
    assert answer.headers["location"] == "/sign-in?next=/label/1%3Fview%3Dtop%26x%3Da%2520b"


@pytest.mark.parametrize("method", FinetuneMethod)
def test_the_dialogs_offer_every_method(sqlite_world: World, method: FinetuneMethod) -> None:
    script = sqlite_world.signed_in("ada").get("/static/campaign-actions.js").text
    offered = script.partition("const METHODS = [")[2].partition("];")[0]
    assert f'["{method}", "' in offered


@pytest.mark.parametrize(("name", "home"), [("ada", "/admin"), ("ann", "/label")])
def test_everybody_has_a_home(sqlite_world: World, name: str, home: str) -> None:
    browser = sqlite_world.signed_in(name)
    for path in ("/", "/sign-in"):
        answer = browser.get(path, follow_redirects=False)
        assert (answer.status_code, answer.headers["location"]) == (303, home)


@pytest.mark.parametrize(
    ("asked", "goal"),
    [
        ("/label/1", "/label/1"),
        ("/label/1%3Fview%3Dtop%26x%3Da%2520b", "/label/1?view=top&x=a%20b"),
        ("//evil.example", "/admin"),
        ("/%5Cevil.example", "/admin"),
        ("/%09/evil.example", "/%09/evil.example"),  # a path of this site that does not exist
        ("https://evil.example/label", "/admin"),
        ("label", "/admin"),
        ("", "/admin"),
    ],
)
def test_who_is_signed_in_goes_on_to_what_was_asked_for_on_this_site(
    sqlite_world: World, asked: str, goal: str
) -> None:
    browser = sqlite_world.signed_in("ada")
    answer = browser.get(f"/sign-in?next={asked}", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, goal)


@pytest.mark.parametrize("path", ["/sign-in", *PAGES])
def test_pages_render_under_a_policy_that_allows_no_foreign_or_inline_script(
    sqlite_world: World, path: str
) -> None:
    sqlite_world.add_campaign()
    browser = sqlite_world.browser() if path == "/sign-in" else sqlite_world.signed_in("ada")
    answer = browser.get(path)
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/html")
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("default-src 'self'") and "script-src" not in policy
    assert "unsafe-eval" not in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "same-origin"
    inline = re.findall(r"<script(?![^>]*\bsrc=)(?![^>]*application/json)[^>]*>", answer.text)
    assert inline == []
    assert re.findall(r"(?:src|href)=\"(?:https?:)?//", answer.text) == []


def test_pages_know_account_campaign_and_version(sqlite_world: World) -> None:
    sqlite_world.add_campaign()
    text = sqlite_world.signed_in("ann").get("/label/1").text
    assert "Pass the first obstacle on its left side." in text
    version = sqlite_world.app.state.ui_version
    assert re.fullmatch(r"0\.1\.0\+[0-9a-f]{12}", version) and len(version) <= 32
    assert version in text


@pytest.mark.parametrize("path", ["/admin", "/admin/campaigns/1"])
def test_annotators_are_sent_from_admin_pages_to_their_own(sqlite_world: World, path: str) -> None:
    answer = sqlite_world.signed_in("ann").get(path, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/label")


def test_a_page_of_an_unknown_campaign_says_so(sqlite_world: World) -> None:
    answer = sqlite_world.signed_in("ann").get("/label/99")
    assert answer.status_code == 404 and "no campaign 99" in answer.text
    assert 'class="brand"' in answer.text
    assert sqlite_world.signed_in("ann").get("/label/abc").status_code == 404


@pytest.mark.parametrize("number", ["0", str(2**31), "9" * 20, "9" * 5000, "-1", "1.5", "%00", "²"])
def test_what_no_database_takes_for_a_number_is_no_campaign(world: World, number: str) -> None:
    browser = world.signed_in("ada")
    for path in (f"/label/{number}", f"/admin/campaigns/{number}"):
        answer = browser.get(path)
        assert answer.status_code == 404 and "There is no campaign" in answer.text


def test_unknown_addresses_answer_people_with_a_page_and_scripts_with_json(
    sqlite_world: World,
) -> None:
    browser = sqlite_world.browser()
    page = browser.get("/nowhere", headers={"Accept": "text/html,*/*;q=0.8"})
    assert page.status_code == 404 and "no page at this address" in page.text
    assert page.headers["content-security-policy"].startswith("default-src 'self'")
    for path, accepted in (("/nowhere", "*/*"), ("/api/v1/nowhere", "text/html")):
        answer = browser.get(path, headers={"Accept": accepted})
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["status"] == 404


def test_every_file_that_a_page_names_is_served(sqlite_world: World) -> None:
    sqlite_world.add_campaign()
    browser = sqlite_world.signed_in("ada")
    for path in PAGES:
        for url in set(
            re.findall(r"(?:src|href)=\"(/(?:static|vendor)/[^\"]+)\"", browser.get(path).text)
        ):
            assert browser.get(url).status_code == 200, (path, url)


def test_a_replay_is_served_for_ever_and_in_part(sqlite_world: World) -> None:
    artifacts = sqlite_world.app.state.services.artifacts
    data = bytes(range(256)) * 40
    sha256 = artifacts.put(data)
    _show(sqlite_world, sha256)
    browser = sqlite_world.signed_in("ann")
    answer = browser.get(f"/replays/{sha256}.viser")
    assert answer.content == data
    assert answer.headers["cache-control"] == "private, max-age=31536000, immutable"
    assert "sandbox" in answer.headers["content-security-policy"]
    head = browser.head(f"/replays/{sha256}.viser")
    assert head.status_code == 200 and head.headers["content-length"] == str(len(data))
    part = browser.get(f"/replays/{sha256}.viser", headers={"Range": "bytes=0-9"})
    assert (part.status_code, part.content) == (206, data[:10])
    thumbnail = browser.get(f"/thumbnails/{sha256}.webp")
    assert thumbnail.headers["content-type"] == "image/webp"


def _show(world: World, sha256: str) -> None:
    _, [pair_id] = world.add_campaign(pairs=1)
    with world.database.write() as session:
        pair = session.get_one(Pair, pair_id)
        pair.replay_sha256 = pair.thumbnail_sha256 = sha256


def test_a_stored_file_that_no_pair_shows_is_not_handed_out(sqlite_world: World) -> None:
    sha256 = sqlite_world.app.state.services.artifacts.put(b"an episode with its outcome")
    for path in (f"/replays/{sha256}.viser", f"/thumbnails/{sha256}.webp"):
        assert sqlite_world.signed_in("ann").get(path).status_code == 404


def test_browsers_ask_for_site_files_each_time(sqlite_world: World) -> None:
    browser = sqlite_world.browser()
    answer = browser.get("/static/label.js")
    assert answer.headers["cache-control"] == "no-cache"
    again = browser.get("/static/label.js", headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.headers["cache-control"]) == (304, "no-cache")


@pytest.mark.parametrize("name", ["..%2f..%2frodif", "A" * 64, "short", "%00", "%ed%a0%80"])
def test_a_replay_that_is_no_hash_is_not_found(world: World, name: str) -> None:
    browser = world.signed_in("ann")
    for path in (f"/replays/{name}.viser", f"/thumbnails/{name}.webp"):
        assert browser.get(path).status_code == 404


@pytest.mark.parametrize("name", ["%00", "x" * 5000, "%ed%a0%80"])
def test_an_odd_name_of_a_site_file_is_not_found(sqlite_world: World, name: str) -> None:
    assert sqlite_world.browser().get(f"/static/{name}").status_code == 404


REPLAY = f"/replays/{'0' * 64}.viser"


def test_the_replay_client_is_the_installed_one_with_our_adapter(sqlite_world: World) -> None:
    address = f"/replay-client/?playbackPath={REPLAY}&logCamera=1&start=paused"
    assert sqlite_world.browser().get(address).status_code == 401
    browser = sqlite_world.signed_in("ann")
    answer = browser.get(address)
    assert answer.status_code == 200
    adapter = browser.get("/static/replay-adapter.js").text
    head, found, _rest = answer.text.partition(f"<script>{adapter}</script></head>")
    assert found and "<body" not in head
    assert len(answer.content) > 500_000
    again = browser.get(address, headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_the_replay_clients_policy_names_the_scripts_of_the_page_and_no_others(
    sqlite_world: World,
) -> None:
    answer = sqlite_world.signed_in("ann").get(f"/replay-client/?playbackPath={REPLAY}")
    policy = answer.headers["content-security-policy"]
    (sources,) = re.findall(r"script-src ([^;]+);", policy)
    assert policy.startswith("default-src 'none';")
    named = set(sources.split()) - {"'wasm-unsafe-eval'"}
    assert all(re.fullmatch(r"'sha256-[0-9A-Za-z+/]{43}='", source) for source in named)
    scripts = re.findall(r"<script[^>]*>(.+?)</script>", answer.text, flags=re.DOTALL)
    digests = [hashlib.sha256(script.encode()).digest() for script in scripts]
    on_page = {f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests}
    assert len(on_page) == 2 and on_page < named
    assert len(named) == 3  # the third is what the client unpacks, as a browser test shows


@pytest.mark.parametrize(
    "query",
    [
        "",
        "?playbackPath=",
        "?playbackPath=data:application/octet-stream;base64,AAAA",
        "?playbackPath=https://example.org/a.viser",
        f"?playbackPath=//example.org{REPLAY}",
        f"?playbackPath=/label/..{REPLAY}",
        f"?playbackPath={REPLAY}%0A",
        f"?playbackPath={REPLAY.upper()}",
        f"?playbackPath={REPLAY}&playbackPath={REPLAY}",
        f"?playbackPath={REPLAY}&%70laybackPath=data:,",
        f"?playbackPath={REPLAY}&websocket=ws://example.org",
        f"?playbackPath={REPLAY}&websocket",
    ],
)
def test_the_replay_client_shows_nothing_but_one_recording_of_this_site(
    sqlite_world: World, query: str
) -> None:
    answer = sqlite_world.signed_in("ann").get(f"/replay-client/{query}")
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    (error,) = answer.json()["errors"]
    assert (error["field"], error["legal"]) in (
        ("playbackPath", "one /replays/<sha256>.viser"),
        ("websocket", "absent"),
    )


def test_plotly_comes_out_of_the_installed_package(sqlite_world: World) -> None:
    answer = sqlite_world.browser().get("/vendor/plotly.min.js")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/javascript")
    assert b"plotly.js v" in answer.content[:200]
    assert len(hashlib.sha256(answer.content).hexdigest()) == 64
