"""Boards, as they are written on the command line."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mirrorskin.engine.calibration.lens.board import Board

BoardText = Annotated[
    str,
    typer.Option(
        metavar="BOARD",
        help="charuco:COLUMNSxROWS:SQUARE:MARKER, as in charuco:7x5:2mm:1.5mm, or"
        " dots:COLUMNSxROWS:PITCH, as in dots:11x9:1mm.",
    ),
]


def board_of(text: str) -> Board:
    """Read what a board is.

    Parameters
    ----------
    text : str
        ``charuco:7x5:2mm:1.5mm``: columns and rows of squares, edges of squares and of markers;
        ``dots:11x9:1mm``: columns and rows of dots, and their pitch.

    Raises
    ------
    InputError
        It is neither, or there can be no such board.
    """
    from mirrorskin.cli.quantity import length
    from mirrorskin.engine.calibration.lens.board import Charuco, Dots
    from mirrorskin.io import InputError

    kind, *numbers = text.strip().split(":")
    size = re.fullmatch("([1-9][0-9]{0,2})x([1-9][0-9]{0,2})", numbers[0].strip()) if numbers else None
    count = {"charuco": 2, "dots": 1}.get(kind)
    if size is None or count is None or len(numbers) != 1 + count:
        raise InputError(f"--board {text}: write e.g. charuco:7x5:2mm:1.5mm, or dots:11x9:1mm")
    columns, rows = int(size[1]), int(size[2])
    lengths = [length(one, "--board") for one in numbers[1:]]
    return Charuco(columns, rows, *lengths) if count == 2 else Dots(columns, rows, *lengths)
