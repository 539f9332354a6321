"""Named arrays and a JSON header as one npz archive, never pickle. Equal contents, equal bytes."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import TrajectoryFileError

_HEADER = "header"


def write_archive(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """The archive; `read_archive` reads it back."""
    text = json.dumps(header, sort_keys=True).encode()
    members = {_HEADER: np.frombuffer(text, dtype=np.uint8), **arrays}
    buffer = io.BytesIO()
    # numpy's own savez stamps the time of day into the archive, so the members are written by hand.
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in members.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            archive.writestr(entry, member.getvalue(), zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def read_archive(
    data: bytes, what: str, *, version: int, facts: Mapping[str, type], ranks: Mapping[str, int]
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header and arrays of an archive.

    what     how to call it in an error
    version  the `format` that its header must tell
    facts    what else the header must hold, by name, and of which type
    ranks    the arrays that it must hold, by name, and their number of axes

    Raises TrajectoryFileError when it is damaged, foreign or of another version.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            header = json.loads(_member(archive, _HEADER).tobytes())
            arrays = {name: _member(archive, name) for name in ranks}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise TrajectoryFileError(f"{what} is not readable ({len(data)} bytes): {error}") from error
    if not isinstance(header, dict):
        raise TrajectoryFileError(f"{what} has a {type(header).__name__} as header, not an object")
    if header.get("format") != version:
        raise TrajectoryFileError(
            f"{what} has format {header.get('format')!r}; this version reads {version}"
        )
    for name, kind in facts.items():
        if not isinstance(header.get(name), kind):
            raise TrajectoryFileError(
                f"{what}: {name} in its header is {header.get(name)!r}, not a {kind.__name__}"
            )
    for name, rank in ranks.items():
        if arrays[name].ndim != rank:
            raise TrajectoryFileError(
                f"{what}: {name} has the shape {arrays[name].shape}, which should have {rank} axes"
            )
    return header, arrays


def _member(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    with archive.open(f"{name}.npy") as file:
        array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array
