"""Copies of a policy that each go one behaviour group's way, to drive in front of experts.

A policy that is about to be steered must be able to go each way wherever it may be sent. Left to
itself it goes a rare way where that is easy, so that its own mistakes hardly show where it is hard.
A copy that imitates its successes in one group goes that way mostly; experts that take over from
the copies show the way back from mistakes which the policy makes only once it is steered. The group
of most successes needs no copy: there the policy drives itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rodif_core.guidance import guide
from rodif_core.guided import IMITATION, decisions_done
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.spec import GuideConfig
from rodif_core.tasks import get_task
from rodif_core.trajectory import Trajectory

# docs/tasks.md tells how surely Sorting's copy goes its way.
UPDATES, LEARNING_RATE = 600, 3e-4


def rare_groups(checkpoint: Checkpoint, driven: Sequence[Trajectory]) -> list[str]:
    """The groups with successes among the rollouts `driven`, but at most half of them all, in the
    task's order."""
    done = [one.outcome["group"] for one in driven if one.success]
    groups = get_task(checkpoint.task).groups
    return [group for group in groups if 0 < done.count(group) <= len(done) / 2]


def steered_copy(
    checkpoint: Checkpoint, group: str, driven: Sequence[Trajectory], seed: int
) -> Checkpoint:
    """A copy that imitates the successes in a group among the rollouts `driven`, whoever drove.

    Deterministic on a CPU. Raises LearningError when there is none.
    """
    own = [one for one in driven if one.success and one.outcome["group"] == group]
    policy, config = checkpoint.policy, GuideConfig(updates=UPDATES, learning_rate=LEARNING_RATE)
    moved = guide(policy, *decisions_done(policy, own), IMITATION, config, seed)
    card = {"kind": "steered", "parent": checkpoint.digest, "group": group}
    return replace(checkpoint, policy=moved, card=card)
