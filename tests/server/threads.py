"""Many calls at the same moment."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

ResultT = TypeVar("ResultT")


def at_once(calls: Sequence[Callable[[], ResultT]]) -> list[ResultT]:
    """Start all calls together, each in its thread; results in order, the first error is raised."""
    barrier = threading.Barrier(len(calls))

    def start(call: Callable[[], ResultT]) -> ResultT:
        barrier.wait()
        return call()

    with ThreadPoolExecutor(len(calls)) as pool:
        return list(pool.map(start, calls))
