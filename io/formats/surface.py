"""What encoders of surfaces share: notes, grids, points, and checks."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import warnings_in
from mirrorskin.io.base.text import one_line
from mirrorskin.io.base.types import Floats, InputError
from mirrorskin.io.model.result import Result

SOFTWARE, DATE, SOURCE = "software", "date", "source"
"""Names of notes."""

NORMAL = "nx", "ny", "nz"
"""Columns of the normal of a point."""

REMEDY = "or export its maps as .npz"
_FROM_PROCESS = {SOURCE: "source", DATE: "date", "turn": "turn"}


def check_heights(result: Result, path: str | Path) -> None:
    """Raise InputError for a result without heights in millimetres."""
    if result.height is None:
        raise InputError(f"{path}: the result has no heights: reconstruct it again with them, {REMEDY}")
    if not np.isfinite(result.height).any():
        raise InputError(f"{path}: no pixel of the result has a height: look at its status, {REMEDY}")
    check_millimetres(result, path)


def check_millimetres(result: Result, path: str | Path) -> None:
    """Raise InputError for a result without a pixel size."""
    if result.x is None or result.y is None:
        again = "reconstruct it again with --pixel-size"
        raise InputError(f"{path} needs millimetres, and the result has no pixel size: {again}, {REMEDY}")


class Encoded(NamedTuple):
    """The parts of a file, and a description of its contents."""

    parts: list[bytes]
    holds: str


def notes_of(result: Result) -> dict[str, str]:
    """Return notes on the source, the zero of heights, and the number of filled heights."""
    process = result.process
    maker = " ".join(str(process[name]) for name in ("program", "version") if name in process)
    notes = {name: one_line(process[key]) for name, key in _FROM_PROCESS.items() if key in process}
    if maker:
        notes[SOFTWARE] = one_line(maker)
    if warnings := warnings_in(process):
        notes["warnings"] = one_line("; ".join(warnings))
    if result.height is not None:
        notes["heights"] = height_datum(result)
    if result.height is not None and result.filled is not None and result.filled.any():
        finite = np.isfinite(result.height)
        filled, of = np.count_nonzero(finite & (result.filled > 0)), np.count_nonzero(finite)
        notes["filled"] = f"{filled} of {of} heights were not measured but filled"
    return notes


def height_datum(result: Result) -> str:
    """Return a description of the zero of heights: the sheet at rest, or the mean of each piece."""
    unknown = result.offset_unknown
    count, of = (0, 0) if unknown is None else (np.count_nonzero(unknown), unknown.size)
    if not count:
        return "from the sheet at rest"
    return f"relative{'' if count == of else f' in {count} of {of} pieces'}: the mean of a piece is 0"


def as_ascii(text: str) -> str:
    """Return a text in ASCII, other characters as escapes."""
    return text.encode("ascii", "backslashreplace").decode()


def grid_of(result: Result, map_name: str = "") -> tuple[NDArray[np.float32], Floats, Floats]:
    """Return the heights or a map, (H, W), NaN where undefined, and the positions of columns and rows, mm."""
    name = map_name or result.name_of("height")
    assert name is not None
    assert result.x is not None
    assert result.y is not None
    values, declared = result[name], result.declaration(name)
    if declared.undefined is not None:
        values = np.where(declared.has_answer(values), values, np.float32(np.nan))
    return values, result.x, result.y


def what_is(result: Result, map_name: str = "") -> str:
    """Return the name and the unit of the values of an export: those of the heights, or of a map."""
    unit = result.declaration(map_name).unit if map_name else "mm"
    return " in ".join(filter(None, [map_name or "heights", unit]))


def points_of(result: Result, pixels: NDArray[np.int64] | None = None) -> dict[str, NDArray[Any]]:
    """Return the columns of points, (n,), by name: of the given pixels, or of all with a height."""
    height, x, y = grid_of(result)
    chosen = np.flatnonzero(np.isfinite(height)) if pixels is None else pixels
    row, column = np.unravel_index(chosen, height.shape)
    columns: dict[str, NDArray[Any]] = {
        "x": x[column].astype(np.float32),
        "y": y[row].astype(np.float32),
        "z": height[row, column],
    }
    if result.normals is not None:
        columns |= dict(zip(NORMAL, result.normals[row, column].T, strict=True))
    if result.height_sigma is not None:
        columns["sigma"] = result.height_sigma[row, column]
    if result.filled is not None:
        columns["filled"] = (result.filled[row, column] > 0).astype(np.uint8)
    return columns


def pixel_size_of(x: Floats, y: Floats) -> tuple[float, float]:
    """Return the width and height of pixels, mm; they are assumed to be square in a single row or column."""
    sizes = [abs(float(axis[-1] - axis[0])) / (len(axis) - 1) for axis in (x, y) if len(axis) > 1]
    if not sizes:
        raise InputError("the pixel size of a result of one pixel is unknown: export it as .xyz or .npz")
    return sizes[0], sizes[-1]
