"""Run a command that ends when its starter ends: `leash.py STARTER_PID SIGNAL COMMAND…`.

On Linux the kernel sends SIGNAL to the process when its parent dies, however it dies. The setting
survives exec. To the kernel the parent is the thread that started the process, so that thread has
to outlive the process. Elsewhere the command simply runs. (Setting it between fork and exec in the
starter itself would run Python code in a forked copy of a threaded program.)
"""

from __future__ import annotations

import ctypes
import os
import sys

PR_SET_PDEATHSIG = 1  # linux/prctl.h


def end_with_parent(signal_number: int) -> None:
    """Let the kernel send `signal_number` to this process when its parent dies (Linux only)."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal_number)


def main(arguments: list[str]) -> None:
    """Put the leash on, then become the command."""
    starter, signal_number, command = int(arguments[0]), int(arguments[1]), arguments[2:]
    end_with_parent(signal_number)
    if sys.platform == "linux" and os.getppid() != starter:
        sys.exit(0)  # the starter died before the leash was on
    os.execvp(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
