"""Export of results to the formats of other programs; the suffix selects the format."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from mirrorskin.io.base.arguments import check_flag, check_kind, check_path, checked, unknown_argument
from mirrorskin.io.base.types import InputError
from mirrorskin.io.base.url import path_of
from mirrorskin.io.formats.registry import Format, export_format, export_suffixes, missing_package
from mirrorskin.io.formats.surface import (
    check_heights,
    check_millimetres,
    height_datum,
)
from mirrorskin.io.model.result import Result
from mirrorskin.io.storage.atomic import write_new


@checked(
    result=check_kind(Result),
    path=check_path,
    map_name=check_kind(str),
    points=check_flag,
    float32=check_flag,
)
def export_result(
    result: Result,
    path: str | Path,
    *,
    map_name: str = "",
    section: Mapping[str, NDArray[Any]] | None = None,
    points: bool = False,
    float32: bool = False,
) -> str:
    """Write a result for other programs; the file appears complete or not at all.

    Parameters
    ----------
    result : Result
        Maps of one turn; see ``select_turn``.
    path : str or Path
        The suffix selects the format, such as ``.ply``, ``.tif``, ``.csv`` or ``.npz``;
        ``mirrorskin export --help`` lists all.
    map_name : str, optional
        Name of a map, built-in or declared, which a ``.csv``, a ``.tif`` (float32) or an ``.npz`` contains
        instead, in its unit.
    section : mapping of ndarray, (n,), optional
        Columns of a cross-section, for a ``.csv``; lengths in mm, and ``filled`` is 1 where a height was not
        measured.
    points : bool, optional
        Write a PLY of all points, without triangles.
    float32 : bool, optional
        Write a TIFF of float32 in mm, NaN where undefined.

    Returns
    -------
    str
        Description of what was written.

    Raises
    ------
    InputError
        See ``check_export``; or no three adjacent pixels have heights; or the file cannot be
        written.

    Examples
    --------
    >>> from mirrorskin import io
    >>> io.export_result(io.open_result("coin.h5"), "coin.ply")  # doctest: +SKIP
    '1860 triangles between 961 points, 3 x 3 x 0.5 mm'
    """
    path = path_of(path)
    check_export(result, path, map_name)
    if map_name and section is not None:
        raise InputError(f"{path}: a cross-section is of the heights. Leave out the section or the map")
    form = _format_of(path)
    choices = {"map_name": map_name, "section": section, "points": points, "float32": float32}
    options = {name: value for name, value in choices.items() if value and name in form.options}
    encode = form.load(form.encoder)
    if form.writes_itself:
        holds: str = encode(result, path) or "everything"
    else:
        try:
            parts, holds = encode(result, **options)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        write_new(path, parts)
    unknown = result.offset_unknown
    heights = form.needs_heights and map_name in ("", result.name_of("height"))
    relative = heights and unknown is not None and unknown.any()
    return f"{holds}, heights {height_datum(result)}" if relative else holds


def check_export(result: Result, path: str | Path, map_name: str = "") -> None:
    """Raise InputError for a result, or a map, that cannot be exported to a path, before any work is done."""
    form = _format_of(path)
    if missing := missing_package(form):
        raise InputError(f"{path} needs {missing}")
    if map_name:
        _check_map(result, path, map_name, form)
    elif form.needs_heights:
        check_heights(result, path)


def _format_of(path: str | Path) -> Format:
    """Return the format of a path; InputError if there is none."""
    suffix = Path(path).suffix.lower()
    form = export_format(suffix)
    if form is None:
        wrong = f"{suffix} is not a supported format" if suffix else "its name has no suffix"
        raise InputError(f"{path}: {wrong}: name a file that ends with one of {' '.join(export_suffixes())}")
    return form


def _check_map(result: Result, path: str | Path, map_name: str, form: Format) -> None:
    """Raise InputError for a map that the result lacks, or that a format cannot hold."""
    if "map_name" not in form.options:
        raise InputError(f"{path} takes no map: choose {', '.join(export_suffixes('map_name'))}")
    if map_name not in result.maps():
        raise InputError(f"{path}: {unknown_argument('the result', map_name, [*result.maps()], 'map')}")
    if form.needs_heights:
        if result.declaration(map_name).components:
            raise InputError(f"{path}: {map_name} has vectors: export it as .npz")
        check_millimetres(result, path)
