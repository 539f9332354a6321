"""Write docs/models.md: a card for every shipped policy, from what its file says about itself.

    .venv/bin/python scripts/model_cards.py

A test compares the page with the files, so that no card tells of another policy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rodif_core.intervals import wilson_interval
from rodif_core.policies.checkpoint import Checkpoint, load_checkpoint
from rodif_core.shipped import shipped_checkpoint, shipped_tasks
from rodif_core.tasks import get_task

PAGE = Path(__file__).parents[1] / "docs" / "models.md"
# Success of the paper's pretrained policies (its table of main results), per cent. Its
# demonstrations are other ones, and it sees Aligning and Stacking through cameras only.
PAPER_SUCCESS = {"avoid": 78, "pushing": 58, "sorting": 82, "aligning": 5, "stacking": 23}
# User time of the training on one thread of a shared AMD EPYC, demonstrations and measurement
# included; what `time` said when the shipped file was made. Nothing timed the takeovers of Sorting
# and the trainings of Aligning and Stacking: there it is the wall time, which is more, on a shared
# core.
CPU_MINUTES = {
    "avoid": 10,
    "pushing": 33,
    "sorting": 140,
    "aligning": 90,
    "aligning-state": 9,
    "stacking": 195,
    "stacking-state": 75,
}

HEAD = """# Shipped policies
One pretrained policy a task lies in `rodif_core/checkpoints/`. This page is made from these
files by `.venv/bin/python scripts/model_cards.py`. Brackets are 95 % Wilson intervals;
*preferred* is the share of the preferred group among successes. *Paper* is the success of the
paper's own pretrained policy on the task of that name: other demonstrations, other simulation, and
Aligning and Stacking seen through cameras only, so a `-state` policy has an easier task than it.

"""


def main() -> None:
    """Write the page."""
    PAGE.write_text(page())


def page() -> str:
    """The whole page."""
    checkpoints = [load_checkpoint(shipped_checkpoint(task)) for task in shipped_tasks()]
    rows = [
        "| task | success | preferred | off the data | n | paper |",
        "|---|---|---|---|---|---|",
        *(_row(one) for one in checkpoints),
    ]
    return HEAD + "\n".join(rows) + "\n" + "".join(_card(one) for one in checkpoints)


def measurement(checkpoint: Checkpoint) -> dict[str, Any]:
    """The evaluation on a card; Avoid's, the first one, has it under another name."""
    found: dict[str, Any] = checkpoint.card.get("evaluation") or checkpoint.card["measured"]
    return found


def _row(checkpoint: Checkpoint) -> str:
    task, measured = get_task(checkpoint.task), measurement(checkpoint)
    paper = PAPER_SUCCESS.get(task.name.value.removesuffix("-state"))
    cells = [
        f"[`{task.name.value}`](#{task.name.value})",
        f"{measured['success']:.1%} {_interval(measured, 'success')}",
        f"{task.preferred_group}: {measured['alignment_of_successes']:.1%}"
        f" {_interval(measured, 'alignment_of_successes')}",
        f"{measured['off_support']:.1%}",
        str(measured["n"]),
        "–" if paper is None else f"{paper} %",
    ]
    return "| " + " | ".join(cells) + " |"


def _card(checkpoint: Checkpoint) -> str:
    name, card, config = checkpoint.task.value, checkpoint.card, checkpoint.policy.config
    weights = sum(value.numel() for value in checkpoint.policy.denoiser.parameters())
    shape = (
        f"history {config.observation_steps}, chunk {config.predicted_steps},"
        f" executed {config.executed_steps}, K = {config.denoising_steps}"
    )
    shown = card["demonstrations"] - card.get("recoveries", 0)
    data = _data(card, shown)
    if "began_with" in card:
        data = _data(card["began_with"], shown) + _went_on(card)
    if checkpoint.policy.encoder is not None:
        data += _seen(checkpoint)
    return (
        f"\n## {name}\n"
        f"`{config.architecture.value}` with {weights:,} weights; {shape}. {data}"
        f"{_minutes(name)} Digest `{checkpoint.digest[:16]}`.\n"
        f"```\n{_commands(checkpoint, shown)}\n```\n"
        f"Modes of the successes: {_modes(checkpoint)}.\n"
    )


