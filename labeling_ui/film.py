"""Moving pictures as files: MP4 with AV1, which browsers play, or animated WebP.

There is no video library here: those that come as wheels bring GPL encoders along (measured: PyAV
18.1 and imageio-ffmpeg 0.8.1 both ship x264). Pillow's AVIF encoder (libavif and libaom, BSD) makes
the same AV1 pictures; an AVIF sequence keeps them in the boxes of ISO/IEC 14496-12 as an MP4 does,
so this module lays them into an MP4 as "AV1 Codec ISO Media File Format Binding" (Alliance for Open
Media, 2019) says. The same frames give the same bytes.
"""

from __future__ import annotations

import io
import itertools
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, features

from rodif_core.errors import RodifError, ValueOutOfRangeError

Frame = NDArray[np.uint8]

SUFFIXES = (".mp4", ".webp")
HOLD_MS = 1500  # how long the last frame stays
GROUP = 48  # frames from one whole picture to the next: the steps of a jump, and the memory needed
QUALITY = 70  # of 100
SPEED = 8  # libaom's: 15 ms of one core for a frame of 1280 x 860 px, 7 times as quick as 6
WEBP_SHRINK = 2  # an animated WebP is for pages: half the width and height, every second frame

_TICKS = 1000  # per second
_TEMPORAL_DELIMITER = b"\x12\x00"  # an MP4's samples come without
_PLAIN_MATRIX = struct.pack(">9I", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)


def check_film_path(path: Path) -> None:
    """Raise ValueOutOfRangeError for a suffix that no film can have, RodifError when this
    machine's Pillow cannot encode it."""
    if path.suffix.lower() not in SUFFIXES:
        legal = f"a file name that ends in {' or '.join(SUFFIXES)}"
        raise ValueOutOfRangeError("video", str(path), legal)
    codec = "avif" if path.suffix.lower() == ".mp4" else "webp"
    if not features.check(codec):
        raise RodifError(
            f"the installed Pillow has no {codec} encoder, which {path.suffix} needs; its wheels"
            " have: install Pillow from a wheel"
        )


def write_film(path: Path, frames: Iterable[Frame], frame_ms: int) -> None:
    """Write frames (height, width, 3) uint8 of even height and width, `frame_ms` each.

    Raises ValueOutOfRangeError when there is no frame or the suffix is unknown.
    """
    check_film_path(path)
    stream = iter(frames)
    first = next(stream, None)
    if first is None:
        raise ValueOutOfRangeError("number of frames", 0, "at least 1")
    frames = itertools.chain([first], stream)
    make = _mp4 if path.suffix.lower() == ".mp4" else _webp
    path.write_bytes(make(frames, frame_ms))


def _webp(frames: Iterable[Frame], frame_ms: int) -> bytes:
    kept = list(itertools.islice(frames, 0, None, 2))
    pictures = [Image.fromarray(frame).reduce(WEBP_SHRINK) for frame in kept]
    durations = [2 * frame_ms] * (len(pictures) - 1) + [HOLD_MS]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer,
        "WEBP",
        save_all=True,
        append_images=pictures[1:],
        duration=durations,
        loop=0,
        quality=QUALITY,
        method=2,
    )
    return buffer.getvalue()


@dataclass
class _Track:
    """Encoded pictures; `entry` is the sample entry, which describes them to a player."""

    entry: bytes = b""
    samples: list[bytes] = field(default_factory=list)
    whole: list[int] = field(default_factory=list)  # numbers, from 1, of pictures that need none


def _mp4(frames: Iterable[Frame], frame_ms: int) -> bytes:
    stream = iter(frames)
    track = _Track()
    height = width = 0
    while group := list(itertools.islice(stream, GROUP)):
        height, width = group[0].shape[:2]
        entry, samples = _encode(group)
        if track.entry not in (b"", entry):
            raise ValueOutOfRangeError("frame", (width, height), "as large as the first one")
        track.entry = entry
        track.whole.append(len(track.samples) + 1)
        track.samples += samples
    return _file(track, width, height, frame_ms)


def _encode(group: list[Frame]) -> tuple[bytes, list[bytes]]:
    """The sample entry and the coded pictures of frames, of which the first is a whole one."""
    pictures = [Image.fromarray(frame) for frame in group]
    buffer = io.BytesIO()
    # Of one picture Pillow would make a still, which has no track.
    more = pictures[1:] or pictures
    pictures[0].save(
        buffer,
        "AVIF",
        save_all=True,
        append_images=more,
        codec="aom",
        quality=QUALITY,
        speed=SPEED,
        max_threads=1,
    )
    data = buffer.getvalue()
    table = _find(data, "moov", "trak", "mdia", "minf", "stbl")
    sizes = _find(table, "stsz")
    (count,) = struct.unpack_from(">I", sizes, 8)
    lengths = struct.unpack_from(f">{count}I", sizes, 12)
    chunks, place = struct.unpack_from(">II", _find(table, "stco"), 4)
    if chunks != 1:
        raise RodifError(f"the AVIF encoder wrote {chunks} chunks of pictures, 1 was expected")
    samples = []
    for length in lengths[: len(group)]:
        samples.append(data[place : place + length].removeprefix(_TEMPORAL_DELIMITER))
        place += length
    return _sample_entry(_find(table, "stsd")), samples


