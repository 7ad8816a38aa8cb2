"""How each kind of file holds a result."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mirrorskin.io.export.counts import counts_of
from mirrorskin.io.export.mesh import Mesh, normals_around, surface_mesh
from mirrorskin.io.export.notes import notes_of
from mirrorskin.io.export.npz import npz
from mirrorskin.io.export.ply import ply
from mirrorskin.io.export.png import png
from mirrorskin.io.export.points import NORMAL, UNITS, grid_of, points_of
from mirrorskin.io.export.stl import stl
from mirrorskin.io.export.tiff import tiff
from mirrorskin.io.export.xyz import xyz
from mirrorskin.io.types import InputError, Result


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
    return Encoded(xyz(columns, UNITS, notes_of(result)), f"{len(columns['x'])} points")


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
    ".tif": Format(_tiff, ("tifffile", "tifffile")),
    ".tiff": Format(_tiff, ("tifffile", "tifffile")),
    ".npz": Format(_npz),
}
"""By suffix."""
