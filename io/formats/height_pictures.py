"""Heights as pictures for other programs: PNG and TIFF."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from io import BytesIO
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.text import one_line
from mirrorskin.io.formats import pictures
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.formats.surface import (
    DATE,
    SOFTWARE,
    SOURCE,
    Encoded,
    as_ascii,
    grid_of,
    notes_of,
    pixel_size_of,
    what_is,
)
from mirrorskin.io.model.result import Result

PNG = Format(
    name="PNG",
    suffixes=(".png",),
    content="heights in 16 bits",
    encoder="encode_png",
    exported=(
        (
            "`.png`",
            "heights in 16 bits",
            "texts: `height = offset + step x count` in mm, pixel size; resolution (pHYs); `Gwy::` "
            "keys of Gwyddion, in m",
            "count 0",
            "number of them in a text",
            "anything; Gwyddion with the scale",
        ),
    ),
)
TIFF = Format(
    name="TIFF",
    suffixes=(".tif", ".tiff"),
    content="heights in 16 bits",
    encoder="encode_tiff",
    options=("float32", "map_name"),
    exported=(
        (
            "`.tif`, `.tiff`",
            "heights in 16 bits",
            "description that ImageJ reads: `c0`, `c1`, `vunit`; resolution in pixels per cm",
            "count 0, also as GDAL's no-data tag",
            "number of them in the description",
            "ImageJ with the scale, anything",
        ),
        (
            "`.tif --float32`",
            "heights, float32",
            "mm; pixel size and position of the first pixel in the description",
            "NaN",
            "number of them in the description",
            "scientific programs",
        ),
    ),
)


_COUNT_MAX = np.iinfo(np.uint16).max
_FLAT = 1e-6  # mm per count, if all heights are equal
_PNG_KEYWORDS = {SOURCE: "Title", DATE: "Creation Time", SOFTWARE: "Software"}
_CENTIMETRE = 10.0  # mm
_METRE = 1e-3  # m per mm
_NO_DATA = 42113  # GDAL's tag for the value of holes


def encode_png(result: Result) -> Encoded:
    """Encode heights as a grey picture of 16 bits, with its resolution in pixels per metre.

    Texts contain the scale of heights, in words and with the keys that Gwyddion documents for pictures of 16
    bits.
    """
    counts, notes = _counts(result), notes_of(result)
    width, height = counts.pixel_size
    size = width * _METRE, height * _METRE
    return Encoded(pictures.encode_png(counts.values, size, _texts(counts, notes)), str(counts))


def encode_tiff(result: Result, float32: bool = False, map_name: str = "") -> Encoded:
    """Encode heights as a grey picture of 16 bits, or of float32 in mm; a map in float32 in its unit.

    Its resolution is in pixels per centimetre, GDAL's tag marks holes, and the scale of heights is in a
    description that ImageJ reads to display millimetres.
    """
    import tifffile

    if float32 or map_name:
        return encode_float_tiff(result, map_name)
    counts, notes = _counts(result), notes_of(result)
    width, height = counts.pixel_size
    file = BytesIO()
    tifffile.imwrite(
        file,
        counts.values,
        photometric="minisblack",
        resolution=(_CENTIMETRE / width, _CENTIMETRE / height),
        resolutionunit="CENTIMETER",
        description=_description(counts, notes).encode(),
        software=as_ascii(notes.get(SOFTWARE, "")),
        metadata=None,
        extratags=[(_NO_DATA, "s", 0, "0", True)],
    )
    return Encoded([file.getvalue()], str(counts))


class _Counts(NamedTuple):
    """A map of heights in 16 bits: a height is ``offset + step * counts``."""

    values: NDArray[np.uint16]  # 1 at the lowest height, 65535 at the highest, 0 where undefined
    offset: float  # mm
    step: float  # mm per count
    pixel_size: tuple[float, float]  # mm
    first: tuple[float, float]  # x and y of the top left pixel's centre, mm

    def __str__(self) -> str:
        return f"height in mm = {self.offset!r} + {self.step!r} x count; count 0: no answer"


def _counts(result: Result) -> _Counts:
    """Scale the heights of a result to 16 bits."""
    height, x, y = grid_of(result)
    finite = np.isfinite(height)
    heights = np.where(finite, height, np.nan).astype(np.float64)
    lowest, highest = float(np.nanmin(heights)), float(np.nanmax(heights))
    step = (highest - lowest) / (_COUNT_MAX - 1) or _FLAT
    values = np.rint((np.where(finite, heights, lowest) - lowest) / step) + 1
    counts = np.where(finite, values, 0).astype(np.uint16)
    return _Counts(counts, lowest - step, step, pixel_size_of(x, y), (float(x[0]), float(y[0])))


def _texts(counts: _Counts, notes: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the scale of heights in words, and in Gwyddion's convention: metres, with y down the picture."""
    yield "Description", str(counts)
    yield "height offset", f"{counts.offset!r} mm"
    yield "height step", f"{counts.step!r} mm"
    yield "pixel size", " ".join(f"{size!r}" for size in counts.pixel_size) + " mm"
    for name, note in notes.items():
        yield _PNG_KEYWORDS.get(name, name), note
    rows, columns = counts.values.shape
    (width, height), (x, y) = counts.pixel_size, counts.first
    lengths = {
        "XReal": columns * width,
        "YReal": rows * height,
        "XOffset": x - width / 2,
        "YOffset": -y - height / 2,
        "ZMin": counts.offset,
        "ZMax": counts.offset + counts.step * _COUNT_MAX,
    }
    for name, length in lengths.items():
        yield f"Gwy::{name}", repr(length * _METRE)
    for name in ("XYUnit", "ZUnit"):
        yield f"Gwy::{name}", "m"  # as in Gwyddion's source code
        yield f"Gwy::{name}s", "m"  # as in its user guide
    yield "Gwy::Title", notes.get(SOURCE, "height")