def _commands(checkpoint: Checkpoint, shown: int) -> str:
    """What makes such a policy: one command, or two where further rounds came later."""
    name, card = checkpoint.task.value, checkpoint.card
    command = f"rodif pretrain {name}"
    first = f"{command} --preset cpu --demonstrations {shown}"
    last = f"--evaluate {measurement(checkpoint)['n']} --out {name}.safetensors"
    if "began_with" not in card:
        return f"{first} {last}"
    names = ("rounds", "recoveries", "drives", "steered_drives", "round_updates")
    options = " ".join(f"--{one.replace('_', '-')} {card['preset'][one]}" for one in names)
    return (
        f"{first} --out before.safetensors\n"
        f"{command} --begin-with before.safetensors --demonstrations {shown} {options} {last}"
    )


def _went_on(card: dict[str, Any]) -> str:
    """What came after the policy of a file that the training went on from."""
    preset = card["preset"]
    rollouts = preset["recoveries"] * preset["steered_drives"]
    return (
        f" With that policy (digest `{card['began_with']['digest'][:16]}`) began {preset['rounds']}"
        f" more of {preset['round_updates']:,} updates, on the demonstrations and what experts did"
        f" after takeovers ({card['recoveries']}) from it and from {rollouts:,} rollouts of copies"
        " that each go one group's way ([tasks.md](tasks.md#what-made-them-learnable))."
    )


def _minutes(name: str) -> str:
    return f" Up to {CPU_MINUTES[name]} CPU minutes in all." if name in CPU_MINUTES else ""


def _data(card: dict[str, Any], shown: int) -> str:
    """What the denoiser learned from."""
    preset = card["preset"]
    rows, rounds = f"{preset['batch_size']} rows", card.get("rounds", 0)
    if preset.get("begin_with"):
        updates = f", then {rounds} rounds of {preset['round_updates']:,} updates of {rows}"
        return (
            f"Begins with the shipped `{preset['begin_with']}`, whose state it sees from then on;"
            f" {shown:,} scripted demonstrations and what experts did after takeovers"
            f" ({card['recoveries']} in all); {preset['looks']} trainings of the encoder alone"
            f"{updates if rounds else ''}."
        )
    data = f"{shown:,} scripted demonstrations, {preset['updates']:,} updates of {rows}"
    if rounds:
        data += (
            f"; then {rounds} rounds of {preset['round_updates']:,} updates, each on what"
            f" experts did after takeovers too ({card['recoveries']} in all)"
        )
    return data + "."


def _seen(checkpoint: Checkpoint) -> str:
    """What the encoder learned from."""
    images, encoder = checkpoint.policy.config.images, checkpoint.policy.encoder
    assert images is not None and encoder is not None  # who calls has looked
    weights = sum(value.numel() for value in encoder.parameters())
    config = checkpoint.card["preset"]["encoder"]
    told = (
        f" The encoder of its {images.cameras} cameras has {weights:,} weights and saw"
        f" {config['moments'] + config.get('rearranged', 0):,} moments in {config['updates']:,}"
        f" updates of {config['batch_size']}"
    )
    preset, further = checkpoint.card["preset"], config.get("round_updates", 0)
    times = preset.get("looks", 0) + preset["rounds"] - (1 if preset.get("begin_with") else 0)
    return told + (f", then {times} times as many in {further:,}." if further and times else ".")


def _modes(checkpoint: Checkpoint) -> str:
    modes, task = measurement(checkpoint)["modes"], get_task(checkpoint.task)
    found = sum(modes.values())
    if len(task.modes) > 6:
        groups = {
            group: sum(count for mode, count in modes.items() if task.group_of(mode) == group)
            for group in task.groups
        }
        return f"{len(modes)} of {len(task.modes)} alive; " + _shares(groups, found)
    return _shares({mode: modes.get(mode, 0) for mode in task.modes}, found)


def _shares(counts: dict[str, int], found: int) -> str:
    parts = []
    for name, count in counts.items():
        low, high = wilson_interval(count, found)
        parts.append(f"{name} {count / max(1, found):.0%} [{100 * low:.0f}–{100 * high:.0f}]")
    return ", ".join(parts)


def _interval(measured: dict[str, Any], name: str) -> str:
    low, high = measured["intervals"][name]
    return f"[{100 * low:.0f}–{100 * high:.0f}]"


if __name__ == "__main__":
    main()
