"""``mirrorskin calibrate scale``: where on the sheet the pixels look."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mirrorskin.cli import options
from mirrorskin.cli.calibrate import inputs
from mirrorskin.cli.calibrate.board import BoardText, board_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mirrorskin.engine.calibration.board import Board
    from mirrorskin.engine.calibration.lens import LensFit
    from mirrorskin.io import Calibration, CameraId, ProcessValue

    Pictures = list[tuple[str, NDArray[Any]]]

_PLACES = 5
_SHOTS = 8


def command(
    output: options.LearnedCalibration,
    board: BoardText,
    pictures: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="PICTURE-OR-RECORDING...",
            help="Of the board, flat on the sheet, at several places and turned.",
        ),
    ] = None,
    rig: inputs.OptionalRig = None,
    places: Annotated[int, typer.Option(min=1, help="With --rig: of the board.")] = _PLACES,
    as_json: options.Json = False,
) -> None:
    """Find millimetres per pixel, perspective and distortion from a board on the sheet.

    One picture is enough where the board fills it; with several, the board need not.
    """
    from mirrorskin import io
    from mirrorskin.engine.calibration.lens import calibrate_lens

    kind, given = board_of(board), list(pictures or [])
    if not given and rig is None:
        raise io.InputError("no picture of a board is given: name some, or take them with --rig RIG.toml")
    io.check_output(output, *given, rig)
    if rig is not None:
        given += inputs.take(rig, output, _plan(rig, places))
    taken, camera = _read(given, output)
    fit = calibrate_lens(taken, kind)
    after = io.update_calibration(output, fit.lens, camera, _process(fit, kind, given))
    _tell(output, fit, given, as_json)
    _warn(after, fit.lens.pixel_size)


def _warn(calibration: Calibration, pixel_size: tuple[float, float]) -> None:
    """Say which parts the new scale has made useless."""
    from mirrorskin.io.calibration.source import outdated
    from mirrorskin.io.calibration.types import GROUPS

    parts = [GROUPS[part] for part, _ in outdated(calibration, pixel_size)]
    if parts:
        typer.echo(f"learn {', '.join(parts)} again: made with another pixel size", err=True)


def _plan(rig: Path, places: int) -> list[inputs.Place]:
    """Say where the board is to lie, with the body lifted."""
    prompt = (
        "lay the board flat on the sheet, place {} of {}, turned and moved from the others, up to the corners"
    )
    return inputs.at_each("board", prompt, places, inputs.still_plan(rig), _SHOTS)


def _read(paths: Sequence[Path], output: Path) -> tuple[Pictures, CameraId]:
    """Read all pictures, and tell of which camera they are."""
    from mirrorskin import io

    read = [_picture(path) for path in paths]
    names = {name for _, name, _ in read} - {""}
    if len(names) > 1:
        raise io.InputError(f"the recordings are of {' and '.join(sorted(names))}: take all with one camera")
    # A picture need not be saved in the camera's type of sample: what a recording or the file says holds.
    told = [dtype for _, _, dtype in read if dtype is not None]
    if not told and output.exists():
        told = [io.open_calibration(output).camera.dtype]
    first = read[0][0]
    camera = io.CameraId("".join(names), first.shape, (told or [first.dtype])[0])
    return [(str(path), picture) for path, (picture, _, _) in zip(paths, read, strict=True)], camera


def _picture(path: Path) -> tuple[NDArray[Any], str, Any]:
    """Read a picture, or the mean of a recording and what that says of its camera."""
    from mirrorskin import io
    from mirrorskin.engine.calibration.board import mean_of_still
    from mirrorskin.io.pictures import PICTURE_SUFFIXES, read_picture

    if path.is_dir() or path.suffix.lower() in (".avi", ".mp4"):
        raise io.InputError(f"{path} is a sequence: name pictures of the board one by one, or a recording")
    if path.suffix.lower() in PICTURE_SUFFIXES:
        return read_picture(path), "", None
    with io.open_recording(path) as recording:
        return mean_of_still(recording), recording.header.camera, recording.dtype


def _process(fit: LensFit, board: Board, paths: Sequence[Path]) -> dict[str, ProcessValue]:
    from mirrorskin.engine.provenance import signature

    return {
        **signature(),
        "board": str(board),
        "sources": ", ".join(map(str, paths)),
        "marks": sum(fit.marks),
        "worst": fit.worst,
        "corner_sigma": fit.corner_sigma,
    }


def _tell(output: Path, fit: LensFit, paths: Sequence[Path], as_json: bool) -> None:
    from mirrorskin.cli.output import print_json

    lens, size = fit.lens, fit.lens.pixel_size[0]
    if as_json:
        each = [
            {"source": str(path), "marks": marks, "error": error}
            for path, marks, error in zip(paths, fit.marks, fit.errors, strict=True)
        ]
        told = {"pixel_size": size, "pixel_size_sigma": size * lens.scale_sigma, "error": lens.error}
        more = {"worst": fit.worst, "corner_sigma": fit.corner_sigma, "distortion": lens.distortion.tolist()}
        print_json({"output": str(output), **told, **more, "pictures": each})
        return
    typer.echo(
        f"{output}: {1000 * size:.4f} +- {1000 * size * lens.scale_sigma:.2g} um a pixel"
        f" ({lens.scale_sigma:.2%}); {sum(fit.marks)} marks in {len(paths)} pictures are off by"
        f" {lens.error:.3f} pixels RMS, {fit.worst:.2f} at most; near its corners the map is known to"
        f" {fit.corner_sigma:.2g} pixels"
    )
