"""A result becomes a file that other programs open; the suffix says which kind."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import write_new
from mirrorskin.io.export_formats import (
    NORMAL,
    POINT_UNITS,
    counts_of,
    grid_of,
    notes_of,
    npz,
    ply,
    png,
    points_of,
    stl,
    tell_zero,
    tiff,
    xyz,
)
from mirrorskin.io.mesh import Mesh, normals_around, surface_mesh
from mirrorskin.io.types import InputError, Result


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
    """
    text = StringIO(newline="")
    for name, said in notes.items():
        text.write(f"# {name}: {' '.join(said.split())}\n")
    table = csv.writer(text, lineterminator="\n")
    table.writerow([f"{name} [{units[name]}]" if units.get(name) else name for name in columns])
    table.writerows(zip(*(_cells(values) for values in columns.values()), strict=True))
    write_new(Path(path), [text.getvalue().encode()])


def _cells(values: NDArray[Any]) -> Iterator[str]:
    """Yield numbers with as many digits as float32 has, and nothing for NaN."""
    for value in values.tolist():
        yield "" if math.isnan(value) else f"{value:.9g}"


_SECTION, _ARRAYS = ".csv", ".npz"


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
    """
    path = Path(path)
    check_export(result, path)
    suffix = path.suffix.lower()
    if suffix == _SECTION:
        holds = _save_section(result, path, section)
    else:
        encode = point_ply if points and suffix == ".ply" else FORMATS[suffix].encode
        try:
            parts, holds = encode(result)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        write_new(path, parts)
    relative = suffix != _ARRAYS and result.offset_unknown is not None and result.offset_unknown.any()
    return f"{holds}, heights {tell_zero(result)}" if relative else holds


def check_export(result: Result, path: str | Path) -> None:
    """Refuse what cannot be exported, before any work is done for it.

    Raises
    ------
    InputError
        No format has that suffix, a package that it takes is not installed, or the result lacks what the
        format needs: heights, and how large its pixels are.
    """
    suffix, known = Path(path).suffix.lower(), (*FORMATS, _SECTION)
    if suffix not in known:
        wrong = f"{suffix} is no format" if suffix else "its name does not say a format"
        raise InputError(f"{path}: {wrong}: name a file that ends with one of {' '.join(known)}")
    package = FORMATS[suffix].package if suffix in FORMATS else None
    if package is not None and find_spec(package[0]) is None:
        raise InputError(f"{path} needs {package[1]}: pip install 'mirrorskin[export]'")
    if suffix != _ARRAYS:
        _check_heights(result, path)


def _check_heights(result: Result, path: str | Path) -> None:
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


class Encoded(NamedTuple):
    """A file's parts, and what they hold, in a few words."""

    parts: list[bytes]
    holds: str


class Format(NamedTuple):
    """How a result is encoded, and the package that it takes, if any: its module and its name."""

    encode: Callable[[Result], Encoded]
    package: tuple[str, str] | None = None


_UNIT = {"unit": "mm"}


def _surface(result: Result) -> Mesh:
    mesh = surface_mesh(*grid_of(result), component=result.component)
    if not mesh.faces.size:
        raise InputError("no three known heights are neighbours, so there is no surface: export points, .xyz")
    return mesh


def _ply(result: Result) -> Encoded:
    mesh = _surface(result)
    columns, notes = points_of(result, mesh.pixels), _UNIT | notes_of(result)
    if result.normals is not None:
        # Programs shade by them, and paint black what has none.
        missing = np.isnan(columns[NORMAL[0]])
        for name, values in zip(NORMAL, normals_around(mesh, missing).T, strict=True):
            columns[name] = columns[name].copy()
            columns[name][missing] = values
        notes["normals"] = "of the result where it has them, elsewhere of the triangles around"
    return Encoded(ply(columns, mesh.faces, notes), _holds_of(mesh))


def point_ply(result: Result) -> Encoded:
    """Encode all points, and no triangles."""
    columns = points_of(result)
    return Encoded(ply(columns, None, _UNIT | notes_of(result)), f"{len(columns['x'])} points")


def _stl(result: Result) -> Encoded:
    mesh, notes = _surface(result), notes_of(result)
    told = ["unit mm", *(notes[name] for name in ("software", "date", "source") if name in notes)]
    return Encoded(stl(mesh, ", ".join(told)), _holds_of(mesh))


def _holds_of(mesh: Mesh) -> str:
    size = " x ".join(f"{length:.4g}" for length in np.ptp(mesh.vertices, axis=0))
    return f"{len(mesh.faces)} triangles between {len(mesh.vertices)} points, {size} mm"


def _xyz(result: Result) -> Encoded:
    columns = points_of(result)
    return Encoded(xyz(columns, POINT_UNITS, notes_of(result)), f"{len(columns['x'])} points")


def _png(result: Result) -> Encoded:
    counts = counts_of(result)
    return Encoded(png(counts, notes_of(result)), str(counts))


def _tiff(result: Result) -> Encoded:
    counts = counts_of(result)
    return Encoded(tiff(counts, notes_of(result)), str(counts))


def _npz(result: Result) -> Encoded:
    return Encoded(npz(result), ", ".join(result.maps()))


FORMATS = {
    ".ply": Format(_ply),
    ".stl": Format(_stl),
    ".xyz": Format(_xyz),
    ".png": Format(_png, ("PIL", "Pillow")),
    ".tif": Format(_tiff),
    ".tiff": Format(_tiff),
    ".npz": Format(_npz),
}
"""By suffix."""
