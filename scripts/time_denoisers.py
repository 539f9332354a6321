"""What each preset costs: weights, and milliseconds of one batch on one thread.

Prints the rows of the tables in docs/architectures.md. Times are process time, the best of a few
repetitions: a machine that is busy with other work changes them little.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from rodif_core.policies.policy import build_denoiser
from rodif_core.policies.resnet import ImageConfig, ImageEncoder
from rodif_core.presets import PRESETS
from rodif_core.tasks import get_task

OBSERVATION_DIM = 10  # for every architecture alike; a task's own differs a little
PROPRIOCEPTION_DIM = 6  # Aligning's
ENCODERS = {"cpu": ImageConfig(width=16), "paper": ImageConfig(width=64)}


def milliseconds(work: Callable[[], object], repeat: int) -> float:
    """Best process time of `repeat` runs, after one that does not count."""
    times = []
    for _ in range(repeat + 1):
        start = time.process_time()
        work()
        times.append(1000 * (time.process_time() - start))
    return min(times[1:])


def time_module(module: torch.nn.Module, rows: tuple[Tensor, ...], repeat: int) -> str:
    """Table cells: weights, forward, forward and backward."""

    def forward() -> None:
        with torch.no_grad():
            module(*rows)

    def both() -> None:
        module.zero_grad(set_to_none=True)
        module(*rows).sum().backward()

    weights = sum(value.numel() for value in module.parameters())
    return f"{weights:,} | {milliseconds(forward, repeat):,.1f} | {milliseconds(both, repeat):,.1f}"


def main() -> int:
    """Time every preset."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=64, help="rows of a batch (default 64)")
    parser.add_argument("--repeat", type=int, default=3, help="runs of which the best counts")
    parser.add_argument("--presets", nargs="+", default=["cpu", "paper"], choices=list(ENCODERS))
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    for architecture, presets in PRESETS.items():
        for name in args.presets:
            size = replace(
                presets[name].policy_config(get_task("avoid")), observation_dim=OBSERVATION_DIM
            )
            noisy = torch.randn(args.batch, size.predicted_steps, size.action_dim)
            k = torch.randint(1, size.denoising_steps + 1, (args.batch,))
            histories = torch.randn(args.batch, size.observation_steps, OBSERVATION_DIM)
            cells = time_module(build_denoiser(size), (noisy, k, histories), args.repeat)
            sys.stdout.write(f"| `{architecture}` | `{name}` | {cells} |\n")
    for name in args.presets:
        config = ENCODERS[name]
        shape = (args.batch, 1, config.cameras, config.pixels, config.pixels, 3)
        frames = torch.randint(0, 256, shape, dtype=torch.uint8)
        rows = torch.randn(args.batch, 1, PROPRIOCEPTION_DIM), frames
        cells = time_module(ImageEncoder(config), rows, args.repeat)
        sys.stdout.write(f"| two cameras | `{name}` | {cells} |\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
