"""Whether a checkpoint and the task that it names fit together: looked at before it is used."""

from __future__ import annotations

from rodif_core.errors import CheckpointFileError
from rodif_core.policies.checkpoint import Checkpoint
from rodif_core.policies.normaliser import Normaliser
from rodif_core.tasks import get_task


def check_fit(checkpoint: Checkpoint) -> None:
    """Raises CheckpointFileError naming the first number of the policy that is not the task's."""
    task, policy = get_task(checkpoint.task), checkpoint.policy
    config, images = policy.config, policy.config.images
    read = task.observation_dim if images is None else task.proprioception_dim
    points, states = checkpoint.support.points, checkpoint.support.normaliser
    if images is not None and states is None:
        raise CheckpointFileError(
            "the policy sees pictures, but its file has no normaliser of the task's observations"
        )
    numbers = {
        "cameras": (0 if images is None else images.cameras, len(task.cameras)),
        "numbers of an observation beside pictures": (config.proprioception_dim, read),
        "numbers of an action": (config.action_dim, task.action_dim),
        "numbers of a state in its support": (
            points.shape[-1] if points.ndim == 2 else 0,
            task.observation_dim,
        ),
        **_widths("normaliser", policy.normaliser, config.observation_dim, task.action_dim),
    }
    if states is not None:
        numbers |= _widths("support's normaliser", states, task.observation_dim, task.action_dim)
    if images is not None and images.told:
        numbers["numbers that pictures tell"] = (
            images.told,
            task.observation_dim - task.proprioception_dim,
        )
    for name, (given, wanted) in numbers.items():
        if given != wanted:
            raise CheckpointFileError(
                f"the policy does not fit task {task.name.value!r}: {name}: {given} in the file,"
                f" but must be {wanted}"
            )


def _widths(
    name: str, normaliser: Normaliser, observation: int, action: int
) -> dict[str, tuple[int, int]]:
    wanted = {"observation": observation, "action": action}
    return {
        f"{part} of its {name}": (tensor.numel(), wanted[part.partition("_")[0]])
        for part, tensor in vars(normaliser).items()
    }
