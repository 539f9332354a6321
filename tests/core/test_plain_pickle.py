"""Foreign pickles: plain data comes through in every dialect, anything else is refused unrun."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rodif_core import plain_pickle
from rodif_core.errors import DemonstrationFileError
from rodif_core.plain_pickle import StoredArray, read_plain_pickle

EPISODE = {
    "robot": {
        "des_c_pos": np.arange(12.0).reshape(4, 3),
        "by_columns": np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
        "big_endian": np.arange(3, dtype=">i4"),
        "empty": np.zeros((0, 3)),
    },
    "one": np.float64(3.5),
    "plain": [1, "two", None, True, (b"four", -5.0)],
}


class Calls:
    """Pickles as a call of `function`."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_comes_through_in_every_protocol(protocol: int):
    read = read_plain_pickle(pickle.dumps(EPISODE, protocol), "file")
    for name, array in EPISODE["robot"].items():
        stored = read["robot"][name]
        assert isinstance(stored, StoredArray)
        assert stored.value.shape == array.shape and np.array_equal(stored.value, array)
    assert read["one"] == 3.5 and read["plain"] == EPISODE["plain"]


def test_arrays_as_numpy_1_names_them_come_through():
    written = pickle.dumps(np.arange(3.0), protocol=2)
    old = written.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert old != written
    assert np.array_equal(read_plain_pickle(old, "file").value, np.arange(3.0))


def test_a_malicious_file_is_refused_and_not_run(tmp_path: Path):
    trace = tmp_path / "was-here"
    bad = pickle.dumps({"robot": Calls(os.system, f"touch {trace}")})
    with pytest.raises(DemonstrationFileError, match=r"evil\.pkl.*asks for posix\.system; legal"):
        read_plain_pickle(bad, "evil.pkl")
    assert not trace.exists()
    pickle.loads(bad)  # what it would have done
    assert trace.exists()


@pytest.mark.parametrize(
    "wish",
    [
        Calls(eval, "1"),
        Calls(getattr, "text", "upper"),
        Calls(np.zeros, 3),
        Calls(np.load, "x"),
        Path("somewhere"),
        np.array([{}], dtype=object),
        np.array(["text"]),
        {1}.__class__,
    ],
    ids=["eval", "getattr", "zeros", "load", "path", "objects", "texts", "class"],
)
def test_anything_but_plain_data_is_refused(wish: Any):
    with pytest.raises(DemonstrationFileError, match="not a pickle of plain data"):
        read_plain_pickle(pickle.dumps(wish), "file")


def test_numpy_itself_is_never_called():
    # Called as numpy's own, this would take a terabyte.
    huge = b"cnumpy._core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(L1000000000000L\ntS'b'\ntR."
    assert read_plain_pickle(huge, "file").value.size == 0
    with pytest.raises(DemonstrationFileError, match="not callable"):
        read_plain_pickle(b"cnumpy\nndarray\n(L1000000000000L\ntR.", "file")


def test_a_file_cannot_change_what_the_next_one_meets():
    # Sets an attribute of the function that makes arrays.
    attack = b"cnumpy._core.multiarray\n_reconstruct\n(N}S'__defaults__'\n(I1\ntstb."
    read_plain_pickle(attack, "file")
    fresh = read_plain_pickle(pickle.dumps(EPISODE), "file")
    assert np.array_equal(fresh["robot"]["des_c_pos"].value, EPISODE["robot"]["des_c_pos"])


@pytest.mark.parametrize("data", [b"", b"not a pickle", pickle.dumps(EPISODE)[:-40]])
def test_damaged_files_are_refused(data: bytes):
    with pytest.raises(DemonstrationFileError, match="damaged.pkl"):
        read_plain_pickle(data, "damaged.pkl")


@pytest.mark.parametrize("shape", [(5,), (2, 3), (-1,), ("4",)])
def test_a_shape_that_does_not_fit_its_numbers_is_refused(shape: tuple[Any, ...]):
    stored, kind = StoredArray(), plain_pickle.StoredType("f8")
    with pytest.raises(pickle.UnpicklingError, match="does not fit"):
        stored.__setstate__((1, shape, kind, False, bytes(32)))


def test_a_file_that_is_far_too_large_is_not_read(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(plain_pickle, "MAX_BYTES", 10)
    with pytest.raises(DemonstrationFileError, match="at most 10"):
        read_plain_pickle(pickle.dumps(EPISODE), "file")
