"""`rodif rollout`: the table, the report, the episodes, the film; and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rodif_core import shipped
from rodif_core.demonstrations import load_demonstrations
from rodif_core.policies.checkpoint import save_checkpoint
from rodif_core.rollout import rollout
from rodif_core.spec import RolloutConfig
from tests.core.learning import tiny_checkpoint
from worker.cli.main import main
from worker.parallel import parallel_rollout


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("tiny") / "tiny.safetensors"
    file.write_bytes(save_checkpoint(tiny_checkpoint()))
    return str(file)


def test_rollout_reports_films_and_keeps_the_episodes(
    tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    film, episodes = tmp_path / "deep" / "film.webp", tmp_path / "episodes.npz"
    files = ["--video", str(film), "--out", str(episodes), "--speed", "8"]
    arguments = ["rollout", "avoid", "--checkpoint", tiny, "--n", "2", "--seed", "9"]
    assert main([*arguments, *files, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["task"] == "avoid" and report["checkpoint"] == tiny_checkpoint().digest
    assert report["n"] == 2 == sum(report["reasons"].values())
    assert {"success", "alignment", "modes", "intervals"} <= set(report)

    kept = load_demonstrations(episodes)
    again = rollout(tiny_checkpoint(), RolloutConfig(episodes=2, seed=9))
    for mine, same in zip(kept, again, strict=True):
        assert np.array_equal(mine.qpos, same.qpos) and mine.outcome == same.outcome
    lengths = [len(one.actions) for one in kept]
    assert report["steps"] == {
        "mean": sum(lengths) / 2, "least": min(lengths), "most": max(lengths)
    }  # fmt: skip

    with Image.open(film) as moving:
        assert moving.size == (640, 284)
        frames = []
        for number in range(moving.n_frames):
            moving.seek(number)
            frames.append(np.asarray(moving.convert("RGB")).astype(int))
    assert len(frames) == -(-(-(-max(lengths) // 8) + 1) // 2)
    assert all(frame.std() > 20 for frame in frames)
    assert np.abs(frames[-1] - frames[0]).mean() > 0.5


def test_rollout_prints_a_table_of_modes_and_failures(
    tiny: str, capsys: pytest.CaptureFixture[str]
):
    assert main(["rollout", "avoid", "--checkpoint", tiny, "--n", "3"]) == 0
    shown = capsys.readouterr().out
    assert "avoid, seeds 0 … 2" in shown and "control steps" in shown
    assert "share" in shown


def test_a_task_without_a_checkpoint_names_those_with_one_and_how_to_make_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    shipped_file = shipped._file
    monkeypatch.setattr(
        shipped, "_file", lambda task: tmp_path if task == "pushing" else shipped_file(task)
    )
    assert main(["rollout", "pushing"]) == 1
    said = capsys.readouterr().err
    assert "tasks that have one: 'avoid', 'sorting'" in said
    assert "rodif pretrain pushing" in said


def test_a_checkpoint_of_another_task_is_refused(tiny: str, capsys: pytest.CaptureFixture[str]):
    assert main(["rollout", "pushing", "--checkpoint", tiny]) == 1
    assert "is a checkpoint of task 'avoid', not of 'pushing'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("wish", "message"),
    [
        (["--video", "film.avi"], "'film.avi', but must be a file name that ends in .mp4 or .webp"),
        (["--speed", "0"], "speed is 0, but must be at least 1"),
        (["--n", "0"], "episodes is 0"),
        (["--processes", "0"], "processes is 0, but must be at least 1"),
    ],
)
def test_wishes_that_cannot_be_met_are_refused(
    wish: list[str], message: str, tiny: str, capsys: pytest.CaptureFixture[str]
):
    assert main(["rollout", "avoid", "--checkpoint", tiny, *wish]) == 1
    assert message in capsys.readouterr().err


def test_without_gl_the_film_is_refused_before_anything_is_rolled_out(
    tiny: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("worker.cli.rollout.rolled_out", lambda *_: pytest.fail("rolled out"))
    monkeypatch.setenv("MUJOCO_GL", "none")
    wish = ["--video", "film.mp4"]
    assert main(["rollout", "avoid", "--checkpoint", tiny, *wish]) == 1
    assert "MUJOCO_GL is 'none'; legal values are egl" in capsys.readouterr().err


@pytest.mark.slow
def test_two_processes_make_the_same_episodes_in_the_same_order():
    config, seen = RolloutConfig(episodes=5, seed=40), []
    shared = parallel_rollout(
        tiny_checkpoint(), config, 2, progress=lambda done, of: seen.append((done, of))
    )
    # The same batches in one process: the network's last bits depend on the rows of a batch.
    alone = rollout(tiny_checkpoint(), RolloutConfig(episodes=5, seed=40, max_parallel=3))
    assert [one.to_bytes() for one in shared] == [one.to_bytes() for one in alone]
    assert seen[-1] == (5, 5)
    with pytest.raises(ValueError, match="read-only"):
        shared[0].actions[0] = 0
