"""The campaign page in a real Chromium: buttons do what they say, and rounds are seen live."""

from __future__ import annotations

import math
from datetime import UTC, datetime

import pytest
from playwright.sync_api import Page
from sqlalchemy import select

from server import campaigns, publications, rounds
from server.labeling import ScreenChoice
from server.states import JobKind, JobState, PairState, PublishRule, Role, RoundState
from server.store import jobs
from server.store.events import add_event
from server.store.tables import Campaign, Checkpoint, Job, Pair, Publication, Round
from tests.ui.driving import sign_in, until
from tests.ui.rounds import WorkerStandIn, evaluation, label_all
from tests.ui.studio import PASSWORD, Studio

pytestmark = pytest.mark.browser


def open_campaign(page: Page, studio: Studio, campaign_id: int) -> None:
    """Sign in as admin and open the campaign's page."""
    page.set_viewport_size({"width": 1200, "height": 800})
    sign_in(page, studio, "admin", f"/admin/campaigns/{campaign_id}")
    page.locator(".tile").first.wait_for()


def confirm(page: Page, name: str) -> None:
    """The dialog's button, and the dialog gone."""
    dialog = page.get_by_role("dialog")
    dialog.get_by_role("button", name=name).click()
    dialog.wait_for(state="detached")


def tile(page: Page, name: str) -> str:
    """The figure on a tile."""
    return page.locator(".tile", has_text=name).locator(".value").first.inner_text()


def test_new_campaign_is_made_in_the_dialog_and_opened(studio: Studio, page: Page) -> None:
    sign_in(page, studio, "admin", "/admin")
    page.get_by_role("button", name="New campaign").click()
    dialog = page.get_by_role("dialog", name="New campaign")
    name = studio.new_name("by dialog")
    dialog.get_by_label("Name").fill(name)
    criterion = dialog.get_by_label("What annotators are asked")
    assert "cylinder" in criterion.input_value(), "the task's own criterion is the proposal"
    criterion.fill("Stay far from the cylinders.")
    dialog.get_by_label("Labels per pair").fill("2")
    dialog.get_by_role("button", name="Create").click()
    page.get_by_role("heading", name=name).wait_for()
    with studio.database.read() as session:
        made = session.scalars(select(Campaign).where(Campaign.name == name)).one()
    assert made.criterion == "Stay far from the cylinders."
    assert made.settings["labels_per_pair"] == 2
    assert page.url.endswith(f"/admin/campaigns/{made.id}")


