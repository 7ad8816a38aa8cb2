"""Boards, as they are written on the command line."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mirrorskin.engine.calibration.board import Board

BoardText = Annotated[
    str,
    typer.Option(
        metavar="BOARD",
        help="charuco:COLUMNSxROWS:SQUARE:MARKER, as in charuco:7x5:2mm:1.5mm, or"
        " dots:COLUMNSxROWS:PITCH, as in dots:11x9:1mm.",
    ),
]


def board_of(text: str) -> Board:
    """Read what a board is."""
    from mirrorskin.cli.quantity import length
    from mirrorskin.engine.calibration.board import Charuco, Dots
    from mirrorskin.io import InputError

    kind, *numbers = text.strip().split(":")
    size = re.fullmatch("([1-9][0-9]{0,2})x([1-9][0-9]{0,2})", numbers[0].strip()) if numbers else None
    count = {"charuco": 2, "dots": 1}.get(kind)
    if size is None or count is None or len(numbers) != 1 + count:
        raise InputError(f"--board {text}: write e.g. charuco:7x5:2mm:1.5mm, or dots:11x9:1mm")
    columns, rows = int(size[1]), int(size[2])
    lengths = [length(one, "--board") for one in numbers[1:]]
    return Charuco(columns, rows, *lengths) if count == 2 else Dots(columns, rows, *lengths)


def command(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="BOARD.png", help="Picture to write.")],
    board: BoardText,
    dpi: Annotated[float, typer.Option(help="Pixels per inch, to be printed at that.")] = 2540.0,
) -> None:
    """Paint a board for printing, in its true size."""
    from mirrorskin.engine.calibration.board import paint_board
    from mirrorskin.io import InputError, check_output
    from mirrorskin.io.pictures import save_print

    kind = board_of(board)
    if output.suffix.lower() != ".png":
        raise InputError(f"{output}: a board is written as PNG, which keeps its size: name it board.png")
    if not 1 <= dpi <= 100_000:
        raise InputError(f"--dpi {dpi:g}: pixels per inch of a printer are needed, such as 2540")
    check_output(output)
    picture = paint_board(kind, dpi)
    save_print(picture, output, dpi)
    rows, columns = picture.shape
    width, height = (side * 25.4 / dpi for side in (columns, rows))
    typer.echo(
        f"{output}: {kind}, {columns} x {rows} pixels at {dpi:g} dpi, {width:.2f} x {height:.2f} mm"
        " with its margin: print it at 100 %, and measure it"
    )
