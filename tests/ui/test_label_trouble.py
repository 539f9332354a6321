"""Replays that do not load: the next pair is never out of reach, and the admins hear of it."""

from __future__ import annotations

import io
import time
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import BrowserContext, Page, Route
from sqlalchemy import select

from server.store.tables import Event, Lease, Pair
from tests.ui.driving import PATIENCE, LabelPage, take_session, until
from tests.ui.studio import Studio

pytestmark = pytest.mark.browser
Opened = Callable[[int], LabelPage]

REPLAYS = "**/replays/*.viser"
NEXT_IS_LOADED = """[...document.querySelectorAll("iframe.waiting")].some(
  (frame) => frame.contentDocument?.querySelector("[role=slider]"))"""


def _address(studio: Studio, campaign: int, index: int) -> str:
    """Where the replay of a campaign's pair lies."""
    with studio.database.read() as session:
        query = select(Pair).where(Pair.campaign_id == campaign).order_by(Pair.id)
        return f"/replays/{session.scalars(query).all()[index].replay_sha256}.viser"


def test_replay_that_failed_while_it_waited_is_loaded_anew_when_its_turn_comes(
    studio: Studio, label_page: Opened, page: Page
) -> None:
    campaign = studio.add_campaign([True, True])
    second, failed = _address(studio, campaign, 1), []

    def fail_once(route: Route) -> None:
        if route.request.url.endswith(second) and not failed:
            failed.append(second)
            route.fulfill(status=500)
        else:
            route.continue_()

    page.route(REPLAYS, fail_once)
    driver = label_page(campaign)
    pair = driver.wait_ready()
    until(page, "document.querySelector('iframe.waiting') !== null")
    while not failed:
        page.wait_for_timeout(50)
    page.wait_for_timeout(200)
    driver.press("ArrowLeft")
    assert driver.wait_ready() != pair


def test_pair_whose_replay_fails_is_skipped_and_reported(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign([True, True])
    page.route(f"**{_address(studio, campaign, 0)}", lambda route: route.fulfill(status=404))
    driver = LabelPage(page, studio, studio.add_annotator())
    driver.open(campaign, ready=False)
    page.get_by_text("The replay is not there").wait_for()
    assert not page.get_by_role("button", name="A is better").is_enabled()
    driver.click("Skip and report")
    shown = driver.wait_ready()
    assert page.locator("#progress-text").inner_text() == "0 of 1"
    with studio.database.read() as session:
        events = select(Event).where(Event.campaign_id == campaign, Event.kind == "release")
        (told,) = session.scalars(events)
        given_back = session.get_one(Lease, told.data["lease_id"])
    assert told.data["reason"] == "replay_failed"
    assert told.data["pair_id"] == given_back.pair_id != shown
    assert given_back.closed_at is not None
    driver.reload()
    assert driver.wait_ready() == shown, "what was skipped does not come straight back"

    take_session(page, studio, "admin")
    page.goto(f"{studio.url}/admin/campaigns/{campaign}")
    page.get_by_text("1 reported: the replay does not play").wait_for()


def test_skipping_without_network_goes_on_when_it_is_back(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign([True, True])
    page.route(f"**{_address(studio, campaign, 0)}", lambda route: route.fulfill(status=404))
    page.route("**/release", lambda route: route.abort(), times=1)
    driver = LabelPage(page, studio, studio.add_annotator())
    driver.open(campaign, ready=False)
    driver.click("Skip and report")
    page.get_by_text("No connection to the server").wait_for()
    driver.click("Try now")  # the pair is still held
    driver.click("Skip and report")
    driver.wait_ready()


def test_replay_refused_after_the_session_ended_asks_to_sign_in(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign([True])
    page.route(REPLAYS, lambda route: route.fulfill(status=401))
    driver = LabelPage(page, studio, studio.add_annotator())
    driver.open(campaign, ready=False)
    page.get_by_role("heading", name="You are signed out").wait_for()
    assert page.locator("#stage-note").get_by_role("link", name="Sign in").is_visible()


def _red_share(page: Page) -> float:
    """Share of the stage in the red of the cylinders, which stand in every replay of the task."""
    picture = page.locator("#stage").screenshot(timeout=1000 * PATIENCE)
    red, green, blue = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"), int).T
    return float(((red > 120) & (green < 90) & (blue < 90)).mean())


def test_a_replay_that_waited_is_drawn_although_nothing_plays_yet(
    studio: Studio, label_page: Opened, page: Page
) -> None:
    driver = label_page(studio.add_campaign([True, True]))
    until(page, NEXT_IS_LOADED)
    driver.press("ArrowLeft")
    driver.wait_ready()
    deadline = time.monotonic() + PATIENCE
    while (share := _red_share(page)) < 0.002:
        assert time.monotonic() < deadline, share
    state = driver.wait_state("state.paused")
    assert state["t"] == 0, "the system asks for less motion: it waits at the start"
    driver.press("Space")
    driver.wait_state("!state.paused && state.t > 0")


def test_page_goes_on_when_its_person_has_signed_in_again_in_another_tab(
    studio: Studio, label_page: Opened, context: BrowserContext, page: Page
) -> None:
    campaign = studio.add_campaign([True, True, True])
    driver = label_page(campaign)
    until(page, NEXT_IS_LOADED)
    context.clear_cookies()
    for done in ("1 of 3", "2 of 3"):
        driver.wait_ready()
        driver.press("ArrowLeft")
        assert page.locator("#progress-text").inner_text() == done, "also without an answer"
    page.get_by_role("heading", name="You are signed out").wait_for()
    take_session(page, studio, driver.name)
    page.evaluate(
        "document.dispatchEvent(new Event('visibilitychange'))"
    )  # back from the other tab
    driver.wait_ready()
    assert len(studio.labels(campaign)) == 2
