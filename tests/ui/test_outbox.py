"""What waits in the browser: kept until the server has stored it, under the right name only."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import BrowserContext, Page, Route

from server.states import Choice
from server.store.tables import Campaign
from tests.ui.driving import PATIENCE, LabelPage, take_session, until
from tests.ui.studio import Studio

pytestmark = pytest.mark.browser
Opened = Callable[[int], LabelPage]

# Routes are laid before the page is opened: an open page's requests may still pass by a new one.
LABELS = "**/api/v1/labels"
STORED = "Object.keys(localStorage).filter((key) => key.startsWith('rodif-outbox')).length"
JSON = "application/json"
PROBLEM = "application/problem+json"
# What proxies, hotels' networks and broken servers answer in the place of "stored".
ODD_ANSWERS = [
    (200, "text/html", "<h1>Welcome to the hotel</h1>"),
    (200, JSON, ""),
    (200, JSON, '{"ok": true}'),
    (204, JSON, ""),
    (403, "text/html", "<h1>Forbidden</h1>"),
    (408, PROBLEM, '{"title": "Request Timeout"}'),
    (500, PROBLEM, '{"title": "Internal Server Error"}'),
]


def _try_now(page: Page) -> None:
    """As if the network had come back: the outbox does not wait for its next turn."""
    page.evaluate("window.dispatchEvent(new Event('online'))")


@contextmanager
def _breaking_off() -> Iterator[str]:
    """A server whose answers begin and do not end."""
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def answer() -> None:
            while True:
                try:
                    connection, _ = listening.accept()
                except OSError:
                    return
                with connection:
                    connection.recv(65536)
                    connection.sendall(
                        b"HTTP/1.1 500 Oh\r\nContent-Type: application/problem+json\r\n"
                        b'Content-Length: 500\r\n\r\n{"title'
                    )

        threading.Thread(target=answer, daemon=True).start()
        yield f"http://127.0.0.1:{listening.getsockname()[1]}/"
        listening.shutdown(socket.SHUT_RDWR)


def test_label_is_kept_until_the_server_itself_says_that_it_is_stored(
    studio: Studio, label_page: Opened, page: Page
) -> None:
    campaign = studio.add_campaign([True])
    odd, keys = list(ODD_ANSWERS), []

    def answer_oddly(route: Route) -> None:
        keys.append(route.request.headers["idempotency-key"])
        if odd:
            status, media_type, body = odd.pop(0)
            route.fulfill(status=status, content_type=media_type, body=body)
        else:
            route.continue_()

    page.route(LABELS, answer_oddly)
    label_page(campaign).press("ArrowLeft")
    for attempt in range(1, len(ODD_ANSWERS) + 1):
        deadline = time.monotonic() + PATIENCE
        while len(keys) < attempt:
            assert time.monotonic() < deadline, f"the label was sent {len(keys)} times"
            _try_now(page)
            page.wait_for_timeout(20)
        assert page.evaluate(STORED) == 1, ODD_ANSWERS[attempt - 1]
    until(page, f"window.dispatchEvent(new Event('online')) && {STORED} === 0")
    assert [row.choice for row in studio.labels(campaign)] == [Choice.FIRST]
    assert len(set(keys)) == 1


def test_label_is_kept_when_the_answer_breaks_off(
    studio: Studio, label_page: Opened, page: Page
) -> None:
    campaign = studio.add_campaign([True])
    with _breaking_off() as address:
        page.route(LABELS, lambda route: route.continue_(url=address))
        label_page(campaign).press("ArrowLeft")
        page.get_by_text("1 answer is kept on this device").wait_for()
        assert page.evaluate(STORED) == 1
        page.unroute(LABELS)
    _try_now(page)
    assert studio.wait_for_labels(campaign, 1)[0].choice == Choice.FIRST


def test_open_page_of_one_person_labels_nothing_under_the_next_ones_session(
    studio: Studio, label_page: Opened, context: BrowserContext, page: Page
) -> None:
    campaign = studio.add_campaign([True])
    with studio.database.write() as session:
        row = session.get_one(Campaign, campaign)
        row.settings = row.settings | {"labels_per_pair": 2}
    driver = label_page(campaign)
    other = LabelPage(context.new_page(), studio, studio.add_annotator())
    other.open(campaign)  # on the same device, and holding the same pair
    driver.press("ArrowRight")
    page.locator("#outbox-waiting").get_by_role("link", name="sign in").wait_for()
    page.get_by_role("heading", name="You are signed out").wait_for()
    assert studio.labels(campaign) == []
    other.press("ArrowLeft")
    (others,) = studio.wait_for_labels(campaign, 1)
    take_session(other.page, studio, driver.name)
    _try_now(page)
    own = studio.wait_for_labels(campaign, 2)[1]
    assert own.annotator_id != others.annotator_id
    assert (others.choice, own.choice) == (Choice.FIRST, Choice.SECOND)


def _name_another_lease(route: Route) -> None:
    """The server will say that the pair was never handed out under this one."""
    body = json.loads(route.request.post_data or "")
    route.continue_(post_data=json.dumps(body | {"lease_id": 2**31 - 1}))


def test_what_the_server_does_not_accept_is_shown_kept_and_sent_again_on_request(
    studio: Studio, label_page: Opened, page: Page
) -> None:
    studio.add_campaign()  # a second one: the choice of campaigns stays on the screen
    campaign = studio.add_campaign([True])
    page.route(LABELS, _name_another_lease)
    label_page(campaign).press("ArrowLeft")
    page.get_by_text("1 answer was not accepted.").wait_for()
    page.unroute(LABELS)
    page.goto(f"{studio.url}/label")
    page.get_by_role("button", name="Show", exact=True).click()
    sheet = page.get_by_role("dialog", name="Not accepted")
    assert "A is better" in sheet.inner_text() and "was never handed to you" in sheet.inner_text()
    assert studio.labels(campaign) == []
    sheet.get_by_role("button", name="Send again").click()
    assert studio.wait_for_labels(campaign, 1)[0].choice == Choice.FIRST
    page.locator("#outbox-refused").wait_for(state="hidden")
    assert page.evaluate(STORED) == 0


def test_answer_that_is_not_accepted_does_not_hold_up_the_next_one_and_can_be_discarded(
    studio: Studio, label_page: Opened, page: Page
) -> None:
    studio.add_campaign()
    campaign = studio.add_campaign([True, False])
    page.route(LABELS, _name_another_lease, times=1)
    driver = label_page(campaign)
    driver.press("ArrowLeft")
    page.get_by_text("1 answer was not accepted.").wait_for()
    shown = driver.wait_ready()
    driver.press("ArrowLeft")
    (row,) = studio.wait_for_labels(campaign, 1)
    assert row.pair_id == shown
    page.goto(f"{studio.url}/label")
    page.get_by_role("button", name="Show", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Discard").click()
    page.locator("#outbox-refused").wait_for(state="hidden")
    assert page.evaluate(STORED) == 0


def test_page_says_that_the_browser_cannot_keep_an_answer(
    studio: Studio, label_page: Opened, context: BrowserContext, page: Page
) -> None:
    context.add_init_script(
        "Storage.prototype.setItem = () => { throw new DOMException('', 'QuotaExceededError'); }"
    )
    campaign = studio.add_campaign([True])
    driver = label_page(campaign)
    context.set_offline(True)
    driver.press("ArrowLeft")
    page.get_by_text("1 answer waits in this tab only").wait_for()
    context.set_offline(False)
    studio.wait_for_labels(campaign, 1)
    page.locator("#outbox-waiting").wait_for(state="hidden")


@pytest.mark.parametrize("status", [429, 500])
def test_pair_whose_label_could_not_be_stored_is_not_judged_twice(
    studio: Studio, label_page: Opened, page: Page, status: int
) -> None:
    campaign = studio.add_campaign([True])
    problem = json.dumps({"title": "Oh", "status": status, "detail": "later, please"})
    page.route(
        LABELS, lambda route: route.fulfill(status=status, content_type=PROBLEM, body=problem)
    )
    driver = label_page(campaign)
    driver.press("ArrowLeft")
    page.get_by_role("heading", name="The server cannot take answers now").wait_for()
    page.wait_for_timeout(1000)
    assert not page.get_by_role("button", name="A is better").is_enabled()
    page.unroute(LABELS)
    driver.click("Try now")
    page.get_by_text("All done").wait_for()
    (row,) = studio.labels(campaign)
    assert row.supersedes_id is None


def test_labels_that_wait_are_sent_from_the_choice_of_campaigns(
    studio: Studio, label_page: Opened, page: Page
) -> None:
    studio.add_campaign()  # a second one: the choice of campaigns stays on the screen
    campaign = studio.add_campaign([True])
    page.route(LABELS, lambda route: route.abort())
    label_page(campaign).press("ArrowLeft")
    page.get_by_text("1 answer is kept on this device").wait_for()
    page.goto(f"{studio.url}/label")
    page.get_by_text("1 answer is kept on this device").wait_for()
    assert studio.labels(campaign) == []
    page.unroute(LABELS)
    studio.wait_for_labels(campaign, 1)
    page.locator("#outbox-waiting").wait_for(state="hidden")
