"""Options that several commands share."""

from __future__ import annotations

import argparse
import json
import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from rodif_core.errors import RodifError
from rodif_core.spec import FinetuneConfig
from server.settings import Settings

if TYPE_CHECKING:
    from worker.cli.client import Client

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
        help="token rdf_… of an admin, made under Tokens on the site (or RODIF_TOKEN)",
    )
    parser.add_argument("--campaign", help="name or number; not needed when there is only one")


def connect(args: argparse.Namespace) -> Client:
    """A client of what `add_connection_arguments` says; raises RodifError without a legal token."""
    from worker.cli.client import Client

    if not args.token:
        raise RodifError(
            f"a token is needed: sign in at {args.url} as an admin, make one under Tokens, and"
            " give it with --token or in RODIF_TOKEN"
        )
    if not args.token.isascii() or not args.token.isprintable():
        raise RodifError("the token has characters that no token has; copy it again: rdf_…")
    return Client(args.url, args.token)


def names(kind: type[StrEnum]) -> list[str]:
    """Legal values of an option, as text: of members argparse would show the representation."""
    return [member.value for member in kind]


def output_file(text: str) -> Path:
    """Value of an option that names a file to write, looked at before the work and not after it.

    Raises ArgumentTypeError for a folder, and where no file can be made.
    """
    path = Path(text)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r} is a folder, but must be a file to write")
    there = path if path.exists() else path.absolute().parent
    while not there.exists():
        there = there.parent
    if not (path.exists() or there.is_dir()) or not os.access(there, os.W_OK):
        raise argparse.ArgumentTypeError(
            f"{text!r} cannot be written: {str(there)!r} is no folder, or not yours to write"
        )
    return path


def output_folder(text: str) -> Path:
    """Value of an option that names a folder to write into, made if it is not there.

    Raises ArgumentTypeError where that cannot be.
    """
    path = Path(text)
    there = path.absolute()
    while not there.exists():
        there = there.parent
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise argparse.ArgumentTypeError(
            f"{text!r} cannot be a folder to write into: {str(there)!r} is no folder, or not yours"
            " to write"
        )
    return path


def read_settings(**given: Any) -> Settings:
    """The system's settings, of which `given` win over the environment.

    Raises RodifError naming the setting, its value and what is legal.
    """
    try:
        return Settings(**given)
    except ValidationError as error:
        wrong = [(str(one["loc"][0]), one) for one in error.errors()]
        raise RodifError(
            "; ".join(
                f"{name if name in given else f'RODIF_{name.upper()}'} is {one['input']!r}:"
                f" {one['msg']}"
                for name, one in wrong
            )
        ) from None


def finetune_settings(text: str) -> dict[str, Any]:
    """Value of `--config`: a JSON file with some settings of the fine-tuner, looked at already.

    Raises ArgumentTypeError naming what the file lacks, or the setting and its legal values.
    """
    try:
        settings: dict[str, Any] = json.loads(Path(text).read_text())
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a readable JSON file: {error}") from None
    if not isinstance(settings, dict):
        raise argparse.ArgumentTypeError(f"{text!r} holds {settings!r}, not an object of settings")
    try:
        FinetuneConfig.from_json(settings)
    except RodifError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: {error}") from None
    return settings


def add_config_argument(parser: argparse.ArgumentParser, told: str) -> None:
    """`--config FILE`, into `args.finetune`."""
    parser.add_argument(
        "--config", dest="finetune", type=finetune_settings, metavar="FILE", help=told
    )


PRINTED = Path("-")  # --json without a file


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """`--json` prints JSON in place of the table, `--json FILE` writes it beside the table."""
    parser.add_argument(
        "--json",
        type=output_file,
        nargs="?",
        const=PRINTED,
        metavar="FILE",
        help="print or write JSON",
    )


def give_json(data: Any, where: Path | None) -> bool:
    """Print or write as `add_json_argument` says; whether it was printed."""
    if where == PRINTED:
        print(json.dumps(data))
        return True
    if where is not None:
        where.parent.mkdir(parents=True, exist_ok=True)
        where.write_text(json.dumps(data, indent=1) + "\n")
    return False


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
