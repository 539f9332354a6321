"""`rodif up`: the embedded system in one process tree. Ctrl-C stops all of it."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from worker.cli.options import read_settings

if TYPE_CHECKING:
    from server.settings import Settings
    from worker.prepare import Prepared


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command's arguments; what is not given comes from `RODIF_*` or the defaults."""
    parser = subparsers.add_parser("up", help="start the system: API, pages, workers, queue")
    parser.add_argument("--state", type=Path, help="folder for all data (default: .rodif)")
    parser.add_argument("--host", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, help="port; 0 picks a free one (default: 8000)")
    parser.add_argument(
        "--workers", type=int, default=2, help="jobs done at the same time (default: %(default)s)"
    )


def settings_from(args: argparse.Namespace) -> Settings:
    """Command-line arguments win over the environment."""
    given: dict[str, Any] = {"state_dir": args.state, "host": args.host, "port": args.port}
    return read_settings(**{name: value for name, value in given.items() if value is not None})


def run(args: argparse.Namespace, environment: Mapping[str, str] = os.environ) -> int:
    """Prepare, start, print the address, wait. Raises SystemStartError with what to do."""
    from worker.supervisor import running_system

    settings = settings_from(args)
    password = environment.get("RODIF_ADMIN_PASSWORD") or None
    signal.signal(signal.SIGTERM, _like_ctrl_c)
    signal.signal(signal.SIGINT, _like_ctrl_c)  # a shell script's "&" would have it ignored
    print(f"Starting in {settings.state_dir} …", flush=True)
    with running_system(settings, workers=args.workers, admin_password=password) as system:
        print(f"\nRoDiF Studio is ready at {system.url}")
        print(how_to_sign_in(system.prepared, given=password is not None))
        print(f"Logs: {settings.state_dir / 'logs'}. Ctrl-C stops everything.", flush=True)
        try:
            system.wait()
        except KeyboardInterrupt:
            print("\nStopping …", file=sys.stderr, flush=True)
    return 0


def how_to_sign_in(prepared: Prepared, *, given: bool) -> str:
    """One sentence; a generated password is shown at the first start only."""
    if given:
        return f"Sign in as {prepared.admin} with the password in RODIF_ADMIN_PASSWORD."
    if prepared.password is not None:
        return f"Sign in as {prepared.admin} with password {prepared.password} (shown only now)."
    if not prepared.active:
        return (
            f"Account {prepared.admin} is deactivated; another admin can activate it,"
            " and so does a start with RODIF_ADMIN_PASSWORD."
        )
    return (
        f"Sign in as {prepared.admin} with the password shown at the first start;"
        " to set a new one, start with RODIF_ADMIN_PASSWORD."
    )


def _like_ctrl_c(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
