"""``mirrorskin calibrate board`` and ``scale``: a board to print, and positions of pixels on the sheet."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.commands.calibrate import inputs
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import STACK

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mirrorskin.engine.calibration.board import Board
    from mirrorskin.engine.calibration.lens import LensFit
    from mirrorskin.io import CameraId

_SHOTS = 8  # frames at each of two positions that nearly coincide

BoardText = Annotated[
    str,
    Option(
        metavar="BOARD",
        help="charuco:COLUMNSxROWS:SQUARE:MARKER, as in charuco:7x5:2mm:1.5mm, or"
        " dots:COLUMNSxROWS:PITCH, as in dots:11x9:1mm.",
    ),
]


def board_of(text: str) -> Board:
    """Return the board of ``charuco:COLUMNSxROWS:SQUARE:MARKER`` or ``dots:COLUMNSxROWS:PITCH``."""
    from mirrorskin.cli.quantity import length
    from mirrorskin.engine.calibration.board import Charuco, Dots
    from mirrorskin.io import InputError

    kind, *numbers = text.strip().split(":")
    size = re.fullmatch("([1-9][0-9]{0,2})x([1-9][0-9]{0,2})", numbers[0].strip()) if numbers else None
    count = {"charuco": 2, "dots": 1}.get(kind)
    if size is None or count is None or len(numbers) != 1 + count:
        raise InputError(f"--board {text}: write e.g. charuco:7x5:2mm:1.5mm, or dots:11x9:1mm")
    columns, rows = int(size[1]), int(size[2])
    lengths = [length(number, "--board") for number in numbers[1:]]
    return Charuco(columns, rows, *lengths) if count == 2 else Dots(columns, rows, *lengths)


def board_command(
    output: Annotated[Path, Option("--output", "-o", metavar="BOARD.png", help="Picture to write.")],
    board: BoardText,
    dpi: Annotated[float, Option(help="Resolution of the printer, pixels per inch.")] = 2540.0,
) -> None:
    """Paint a board for printing in its true size."""
    from mirrorskin.engine.calibration.board import paint_board
    from mirrorskin.io import InputError, check_output
    from mirrorskin.io.formats.pictures import save_print

    kind = board_of(board)
    if output.suffix.lower() != ".png":
        raise InputError(f"{output}: a board is written as PNG, which stores its size: name it board.png")
    if not 1 <= dpi <= 100_000:
        raise InputError(f"--dpi {dpi:g}: give the pixels per inch of a printer, such as 2540")
    check_output(output)
    picture = paint_board(kind, dpi)
    save_print(picture, output, dpi)
    rows, columns = picture.shape
    width, height = (side * 25.4 / dpi for side in (columns, rows))
    click.echo(
        f"{output}: {kind}, {columns} x {rows} pixels at {dpi:g} dpi, {width:.2f} x {height:.2f} mm"
        " with its margin: print it at 100 %, and measure it"
    )


def command(
    output: options.LearnedCalibration,
    board: BoardText,
    pictures: Annotated[
        list[Path] | None,
        Argument(
            metavar="PICTURE-OR-RECORDING...",
            help="Of the board, flat on the sheet, at several positions and orientations.",
        ),
    ] = None,
    rig: inputs.OptionalRig = None,
    places: Annotated[int, Option(min=1, help="With --rig: places of the board.")] = 5,
    overwrite: inputs.Overwrite = False,
    as_json: options.Json = False,
    **stack: Annotated[Any, STACK.only("verify")],
) -> None:
    """Determine millimetres per pixel, perspective and distortion from a board on the sheet.

    One picture is enough if the board fills it; otherwise take several.
    """
    from mirrorskin import io
    from mirrorskin.engine.calibration.lens import calibrate_lens
    from mirrorskin.io.model.calibrated import outdated
    from mirrorskin.io.model.calibration import PARTS

    kind, paths = board_of(board), list(pictures or [])
    if not paths and rig is None:
        raise io.InputError("no picture of a board is given: name some, or capture them with --rig RIG.toml")
    if overwrite and rig is None:
        raise io.InputError("--overwrite is for recordings taken with --rig: remove it")
    io.check_output(output, *paths, rig, replaces="calibration")
    if rig is not None:
        prompt = "lay the board flat on the sheet, place {} of {}, turned and moved, also to the corners"
        if paths:
            _read(paths, output, stack)  # refused before anything moves
        boards = inputs.at_each("board", prompt, places, inputs.still_plan(rig), _SHOTS)
        paths += inputs.take(rig, output, boards, overwrite=overwrite)
    read, camera = _read(paths, output, stack)
    fit = calibrate_lens(read, kind)
    process = inputs.process_of(
        board=str(kind),
        sources=paths,
        marks=sum(fit.marks),
        worst=fit.worst,
        corner_sigma=fit.corner_sigma,
    )
    calibration = inputs.save(output, camera, _learned(fit, paths), process, as_json)
    old = [PARTS[part].command for part, _ in outdated(calibration, fit.lens.pixel_size)]
    if old:
        click.echo(f"learn {', '.join(old)} again: made with another pixel size", err=True)


def _read(
    paths: Sequence[Path], output: Path, stack: dict[str, Any]
) -> tuple[list[tuple[str, NDArray[Any]]], CameraId]:
    """Return pictures and the means of recordings with their names, and the camera."""
    from mirrorskin import io
    from mirrorskin.engine.calibration.board import mean_of_still
    from mirrorskin.io.formats.pictures import read_picture
    from mirrorskin.io.formats.registry import format_of_frames

    pictures, names, dtypes = [], [], []
    for path in paths:
        if path.is_dir():
            raise io.InputError(
                f"{path} is a sequence: name pictures of the board one by one, or a recording"
            )
        form = format_of_frames(path)
        if form is not None and form.name in ("picture", "TIFF"):
            pictures.append(read_picture(path))
            continue
        with inputs.open_still(path, **stack) as recording:
            pictures.append(mean_of_still(recording))
            names.append(recording.header.camera)
            dtypes.append(recording.dtype)
    # The type of a picture may differ from the camera's: a recording or the file is preferred.
    if not dtypes and output.exists():
        dtypes = [io.open_calibration(output).camera.dtype]
    first = pictures[0]
    camera = io.CameraId(inputs.camera_name(names), first.shape, (dtypes or [first.dtype])[0])
    return [(str(path), picture) for path, picture in zip(paths, pictures, strict=True)], camera


def _learned(fit: LensFit, paths: Sequence[Path]) -> inputs.Learned:
    lens, size = fit.lens, fit.lens.pixel_size[0]
    each = [
        {"source": str(path), "marks": marks, "error": error}
        for path, marks, error in zip(paths, fit.marks, fit.errors, strict=True)
    ]
    sizes = {"pixel_size": size, "pixel_size_sigma": size * lens.scale_sigma}
    errors = {"error": lens.error, "worst": fit.worst, "corner_sigma": fit.corner_sigma}
    return inputs.Learned(
        lens,
        {},
        {**sizes, **errors, "distortion": lens.distortion.tolist(), "pictures": each},
        f"{1000 * size:.4f} ± {1000 * size * lens.scale_sigma:.2g} µm a pixel"
        f" ({lens.scale_sigma:.2%}); residual of {sum(fit.marks)} marks in {len(paths)}"
        f" picture{'s' if len(paths) > 1 else ''} {lens.error:.3f} pixels RMS, {fit.worst:.2f} at most;"
        f" standard error of the map near its corners {fit.corner_sigma:.2g} pixels",
    )
