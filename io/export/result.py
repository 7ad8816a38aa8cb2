"""A result becomes a file that other programs open; the suffix says which kind."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.export.formats import FORMATS, point_ply
from mirrorskin.io.export.notes import notes_of, tell_zero
from mirrorskin.io.export.table import save_table
from mirrorskin.io.export.writing import write_new
from mirrorskin.io.types import InputError, Result

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
        Of one turn; see ``of_turn``.
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
