"""Films: the mosaic's frames, and files that a browser and other readers take."""

from __future__ import annotations

import base64
import io
import itertools
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page

from labeling_ui.film import GROUP, HOLD_MS, check_film_path, write_film
from labeling_ui.mode_plot import colours_of_groups
from labeling_ui.mosaic import CAPTION, GAP, HEADER, Mosaic, columns_of
from rodif_core.demonstrations import make_demonstrations
from rodif_core.errors import ValueOutOfRangeError
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory

FRAME_MS = 40
RED, PAPER = (200, 30, 40), (230, 230, 235)


def disc_at(x: int) -> Any:
    """A frame with a red square whose left edge is at x."""
    frame = np.full((96, 160, 3), PAPER, dtype=np.uint8)
    frame[30:60, x : x + 30] = RED
    return frame


def place_of(picture: Any) -> float:
    """Where the red square's middle is."""
    pixels = np.asarray(picture).astype(int)
    red = (pixels[..., 0] > 150) & (pixels[..., 1] < 90)
    return float(np.nonzero(red)[1].mean())


def read_back(path: Path) -> Image.Image:
    """The film as Pillow sees it: its pictures are those of an AVIF sequence, which only has
    another brand and another word for what it shows."""
    data = path.read_bytes()
    start = struct.unpack(">I", data[:4])[0]
    brand = struct.pack(">I4s4sI", 32, b"ftyp", b"avis", 0) + b"avismsf1iso8miaf"
    assert start == len(brand)
    return Image.open(io.BytesIO(brand + data[start:].replace(b"vide", b"pict", 1)))


@pytest.mark.parametrize("count", [1, 2, GROUP, GROUP + 1, 2 * GROUP + 7])
def test_every_frame_of_an_mp4_can_be_read_back(count: int, tmp_path: Path):
    path = tmp_path / "film.mp4"
    write_film(path, (disc_at(i) for i in range(count)), FRAME_MS)
    film = read_back(path)
    assert film.size == (160, 96) and getattr(film, "n_frames", 1) == count
    for number in {0, count // 2, count - 1}:
        film.seek(number)
        assert place_of(film.convert("RGB")) == pytest.approx(number + 14.5, abs=0.6)


def test_equal_frames_give_equal_bytes(tmp_path: Path):
    for name in ("a.mp4", "b.mp4"):
        write_film(tmp_path / name, (disc_at(2 * i) for i in range(5)), FRAME_MS)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


@pytest.mark.browser
def test_a_browser_plays_and_seeks_the_mp4(page: Page, tmp_path: Path):
    count = GROUP + 12
    write_film(tmp_path / "film.mp4", (disc_at(2 * i) for i in range(count)), FRAME_MS)
    page.set_content("<video muted></video>")
    wanted = [0, GROUP - 1, GROUP, count - 1]
    length = page.evaluate(
        """async (data) => {
          const video = document.querySelector("video");
          const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
          video.src = URL.createObjectURL(new Blob([bytes], {type: "video/mp4"}));
          await new Promise((good, bad) => {
            video.onloadeddata = good;
            video.onerror = () => bad(new Error(video.error.message));
          });
          return video.duration;
        }""",
        base64.b64encode((tmp_path / "film.mp4").read_bytes()).decode(),
    )
    assert length == pytest.approx(((count - 1) * FRAME_MS + HOLD_MS) / 1000, abs=0.01)
    for number in wanted:
        page.evaluate(
            """async (time) => {
              const video = document.querySelector("video");
              const seeked = new Promise((good) => { video.onseeked = good; });
              video.currentTime = time;
              await seeked;
            }""",
            (number + 0.5) * FRAME_MS / 1000,
        )
        # On a busy machine the picture comes a little after the browser says that it has sought.
        expected, deadline = pytest.approx(2 * number + 14.5, abs=0.6), time.monotonic() + 20
        while (place := place_of(shown_picture(page))) != expected:
            assert time.monotonic() < deadline, f"frame {number} shows the disc at {place}"
            page.wait_for_timeout(100)


def shown_picture(page: Page) -> Image.Image:
    """What the page's video shows now."""
    data = page.evaluate(
        """() => {
          const video = document.querySelector("video");
          const canvas = document.createElement("canvas");
          canvas.width = video.videoWidth;
          canvas.height = video.videoHeight;
          canvas.getContext("2d").drawImage(video, 0, 0);
          return canvas.toDataURL("image/png").split(",")[1];
        }"""
    )
    return Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")


def test_a_webp_is_small_and_moves(tmp_path: Path):
    path = tmp_path / "film.webp"
    write_film(path, (disc_at(i) for i in range(9)), FRAME_MS)
    with Image.open(path) as film:
        assert film.size == (80, 48) and film.n_frames == 5
        film.seek(4)
        assert place_of(film.convert("RGB")) == pytest.approx((8 + 14.5) / 2, abs=0.6)


def test_other_kinds_of_files_are_refused_with_the_legal_ones(tmp_path: Path):
    for name in ("film.avi", "film", "film.gif"):
        with pytest.raises(ValueOutOfRangeError, match=r"ends in \.mp4 or \.webp"):
            check_film_path(tmp_path / name)
    check_film_path(tmp_path / "FILM.MP4")


def test_no_frame_is_refused(tmp_path: Path):
    with pytest.raises(ValueOutOfRangeError, match="number of frames"):
        write_film(tmp_path / "film.mp4", [], FRAME_MS)
    assert not (tmp_path / "film.mp4").exists()


@pytest.fixture(scope="module")
def episodes() -> list[Trajectory]:
    return make_demonstrations(get_task("avoid"), episodes=2, seed=1, preferred_share=0.5)


def test_a_mosaic_moves_until_the_longest_episode_has_ended(episodes: list[Trajectory]):
    longest = max(len(one.actions) for one in episodes)
    mosaic = Mosaic(get_task("avoid"), "two", episodes, stride=16)
    frames = list(mosaic.frames())
    assert len(frames) == mosaic.frame_count == len([*range(0, longest, 16)]) + 1
    assert mosaic.frame_ms == 35
    assert all(frame.shape == frames[0].shape for frame in frames)
    assert frames[0].shape[0] % 2 == frames[0].shape[1] % 2 == 0
    assert all(frame.std() > 20 for frame in frames)
    differences = [np.abs(b.astype(int) - a).mean() for a, b in itertools.pairwise(frames)]
    assert min(differences) > 0.1


def test_tiles_differ_and_show_their_own_group(episodes: list[Trajectory]):
    mosaic = Mosaic(get_task("avoid"), "two", episodes, stride=200)
    last = list(mosaic.frames())[-1]
    tile = (last.shape[1] - GAP) // 2
    left, right = last[HEADER:, GAP:tile], last[HEADER:, GAP + tile : 2 * tile]
    assert np.abs(left.astype(int) - right).mean() > 1
    colours = colours_of_groups(get_task("avoid"))
    for side, episode in ((left, episodes[0]), (right, episodes[1])):
        # The bar under the picture has filled, in the colour of the group.
        line = side[side.shape[0] - GAP - CAPTION + 1]
        assert (line == colours[episode.outcome["group"]]).all(axis=-1).mean() > 0.9


def test_grids_have_room_for_all_tiles():
    assert [columns_of(n) for n in (1, 2, 4, 5, 9, 10, 12)] == [1, 2, 2, 3, 3, 4, 4]
