"""The replay client shows recordings; it does not run what they carry."""

from __future__ import annotations

import msgspec
import pytest
import zstandard
from playwright.sync_api import Page
from sqlalchemy import select

from server.store.tables import Pair
from tests.ui.driving import PATIENCE, take_session, until
from tests.ui.studio import Studio, replay_of

pytestmark = pytest.mark.browser

SIGN_OUT = "fetch('/api/v1/session', {method: 'DELETE'})"
HTML = f'<b id="carried">hello</b><img src="data:," onerror="{SIGN_OUT}">'


def _with_html(recording: bytes, html: str) -> bytes:
    """The same recording, with a window that shows `html`; the format is told in test_replay.py."""
    raw = zstandard.ZstdDecompressor().decompress(
        recording[8:], max_output_size=int.from_bytes(recording[:8], "little")
    )
    length = int.from_bytes(raw[:8], "little")
    told = msgspec.msgpack.decode(raw[8 : 8 + length])
    props = {"order": 0.0, "content": html, "visible": True}
    told["messages"] = [
        [0.0, {"type": "GuiModalMessage", "order": 0.0, "uuid": "m", "title": "hello"}],
        [0.0, {"type": "GuiHtmlMessage", "uuid": "h", "container_uuid": "m", "props": props}],
        *told["messages"],
    ]
    packed = msgspec.msgpack.encode(told)
    arrays = 8 + length + -length % 8  # they start at a multiple of 8 bytes
    new = len(packed).to_bytes(8, "little") + packed + bytes(-len(packed) % 8) + raw[arrays:]
    return len(new).to_bytes(8, "little") + zstandard.ZstdCompressor().compress(new)


def test_handler_in_the_html_of_a_recording_does_not_run(studio: Studio, page: Page) -> None:
    campaign = studio.add_campaign([True])
    with studio.database.write() as session:
        pair = session.scalars(select(Pair).where(Pair.campaign_id == campaign)).one()
        pair.replay_sha256 = studio.artifacts.put(_with_html(replay_of(0, 1)[0], HTML))
        path = f"/replays/{pair.replay_sha256}.viser"
    take_session(page, studio, studio.add_annotator())
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.goto(f"{studio.url}/replay-client/?playbackPath={path}&fixedDpr=0.3")
    page.locator("#carried").first.wait_for(timeout=1000 * PATIENCE)  # the HTML itself is shown
    until(page, "document.querySelector('[role=slider]') !== null")
    page.wait_for_timeout(1000)
    assert page.request.get(f"{studio.url}/api/v1/me").ok, "the handler has signed the person out"
    assert any("inline event handler" in text for text in said), said
