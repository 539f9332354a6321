"""Make docs/images from a real running system: `make screenshots`.

Without --url it runs `rodif demo` and photographs what the demo leaves behind; with --url and
--admin-password it photographs a system that runs already. Needs Chromium; pictures are written as
PNG below 400 kB.
"""

from __future__ import annotations

import argparse
import io
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx2
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

DESKTOP = {"width": 1280, "height": 720}
PHONE = {"width": 390, "height": 844}
MAX_BYTES = 400_000
READY_MS = 120_000  # software rendering on a busy machine
MOMENT = 0.56  # share of the replay at which the pictures are taken: both runs are under way
FLAGS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-quic"]


@dataclass(frozen=True)
class Site:
    """A running system and its admin account."""

    url: str
    name: str
    password: str


@contextmanager
def demo(options: list[str]) -> Iterator[Site]:
    """The site that `rodif demo` with these options leaves running; stopped at the end."""
    with tempfile.TemporaryDirectory(prefix="rodif-screenshots-") as folder:
        command = [str(Path(sys.executable).parent / "rodif"), "demo", "--port", "0"]
        process = subprocess.Popen(
            [*command, "--state", str(Path(folder) / "state"), *options],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert process.stdout is not None
            url = password = None
            for line in process.stdout:
                sys.stdout.write(line)
                if found := re.search(r"site is running at\s+(http://\S+?)\.?\s", line):
                    url = found.group(1)
                elif found := re.search(r"^\s+admin\s+password (\S+)", line):
                    password = found.group(1)
                if url and password:
                    break
            else:
                raise SystemExit(f"rodif demo ended with {process.wait()} before the site was up")
            site = Site(url, "admin", password)
            leave_something_to_label(site)
            yield site
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(timeout=60)


def leave_something_to_label(site: Site) -> None:
    """The demo's annotators may have judged every pair: ask for a second opinion on each."""
    with httpx2.Client(base_url=f"{site.url}/api/v1", headers={"Origin": site.url}) as api:
        api.post("/session", json={"name": site.name, "password": site.password})
        for campaign in api.get("/campaigns").json():
            change = {"settings": {"labels_per_pair": 2}}
            api.patch(f"/campaigns/{campaign['id']}", json=change).raise_for_status()


def save(page: Page, path: Path, *, full: bool = False) -> None:
    """Photograph the page; with fewer colours when the file would be large."""
    data = page.screenshot(full_page=full, timeout=READY_MS)
    if len(data) > MAX_BYTES:
        buffer = io.BytesIO()
        colours = Image.open(io.BytesIO(data)).convert("RGB").quantize(colors=192)
        colours.save(buffer, "PNG", optimize=True)
        data = buffer.getvalue()
    path.write_bytes(data)
    sys.stdout.write(f"{path}  {len(data) // 1000} kB\n")


def open_page(browser: Browser, size: dict[str, int], *, dark: bool = False) -> Page:
    """A fresh window, as a phone when it is narrow."""
    phone = size["width"] < 600
    return browser.new_context(
        viewport={"width": size["width"], "height": size["height"]},
        color_scheme="dark" if dark else "light",
        has_touch=phone,
        is_mobile=phone,
        device_scale_factor=1,
    ).new_page()


def sign_in(page: Page, site: Site) -> None:
    """As admin."""
    page.goto(f"{site.url}/sign-in")
    page.get_by_label("Name").fill(site.name)
    page.get_by_label("Password").fill(site.password)
    page.get_by_role("button", name="Sign in").click()
    page.wait_for_url(f"{site.url}/admin")


def first_campaign(page: Page) -> int:
    """Id of the first campaign in the list."""
    link = page.locator(".campaign-card").first
    address = link.get_attribute("href", timeout=READY_MS)
    assert address is not None
    return int(address.rsplit("/", 1)[1])


def show_pair(page: Page, site: Site, campaign: int) -> None:
    """The annotator's page, with both runs stopped in the middle."""
    page.goto(f"{site.url}/label/{campaign}?fixedDpr=1")
    page.locator('[data-choice="left"]:enabled').wait_for(timeout=READY_MS)
    page.keyboard.press("Space")
    page.evaluate(
        """(share) => {
          const scrubber = document.querySelector("#scrubber");
          scrubber.value = share * scrubber.max;
          scrubber.dispatchEvent(new Event("input"));
        }""",
        MOMENT,
    )
    page.wait_for_timeout(4000)  # two or three frames, also where each takes a second


def take(site: Site, out: Path) -> None:
    """All pictures."""
    out.mkdir(parents=True, exist_ok=True)
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = open_page(browser, DESKTOP)
        page.goto(f"{site.url}/sign-in")
        save(page, out / "sign-in.png")
        sign_in(page, site)
        campaign = first_campaign(page)
        page.locator("#people tr").first.wait_for()
        save(page, out / "campaigns.png")
        take_campaign(page, site, campaign, out)
        show_pair(page, site, campaign)
        save(page, out / "label.png")
        page.keyboard.press("?")
        page.wait_for_timeout(1500)
        save(page, out / "label-help.png")
        for name, size, dark in (("label-phone", PHONE, False), ("label-dark", DESKTOP, True)):
            page = open_page(browser, size, dark=dark)
            sign_in(page, site)
            show_pair(page, site, campaign)
            save(page, out / f"{name}.png")
        page = open_page(browser, PHONE)
        sign_in(page, site)
        page.goto(f"{site.url}/admin/campaigns/{campaign}")
        page.locator(".tile").first.wait_for(timeout=READY_MS)
        page.wait_for_timeout(2000)
        save(page, out / "campaign-phone.png")
        browser.close()


def take_campaign(page: Page, site: Site, campaign: int, out: Path) -> None:
    """The campaign page, whole, and its dialogs."""
    page.goto(f"{site.url}/admin/campaigns/{campaign}")
    page.locator(".tile").first.wait_for(timeout=READY_MS)
    page.wait_for_timeout(4000)  # charts and moving pictures
    save(page, out / "campaign.png")
    page.mouse.move(640, 400)
    for _ in range(8):  # pictures load when they come into view
        page.mouse.wheel(0, 600)
        page.wait_for_timeout(400)
    save(page, out / "campaign-whole.png", full=True)
    page.mouse.wheel(0, -6000)
    page.get_by_role("button", name="Start round").click()
    page.wait_for_timeout(500)
    save(page, out / "start-round.png")
    page.keyboard.press("Escape")
    made = page.locator("#checkpoints tr", has_text="-round-")  # the first round is the oldest
    made.last.get_by_role("button", name="Lineage").click()
    page.get_by_role("dialog").wait_for()
    page.wait_for_timeout(500)
    save(page, out / "lineage.png")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", help="a running system; without it, `rodif demo` is run")
    parser.add_argument("--admin", default="admin", help="name of the admin account")
    parser.add_argument("--admin-password", help="its password, needed with --url")
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="folder of the PNGs")
    args, options = parser.parse_known_args()  # the rest is for the demo, such as --pairs 100
    if args.url is None:
        with demo(options) as site:
            take(site, args.out)
    elif args.admin_password is None or options:
        parser.error("--url needs --admin-password, and takes no options of the demo")
    else:
        take(Site(args.url.rstrip("/"), args.admin, args.admin_password), args.out)


if __name__ == "__main__":
    main()
