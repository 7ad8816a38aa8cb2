"""``mirrorskin info``: what a file holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument
from mirrorskin.cli.output import print_fields, print_json


def command(
    file: Annotated[Path, Argument(metavar="FILE", help="Recording, result, or any HDF5 file.")],
    as_json: options.Json = False,
) -> None:
    """Tell what a file holds."""
    from mirrorskin import io

    facts = io.describe(file)
    if as_json:
        print_json(facts)
    else:
        print_fields(facts)
