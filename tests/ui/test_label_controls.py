"""Keys judge only where nothing else has the focus, and every control is within reach."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Page

from server.states import Choice
from server.store.tables import Campaign
from tests.ui.driving import LabelPage, boxes, resize, until
from tests.ui.studio import PASSWORD, Studio

pytestmark = pytest.mark.browser
Opened = Callable[[int], LabelPage]

SIZES = [(390, 664), (390, 844), (844, 390), (1280, 720)]
SENTENCE = "Prefer the run that passes the cylinders on the left and stays far from all of them. "


def test_arrows_in_the_account_menu_do_not_judge(studio: Studio, label_page: Opened) -> None:
    driver = label_page(studio.add_campaign([True]))
    driver.page.get_by_label("Account of").focus()
    driver.press("Enter")
    driver.page.get_by_role("button", name="Sign out").wait_for()
    driver.press("ArrowDown")
    driver.press("Tab")
    driver.press("ArrowDown")
    driver.page.evaluate("document.activeElement.blur()")
    driver.press("ArrowDown")  # the menu is still open
    driver.page.wait_for_timeout(300)
    assert studio.labels(driver.campaign_id) == []
    box = driver.page.locator("#stage").bounding_box()
    assert box is not None
    driver.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    driver.page.get_by_role("button", name="Sign out").wait_for(state="hidden")
    driver.press("ArrowDown")  # the scene has the focus, and the menu is closed
    assert studio.wait_for_labels(driver.campaign_id, 1)[0].choice == Choice.CANNOT_TELL


def test_escape_closes_the_account_menu_and_gives_the_focus_back(
    studio: Studio, page: Page, label_page: Opened
) -> None:
    driver = label_page(studio.add_campaign([True]))
    page.get_by_label("Account of").focus()
    driver.press("Enter")
    driver.press("Tab")
    driver.press("Escape")
    page.get_by_role("button", name="Sign out").wait_for(state="hidden")
    assert page.evaluate("document.activeElement.matches('.menu > summary')")
    assert page.locator("dialog[open]").count() == 0


def test_an_annotator_changes_the_own_password_and_goes_on_labelling(
    studio: Studio, page: Page, label_page: Opened
) -> None:
    driver = label_page(studio.add_campaign([True]))
    page.get_by_label("Account of").click()
    page.get_by_role("button", name="Change password").click()
    dialog = page.get_by_role("dialog", name="Change password")
    dialog.get_by_label("Current password").fill(PASSWORD)
    dialog.get_by_label("New password", exact=True).type("zebra 1 2 3")  # keys of answers
    dialog.get_by_label("New password again").fill("zebra 1 2 4")
    page.keyboard.press("ArrowLeft")
    dialog.get_by_role("button", name="Change password").click()
    dialog.get_by_text("The two new passwords are not the same.").wait_for()
    dialog.get_by_label("New password again").fill("zebra 1 2 3")
    dialog.get_by_role("button", name="Change password").click()
    page.get_by_text("Your password is changed.").wait_for()
    assert studio.labels(driver.campaign_id) == []
    page.evaluate("document.activeElement.blur()")
    driver.press("ArrowDown")
    assert studio.wait_for_labels(driver.campaign_id, 1)[0].choice == Choice.CANNOT_TELL


def test_arrows_on_help_and_on_the_notes_undo_do_not_judge(
    studio: Studio, label_page: Opened
) -> None:
    driver = label_page(studio.add_campaign([True, True]))
    driver.page.get_by_role("button", name="Help and keys").focus()
    driver.press("ArrowDown")
    driver.page.evaluate("document.activeElement.blur()")
    driver.press("ArrowLeft")
    studio.wait_for_labels(driver.campaign_id, 1)
    driver.wait_ready()
    # The note may be gone by now, on a busy machine.
    driver.page.evaluate("document.querySelector('#toast').hidden = false")
    driver.page.locator("#toast").get_by_role("button", name="Undo").focus()
    driver.press("ArrowDown")
    driver.page.wait_for_timeout(300)
    assert [row.choice for row in studio.labels(driver.campaign_id)] == [Choice.FIRST]


def test_arrows_judge_after_a_click_on_help(studio: Studio, label_page: Opened) -> None:
    driver = label_page(studio.add_campaign([True]))
    driver.click("Help and keys")
    driver.click("Back to work")
    driver.press("ArrowLeft")
    studio.wait_for_labels(driver.campaign_id, 1)


def test_key_held_down_judges_one_pair(studio: Studio, label_page: Opened) -> None:
    driver = label_page(studio.add_campaign([True, True]))
    driver.page.keyboard.down("ArrowLeft")
    studio.wait_for_labels(driver.campaign_id, 1)
    driver.wait_ready()
    driver.page.keyboard.down("ArrowLeft")  # the second one is a repetition
    driver.page.wait_for_timeout(300)
    assert len(studio.labels(driver.campaign_id)) == 1


def test_scene_leaves_the_browsers_keys_to_the_browser(studio: Studio, label_page: Opened) -> None:
    driver = label_page(studio.add_campaign([True]))
    swallowed = driver.page.evaluate(
        """() => {
          const scene = document.querySelector("iframe.replay").contentWindow;
          const keys = ["F5", "F11", "F12", "Escape", "Tab", "x", "ArrowUp", " ", "Z", "2"];
          return keys.filter((key) => {
            const init = { key, cancelable: true, bubbles: true, repeat: true };
            const event = new scene.KeyboardEvent("keydown", init);
            scene.document.body.dispatchEvent(event);
            return event.defaultPrevented;
          });
        }"""
    )
    assert swallowed == ["ArrowUp", " ", "Z", "2"]


def test_undo_stays_in_reach_after_its_note_is_gone(
    studio: Studio, page: Page, label_page: Opened
) -> None:
    campaign = studio.add_campaign([True, True])
    driver = label_page(campaign)
    pair = driver.wait_ready()
    button = page.get_by_role("button", name="Undo the last answer")
    assert not button.is_enabled()
    driver.click("A is better")
    studio.wait_for_labels(campaign, 1)
    driver.wait_ready()
    page.locator("#toast").wait_for(state="hidden")
    for width, height in SIZES:
        resize(page, width, height)
        (box,) = boxes(page, "#undo")
        assert box["width"] >= 44 and box["height"] >= 44 and box["on_top"], (width, height)
    button.click()
    assert driver.wait_ready() == pair
    assert studio.wait_for_labels(campaign, 2)[1].retracted
    assert not button.is_enabled()
    driver.press("ArrowRight")  # the mouse has left the button: the arrow judges
    studio.wait_for_labels(campaign, 3)


@pytest.mark.parametrize("length", [400, 1500, 10_000])
def test_answers_and_runs_stay_in_sight_however_long_the_criterion(
    studio: Studio, page: Page, length: int
) -> None:
    campaign = studio.add_campaign([True])
    with studio.database.write() as session:
        session.get_one(Campaign, campaign).criterion = (SENTENCE * 150)[:length]
    driver = LabelPage(page, studio, studio.add_annotator())
    driver.open(campaign, ready=False)
    for width, height in SIZES:
        resize(page, width, height)
        choices = boxes(page, ".choice")
        assert len(choices) == 4
        for box in choices:
            assert box["x"] >= 0 and box["x"] + box["width"] <= width
            assert box["y"] >= 0 and box["y"] + box["height"] <= height, (width, height)
        (stage,) = boxes(page, "#stage")
        assert stage["height"] >= 0.33 * height, (width, height)
        text = page.locator(".criterion")
        until(page, "document.querySelector('.criterion').clientHeight >= 60")
        assert text.evaluate("(box) => box.scrollWidth <= box.clientWidth")
