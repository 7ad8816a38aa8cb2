"""A result becomes a file that other programs open; the suffix says which kind."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.arguments import checked
from mirrorskin.io.atomic import write_new
from mirrorskin.io.export_formats import (
    Encoded,
    encode_npz,
    encode_ply,
    encode_png,
    encode_stl,
    encode_tiff,
    encode_xyz,
    height_datum,
    notes_of,
)
from mirrorskin.io.types import InputError, Result

_FORMATS: dict[str, Callable[[Result], Encoded]] = {
    ".ply": encode_ply,
    ".stl": encode_stl,
    ".xyz": encode_xyz,
    ".png": encode_png,
    ".tif": encode_tiff,
    ".tiff": encode_tiff,
    ".npz": encode_npz,
}
_SECTION, _ARRAYS = ".csv", ".npz"


@checked
def export_result(
    result: Result,
    path: str | Path,
    *,
    section: Mapping[str, NDArray[Any]] | None = None,
    points: bool = False,
) -> str:
    """Write a result for other programs; the file exists whole or not at all.

    Parameters
    ----------
    result : Result
        Of one turn; see ``select_turn``.
    path : str or Path
        Its suffix chooses the format: ``.ply`` and ``.stl``, a surface of triangles; ``.xyz``, points as
        text; ``.png``, ``.tif`` and ``.tiff``, heights as counts of 16 bits with their scale, and 0 for no
        answer; ``.npz``, all maps as plain arrays; ``.csv``, a cross-section.
    section : mapping of ndarray, (n,), optional
        The cross-section, by name; lengths are mm, and ``filled`` is 1 where a height was not measured.
    points : bool, optional
        A PLY of all points, and no triangles.

    Returns
    -------
    str
        What was written, in a few words.

    Raises
    ------
    InputError
        See ``check_export``; or no pixels lie together so that they make a surface; or the file cannot be
        written there.

    Examples
    --------
    >>> from mirrorskin import io
    >>> io.export_result(io.open_result("coin.h5"), "coin.ply")  # doctest: +SKIP
    '1860 triangles between 961 points, 3 x 3 x 0.5 mm'
    """
    path = Path(path)
    check_export(result, path)
    suffix = path.suffix.lower()
    if suffix == _SECTION:
        holds = _save_section(result, path, section)
    else:
        try:
            if points and suffix == ".ply":
                parts, holds = encode_ply(result, points=True)
            else:
                parts, holds = _FORMATS[suffix](result)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        write_new(path, parts)
    relative = suffix != _ARRAYS and result.offset_unknown is not None and result.offset_unknown.any()
    return f"{holds}, heights {height_datum(result)}" if relative else holds


def check_export(result: Result, path: str | Path) -> None:
    """Refuse what cannot be exported, before any work is done for it."""
    suffix, known = Path(path).suffix.lower(), (*_FORMATS, _SECTION)
    if suffix not in known:
        wrong = f"{suffix} is no format" if suffix else "its name does not say a format"
        raise InputError(f"{path}: {wrong}: name a file that ends with one of {' '.join(known)}")
    if suffix == _ARRAYS:
        return
    remedy = f"or export its maps as {_ARRAYS}"
    if result.height is None:
        raise InputError(f"{path}: the result has no heights: reconstruct it again with them, {remedy}")
    if not np.isfinite(result.height).any():
        raise InputError(f"{path}: no height of the result is known: look at its status, {remedy}")
    if result.x is None or result.y is None:
        again = "reconstruct it again with --pixel-size"
        raise InputError(f"{path} needs millimetres, and the result has no pixel size: {again}, {remedy}")


def _save_section(result: Result, path: Path, section: Mapping[str, NDArray[Any]] | None) -> str:
    if section is None:
        raise InputError(f"{path}: a table takes a cross-section, and none is given: export something else")
    units = {name: "mm" for name in section if name != "filled"}
    save_table(path, section, units, notes_of(result))
    return f"{len(section['height'])} points of a cross-section"


def save_table(
    path: str | Path,
    columns: Mapping[str, NDArray[Any]],
    units: Mapping[str, str],
    notes: Mapping[str, str],
) -> None:
    """Write columns as comma-separated values; the file exists whole or not at all.

    Notes come first, in lines that begin with ``#``; then names with units, as in ``height [mm]``, then the
    rows. A cell without an answer is empty.

    Parameters
    ----------
    path : str or Path
    columns : mapping of ndarray, (n,)
        By name.
    units : mapping of str
        Of the columns that have one.
    notes : mapping of str
        By name; one line each.

    Raises
    ------
    InputError
        It cannot be written there.

    Examples
    --------
    >>> columns = {"x": np.arange(3.0), "height": np.zeros(3)}
    >>> save_table("section.csv", columns, {"x": "mm", "height": "mm"}, {})  # doctest: +SKIP
    """
    text = StringIO(newline="")
    for name, note in notes.items():
        text.write(f"# {name}: {' '.join(note.split())}\n")
    table = csv.writer(text, lineterminator="\n")
    table.writerow([f"{name} [{units[name]}]" if units.get(name) else name for name in columns])
    table.writerows(zip(*(_cells(values) for values in columns.values()), strict=True))
    write_new(Path(path), [text.getvalue().encode()])


def _cells(values: NDArray[Any]) -> Iterator[str]:
    """Yield numbers with as many digits as float32 has, and nothing for NaN."""
    for value in values.tolist():
        yield "" if math.isnan(value) else f"{value:.9g}"
