"""Options that several commands share."""

from __future__ import annotations

import argparse
import os

DEFAULT_URL = "http://127.0.0.1:8000"


def add_connection_arguments(parser: argparse.ArgumentParser) -> None:
    """`--url`, `--token` and `--campaign`; the first two also from the environment."""
    parser.add_argument(
        "--url",
        default=os.environ.get("RODIF_URL", DEFAULT_URL),
        help="address of the system (or RODIF_URL; default %(default)s)",
    )
    parser.add_argument(
        "--token",
        default=os.environ.get("RODIF_TOKEN"),
        help="bearer token rdf_… (or RODIF_TOKEN)",
    )
    parser.add_argument("--campaign", help="name or number; not needed when there is only one")


def number_list(text: str) -> list[int]:
    """ "3,5,7" or "100-104" or both joined by commas, as a list of whole numbers."""
    numbers: list[int] = []
    for part in text.split(","):
        low, dash, high = part.strip().partition("-")
        try:
            first, last = int(low), int(high) if dash else int(low)
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"{part!r} is not a whole number or a range like 100-104"
            ) from None
        if last < first:
            raise argparse.ArgumentTypeError(f"the range {part!r} runs backwards")
        numbers += range(first, last + 1)
    return numbers
