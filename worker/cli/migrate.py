"""`rodif migrate`: what `up` does before it starts anything, for set-ups with a process each."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping

from worker.cli.options import read_settings


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command has no arguments; the database comes from `RODIF_DATABASE_URL`."""
    subparsers.add_parser(
        "migrate",
        help="bring the database up to date; ensure admin account and shipped checkpoints",
    )


def run(args: argparse.Namespace, environment: Mapping[str, str] = os.environ) -> int:  # noqa: ARG001
    """Prepare the database; the admin's password is `RODIF_ADMIN_PASSWORD`, or printed once."""
    from worker.cli.up import how_to_sign_in
    from worker.prepare import prepare

    password = environment.get("RODIF_ADMIN_PASSWORD") or None
    prepared = prepare(read_settings(), admin_password=password)
    print("The database is up to date.")
    print(how_to_sign_in(prepared, given=password is not None))
    return 0
