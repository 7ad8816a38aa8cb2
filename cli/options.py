"""Options that several commands share."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

from mirrorskin.cli.groups import Argument, Option
from mirrorskin.io.formats.registry import surfaces


class MotionName(StrEnum):
    """Motion of the sensor's body."""

    vertical = "vertical"
    axial = "axial"
    horizontal = "horizontal"
    twist = "twist"


class CompressionName(StrEnum):
    """Compression of the frames in a recording."""

    raw = "raw"
    bitshuffle = "bitshuffle"
    blosc = "blosc"
    gzip = "gzip"
    lzf = "lzf"


Json = Annotated[bool, Option("--json", help="Print machine-readable output.")]
Device = Annotated[
    str | None, Option(metavar="NAME", help="Number or part of the name, as in 'mirrorskin devices'.")
]
Devices = Annotated[
    str | None,
    Option(
        metavar="NAME",
        help="Number or part of the name, as in 'mirrorskin devices'; 'all' divides the picture among all"
        " devices like the default one.",
    ),
]
LiveFrames = Annotated[
    bool, Option("--live", help="Only the frames that a live run used, with the positions it had.")
]


def result_option(default: str) -> Option:
    """Return the option of a result to write."""
    text = "Result to write: HDF5, or NAME.zarr."
    return Option("--output", "-o", metavar="RES.h5", help=text, show_default=default)


ResultFile = Annotated[Path, Argument(metavar="RES.h5", help=f"Result to take, or a surface: {surfaces()}.")]
Turn = Annotated[
    int | None,
    Option(metavar="N", min=0, help="Of a result of each turn: which one, from 0."),
]
Section = Annotated[
    str | None,
    Option(
        metavar="X1,Y1:X2,Y2",
        help="Cut between two points, from the picture's centre: -2mm,0mm:2mm,0mm.",
        show_default="across the apex",
    ),
]
Calibration = Annotated[
    Path | None,
    Option(metavar="CAL.h5", help="Calibration of the sensor, by 'mirrorskin calibrate'."),
]
Memory = Annotated[str, Option(metavar="SIZE", help="Memory for frames on the move.")]
Strict = Annotated[bool, Option("--strict", help="Warnings are errors: nothing is written, exit code 2.")]
Compression = Annotated[CompressionName, Option(help="How to pack the frames.")]
NewRecording = Annotated[Path, Option("--output", "-o", metavar="REC.h5", help="Recording to write.")]
Overwrite = Annotated[bool, Option("--overwrite", help="Replace an existing file of that name.")]
LearnedCalibration = Annotated[
    Path, Option("--output", "-o", metavar="CAL.h5", help="Calibration file to write or add to.")
]
Ball = Annotated[str, Option(metavar="LENGTH", help="Diameter of the ball: 4mm.")]
Contact = Annotated[
    Path | None,
    Option(
        metavar="RES.h5",
        help="a press's result, where the skin touches.",
        show_default="estimated",
        motions=("horizontal", "twist"),
    ),
]
