"""Copies of a policy that each go one behaviour group's way, to drive in front of experts.

A policy that is about to be steered must be able to go each way wherever it may be sent. Left to
itself it goes a rare way where that is easy, so that its own mistakes hardly show where it is hard.
A copy that imitates its successes in one group goes that way nearly always; experts that take over
from the copies show the way back from mistakes which the policy makes only once it is steered. The
group of most successes needs no copy: there the policy drives itself.
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


def steered_copies(
    checkpoint: Checkpoint, driven: Sequence[Trajectory], seed: int
) -> dict[str, Checkpoint]:
    """For each group with successes among the rollouts `driven`, but at most half of them all, a
    copy that imitates those, by the groups' names and in the task's order. Deterministic on a CPU.
    """
    policy, config = checkpoint.policy, GuideConfig(updates=UPDATES, learning_rate=LEARNING_RATE)
    done = [one for one in driven if one.success]
    copies = {}
    for group in get_task(checkpoint.task).groups:
        own = [one for one in done if one.outcome["group"] == group]
        if 0 < len(own) <= len(done) / 2:
            moved = guide(policy, *decisions_done(policy, own), IMITATION, config, seed)
            card = {"kind": "steered", "parent": checkpoint.digest, "group": group}
            copies[group] = replace(checkpoint, policy=moved, card=card)
    return copies
