"""The page of campaigns, people and tokens in a real Chromium."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from playwright.sync_api import Page
from sqlalchemy import select

from server.bootstrap import register_checkpoint
from server.store.tables import Campaign, Checkpoint
from tests.ui.driving import sign_in
from tests.ui.studio import Studio, task_facts
from worker.cli.client import ApiError, Client

pytestmark = pytest.mark.browser


def test_token_made_on_the_page_opens_the_api_until_it_is_revoked(
    studio: Studio, page: Page
) -> None:
    sign_in(page, studio, "admin", "/admin")
    name = studio.new_name("script")
    page.get_by_role("button", name="New token").click()
    page.get_by_label("What it is for").fill(name)
    page.get_by_role("button", name="Make token").click()
    shown = page.get_by_role("dialog", name=f"Token “{name}”")
    token = shown.locator("code").inner_text()
    with Client(studio.url, token) as api:
        assert api.get("/me")["name"] == "admin"
        shown.get_by_role("button", name="Close").click()
        shown.wait_for(state="detached")
        row = page.locator("#tokens tr", has_text=name)
        assert token not in page.content(), "the secret is shown once"
        row.get_by_role("button", name="Revoke").click()
        page.get_by_role("dialog").get_by_role("button", name="Revoke").click()
        row.wait_for(state="detached")
        with pytest.raises(ApiError) as refused:
            api.get("/me")
    assert refused.value.status == 401


def test_password_with_spaces_around_it_signs_in_as_it_was_typed(
    studio: Studio, page: Page
) -> None:
    sign_in(page, studio, "admin", "/admin")
    name, passwords = studio.new_name("spaced"), ("  first one ", " second one  ")
    page.get_by_role("button", name="New account").click()
    page.get_by_label("Name").fill(f" {name} ")
    page.get_by_role("dialog").get_by_label("Password").fill(passwords[0])
    page.get_by_role("button", name="Create").click()
    row = page.locator("#people tr", has_text=name)
    row.get_by_role("button", name="Password").wait_for()
    with Client(studio.url) as person:
        person.sign_in(name, passwords[0])
    row.get_by_role("button", name="Password").click()
    page.get_by_role("dialog").get_by_label("Password").fill(passwords[1])
    page.get_by_role("button", name="Set password").click()
    page.get_by_role("dialog").wait_for(state="detached")
    with Client(studio.url) as person:
        person.sign_in(name, passwords[1])
        with pytest.raises(ApiError):
            person.sign_in(name, passwords[1].strip())


def test_another_task_proposes_its_own_criterion_unless_one_was_written(
    studio: Studio, page: Page
) -> None:
    with studio.database.write() as session:
        register_checkpoint(
            session,
            datetime.now(UTC),
            studio.artifacts,
            task="pushing",
            name="pushing-pretrained",
            blob=b"other weights",
            digest="2" * 64,
            config={"task_facts": task_facts() | {"criterion": "Red to red first."}},
            metrics={},
            code_version="test",
        )
    sign_in(page, studio, "admin", "/admin")
    page.get_by_role("button", name="New campaign").click()
    dialog = page.get_by_role("dialog", name="New campaign")
    criterion = dialog.get_by_label("What annotators are asked")
    dialog.get_by_label("Robot task").select_option("pushing")
    assert criterion.input_value() == "Red to red first."
    dialog.get_by_label("Robot task").select_option("avoid")
    assert "cylinder" in criterion.input_value()
    criterion.fill("My own words.")
    dialog.get_by_label("Robot task").select_option("pushing")
    assert criterion.input_value() == "My own words."


def test_new_campaign_starts_from_the_policy_that_was_chosen(studio: Studio, page: Page) -> None:
    name = studio.new_name("mine")
    with studio.database.write() as session:
        older = session.scalars(select(Checkpoint).where(Checkpoint.task == "avoid")).all()[-1]
        newest = register_checkpoint(
            session,
            datetime.now(UTC),
            studio.artifacts,
            task="avoid",
            name=name,
            blob=name.encode(),
            digest="3" * 64,
            config={"task_facts": task_facts()},
            metrics={},
            code_version="test",
        )
    sign_in(page, studio, "admin", "/admin")
    page.get_by_role("button", name="New campaign").click()
    dialog = page.get_by_role("dialog", name="New campaign")
    start = dialog.get_by_label("Policy to start from")
    dialog.get_by_label("Robot task").select_option("avoid")
    assert start.locator("option").first.inner_text() == f"{name} (newest pretrained)"
    assert start.input_value() == str(newest.id)
    start.locator(f'option[value="{older.id}"]').wait_for(state="attached")
    start.select_option(str(older.id))
    campaign = studio.new_name("campaign")
    dialog.get_by_label("Name").fill(campaign)
    dialog.get_by_role("button", name="Create").click()
    page.get_by_role("heading", name=campaign).wait_for()
    with studio.database.read() as session:
        made = session.scalars(select(Campaign).where(Campaign.name == campaign)).one()
    assert made.start_checkpoint_id == made.published_checkpoint_id == older.id


def test_campaigns_and_people_stay_on_the_page_when_the_server_does_not_answer(
    studio: Studio, page: Page
) -> None:
    campaign, errors = studio.add_campaign(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    sign_in(page, studio, "admin", "/admin")
    page.locator("#tokens").locator("table, .empty").first.wait_for()
    page.route("**/api/v1/**", lambda route: route.abort())
    card = page.locator(f'a[href="/admin/campaigns/{campaign}"]')
    for name in ("New campaign", "New account"):
        page.get_by_role("button", name=name).click()
        page.keyboard.press("Escape")  # the new account's dialog opens, the new campaign's does not
        page.locator("#toast").get_by_text("The server cannot be reached.").wait_for()
        page.evaluate("document.querySelector('#toast').remove()")
        assert card.is_visible()
    assert errors == []
