"""The recorded episode: round trip, equal bytes, damaged files."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest

from rodif_core.errors import TrajectoryFileError
from rodif_core.npz import write_archive
from rodif_core.trajectory import Trajectory
from tests.core.learning import chain_trajectory, tiny_policy


def episode() -> Trajectory:
    return chain_trajectory(tiny_policy(), 3, seed=1)


def test_trajectory_survives_the_file_form() -> None:
    original = episode()
    copy = Trajectory.from_bytes(original.to_bytes())
    for name in ("observations", "actions", "qpos", "paths", "histories", "chains"):
        assert np.array_equal(getattr(copy, name), getattr(original, name))
        assert getattr(copy, name).dtype == getattr(original, name).dtype
    assert (copy.context, copy.outcome, copy.info) == (
        original.context, original.outcome, original.info,
    )  # fmt: skip


def test_equal_trajectories_give_equal_bytes() -> None:
    assert episode().to_bytes() == episode().to_bytes()


def test_arrays_cannot_be_written_once_recorded() -> None:
    with pytest.raises(ValueError, match="read-only"):
        episode().chains[0] = 0


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "foreign"])
def test_damaged_file_gives_a_clear_error(damage: str) -> None:
    data = episode().to_bytes()
    middle = len(data) // 2
    damaged = {
        "empty": b"",
        "cut": data[:middle],
        "flipped": data[:middle] + bytes([data[middle] ^ 0xFF]) + data[middle + 1 :],
        "foreign": b"RIFF" + data[4:],
    }[damage]
    with pytest.raises(TrajectoryFileError, match="the episode file is not readable"):
        Trajectory.from_bytes(damaged)


def test_foreign_archive_is_refused_with_what_is_wrong() -> None:
    array = io.BytesIO()
    np.save(array, np.zeros(3))
    good = {"context": {}, "outcome": {}, "info": {}}
    arrays = {name: getattr(episode(), name) for name in (
        "observations", "actions", "qpos", "paths", "histories", "chains", "decision_steps",
    )}  # fmt: skip
    flat = arrays | {"chains": np.zeros(3, np.float32)}
    for data, words in (
        (array.getvalue(), "is not readable"),
        (write_archive({"format": 1, **good, "outcome": 3}, arrays), "outcome in its header is 3"),
        (write_archive({"format": 1}, arrays), "context in its header is None"),
        (write_archive({"format": 9, **good}, arrays), "format 9; this version reads 1"),
        (write_archive({"format": 1, **good}, flat), r"chains has the shape \(3,\).*4 axes"),
    ):
        with pytest.raises(TrajectoryFileError, match=words):
            Trajectory.from_bytes(data)


def test_inconsistent_lengths_are_named() -> None:
    with pytest.raises(TrajectoryFileError, match="qpos has 5 rows; 12 actions need 13"):
        replace(episode(), qpos=np.zeros((5, 7), dtype=np.float32))


def test_values_that_are_not_finite_are_refused() -> None:
    actions = np.full((12, 2), np.nan, dtype=np.float32)
    with pytest.raises(TrajectoryFileError, match="actions has values that are not finite"):
        replace(episode(), actions=actions)
