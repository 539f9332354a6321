"""viser's playback client as one page, and the policy under which no other script runs in it.

The installed client is a single HTML file. Its only script unpacks a style sheet and the program
itself, and puts both into the page. The policy names that script, the program and our adapter by
their SHA-256, so that scripts which a recording carries, such as an `onerror` in its HTML, do not
run with the session of whoever looks at it.
"""

from __future__ import annotations

import base64
import hashlib
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import zstandard
from starlette.datastructures import QueryParams

from rodif_core.errors import ValueOutOfRangeError
from server.errors import NotFoundError

RECORDING = "/replays/<sha256>.viser"
_RECORDING = re.compile(r"/replays/[0-9a-f]{64}\.viser", flags=re.ASCII)

# The client carries its pictures, fonts and WebAssembly along as data: and reads them with fetch.
# A recording can also hold scripts that the client would run with `new Function`: without
# 'unsafe-eval' the browser refuses them.
_POLICY = (
    "default-src 'none'; script-src {scripts} 'wasm-unsafe-eval'; worker-src blob:;"
    " connect-src 'self' data:; img-src 'self' data: blob:; font-src data:;"
    " style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)

_SCRIPT = re.compile(
    r'<script data-p="(?P<packed>[^"]+)" data-ss="(?P<style>\d+)" data-cs="(?P<program>\d+)">'
    r"(?P<unpacker>.+?)</script>",
    flags=re.DOTALL,
)
# What the client packs binary data with: five digits for four bytes, the most significant first.
_DIGITS = (
    "!#$%()*+,-./0123456789:;=?@ABCDEFGHIJKLMNOPQRSTUVWXYZ[\\]^_abcdefghijklmnopqrstuvwxyz{|}~"
)


@dataclass(frozen=True)
class ReplayClient:
    """The page and its Content-Security-Policy."""

    page: bytes
    policy: str


def check_parameters(query: QueryParams) -> None:
    """Refuse what would make the client show anything but one recording of this site.

    Its other parameters (camera, resolution …) change the picture only. Raises
    ValueOutOfRangeError.
    """
    paths = query.getlist("playbackPath")
    if len(paths) != 1 or _RECORDING.fullmatch(paths[0]) is None:
        raise ValueOutOfRangeError("playbackPath", ", ".join(paths), f"one {RECORDING}")
    if "websocket" in query:
        raise ValueOutOfRangeError("websocket", query["websocket"], "absent")


def replay_client(installed: Path, adapter: bytes) -> ReplayClient:
    """The installed client (its index.html) with our script in its head.

    Raises NotFoundError when the file is not built as that of viser 1.1.1.
    """
    head, tail, scripts = _parts(installed)
    sources = " ".join(_source(script) for script in (*scripts, adapter))
    page = head + b"<script>" + adapter + b"</script>" + tail
    return ReplayClient(page, _POLICY.format(scripts=sources))


@cache
def _parts(installed: Path) -> tuple[bytes, bytes, tuple[bytes, bytes]]:
    """The page before and after the end of its head, and its two scripts."""
    page = installed.read_bytes()
    head, found, rest = page.partition(b"</head>")
    script = _SCRIPT.search(head.decode())
    if not found or script is None:
        raise NotFoundError("head with a packed script in the installed viser's", installed.name)
    style_size, size = int(script["style"]), int(script["style"]) + int(script["program"])
    unpacked = zstandard.ZstdDecompressor().decompress(_bytes(script["packed"]), size)
    return head, found + rest, (script["unpacker"].encode(), unpacked[style_size:size])


def _bytes(digits: str) -> bytes:
    value_of = {digit: value for value, digit in enumerate(_DIGITS)}
    made = bytearray()
    for start in range(0, len(digits), 5):
        group = digits[start : start + 5]
        number = 0
        for digit in group:
            number = number * len(_DIGITS) + value_of[digit]
        made += number.to_bytes(len(group) - 1, "big")  # a shorter last group has fewer bytes
    return bytes(made)


def _source(script: bytes) -> str:
    """A script as a policy names it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"
