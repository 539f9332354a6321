"""How the tests drive the pages: the hands and eyes of a person, and some waiting."""

from __future__ import annotations

import time
from typing import Any

from playwright.sync_api import Page

from tests.ui.studio import PASSWORD, Studio

CHROMIUM_FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
PATIENCE = 60.0  # s; software rendering on a busy machine


def until(page: Page, expression: str, seconds: float = PATIENCE) -> Any:
    """Wait until the JavaScript expression is truthy; returns its value.

    Playwright's own waiting evaluates text inside the page, which the pages' policy forbids.
    """
    deadline = time.monotonic() + seconds
    while not (value := page.evaluate(expression)):
        assert time.monotonic() < deadline, f"never became true: {expression}"
        page.wait_for_timeout(50)
    return value


def resize(page: Page, width: int, height: int) -> None:
    """Give the page this size, and wait until it has it."""
    page.set_viewport_size({"width": width, "height": height})
    until(page, f"innerWidth === {width} && innerHeight === {height}")


def boxes(page: Page, selector: str) -> list[dict[str, Any]]:
    """{x, y, width, height, on_top} of all that match: pixels, and whether the middle is on the
    screen with nothing over it.

    One call, where Playwright's own boxes wait for a frame each, which software renders slowly.
    """
    found: list[dict[str, Any]] = page.evaluate(
        """(selector) => [...document.querySelectorAll(selector)].map((one) => {
          const { x, y, width, height } = one.getBoundingClientRect();
          const top = document.elementFromPoint(x + width / 2, y + height / 2);
          return { x, y, width, height, on_top: one.contains(top) };
        })""",
        selector,
    )
    assert found, selector
    return found


def sign_in(page: Page, studio: Studio, name: str, path: str) -> None:
    """Go to `path`, be sent to the sign-in page, sign in, and be sent back."""
    page.goto(studio.url + path)
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("button", name="Sign in").click()
    page.wait_for_url(studio.url + path)


def take_session(page: Page, studio: Studio, name: str) -> None:
    """Give the browser a session without the sign-in page, which has tests of its own."""
    answer = page.request.post(
        f"{studio.url}/api/v1/session",
        data={"name": name, "password": PASSWORD},
        headers={"Origin": studio.url},
    )
    assert answer.ok, answer.text()


class LabelPage:
    """The annotator's page of one campaign."""

    def __init__(self, page: Page, studio: Studio, name: str) -> None:
        self.page, self.studio, self.name = page, studio, name

    def open(self, campaign_id: int, *, ready: bool = True) -> None:
        """As this person; a small picture keeps software rendering fast."""
        self.campaign_id = campaign_id
        self.path = f"/label/{campaign_id}"
        take_session(self.page, self.studio, self.name)
        self.reload(ready=ready)

    def reload(self, *, ready: bool = True) -> None:
        """Load the page again."""
        self.page.goto(f"{self.studio.url}{self.path}?fixedDpr=0.3")
        # What the replay on stage says about itself, for the tests to look at.
        self.page.evaluate(
            """window.addEventListener("message", (event) => {
              const front = document.querySelector(".replay:not(.waiting)");
              const fromFront = front && event.source === front.contentWindow;
              if (event.data.kind === "replay-state" && fromFront) window.state = event.data;
            })"""
        )
        if ready:
            self.wait_ready()

    def wait_ready(self) -> int:
        """Until a pair is on stage and can be judged; returns its id."""
        self.page.locator('[data-choice="left"]:enabled').wait_for(timeout=1000 * PATIENCE)
        self.page.wait_for_timeout(400)  # a key is not accepted right after the change of pairs
        return int(until(self.page, "document.querySelector('#stage').dataset.pairId"))

    def press(self, key: str) -> None:
        """One key stroke."""
        self.page.keyboard.press(key)

    def click(self, name: str) -> None:
        """A button by its accessible name."""
        self.page.get_by_role("button", name=name, exact=True).click()

    def state(self) -> dict[str, Any]:
        """The newest state of the replay on stage."""
        found: dict[str, Any] = until(self.page, "window.state")
        return found

    def wait_state(self, condition: str) -> dict[str, Any]:
        """Until `condition`, in terms of `state`, holds; returns the state."""
        until(self.page, f"window.state && {condition}")
        return self.state()