def _description(counts: _Counts, notes: Mapping[str, str]) -> str:
    (width, height), (x, y) = counts.pixel_size, counts.first
    lines: dict[str, object] = {
        "ImageJ": "1.54",
        "unit": "cm",  # of the resolution
        "xorigin": -x / width,
        "yorigin": y / height,
        "inverty": "true",
        "cf": 0,  # heights are a linear function of counts: c0 + c1 x count
        "c0": counts.offset,
        "c1": counts.step,
        "vunit": "mm",
        "min": 1,
        "max": int(counts.values.max()),
        "scale": counts,
    }
    # A backslash would begin an escape sequence.
    lines |= {name: note.replace("\\", r"\\") for name, note in notes.items()}
    return "".join(f"{name}={note}\n" for name, note in lines.items())


def encode_float_tiff(result: Result, map_name: str = "") -> Encoded:
    """Encode heights in mm, or a map in its unit, as a TIFF of float32, NaN where undefined."""
    import tifffile

    values, x, y = grid_of(result, map_name)
    width, step = pixel_size_of(x, y)
    lines = {
        "unit": result.declaration(map_name).unit if map_name else "mm",
        "pixel size": f"{width!r} x {step!r} mm",
        "first pixel": f"x {float(x[0])!r} mm, y {float(y[0])!r} mm",
    } | notes_of(result)
    description = "".join(f"{name}: {one_line(note)}\n" for name, note in lines.items())
    file = BytesIO()
    tifffile.imwrite(
        file,
        values.astype(np.float32),
        photometric="minisblack",
        resolution=(_CENTIMETRE / width, _CENTIMETRE / step),
        resolutionunit="CENTIMETER",
        description=description.encode("ascii", "backslashreplace"),
        metadata=None,
    )
    rows, columns = values.shape
    return Encoded(
        [file.getvalue()], f"{rows} x {columns} {what_is(result, map_name) if map_name else 'heights'}"
    )
