"""Heights for programs of surface metrology: X3P, SUR, GSF, and TIFF of float32.

All contain one height per pixel, NaN or a mark where undefined, and the pixel size. In X3P the first row is
at the lowest y; in the others at the top, as in pictures.
"""

from __future__ import annotations

import tempfile
import warnings
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path

import numpy as np

from mirrorskin.io.base.text import one_line
from mirrorskin.io.base.types import InputError
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.formats.surface import Encoded, grid_of, notes_of, pixel_size_of
from mirrorskin.io.model.result import Result

X3P = Format(
    name="X3P",
    suffixes=(".x3p",),
    content="a surface",
    encoder="encode_x3p",
    package="x3pio",
    extra="metrology",
    exported=(
        (
            "`.x3p`",
            "heights, ISO 25178-72",
            "m; position of the first pixel; program, date and notes in the metadata",
            "NaN",
            "number of them in the comment",
            "programs of metrology, forensics; x3pio",
        ),
    ),
)
SUR = Format(
    name="SUR",
    suffixes=(".sur",),
    content="a surface",
    encoder="encode_sur",
    package="surfalize",
    extra="metrology",
    exported=(
        (
            "`.sur`",
            "heights, Digital Surf",
            "µm; no position, as surfalize writes none",
            "their own code",
            "number of them in the comment",
            "MountainsMap, Gwyddion; surfalize",
        ),
    ),
)
GSF = Format(
    name="GSF",
    suffixes=(".gsf",),
    content="a surface",
    encoder="encode_gsf",
    package="gsffile",
    extra="metrology",
    exported=(
        (
            "`.gsf`",
            "heights, Gwyddion Simple Field, float32",
            "m; size and position of the picture",
            "NaN",
            "number of them in `Comment`",
            "Gwyddion; gsffile",
        ),
    ),
)


_METRE, _MICROMETRE = 1e-3, 1e3  # of a millimetre
_COMMENT_MAX = 32_000  # bytes of a comment in a SUR file, whose length has 16 bits
_CENTIMETRE = 10.0  # mm


def encode_x3p(result: Result) -> Encoded:
    """Encode heights as X3P (ISO 25178-72), float64 in metres, with the origin of x and y."""
    import x3pio

    height, x, y = grid_of(result)
    width, step = pixel_size_of(x, y)
    process = result.process
    program, version = (one_line(process.get(name, "")) for name in ("program", "version"))
    metadata = x3pio.Metadata.for_software(program or "mirrorskin", version, date=_date(result))
    metadata.comment = _comment(result)
    file = BytesIO()
    surface = x3pio.Surface.from_array(
        height[::-1].astype(np.float64) * _METRE,
        x_scale=width * _METRE,
        y_scale=step * _METRE,
        metadata=metadata,
        placement=x3pio.Placement.translation(float(x[0]) * _METRE, float(y[-1]) * _METRE, 0.0),
        coordinate_system=x3pio.CoordinateSystem.VIEW,
    )
    surface.save(file)
    return Encoded([file.getvalue()], _holds(result))


def encode_sur(result: Result) -> Encoded:
    """Encode heights as SUR (Digital Surf, MountainsMap): counts of 32 bits, without an origin."""
    from surfalize import Surface

    height, x, y = grid_of(result)
    if np.nanmin(height) == np.nanmax(height):
        raise InputError("all heights are equal, which .sur cannot hold: export .x3p")
    width, step = pixel_size_of(x, y)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The surface has different pixel size in x and y")
        surface = Surface(height * np.float64(_MICROMETRE), width * _MICROMETRE, step * _MICROMETRE)
    comment = _comment(result).encode("ascii", "backslashreplace")[:_COMMENT_MAX].decode()
    file = BytesIO()
    surface.save(file, format=".sur", comment=comment)
    return Encoded([file.getvalue()], _holds(result))


def encode_gsf(result: Result) -> Encoded:
    """Encode heights as a Gwyddion Simple Field: float32 in metres, with the origin at the top left."""
    import gsffile

    height, x, y = grid_of(result)
    width, step = pixel_size_of(x, y)
    rows, columns = height.shape
    fields = {
        "XReal": columns * width * _METRE,
        "YReal": rows * step * _METRE,
        "XOffset": (float(x[0]) - width / 2) * _METRE,
        "YOffset": -(float(y[0]) + step / 2) * _METRE,  # down the picture
        "XYUnits": "m",
        "ZUnits": "m",
        "Title": "height",
        "Comment": _comment(result).replace("=", ":"),
    }
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        path = Path(folder, "height.gsf")
        gsffile.write_gsf(path, (height * np.float64(_METRE)).astype(np.float32), fields)
        return Encoded([path.read_bytes()], _holds(result))


def _holds(result: Result) -> str:
    height, _, _ = grid_of(result)
    rows, columns = height.shape
    return f"{rows} x {columns} heights"


def _comment(result: Result) -> str:
    """Return the notes as one line, which names the program."""
    return "; ".join(
        ["exported by mirrorskin", *(f"{name}: {note}" for name, note in notes_of(result).items())]
    )


def _date(result: Result) -> datetime:
    """Return the date of a result, or now."""
    try:
        return datetime.fromisoformat(str(result.process["date"]))
    except (KeyError, ValueError):
        return datetime.now(UTC)
