"""What encoders and decoders of surfaces share: notes, grids, points, and checks."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding, in_process, warnings_in
from mirrorskin.io.base.system import check_unpacked
from mirrorskin.io.base.text import one_line
from mirrorskin.io.base.types import Floats, InputError, ProcessValue, pixel_axes
from mirrorskin.io.base.units import in_base
from mirrorskin.io.model.result import Result, in_pixels, zero_of_relative

SOFTWARE, DATE, SOURCE = "software", "date", "source"
"""Names of notes."""

NORMAL = "nx", "ny", "nz"
"""Columns of the normal of a point."""

REMEDY = "or export its maps as .npz"
_FROM_PROCESS = {SOURCE: "source", DATE: "date", "turn": "turn"}
_OURS, _AT_REST, _BETWEEN = "exported by mirrorskin", "from the sheet at rest", "; "
_NOTES = SOURCE, DATE, "turn", SOFTWARE, "warnings", "heights", "filled"  # as `notes_of` names them
_BYTES = 24  # memory for a point while it is read: as stored, as float64, and as its map
_FARTHEST = 1e9  # mm, beyond which a height is none
_LARGE_OFFSET = 1e3  # times the range of heights, beyond which float32 does not resolve them


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
        if in_pixels(result):
            again = "integrate again with pixel_size"
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
    """Return a description of the zero of heights: the sheet at rest, or the mean of each piece, or any."""
    unknown = result.offset_unknown
    count, of = (0, 0) if unknown is None else (np.count_nonzero(unknown), unknown.size)
    if not count:
        return _AT_REST
    return f"relative{'' if count == of else f' in {count} of {of} pieces'}: {zero_of_relative(result)}"


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


def comment_of(result: Result) -> str:
    """Return the notes as one line, which names the program."""
    return _BETWEEN.join([_OURS, *(f"{name}: {note}" for name, note in notes_of(result).items())])


def result_of_surface(
    height: Floats,
    pixel_size: tuple[float, float],
    first: tuple[float, float] | None = None,
    *,
    comment: str = "",
    facts: Mapping[str, ProcessValue] | None = None,
    findings: Sequence[Finding] = (),
) -> Result:
    """Return a surface of another program, or one that was exported, as a result.

    Heights are relative, as nothing is known of a sheet at rest, unless the comment is that of an export.

    Parameters
    ----------
    height : ndarray, (H, W), float64
        Millimetres, the first row at the top; not finite where a point is invalid.
    pixel_size : (float, float)
        Millimetres along x and y.
    first : (float, float), optional
        Position of the first pixel, mm, y up; by default positions are those from the picture's centre.
    comment : str, optional
        Comment in the file.
    facts : mapping, optional
        What the file states of its origin, for display.
    findings : sequence of Finding, optional

    Raises
    ------
    InputError
        There is no valid point, or the pixel size is not positive.
    """
    if not all(np.isfinite(size) and size > 0 for size in pixel_size):
        sizes = " x ".join(f"{size:g}" for size in pixel_size)
        raise InputError(f"the spacing of its points is {sizes} mm, which is not positive: save it again")
    finite = np.isfinite(height)
    if not finite.any():
        raise InputError("no point of the surface is valid: save one with heights")
    findings = list(findings)
    lowest, highest = float(np.min(height[finite])), float(np.max(height[finite]))
    if max(-lowest, highest) > _FARTHEST:
        raise InputError(
            f"its heights are from {lowest:g} to {highest:g} mm: its unit or its values are wrong"
        )
    if abs(lowest) > _LARGE_OFFSET * (highest - lowest) > 0:
        height = height - lowest
        findings.append(Finding("surface file", f"heights are above z = {lowest:.9g} mm of the file", False))
    notes = _notes_in(comment)
    if "filled" in notes:
        findings.append(Finding("surface file", f"{notes['filled']}, and the file does not mark them"))
    if "warnings" in notes:
        findings.append(Finding("surface file", notes["warnings"]))
    process: dict[str, ProcessValue] = {**(facts or {})}
    process |= {name: notes[name] for name in (SOURCE, DATE, "turn", SOFTWARE) if name in notes}
    if comment and not notes:
        process["comment"] = one_line(comment)
    maps: dict[str, Any] = {"height": np.where(finite, height, np.nan).astype(np.float32)}
    if notes.get("heights") != _AT_REST:
        maps |= {
            "component": np.where(finite, 0, -1).astype(np.int32),
            "offset_unknown": np.ones(1, np.uint8),
        }
    x, y = pixel_axes((height.shape[0], height.shape[1]), pixel_size)
    if first is not None:
        x, y = x + (first[0] - x[0]), y + (first[1] - y[0])
    return Result(maps, x=x, y=y, process=process | in_process(findings, {}))


def _notes_in(comment: str) -> dict[str, str]:
    """Return the notes in the comment of an export, by name; none of another comment."""
    ours, *notes = re.split(f"{_BETWEEN}(?=(?:{'|'.join(_NOTES)}): )", comment)
    return dict(note.split(": ", 1) for note in notes) if ours == _OURS else {}


def check_points(rows: int, columns: int) -> None:
    """Raise InputError for a surface without points, or with more than memory is for."""
    if rows < 1 or columns < 1:
        raise InputError(f"it states {columns} x {rows} points: save a surface with points")
    check_unpacked(_BYTES * rows * columns, f"a surface of {columns} x {rows} points", "save a smaller part")


def millimetres_per(unit: str, what: str) -> float:
    """Return the millimetres of a unit in a file; InputError if there is none, or it is no length."""
    if not unit.strip():
        raise InputError(f"it states no unit of its {what}: save it with one")
    try:
        return in_base(unit.strip(), "length")
    except ValueError as error:
        text = f"its {what} are in {one_line(unit)[:40]!r}, and only lengths are read"
        raise InputError(f"{text}: save a surface of heights") from error


def pixel_size_of(x: Floats, y: Floats) -> tuple[float, float]:
    """Return the width and height of pixels, mm; they are assumed to be square in a single row or column."""
    sizes = [abs(float(axis[-1] - axis[0])) / (len(axis) - 1) for axis in (x, y) if len(axis) > 1]
    if not sizes:
        raise InputError("the pixel size of a result of one pixel is unknown: export it as .xyz or .npz")
    return sizes[0], sizes[-1]
