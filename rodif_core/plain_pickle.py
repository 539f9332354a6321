"""Reading foreign pickle files that hold plain data, without running what else they may hold.

A pickle is a program that may call anything. Here it can name only what numpy's arrays are written
with, and even that leads to code of this module and never to numpy's: whatever the file says, the
result is made of dicts, lists, tuples, numbers, text, bytes and `StoredArray`.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import DemonstrationFileError

MAX_BYTES = 50_000_000  # of one file; an episode of a thousand control steps has 1 MB
_NUMBER = re.compile(r"[fiub?][1248]?")  # floats, integers, truth values
# What reading may raise. A damaged file does not only lead to the first.
_DAMAGED = (
    pickle.UnpicklingError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    OverflowError,
    RecursionError,
    TypeError,
    ValueError,
)


class StoredType:
    """The type of a stored array's numbers."""

    __slots__ = ("dtype",)

    def __init__(self, name: object) -> None:
        if not isinstance(name, str) or not _NUMBER.fullmatch(name):
            raise pickle.UnpicklingError(f"an array of {name!r}; legal are arrays of numbers")
        self.dtype = np.dtype(name)

    def __setstate__(self, state: object) -> None:
        """Byte order, as numpy writes it."""
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        if order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError(f"numbers of byte order {order!r}")
        self.dtype = self.dtype.newbyteorder(order)


class StoredArray:
    """An array of numbers, `value` once it has been read."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value: NDArray[Any] = np.zeros(0)

    def __setstate__(self, state: object) -> None:
        """Version, shape, type, order of axes and raw numbers, as numpy writes them."""
        if not isinstance(state, tuple) or len(state) != 5:
            raise pickle.UnpicklingError("an array that numpy has not written")
        _, shape, kind, by_columns, raw = state
        self.fill(shape, kind, "F" if by_columns else "C", raw)

    def fill(self, shape: object, kind: object, order: object, raw: object) -> None:
        """Take the numbers; raises pickle.UnpicklingError when they do not fit together."""
        if (
            isinstance(kind, StoredType)
            and isinstance(shape, tuple)
            and all(isinstance(n, int) and n >= 0 for n in shape)
            and isinstance(raw, bytes | bytearray)
            and math.prod(shape) * kind.dtype.itemsize == len(raw)
        ):
            flat = np.frombuffer(bytes(raw), dtype=kind.dtype)
            self.value = flat.reshape(shape, order="F" if order == "F" else "C")
        else:
            raise pickle.UnpicklingError("an array whose shape does not fit its numbers")


def read_plain_pickle(data: bytes, name: str) -> Any:
    """The object in a pickle file of plain data; arrays are `StoredArray`s.

    Raises DemonstrationFileError, naming the file and what it wanted, when it is damaged or asks
    for anything else.
    """
    if len(data) > MAX_BYTES:
        raise DemonstrationFileError(
            f"{name} has {len(data)} bytes; an episode has at most {MAX_BYTES}"
        )
    try:
        return _PlainUnpickler(io.BytesIO(data)).load()
    except _DAMAGED as error:
        raise DemonstrationFileError(f"{name} is not a pickle of plain data: {error}") from error


class _PlainUnpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        # Made afresh, since a file could change the attributes of what it names.
        self._legal = _legal_names()

    def find_class(self, module: str, name: str) -> Any:
        """What a name in the file stands for."""
        if (module, name) not in self._legal:
            raise pickle.UnpicklingError(
                f"it asks for {module}.{name}; legal are dicts, lists, numbers, text and arrays"
                " of numbers"
            )
        return self._legal[module, name]


def _legal_names() -> dict[tuple[str, str], Any]:
    """Stand-ins for what numpy 1 and 2 write into a pickle of arrays."""

    def array(*_: object) -> StoredArray:
        return StoredArray()

    def number_type(name: object, *_: object) -> StoredType:
        return StoredType(name)

    def scalar(kind: object, raw: object) -> float | int | bool:
        one = StoredArray()
        one.fill((), kind, "C", raw)
        value: float | int | bool = one.value.item()
        return value

    def array_of(raw: object, kind: object, shape: object, order: object) -> StoredArray:
        made = StoredArray()
        made.fill(shape, kind, order, raw)
        return made

    def as_bytes(text: object, encoding: object) -> bytes:
        # Older protocols have no bytes and write them as text.
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise pickle.UnpicklingError(f"bytes written as {encoding!r} text")
        return text.encode("latin1")

    def no_bytes() -> bytes:
        return b""  # how older protocols write just these

    by_name: dict[str, dict[str, Callable[..., Any]]] = {
        "multiarray": {"_reconstruct": array, "scalar": scalar},
        "numeric": {"_frombuffer": array_of},
    }
    legal: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): "ndarray",  # only ever handed to `array`, which does not look
        ("numpy", "dtype"): number_type,
        ("_codecs", "encode"): as_bytes,
        ("__builtin__", "bytes"): no_bytes,
    }
    for package in ("numpy.core", "numpy._core"):
        for module, names in by_name.items():
            legal |= {(f"{package}.{module}", name): made for name, made in names.items()}
    return legal
