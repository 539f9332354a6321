"""The annotator's page in a real Chromium, on the real server: what is clicked, SQL keeps."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime

import pytest
from playwright.sync_api import BrowserContext, Page, Playwright, Route
from sqlalchemy import func, select

from server.states import Choice
from server.store.tables import Lease
from tests.ui.driving import CHROMIUM_FLAGS, PATIENCE, LabelPage, sign_in, until
from tests.ui.studio import PASSWORD, Studio

pytestmark = pytest.mark.browser
Opened = Callable[[int], LabelPage]


def test_sign_in_refuses_a_wrong_password_and_returns_to_the_page_asked_for(
    studio: Studio, page: Page
) -> None:
    name, campaign = studio.add_annotator(), studio.add_campaign()
    page.goto(f"{studio.url}/label/{campaign}")
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill("not the password")
    page.get_by_role("button", name="Sign in").click()
    page.get_by_role("alert").get_by_text("Name or password is wrong.").wait_for()
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("button", name="Sign in").click()
    page.wait_for_url(f"{studio.url}/label/{campaign}")


def test_replay_plays_by_itself_and_obeys_keys_and_the_transport_bar(
    studio: Studio, page: Page, label_page: Opened
) -> None:
    page.emulate_media(reduced_motion="no-preference")
    driver = label_page(studio.add_campaign([True]))
    first = driver.state()["t"]
    driver.wait_state(f"!state.paused && state.t !== {first}")
    assert driver.state()["duration"] == pytest.approx(3.16, abs=0.01)

    driver.press("Space")
    driver.wait_state("state.paused")
    driver.page.locator("#scrubber").fill("1.5")
    driver.wait_state("Math.abs(state.t - 1.5) < 0.01")
    driver.press(".")
    driver.wait_state("Math.abs(state.t - 1.535) < 0.01")
    driver.press(",")
    driver.press(",")
    driver.wait_state("Math.abs(state.t - 1.465) < 0.01")
    driver.page.wait_for_timeout(1000)
    assert driver.state()["t"] == pytest.approx(1.465, abs=0.01), "a step stays where it is"
    driver.press("]")
    driver.wait_state("state.speed === 2 && state.paused")
    driver.press("[")
    driver.press("[")
    driver.wait_state("state.speed === 0.5")
    driver.press("r")
    driver.wait_state("!state.paused && state.t < 1.4")
    driver.click("Pause")
    driver.wait_state("state.paused")


def test_replay_waits_for_space_where_the_system_asks_for_less_motion(
    studio: Studio, page: Page, label_page: Opened
) -> None:
    page.emulate_media(reduced_motion="reduce")
    driver = label_page(studio.add_campaign([True]))
    driver.wait_state("state.paused")
    page.wait_for_timeout(500)  # whatever was under way when it was paused has come by then
    begun = driver.state()["t"]
    page.wait_for_timeout(500)
    assert driver.state()["t"] == begun
    driver.press("Space")
    driver.wait_state(f"!state.paused && state.t !== {begun}")


def test_camera_buttons_turn_the_scene(studio: Studio, page: Page, label_page: Opened) -> None:
    page.emulate_media(reduced_motion="no-preference")
    driver = label_page(studio.add_campaign([True]))
    front = driver.wait_state("state.camera !== ''")["camera"]
    driver.press("2")
    y = "Number(state.camera.match(/Position=[^,]+,([^,]+),/)[1])"  # behind the runs' start
    assert front.startswith("&initialCameraPosition=")
    driver.wait_state(f"state.camera !== {front!r} && {y} > -0.3")
    assert driver.page.get_by_role("button", name="Top").get_attribute("aria-pressed") == "true"
    driver.press("1")
    driver.wait_state(f"{y} < -0.8")


def test_labels_by_key_and_mouse_name_the_right_winner_for_both_side_orders(
    studio: Studio, label_page: Opened
) -> None:
    campaign = studio.add_campaign([True, False, True, False, True, False])
    driver = label_page(campaign)
    actions = [
        lambda: driver.press("ArrowLeft"),
        lambda: driver.press("ArrowLeft"),
        lambda: driver.click("B is better"),
        lambda: driver.click("B is better"),
        lambda: driver.press("ArrowUp"),
        lambda: driver.click("Can’t tell"),
    ]
    shown = []
    for count, action in enumerate(actions, start=1):
        shown.append(driver.wait_ready())
        action()
        studio.wait_for_labels(campaign, count)
    rows = studio.labels(campaign)
    assert [row.pair_id for row in rows] == shown
    assert [row.choice for row in rows] == [
        Choice.FIRST,  # left, where the first episode stands left
        Choice.SECOND,  # left, where the second episode stands left
        Choice.SECOND,
        Choice.FIRST,
        Choice.EQUAL,
        Choice.CANNOT_TELL,
    ]
    for row in rows:
        assert row.duration_ms is not None and row.active_ms is not None
        assert 0 < row.active_ms <= row.duration_ms
        assert row.client_time is not None and row.ui_version
        assert not row.late
    driver.page.get_by_text("All done").wait_for()
    assert driver.page.locator("#progress-text").inner_text() == "6 of 6"


def test_what_was_watched_is_stored_with_the_label(
    studio: Studio, page: Page, label_page: Opened
) -> None:
    page.emulate_media(reduced_motion="no-preference")
    campaign = studio.add_campaign([True])
    driver = label_page(campaign)
    driver.press("Space")
    paused = driver.wait_state("state.paused")
    # Somewhere else than where the replay was paused, or the wait below would prove nothing.
    goal = 1.0 if paused["t"] > 1.6 else 2.2
    box = driver.page.locator("#scrubber").bounding_box()
    assert box is not None
    x = box["x"] + box["width"] * goal / paused["duration"]
    driver.page.mouse.click(x, box["y"] + box["height"] / 2)
    driver.wait_state(f"Math.abs(state.t - {goal}) < 0.1")
    driver.press("ArrowRight")  # the mouse has left the scrubber: the arrow judges
    events = studio.wait_for_labels(campaign, 1)[0].replay_events
    assert {"pause", "seek"} <= {event["what"] for event in events}
    seek = next(event for event in events if event["what"] == "seek")
    assert seek["to"] == pytest.approx(goal, abs=0.1) and seek["at"] > 0


def test_arrows_move_the_scrubber_that_the_keyboard_reached(
    studio: Studio, page: Page, label_page: Opened
) -> None:
    page.emulate_media(reduced_motion="no-preference")
    campaign = studio.add_campaign([True])
    driver = label_page(campaign)
    driver.press("Space")
    before = driver.wait_state("state.paused")["t"]
    driver.page.locator("#scrubber").focus()
    driver.press("ArrowLeft")
    driver.wait_state(f"state.t !== {before}")
    assert studio.labels(campaign) == []


def test_active_time_stops_after_a_minute_without_input(studio: Studio, page: Page) -> None:
    page.goto(f"{studio.url}/sign-in")
    spent = page.evaluate(
        """async () => {
          const { Watch } = await import("/static/watch.js");
          let now = 1000;
          const watch = new Watch(() => now);
          now += 10_000;
          watch.input();  // 10 s of work, then five minutes away: a minute of them counts
          now += 300_000;
          watch.input();
          now += 5_000;
          return watch.summary();
        }"""
    )
    assert spent == {"duration_ms": 315_000, "active_ms": 75_000, "replay_events": []}


def test_undo_opens_the_same_pair_again_and_adds_rows(studio: Studio, label_page: Opened) -> None:
    campaign = studio.add_campaign([False, False])
    driver = label_page(campaign)
    pair = driver.wait_ready()
    driver.press("ArrowLeft")
    studio.wait_for_labels(campaign, 1)
    other = driver.wait_ready()
    assert other != pair
    driver.press("z")
    studio.wait_for_labels(campaign, 2)
    assert driver.wait_ready() == pair
    assert driver.page.locator("#progress-text").inner_text() == "0 of 2"
    driver.press("ArrowRight")
    studio.wait_for_labels(campaign, 3)
    assert driver.wait_ready() == other
    label, retraction, second = studio.labels(campaign)
    assert (label.choice, label.retracted) == (Choice.SECOND, False)
    assert (retraction.retracted, retraction.supersedes_id) == (True, label.id)
    assert (second.choice, second.supersedes_id) == (Choice.FIRST, retraction.id)
    assert second.pair_id == pair


def test_next_pair_is_loaded_while_this_one_is_judged(studio: Studio, label_page: Opened) -> None:
    campaign = studio.add_campaign([True, True, True])
    driver = label_page(campaign)
    pair = driver.wait_ready()
    waiting = driver.page.locator("iframe.replay.waiting")
    waiting.wait_for(state="attached", timeout=1000 * PATIENCE)
    ready = """() => [...document.querySelectorAll("iframe.waiting")].some(
      (frame) => frame.contentDocument?.querySelector("[role=slider]"))"""
    until(driver.page, ready)
    with studio.database.read() as session:
        live = select(func.count()).select_from(Lease).where(Lease.closed_at.is_(None))
        mine = live.where(Lease.expires_at > datetime.now(UTC))
        assert session.scalars(mine).one() >= 2
    address = waiting.get_attribute("src")
    driver.press("ArrowLeft")
    assert driver.wait_ready() != pair
    on_stage = driver.page.locator("iframe.replay:not(.waiting)")
    assert on_stage.get_attribute("src") == address, "the waiting replay should come on stage"


def test_empty_campaign_says_so_and_shows_pairs_as_soon_as_they_are_ready(
    studio: Studio, page: Page
) -> None:
    empty = LabelPage(page, studio, studio.add_annotator())
    empty.open(studio.add_campaign(), ready=False)
    page.get_by_text("Nothing to label yet").wait_for()

    campaign = studio.add_campaign([True], replays=False)
    empty.path = f"/label/{campaign}"
    empty.reload(ready=False)
    page.get_by_text("The next replays are being made").wait_for()
    assert not page.get_by_role("button", name="Equal").is_enabled()
    studio.make_replays(campaign)
    empty.wait_ready()


def test_keys_judge_also_while_the_scene_has_the_focus(studio: Studio, label_page: Opened) -> None:
    campaign = studio.add_campaign([True])
    driver = label_page(campaign)
    box = driver.page.locator("#stage").bounding_box()
    assert box is not None
    driver.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert driver.page.evaluate("document.activeElement.tagName") == "IFRAME"
    driver.press("ArrowRight")
    assert studio.wait_for_labels(campaign, 1)[0].choice == Choice.SECOND


def test_label_given_without_network_is_kept_and_sent_once_later(
    studio: Studio, label_page: Opened, context: BrowserContext
) -> None:
    campaign = studio.add_campaign([True, True])
    driver = label_page(campaign)
    context.set_offline(True)
    driver.press("ArrowLeft")
    driver.page.get_by_text("1 answer is kept on this device").wait_for()
    assert studio.labels(campaign) == []
    stored = "Object.keys(localStorage).filter((key) => key.startsWith('rodif-outbox')).length"
    assert driver.page.evaluate(stored) == 1
    context.set_offline(False)
    studio.wait_for_labels(campaign, 1)
    until(driver.page, "document.querySelector('#outbox-waiting').hidden")
    assert driver.page.evaluate(stored) == 0
    assert [row.choice for row in studio.labels(campaign)] == [Choice.FIRST]


def test_undo_without_network_goes_out_in_order_when_it_is_back(
    studio: Studio, label_page: Opened, context: BrowserContext
) -> None:
    campaign = studio.add_campaign([True])
    driver = label_page(campaign)
    pair = driver.wait_ready()
    context.set_offline(True)
    driver.press("ArrowLeft")
    driver.page.get_by_text("No connection to the server").wait_for()
    driver.press("z")
    assert driver.wait_ready() == pair
    driver.press("ArrowRight")
    driver.page.get_by_text("3 answers are kept on this device").wait_for()
    context.set_offline(False)
    label, retraction, second = studio.wait_for_labels(campaign, 3)
    assert (label.choice, retraction.supersedes_id) == (Choice.FIRST, label.id)
    assert (second.choice, second.supersedes_id) == (Choice.SECOND, retraction.id)


def test_label_whose_answer_was_lost_is_stored_once(
    studio: Studio, label_page: Opened, page: Page
) -> None:
    campaign = studio.add_campaign([True])
    keys: list[str | None] = []  # of each attempt to send the label

    def lose_the_first_answer(route: Route) -> None:
        keys.append(route.request.headers.get("idempotency-key"))
        if len(keys) == 1:
            route.fetch()  # it arrives, but its answer does not
            route.abort()
        else:
            route.continue_()

    page.route("**/api/v1/labels", lose_the_first_answer)  # an open page's may pass by a new route
    label_page(campaign).press("ArrowLeft")
    studio.wait_for_labels(campaign, 1)
    until(page, "!Object.keys(localStorage).some((key) => key.startsWith('rodif-outbox'))")
    assert len(keys) == 2 and keys[0] == keys[1]
    assert len(studio.labels(campaign)) == 1


def test_label_after_the_session_ended_is_sent_after_signing_in_again(
    studio: Studio, label_page: Opened, context: BrowserContext, page: Page
) -> None:
    campaign = studio.add_campaign([True])
    driver = label_page(campaign)
    context.clear_cookies()
    driver.press("ArrowRight")
    page.locator("#outbox-waiting").get_by_role("link", name="sign in").click()
    assert studio.labels(campaign) == []
    page.get_by_label("Name").fill(driver.name)
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("button", name="Sign in").click()
    assert studio.wait_for_labels(campaign, 1)[0].choice == Choice.SECOND


def test_another_person_on_the_same_device_does_not_send_what_waits(
    studio: Studio, label_page: Opened, context: BrowserContext, page: Page
) -> None:
    campaign = studio.add_campaign([True])
    driver = label_page(campaign)
    context.clear_cookies()
    driver.press("ArrowRight")
    page.locator("#outbox-waiting").get_by_role("link", name="sign in").wait_for()
    sign_in(page, studio, studio.add_annotator(), f"/label/{campaign}")
    # The pair is still leased to the other one, so there is nothing for this one.
    page.locator("[data-nothing]").wait_for()
    assert studio.labels(campaign) == []


def test_phone_shows_both_runs_and_large_buttons(
    studio: Studio, page: Page, label_page: Opened
) -> None:
    page.set_viewport_size({"width": 390, "height": 844})
    driver = label_page(studio.add_campaign([True]))
    driver.wait_state("state.camera !== ''")
    # Where the client says its camera is, the bases, arms and letters of both sides must be seen.
    seen = page.evaluate(
        """async () => {
          const { project } = await import("/static/camera.js");
          const told = new URLSearchParams(state.camera);
          const point = (name) => told.get("initialCamera" + name).split(",").map(Number);
          const camera = { position: point("Position"), lookAt: point("LookAt") };
          const box = document.querySelector("#stage").getBoundingClientRect();
          const things = [];
          for (const x of [-0.48, 0.48]) {
            things.push([x - 0.38, 0, 0], [x - 0.3, 0.1, 0.7]);
            things.push([x + 0.12, -0.49, 0.03], [x + 0.35, 0.4, 0]);
          }
          return things.map((thing) => project(thing, camera, box.width / box.height));
        }"""
    )
    assert all(abs(place["x"]) <= 1 and abs(place["y"]) <= 1 for place in seen), seen
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    for button in page.get_by_role("button").all():
        box = button.bounding_box()
        assert box is not None
        assert box["width"] >= 44 and box["height"] >= 44, button.inner_text()
        assert box["y"] + box["height"] <= 844
    driver.click("A is better")
    assert studio.wait_for_labels(driver.campaign_id, 1)[0].choice == Choice.FIRST


def test_help_lists_the_keys_and_closes(studio: Studio, label_page: Opened) -> None:
    driver = label_page(studio.add_campaign([True]))
    driver.press("?")
    sheet = driver.page.get_by_role("dialog", name="Help and keys")
    sheet.wait_for()
    assert "Undo" in sheet.inner_text()
    driver.press("ArrowLeft")  # keys do not judge through the sheet
    driver.press("Escape")
    sheet.wait_for(state="hidden")
    assert studio.labels(driver.campaign_id) == []


def test_missing_replay_is_reported_and_can_be_tried_again(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign([True])
    page.route("**/replays/*.viser", lambda route: route.fulfill(status=404))
    driver = LabelPage(page, studio, studio.add_annotator())
    driver.open(campaign, ready=False)
    page.get_by_text("The replay is not there").wait_for()
    page.unroute("**/replays/*.viser")
    driver.click("Try again")
    driver.wait_ready()


def test_browser_without_webgl_labels_from_the_moving_picture(
    studio: Studio, playwright: Playwright
) -> None:
    campaign = studio.add_campaign([True])
    flags = [*(flag for flag in CHROMIUM_FLAGS if "swiftshader" not in flag), "--disable-3d-apis"]
    plain = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=flags)
    try:
        driver = LabelPage(plain.new_page(), studio, studio.add_annotator())
        driver.open(campaign)
        picture = driver.page.locator("img.poster")
        assert picture.evaluate("(image) => image.decode().then(() => image.naturalWidth)") == 286
        driver.press("ArrowLeft")
        assert studio.wait_for_labels(campaign, 1)[0].choice == Choice.FIRST
    finally:
        plain.close()
