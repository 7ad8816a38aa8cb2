"""``mirrorskin calibrate board``: a board to print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mirrorskin.cli.calibrate.boards import BoardText, board_of


def command(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="BOARD.png", help="Picture to write.")],
    board: BoardText,
    dpi: Annotated[float, typer.Option(help="Pixels per inch, to be printed at that.")] = 2540.0,
) -> None:
    """Paint a board for printing, in its true size."""
    from mirrorskin.engine.calibration.lens.board import paint_board
    from mirrorskin.io import InputError, check_output
    from mirrorskin.io.printing import save_print

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
