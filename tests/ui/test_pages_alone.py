"""The pages live on their own server: nothing comes from elsewhere, and nothing goes wrong."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import ConsoleMessage, Page

from server.store.tables import Campaign
from tests.ui.driving import LabelPage, take_session, until
from tests.ui.studio import Studio

pytestmark = pytest.mark.browser

# viser's client, which is not ours, warns, and tries `eval` for a feature that replays do not use.
KNOWN = ("THREE.Clock", "GL Driver Message", "WebGL")
KNOWN_REFUSAL = ("/replay-client/", "script-src", "eval")
# The event says in which frame the policy refused what; console and page errors do not.
TELL_REFUSALS = """addEventListener("securitypolicyviolation", (event) =>
  window.tellRefusal([location.pathname, event.effectiveDirective, event.blockedURI]))"""


class Witness:
    """Notes foreign addresses, errors, warnings and what the policy refused on a page."""

    def __init__(self, page: Page, studio: Studio) -> None:
        self.foreign: list[str] = []
        self.complaints: list[str] = []
        self.refusals: set[tuple[str, ...]] = set()
        allowed = (studio.url, "blob:", "data:")
        page.on(
            "request",
            lambda request: (
                None if request.url.startswith(allowed) else self.foreign.append(request.url)
            ),
        )
        page.on("console", self._note)
        page.on("pageerror", lambda error: self._note_text(str(error)))
        page.expose_function("tellRefusal", lambda refused: self.refusals.add(tuple(refused)))
        page.add_init_script(TELL_REFUSALS)

    def _note(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self._note_text(message.text)

    def _note_text(self, text: str) -> None:
        told_by_event = "following Content Security Policy directive" in text
        if not told_by_event and not any(known in text for known in KNOWN):
            self.complaints.append(text)


def test_annotators_page_loads_from_its_own_server_only(
    studio: Studio, page: Page, label_page: Callable[[int], LabelPage]
) -> None:
    witness = Witness(page, studio)
    driver = label_page(studio.add_campaign([True]))
    driver.wait_state("state.t > 0")
    assert witness.foreign == []
    assert witness.complaints == []
    assert witness.refusals <= {KNOWN_REFUSAL}


def test_what_the_policy_refuses_on_a_page_is_noticed(studio: Studio, page: Page) -> None:
    witness = Witness(page, studio)
    page.goto(f"{studio.url}/sign-in")
    page.evaluate("document.querySelector('form').setAttribute('onclick', 'alert(1)')")
    page.wait_for_timeout(500)
    assert witness.refusals == {("/sign-in", "script-src-attr", "inline")}


@pytest.mark.parametrize("path", ["/sign-in", "/label", "/admin", "/admin/campaigns/{id}"])
def test_other_pages_load_from_their_own_server_only(studio: Studio, page: Page, path: str) -> None:
    campaign = studio.add_campaign([True])
    studio.add_campaign()  # a second one: the choice of campaigns stays on the screen
    witness = Witness(page, studio)
    if path != "/sign-in":
        take_session(page, studio, "admin")
    page.goto(studio.url + path.format(id=campaign))
    until(page, "!document.body.innerText.includes('Loading…')")
    page.wait_for_timeout(500)
    assert page.locator("h1, .brand").first.is_visible()
    assert witness.foreign == []
    assert witness.complaints == []
    assert witness.refusals == set()


@pytest.mark.parametrize("path", ["/sign-in", "/label", "/admin", "/admin/campaigns/{id}"])
def test_pages_fit_a_phone_and_every_control_has_a_name(
    studio: Studio, page: Page, path: str
) -> None:
    campaign = studio.add_campaign([True])
    page.set_viewport_size({"width": 390, "height": 844})
    if path != "/sign-in":
        take_session(page, studio, "admin")
    page.goto(studio.url + path.format(id=campaign))
    until(page, "!document.body.innerText.includes('Loading…')")
    page.wait_for_timeout(500)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    nameless = page.evaluate(
        """() => [...document.querySelectorAll("button, a, input, select, summary")]
          .filter((item) => item.checkVisibility())
          .filter((item) => !(item.innerText || item.ariaLabel || item.labels?.length))
          .map((item) => item.outerHTML)"""
    )
    assert nameless == []


@pytest.mark.parametrize("path", ["/label", "/admin", "/admin/campaigns/{id}", "/label/{id}"])
def test_pages_fit_a_phone_however_long_the_names_are(
    studio: Studio, page: Page, path: str
) -> None:
    campaign, other = studio.add_campaign([True]), studio.add_campaign()
    long = "x" * 100
    page.set_viewport_size({"width": 390, "height": 844})
    take_session(page, studio, "admin")
    with studio.database.write() as session:
        for number in (campaign, other):
            row = session.get_one(Campaign, number)
            row.name, row.criterion = f"{studio.new_name(long)}", f"{long} {long}"
    page.goto(studio.url + path.format(id=campaign))
    until(page, "!document.body.innerText.includes('Loading…')")
    page.wait_for_timeout(500)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


# What a click or a key would reach: visible, enabled, and not below a part that is switched off.
WITHIN_REACH = """[...document.querySelectorAll("button, select, input[type=checkbox]")]
  .filter((item) => item.checkVisibility() && !item.disabled && !item.closest(".off"))
  .map((item) => item.outerHTML)"""


@pytest.mark.parametrize("path", ["/admin", "/admin/campaigns/{}", "/label/{}"])
def test_no_control_can_be_used_before_something_listens_to_it(
    studio: Studio, page: Page, path: str
) -> None:
    take_session(page, studio, "admin")
    page.route("**/static/*.js", lambda route: route.abort())
    page.goto(studio.url + path.format(studio.add_campaign([True])))
    page.get_by_label("Account of").click()
    assert page.evaluate(WITHIN_REACH) == []


def test_password_is_sent_by_the_pages_own_script_or_not_at_all(studio: Studio, page: Page) -> None:
    page.route("**/static/*.js", lambda route: route.abort())
    page.goto(f"{studio.url}/sign-in")
    page.get_by_label("Name").fill("admin")
    page.get_by_label("Password").fill("secret words")
    page.get_by_label("Password").press("Enter")
    page.wait_for_timeout(300)
    assert page.url == f"{studio.url}/sign-in"
    assert not page.get_by_role("button", name="Sign in").is_enabled()
