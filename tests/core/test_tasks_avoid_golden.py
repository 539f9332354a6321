"""Avoid's episodes are what they were: the shipped checkpoint was measured on this physics.

`golden_avoid.json` was written once, by `python -m tests.core.test_tasks_avoid_golden`, when the
shipped checkpoint was. A change that is meant to alter Avoid writes it again and trains again.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rodif_core.demonstrations import make_demonstrations
from rodif_core.policies.checkpoint import load_checkpoint
from rodif_core.rollout import rollout
from rodif_core.shipped import shipped_checkpoint
from rodif_core.spec import RolloutConfig, TaskName
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory

FILE = Path(__file__).with_name("golden_avoid.json")
EVERY = 10  # control steps between the rows that are kept


def facts(episodes: Sequence[Trajectory]) -> list[dict[str, Any]]:
    return [
        {
            "context": one.context,
            "outcome": one.outcome,
            "steps": len(one.actions),
            "observations": one.observations[::EVERY].tolist(),
            "actions": one.actions[::EVERY].tolist(),
            "qpos": one.qpos[::EVERY].tolist(),
        }
        for one in episodes
    ]


def demonstrated() -> list[dict[str, Any]]:
    return facts(make_demonstrations(get_task("avoid"), episodes=5, seed=11))


def rolled_out() -> list[dict[str, Any]]:
    checkpoint = load_checkpoint(shipped_checkpoint(TaskName.AVOID))
    return facts(rollout(checkpoint, RolloutConfig(episodes=5, seed=500)))


# The network's last bits depend on the machine's vector instructions, and rollouts feed them back.
@pytest.mark.parametrize(
    ("name", "made", "tolerance"),
    [("demonstrations", demonstrated, 1e-6), ("rollouts", rolled_out, 1e-3)],
)
def test_avoid_gives_the_episodes_it_always_gave(name: str, made: Any, tolerance: float) -> None:
    golden = json.loads(FILE.read_text())[name]
    now = json.loads(json.dumps(made()))
    assert len(now) == len(golden)
    for before, after in zip(golden, now, strict=True):
        for key in ("context", "outcome", "steps"):
            assert after[key] == before[key]
        for key in ("observations", "actions", "qpos"):
            np.testing.assert_allclose(after[key], before[key], rtol=0, atol=tolerance)


if __name__ == "__main__":
    FILE.write_text(json.dumps({"demonstrations": demonstrated(), "rollouts": rolled_out()}) + "\n")
