"""``mirrorskin info``: the contents of a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.output import print_fields, print_json
from mirrorskin.cli.stack import CHOICE, FORMATS
from mirrorskin.io.formats.registry import surfaces


def command(
    file: Annotated[
        Path,
        Argument(
            metavar="FILE",
            help=f"Recording, result, calibration, a surface ({surfaces()}) or frames: {FORMATS}.",
        ),
    ],
    verify: Annotated[
        bool, Option("--verify", help="Read all frames, and compare them with their checksums.")
    ] = False,
    as_json: options.Json = False,
    **chosen: Annotated[Any, CHOICE],
) -> None:
    """Show what a file contains."""
    from mirrorskin import io

    facts = io.describe(file, **chosen)
    if verify:
        facts["checksums"] = _verify(file)
    if as_json:
        print_json(facts)
    else:
        print_fields(facts)


def _verify(file: Path) -> str:
    """Report that all frames are as recorded; InputError if they are not, or if it cannot be checked."""
    from mirrorskin import io

    with io.open_recording(file) as recording:
        damaged, count = recording.find_damage(), recording.shape[0]
    if damaged is None:
        raise io.InputError(f"{file} has no checksums of its frames: only recordings of this program have")
    if damaged.size:
        numbers = ", ".join(map(str, damaged[:5])) + (", ..." if damaged.size > 5 else "")
        raise io.InputError(
            f"{file}: {damaged.size} of {count} frames differ from what was recorded ({numbers}): "
            "copy it again"
        )
    return f"all {count} frames are as they were recorded"
