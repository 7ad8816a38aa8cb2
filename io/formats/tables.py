"""Tables, points and arrays for other programs: CSV, XYZ and NPZ."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.text import one_line
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.formats.surface import (
    Encoded,
    grid_of,
    notes_of,
    pixel_size_of,
    points_of,
    what_is,
)
from mirrorskin.io.model.result import Result
from mirrorskin.io.storage.atomic import write_new

XYZ = Format(
    name="XYZ",
    suffixes=(".xyz",),
    content="points",
    encoder="encode_xyz",
    exported=(
        (
            "`.xyz`",
            "text, one point per line, after lines with `#`; columns as in PLY",
            "mm; in the last `#` line, `x[mm]`",
            "no line",
            "column `filled`",
            "CloudCompare, anything",
        ),
    ),
)
CSV = Format(
    name="CSV",
    suffixes=(".csv",),
    content="a matrix or a cross-section",
    encoder="encode_csv",
    options=("section", "map_name"),
    exported=(
        (
            "`.csv`",
            "heights as a matrix, a row of the picture per line",
            "mm; pixel size and position of the first value in lines with `#`",
            "`nan`",
            "number of them in a line",
            "spreadsheets, NumPy, MATLAB",
        ),
        (
            "`.csv --section`",
            "a cross-section, between two points or across the `apex`: `distance, x, y, height`, "
            "`sigma`, `filled`",
            "mm; in the names, `height [mm]`",
            "empty cell",
            "column `filled`",
            "spreadsheets",
        ),
    ),
)
NPZ = Format(
    name="NPZ",
    suffixes=(".npz",),
    content="arrays",
    encoder="encode_npz",
    options=("map_name",),
    needs_heights=False,
    exported=(
        (
            "`.npz`",
            "all maps unchanged, `x`, `y`, and `units`, `legends`, `process` and `fitted` as JSON",
            "`units`",
            "NaN, and the codes above",
            "`filled`",
            "NumPy",
        ),
    ),
)


_FORMULA = tuple("=+-@\t\r")
_POINT_UNITS = dict.fromkeys(("x", "y", "z", "sigma"), "mm")  # columns of points; the others have no unit


def save_table(
    path: str | Path,
    columns: Mapping[str, NDArray[Any] | Sequence[str]],
    units: Mapping[str, str],
    notes: Mapping[str, str],
) -> None:
    """Write columns as comma-separated values; the file appears complete or not at all.

    Notes come first, in lines that begin with ``#``; then names with units, as in ``height [mm]``, then the
    rows. Cells of undefined values are empty.

    Parameters
    ----------
    path : str or Path
    columns : mapping of ndarray, (n,), or sequence of str
        Columns by name.
    units : mapping of str
        Units of the columns that have one.
    notes : mapping of str
        Texts by name, one line each.

    Raises
    ------
    InputError
        The file cannot be written.

    Examples
    --------
    >>> columns = {"x": np.arange(3.0), "height": np.zeros(3)}
    >>> save_table("section.csv", columns, {"x": "mm", "height": "mm"}, {})  # doctest: +SKIP
    """
    write_new(Path(path), [_table(columns, units, notes)])


def _table(
    columns: Mapping[str, NDArray[Any] | Sequence[str]], units: Mapping[str, str], notes: Mapping[str, str]
) -> bytes:
    """Return the text of a table, see `save_table`."""
    text = _commented(notes)
    table = csv.writer(text, lineterminator="\n")
    table.writerow([f"{name} [{units[name]}]" if units.get(name) else name for name in columns])
    table.writerows(zip(*(_cells(values) for values in columns.values()), strict=True))
    return text.getvalue().encode()


def _commented(notes: Mapping[str, str]) -> StringIO:
    """Return notes as lines that begin with ``#``; a table may follow."""
    text = StringIO(newline="")
    for name, note in notes.items():
        text.write(f"# {name}: {one_line(note)}\n")
    return text


def _cells(values: NDArray[Any] | Sequence[str]) -> Iterator[str]:
    """Yield numbers with the precision of float32, an empty text for NaN, and texts on one line.

    Texts that a spreadsheet would take for a formula begin with an apostrophe.
    """
    if not isinstance(values, np.ndarray):
        for text in values:
            yield f"'{one_line(text)}" if text[:1] in _FORMULA else one_line(text)
        return
    for value in values.tolist():
        yield "" if math.isnan(value) else f"{value:.9g}"


def encode_csv(
    result: Result, section: Mapping[str, NDArray[Any]] | None = None, map_name: str = ""
) -> Encoded:
    """Encode the heights or a map as a matrix, NaN where undefined; or the columns of a cross-section."""
    if section is not None:
        units = {name: "mm" for name in section if name != "filled"}
        text = _table(section, units, notes_of(result))
        return Encoded([text], f"{len(section['height'])} points of a cross-section")
    values, x, y = grid_of(result, map_name)
    width, step = pixel_size_of(x, y)
    what = what_is(result, map_name)
    notes = {
        "content": f"{what}, a row of the picture per line, from the top",
        "pixel size": f"{width!r} x {step!r} mm (x, y)",
        "first value": f"x = {float(x[0])!r} mm, y = {float(y[0])!r} mm; y decreases from line to line",
    }
    text_file = _commented(notes | notes_of(result))
    np.savetxt(text_file, values, "%.9g", delimiter=",")
    rows, columns = values.shape
    return Encoded([text_file.getvalue().encode()], f"{rows} x {columns} {what}")


def encode_xyz(result: Result) -> Encoded:
    """Encode points as text, one per line, after comments; the last comment names the columns."""
    columns = points_of(result)
    names = [f"{name}[{_POINT_UNITS[name]}]" if name in _POINT_UNITS else name for name in columns]
    head = [*(f"{name}: {note}" for name, note in notes_of(result).items()), " ".join(names)]
    formats = ["%d" if values.dtype.kind == "u" else "%.9g" for values in columns.values()]
    file = BytesIO()
    rows = np.stack([values.astype(np.float64) for values in columns.values()], axis=1)
    np.savetxt(file, rows, formats, header="\n".join(head), encoding="utf-8")
    return Encoded([file.getvalue()], f"{len(rows)} points")


def encode_npz(result: Result, map_name: str = "") -> Encoded:
    """Encode all maps or one, positions of the pixels, and JSON texts of units, legends, process and fitted.

    It can be loaded without ``allow_pickle``.
    """
    axes = {name: values for name, values in (("x", result.x), ("y", result.y)) if values is not None}
    kept: dict[str, Any] = {map_name: result[map_name]} if map_name else {**result}
    arrays, declared = {**kept, **axes}, {name: result.declaration(name) for name in kept}
    texts = {
        "units": {name: declaration.unit for name, declaration in declared.items() if declaration.unit}
        | dict.fromkeys(axes, "mm"),
        "legends": {name: declaration.codes for name, declaration in declared.items() if declaration.codes},
        "process": dict(result.process),
        "fitted": result.fitted.values(),
    }
    arrays |= {name: json.dumps(text) for name, text in texts.items()}
    file = BytesIO()
    np.savez(file, **arrays)
    return Encoded([file.getvalue()], map_name or ", ".join(result.maps()))