def _sample_entry(description: bytes) -> bytes:
    """An AVIF's `av01` entry without what only an AVIF has (`ccst`)."""
    _, body = next(_boxes(description[8:]))
    fixed = 78  # bytes of a VisualSampleEntry before its boxes
    kept = [_box(kind, part) for kind, part in _boxes(body[fixed:]) if kind in ("av1C", "colr")]
    return _box("av01", body[:fixed], *kept)


def _boxes(data: bytes) -> Iterator[tuple[str, bytes]]:
    place = 0
    while place < len(data):
        size, kind = struct.unpack_from(">I4s", data, place)
        yield kind.decode("ascii"), data[place + 8 : place + size]
        place += size


def _find(data: bytes, *kinds: str) -> bytes:
    """The content of the first box of the first kind in that of …"""
    for kind in kinds:
        data = next(body for name, body in _boxes(data) if name == kind)
    return data


def _box(kind: str, *parts: bytes) -> bytes:
    size = 8 + sum(len(part) for part in parts)
    return struct.pack(">I4s", size, kind.encode("ascii")) + b"".join(parts)


def _full(kind: str, flags: int, layout: str, *values: Any) -> bytes:
    """A box with a version, 0 here, and flags."""
    return _box(kind, struct.pack(">I", flags), struct.pack(">" + layout, *values))


def _file(track: _Track, width: int, height: int, frame_ms: int) -> bytes:
    start = _box("ftyp", b"isom", struct.pack(">I", 0x200), b"isomiso6av01mp41")
    # The table comes before the pictures, so that a browser can begin early; its size does not
    # depend on where they are.
    size = len(_movie(track, width, height, frame_ms, 0))
    movie = _movie(track, width, height, frame_ms, len(start) + size + 8)
    return start + movie + _box("mdat", *track.samples)


def _movie(track: _Track, width: int, height: int, frame_ms: int, offset: int) -> bytes:
    count = len(track.samples)
    length = (count - 1) * frame_ms + HOLD_MS
    fixed = (width << 16, height << 16)
    head = _box(
        "mvhd",
        struct.pack(">5I", 0, 0, 0, _TICKS, length),
        struct.pack(">IHHQ", 1 << 16, 1 << 8, 0, 0),  # speed and volume 1
        _PLAIN_MATRIX,
        struct.pack(">7I", 0, 0, 0, 0, 0, 0, 2),  # the next free track
    )
    track_head = _box(
        "tkhd",
        struct.pack(">6I", 3, 0, 0, 1, 0, length),  # flags: enabled, in the movie; track 1
        struct.pack(">QHHHH", 0, 0, 0, 0, 0),
        _PLAIN_MATRIX,
        struct.pack(">2I", *fixed),
    )
    media = _box(
        "mdia",
        _full("mdhd", 0, "4IHH", 0, 0, _TICKS, length, 0x55C4, 0),  # language: none
        _full("hdlr", 0, "I4s12s6s", 0, b"vide", b"", b"video"),
        _box(
            "minf",
            _full("vmhd", 1, "4H", 0, 0, 0, 0),
            _box("dinf", _box("dref", struct.pack(">II", 0, 1), _full("url ", 1, ""))),
            _sample_table(track, frame_ms, offset),
        ),
    )
    return _box("moov", head, _box("trak", track_head, media))


def _sample_table(track: _Track, frame_ms: int, offset: int) -> bytes:
    count, sizes = len(track.samples), [len(sample) for sample in track.samples]
    durations = [(count - 1, frame_ms), (1, HOLD_MS)]
    runs = [value for run in durations if run[0] for value in run]
    return _box(
        "stbl",
        _box("stsd", struct.pack(">II", 0, 1), track.entry),
        _full("stts", 0, f"{1 + len(runs)}I", len(runs) // 2, *runs),
        _full("stsc", 0, "4I", 1, 1, count, 1),  # all samples in one chunk
        _full("stsz", 0, f"{2 + count}I", 0, count, *sizes),
        _full("stss", 0, f"{1 + len(track.whole)}I", len(track.whole), *track.whole),
        _full("stco", 0, "2I", 1, offset),
    )