def test_name_that_is_taken_is_refused_in_the_dialog(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign()
    with studio.database.read() as session:
        name = session.get_one(Campaign, campaign).name
    sign_in(page, studio, "admin", "/admin")
    page.get_by_role("button", name="New campaign").click()
    page.get_by_label("Name").fill(name)
    page.get_by_role("button", name="Create").click()
    assert name in page.get_by_role("dialog").get_by_role("alert").inner_text()


def test_collect_button_queues_the_job_with_the_numbers_asked_for(
    studio: Studio, page: Page
) -> None:
    campaign = studio.add_campaign()
    open_campaign(page, studio, campaign)
    page.get_by_role("button", name="Collect runs").click()
    page.get_by_label("Runs", exact=True).fill("12")
    page.get_by_label("Pairs", exact=True).fill("7")
    confirm(page, "Collect")
    page.get_by_role("heading", name="Collecting runs of the published policy").wait_for()
    with studio.database.read() as session:
        wanted = select(Job).where(Job.campaign_id == campaign, Job.state == JobState.QUEUED)
        job = session.scalars(wanted).one()
    assert job.kind == JobKind.COLLECT
    assert (job.payload["episodes"], job.payload["pairs"]) == (12, 7)


def test_round_without_labels_is_refused_with_the_servers_words(studio: Studio, page: Page) -> None:
    open_campaign(page, studio, studio.add_campaign([True]))
    page.get_by_role("button", name="Start round").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_role("button", name="Start round").click()
    assert "label" in dialog.get_by_role("alert").inner_text()
    dialog.get_by_role("button", name="Cancel").click()


def test_round_is_followed_live_published_and_rolled_back(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign([True, False, True])
    label_all(studio, campaign, studio.add_annotator(), ScreenChoice.LEFT)
    open_campaign(page, studio, campaign)
    assert tile(page, "Labels") == "3"
    page.get_by_role("button", name="Start round").click()
    page.get_by_label("Conservativeness").fill("0.35")
    confirm(page, "Start round")

    live = page.locator(".live")
    live.get_by_text("is running").wait_for()
    with studio.database.read() as session:
        this = session.scalars(select(Round).where(Round.campaign_id == campaign)).one()
        start = session.get_one(Campaign, campaign).published_checkpoint_id
    assert this.config["conservativeness"] == 0.35

    worker = WorkerStandIn(studio, this.id)
    worker.start()
    live.locator("li.now", has_text="Fine-tuning").wait_for()
    worker.progress("score", 0.25, loss=1.5, mean_vote=0.5)
    worker.progress("score", 0.5, loss=math.exp(-1), mean_vote=0.6)
    live.get_by_text("scoring the labelled runs · 50 %").wait_for()
    page.locator("#loss-chart .scatterlayer .trace").first.wait_for()
    page.locator("#vote-chart .scatterlayer .trace").first.wait_for()

    candidate = worker.finish(evaluation(22, 70, 8), evaluation(91, 3, 6))
    page.locator("#rounds").get_by_text("published").wait_for()
    live.wait_for(state="detached")
    page.locator(".tile", has_text="Alignment, published").get_by_text("91 %").wait_for()
    page.locator("#rounds").get_by_text("22 % → 91 %").wait_for()
    page.locator("#behaviour svg").nth(1).wait_for()
    before, after = page.locator("#behaviour svg").all()
    lefts = 'polyline[data-group="left"]'
    assert (before.locator(lefts).count(), after.locator(lefts).count()) == (22, 91)
    assert before.locator("circle").count() == 7  # six cylinders and the start

    page.locator(f'[data-checkpoint="{candidate}"]').get_by_role("button", name="Lineage").click()
    story = page.get_by_role("dialog", name="Lineage").inner_text()
    assert "3 labels" in story and "pretrained, no labels behind it" in story
    page.get_by_role("dialog").get_by_role("button", name="Close").click()

    page.get_by_role("button", name="Roll back").click()
    page.get_by_label("Reason").fill("looked odd on the robot")
    confirm(page, "Roll back")
    published = page.locator(f'[data-checkpoint="{start}"]').get_by_text("published")
    published.wait_for()
    with studio.database.read() as session:
        assert session.get_one(Campaign, campaign).published_checkpoint_id == start
        last = session.scalars(select(Publication).order_by(Publication.id.desc())).first()
    assert last is not None
    assert (last.action, last.reason) == ("rollback", "looked odd on the robot")

    page.locator(f'[data-checkpoint="{candidate}"]').get_by_role("button", name="Publish").click()
    confirm(page, "Publish")
    page.locator(f'[data-checkpoint="{candidate}"]').get_by_text("published").wait_for()
    with studio.database.read() as session:
        assert session.get_one(Campaign, campaign).published_checkpoint_id == candidate


def test_running_round_can_be_cancelled(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign([True])
    label_all(studio, campaign, studio.add_annotator(), ScreenChoice.LEFT)
    open_campaign(page, studio, campaign)
    page.get_by_role("button", name="Start round").click()
    confirm(page, "Start round")
    page.locator(".live").get_by_role("button", name="Cancel").click()
    confirm(page, "Cancel round")
    page.locator("#rounds").get_by_text("cancelled").wait_for()


def test_failed_job_shows_its_error_and_is_queued_again_on_retry(
    studio: Studio, page: Page
) -> None:
    campaign = studio.add_campaign([True])
    label_all(studio, campaign, studio.add_annotator(), ScreenChoice.LEFT)
    open_campaign(page, studio, campaign)
    page.get_by_role("button", name="Start round").click()
    confirm(page, "Start round")
    page.locator(".live").wait_for()
    with studio.database.write() as session:
        this = session.scalars(select(Round).where(Round.campaign_id == campaign)).one()
        job = session.scalars(select(Job).where(Job.round_id == this.id)).one()
        job.state, job.error = JobState.FAILED, "no space left on the disk"
        rounds.move(session, datetime.now(UTC), this.id, RoundState.FAILED, error="disk")
    page.locator("#jobs").get_by_text("no space left on the disk").wait_for()
    page.locator("#jobs").get_by_role("button", name="Retry").click()
    page.get_by_text(f"Job {job.id} is queued again.").wait_for()
    with studio.database.read() as session:
        assert session.get_one(Job, job.id).state == JobState.QUEUED


def test_pairs_and_annotators_are_shown(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign([True, False])
    name = studio.add_annotator()
    label_all(studio, campaign, name, ScreenChoice.LEFT)
    open_campaign(page, studio, campaign)
    row = page.locator("#annotators tr", has_text=name).inner_text()
    assert "100 %" in row  # always the left side
    pictures = page.locator("#pairs img")
    assert pictures.count() == 2
    loaded = "[...document.querySelectorAll('#pairs img')].every((image) => image.naturalWidth)"
    pictures.first.scroll_into_view_if_needed()
    until(page, loaded)


def test_an_admin_watches_a_pair_and_sees_who_answered_what(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign([True, False])
    name = studio.add_annotator()
    label_all(studio, campaign, name, ScreenChoice.LEFT)
    page.emulate_media(reduced_motion="no-preference")
    open_campaign(page, studio, campaign)
    page.get_by_role("button", name="Watch pair").first.click()
    dialog = page.get_by_role("dialog", name="Pair")
    answer = dialog.locator("#watch-answers tr", has_text=name)
    assert "A is better" in answer.inner_text() and "yes" in answer.inner_text()
    runs = dialog.locator("#watch-runs tbody tr")
    assert runs.count() == 2 and runs.nth(0).inner_text().startswith("A")
    until(page, "document.querySelector('#clock').textContent.includes('/ 0.0') === false")
    clock = dialog.locator("#clock").inner_text()
    until(page, f"document.querySelector('#clock').textContent !== {clock!r}")  # it plays
    page.keyboard.press("r")
    dialog.get_by_role("button", name="Pause").click()
    dialog.get_by_role("button", name="Top").click()
    assert dialog.get_by_role("button", name="Top").get_attribute("aria-pressed") == "true"
    dialog.get_by_role("button", name="Close").focus()
    page.keyboard.press("Space")  # presses the button, and plays nothing
    dialog.wait_for(state="hidden")
    assert page.locator("iframe").count() == 0


def test_annotators_are_kept_out_of_the_admin_pages(studio: Studio, page: Page) -> None:
    name = studio.add_annotator(Role.ANNOTATOR)
    page.goto(f"{studio.url}/admin")
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("button", name="Sign in").click()
    page.wait_for_url("**/label*")
    page.goto(f"{studio.url}/admin")
    assert "/label" in page.url


def test_sign_out_ends_the_session(studio: Studio, page: Page) -> None:
    sign_in(page, studio, studio.add_annotator(), "/label")
    page.get_by_label("Account of").click()
    page.get_by_role("button", name="Sign out").click()
    page.wait_for_url(f"{studio.url}/sign-in")
    page.goto(f"{studio.url}/label")
    assert "/sign-in" in page.url


def test_settings_are_changed_in_the_dialog(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign()
    open_campaign(page, studio, campaign)
    page.get_by_role("button", name="Settings").click()
    page.get_by_label("What annotators are asked").fill("Slow is better.")
    page.get_by_label("Start a round by itself").fill("40")
    confirm(page, "Save")
    page.get_by_text("Slow is better.").wait_for()
    with studio.database.read() as session:
        row = session.get_one(Campaign, campaign)
    assert row.criterion == "Slow is better."
    assert row.settings["round_after_labels"] == 40


def test_settings_that_another_admin_changes_meanwhile_are_kept(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign()
    open_campaign(page, studio, campaign)
    page.get_by_role("button", name="Settings").click()
    page.get_by_label("Start a round by itself").fill("40")
    with studio.database.write() as session:
        row = session.get_one(Campaign, campaign)
        row.settings = row.settings | {"publish_rule": "manual", "labels_per_pair": 3}
        expected = row.settings | {"round_after_labels": 40}
    confirm(page, "Save")
    with studio.database.read() as session:
        assert session.get_one(Campaign, campaign).settings == expected


def test_settings_are_stored_beside_a_criterion_that_ends_in_a_new_line(
    studio: Studio, page: Page
) -> None:
    campaign, stored = studio.add_campaign([True]), "Prefer left.\r\nSlowly.\n"
    with studio.database.write() as session:
        session.get_one(Campaign, campaign).criterion = stored
    label_all(studio, campaign, studio.add_annotator(), ScreenChoice.LEFT)
    open_campaign(page, studio, campaign)
    page.get_by_role("button", name="Settings").click()
    page.get_by_label("Start a round by itself").fill("40")
    confirm(page, "Save")
    with studio.database.read() as session:
        row = session.get_one(Campaign, campaign)
    assert (row.criterion, row.settings["round_after_labels"]) == (stored, 40)


def test_new_account_can_sign_in_until_it_is_deactivated(studio: Studio, page: Page) -> None:
    sign_in(page, studio, "admin", "/admin")
    name = studio.new_name("guest")
    page.get_by_role("button", name="New account").click()
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill("short")
    page.get_by_role("button", name="Create").click()
    assert "8" in page.get_by_role("dialog").get_by_role("alert").inner_text()
    page.get_by_label("Password").fill(PASSWORD)
    confirm(page, "Create")
    row = page.locator("#people tr", has_text=name)
    guest = page.context.browser.new_context().new_page()  # type: ignore[union-attr]
    sign_in(guest, studio, name, "/label")
    row.get_by_role("button", name="Deactivate").click()
    confirm(page, "Deactivate")
    row.get_by_text("deactivated").wait_for()
    guest.goto(f"{studio.url}/label")
    assert "/sign-in" in guest.url
    guest.context.close()


def test_focus_and_elements_stay_where_they_are_while_the_page_refreshes(
    studio: Studio, page: Page
) -> None:
    campaign = studio.add_campaign([True, False, True])
    name = studio.add_annotator()
    label_all(studio, campaign, name, ScreenChoice.LEFT, at_most=1)
    open_campaign(page, studio, campaign)
    page.get_by_role("button", name="Start round").click()
    confirm(page, "Start round")
    live = page.locator(".live")
    cancel = live.get_by_role("button", name="Cancel")
    cancel.wait_for()
    with studio.database.read() as session:
        this = session.scalars(select(Round).where(Round.campaign_id == campaign)).one()
    lineage = page.locator("#checkpoints").get_by_role("button", name="Lineage").first
    for button in (cancel, lineage):
        button.focus()
        button.evaluate("button => { window.before = button; }")
        worker = WorkerStandIn(studio, this.id)
        if button is cancel:
            worker.start()
            page.locator("#live-state").get_by_text(f"Round {this.id}: Fine-tuning.").wait_for()
        else:
            worker.job_id = studio_job(studio, this.id)
            worker.progress("score", 0.5)
            live.get_by_text("scoring the labelled runs · 50 %").wait_for()
            page.locator("#jobs").get_by_text("scoring the labelled runs").wait_for()
        assert page.evaluate("document.activeElement === window.before")
    assert page.locator("#live").get_attribute("aria-live") is None


def studio_job(studio: Studio, round_id: int) -> int:
    """The fine-tuning of a round."""
    with studio.database.read() as session:
        return session.scalars(select(Job.id).where(Job.round_id == round_id)).one()


def test_a_label_event_fetches_the_figures_only_and_no_history_is_told_again(
    studio: Studio, page: Page
) -> None:
    campaign = studio.add_campaign([True, False])
    name = studio.add_annotator()
    label_all(studio, campaign, name, ScreenChoice.LEFT, at_most=1)
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url.split("/api/v1/")[-1]))
    open_campaign(page, studio, campaign)
    page.wait_for_timeout(1500)  # what the first drawing leads to is over
    assert f"campaigns/{campaign}/events?after=now" in asked
    assert len([path for path in asked if path.endswith("/stats")]) == 1
    asked.clear()
    label_all(studio, campaign, name, ScreenChoice.LEFT)
    until(page, "document.querySelectorAll('.tile .value')[2].textContent === '2'")
    assert asked == [f"campaigns/{campaign}/stats"]


def test_what_cannot_be_published_is_not_offered_and_what_can_be_rolled_back_is(
    studio: Studio, page: Page
) -> None:
    other = studio.add_campaign([True])
    label_all(studio, other, studio.add_annotator(), ScreenChoice.LEFT)
    now = datetime.now(UTC)
    with studio.database.write() as session:
        request = rounds.RoundRequest(publish_rule=PublishRule.NEVER)
        compared = rounds.launch(session, now, other, request).id
    worker = WorkerStandIn(studio, compared)
    worker.start()
    comparison = worker.finish(evaluation(22, 70, 8), evaluation(91, 3, 6))
    campaign = studio.add_campaign()
    with studio.database.write() as session:
        start = session.get_one(Campaign, campaign).start_checkpoint_id
        row = session.get_one(Checkpoint, comparison)
        start_name = session.get_one(Checkpoint, start).name  # other tests add newer ones
        second = Checkpoint(
            task=row.task,
            name=studio.new_name("second"),
            digest="2" * 64,
            artifact_sha256="0" * 64,
            parent_id=start,
            config=dict(row.config),
            metrics={},
            code_version="test",
            created_at=now,
        )
        session.add(second)
        session.flush()
        for checkpoint_id in (second.id, start):  # the start once more, which is no rollback
            publications.publish(
                session, now, campaign_id=campaign, checkpoint_id=checkpoint_id, reason="", by=None
            )
    open_campaign(page, studio, campaign)
    shown = page.locator(f'[data-checkpoint="{comparison}"]')
    shown.get_by_text("comparison", exact=True).wait_for()
    assert shown.get_by_role("button", name="Publish").count() == 0
    page.get_by_role("button", name="Roll back").click()
    page.get_by_role("dialog", name=f"Roll back to {second.name}?").wait_for()
    confirm(page, "Roll back")
    page.locator(f'[data-checkpoint="{second.id}"]').get_by_text("published").wait_for()
    page.get_by_role("button", name="Roll back").click()
    dialog = page.get_by_role("dialog", name=f"Roll back to {start_name}?")
    dialog.wait_for()
    with studio.database.write() as session:  # somebody else is quicker
        publications.publish(
            session, now, campaign_id=campaign, checkpoint_id=start, reason="", by=None
        )
    dialog.get_by_role("button", name="Roll back").click()
    refusal = f"would now publish checkpoint {second.id}, not {start}"
    dialog.get_by_role("alert").get_by_text(refusal).wait_for()
    dialog.get_by_role("button", name="Cancel").click()
    page.locator(f'[data-checkpoint="{start}"]').get_by_text("published").wait_for()
    for target in (second.id, start):
        page.get_by_role("button", name="Roll back").click()
        confirm(page, "Roll back")
        page.locator(f'[data-checkpoint="{target}"]').get_by_text("published").wait_for()
    page.locator("#rollback:disabled").wait_for()


@pytest.mark.parametrize(
    ("rule", "told"),
    [
        (PublishRule.NEVER, "The gate passed · for comparison, never published"),
        (PublishRule.MANUAL, "The gate passed · kept for an admin to publish"),
    ],
)
def test_page_says_of_a_kept_candidate_whether_it_can_be_published(
    studio: Studio, page: Page, rule: PublishRule, told: str
) -> None:
    campaign = studio.add_campaign([True])
    label_all(studio, campaign, studio.add_annotator(), ScreenChoice.LEFT)
    with studio.database.write() as session:
        request = rounds.RoundRequest(publish_rule=rule)
        this = rounds.launch(session, datetime.now(UTC), campaign, request).id
    worker = WorkerStandIn(studio, this)
    worker.start()
    candidate = worker.finish(evaluation(22, 70, 8), evaluation(91, 3, 6))
    open_campaign(page, studio, campaign)
    page.locator("#behaviour .gate").get_by_text(told).wait_for()
    offered = page.locator(f'[data-checkpoint="{candidate}"]').get_by_role("button", name="Publish")
    assert offered.count() == (0 if rule is PublishRule.NEVER else 1)


def test_figures_of_a_policy_come_from_its_measurement_of_most_runs(
    studio: Studio, page: Page
) -> None:
    campaign = studio.add_campaign([True])
    label_all(studio, campaign, studio.add_annotator(), ScreenChoice.LEFT)
    for before in (evaluation(22, 70, 8), evaluation(3, 4, 3)):  # the newest one is the smallest
        with studio.database.write() as session:
            request = rounds.RoundRequest(publish_rule=PublishRule.MANUAL)
            this = rounds.launch(session, datetime.now(UTC), campaign, request).id
        worker = WorkerStandIn(studio, this)
        worker.start()
        worker.finish(before, evaluation(9, 1, 0))
    open_campaign(page, studio, campaign)
    assert tile(page, "Success, published") == "92 %"
    assert "n = 100" in page.locator(".tile", has_text="Success, published").inner_text()


def test_page_says_why_a_round_learned_nothing(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign([True])
    label_all(studio, campaign, studio.add_annotator(), ScreenChoice.LEFT)
    with studio.database.write() as session:
        this = rounds.launch(session, datetime.now(UTC), campaign, rounds.RoundRequest()).id
    worker, same = WorkerStandIn(studio, this), evaluation(22, 70, 8)
    worker.start()
    worker.finish(same, same, unchanged="dead gradient: use a conservativeness below 0.5")
    open_campaign(page, studio, campaign)
    said = page.locator("#behaviour .gate")
    said.get_by_text("The gate passed · not published, nothing was learned").wait_for()
    said.get_by_text("Fine-tuning: dead gradient: use a conservativeness below 0.5").wait_for()


def test_a_campaign_is_renamed_archived_and_taken_back(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign()
    open_campaign(page, studio, campaign)
    name = studio.new_name("renamed")
    page.get_by_role("button", name="Settings").click()
    page.get_by_label("Name", exact=True).fill(name)
    page.get_by_label("Campaign", exact=True).select_option("archived")
    confirm(page, "Save")
    page.get_by_role("heading", name=name).wait_for()
    page.locator("#archived").get_by_text("archived").wait_for()
    assert page.locator(".crumb").last.inner_text() == name
    assert page.title() == f"{name} · RoDiF Studio"
    for refused in ("Collect runs", "Start round"):
        assert page.get_by_role("button", name=refused).is_disabled()
    page.goto(f"{studio.url}/admin")
    page.locator("#people tr").first.wait_for()
    assert page.get_by_role("heading", name=name).count() == 0
    page.get_by_label("Show archived").check()
    page.get_by_role("heading", name=name).click()
    page.get_by_role("button", name="Settings").click()
    page.get_by_label("Campaign", exact=True).select_option("in use")
    confirm(page, "Save")
    page.locator("#archived").wait_for(state="hidden")
    assert page.get_by_role("button", name="Collect runs").is_enabled()
    with studio.database.read() as session:
        row = session.get_one(Campaign, campaign)
    assert (row.name, row.archived) == (name, False)


def test_a_checkpoint_is_downloaded_from_its_row(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign()
    open_campaign(page, studio, campaign)
    with studio.database.read() as session:
        start = session.get_one(Checkpoint, session.get_one(Campaign, campaign).start_checkpoint_id)
    with page.expect_download() as started:
        page.get_by_role("link", name=f"Download {start.name}").click()
    assert started.value.suggested_filename == f"{start.name}.safetensors"
    assert started.value.path().read_bytes() == studio.artifacts.get(start.artifact_sha256)


def test_a_collection_is_cancelled_on_its_card_and_a_replay_in_its_row(
    studio: Studio, page: Page
) -> None:
    campaign = studio.add_campaign([True], replays=False)
    now = datetime.now(UTC)
    with studio.database.write() as session:
        pair = session.scalars(select(Pair).where(Pair.campaign_id == campaign)).one()
        replay = jobs.enqueue(
            session,
            now,
            kind=JobKind.REPLAY,
            campaign_id=campaign,
            payload={},
            pair_id=pair.id,
        ).id
        collect = campaigns.start_collect(session, now, campaign, {}, by=1).id
    open_campaign(page, studio, campaign)
    live = page.locator(".live")
    live.get_by_role("button", name="Cancel").click()
    assert "The runs that are stored stay." in page.get_by_role("dialog").inner_text()
    confirm(page, "Cancel job")
    live.wait_for(state="detached")
    page.locator(f'[data-job="{replay}"]').get_by_role("button", name="Cancel").click()
    confirm(page, "Cancel job")
    page.locator(f'[data-job="{replay}"]').wait_for(state="detached")
    with studio.database.read() as session:
        states = {number: session.get_one(Job, number).state for number in (collect, replay)}
        assert states == {collect: JobState.CANCELLED, replay: JobState.CANCELLED}
        assert session.get_one(Pair, pair.id).state == PairState.FAILED


def test_running_work_is_seen_however_much_has_failed_and_its_row_moves_with_its_card(
    studio: Studio, page: Page
) -> None:
    campaign, now = studio.add_campaign([True]), datetime.now(UTC)
    with studio.database.write() as session:
        collect = campaigns.start_collect(session, now, campaign, {}, by=1)
        collect.state, collect.stage, collect.progress = JobState.RUNNING, "rollouts", 0.25
        collect.attempt, collect.started_at = 1, now
        for _ in range(25):
            failed = {"state": JobState.FAILED, "error": "no picture", "payload": {}}
            row = Job(kind=JobKind.REPLAY, campaign_id=campaign, created_at=now, **failed)
            session.add(row)
        number = collect.id
    open_campaign(page, studio, campaign)
    page.locator(".live").get_by_text("rollouts · 25 %").wait_for()
    note = page.locator("#jobs-note")
    assert note.inner_text() == "0 queued · 1 running · 25 failed · 20 of them shown"
    with studio.database.write() as session:
        told = {"job_id": number, "kind": "collect", "progress": 0.5, "stage": "rollouts"}
        add_event(session, now, campaign_id=campaign, kind="job", data=told, job_id=number)
    page.locator(f'tr[data-job="{number}"]', has_text="50 %").wait_for()
    assert page.get_by_role("progressbar").get_attribute("aria-valuenow") == "50"


def test_page_says_that_no_worker_takes_what_waits(studio: Studio, page: Page) -> None:
    campaign, now = studio.add_campaign([True]), datetime.now(UTC)
    open_campaign(page, studio, campaign)
    assert not page.locator("#system").is_visible(), "nothing waits"
    with studio.database.write() as session:
        number = campaigns.start_collect(session, now, campaign, {}, by=1).id
    page.reload()
    page.locator("#system").get_by_text("no worker for queue 'rollout'").wait_for()
    page.locator(f'tr[data-job="{number}"]').get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Keep it").wait_for()
    confirm(page, "Cancel job")
    page.locator("#system").wait_for(state="hidden")


def test_times_are_whole_seconds(studio: Studio, page: Page) -> None:
    page.goto(f"{studio.url}/sign-in")
    told = page.evaluate(
        """async (all) => all.map((await import("/static/format.js")).duration)""",
        [9_940, 99_700, 119_600, 3_600_000],
    )
    assert told == ["9.9 s", "1 min 40 s", "2 min 0 s", "60 min 0 s"]
