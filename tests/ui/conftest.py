"""One studio and one Chromium for all browser tests of the room; rows are per test."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, Playwright, sync_playwright

from tests.ui.driving import CHROMIUM_FLAGS, LabelPage
from tests.ui.studio import Studio, running_studio


@pytest.fixture(scope="session")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    with running_studio(tmp_path_factory.mktemp("studio")) as running:
        yield running


@pytest.fixture(scope="session")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as running:
        yield running


@pytest.fixture(scope="session")
def browser(playwright: Playwright) -> Iterator[Browser]:
    executable = shutil.which("chromium")
    assert executable is not None, "these tests need Chromium: apt-get install chromium"
    launched = playwright.chromium.launch(executable_path=executable, args=CHROMIUM_FLAGS)
    yield launched
    launched.close()


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    # Replays then wait for Space: playing them, in software, is most of what these tests would do.
    made = browser.new_context(viewport={"width": 700, "height": 620}, reduced_motion="reduce")
    yield made
    made.close()


@pytest.fixture
def page(context: BrowserContext) -> Page:
    return context.new_page()


@pytest.fixture
def label_page(studio: Studio, page: Page) -> Callable[[int], LabelPage]:
    """Signs a new person in and opens the annotator's page of a campaign."""

    def opened(campaign_id: int) -> LabelPage:
        driver = LabelPage(page, studio, studio.add_annotator())
        driver.open(campaign_id)
        return driver

    return opened
