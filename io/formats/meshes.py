"""Surfaces of triangles for other programs: PLY, STL and OBJ."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import InputError
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.formats.surface import (
    DATE,
    NORMAL,
    SOFTWARE,
    SOURCE,
    Encoded,
    as_ascii,
    grid_of,
    notes_of,
    points_of,
)
from mirrorskin.io.model.mesh import Mesh, face_vectors, normals_around, surface_mesh
from mirrorskin.io.model.result import Result

PLY = Format(
    name="PLY",
    suffixes=(".ply",),
    content="a mesh",
    encoder="encode_ply",
    options=("points",),
    exported=(
        (
            "`.ply`",
            "triangles between pixels with a height; each vertex with `x y z`, normal `nx ny nz`, "
            "`sigma`, `filled`",
            "mm; comments in the header",
            "no triangle",
            "`filled` = 1, `sigma` NaN",
            "MeshLab, CloudCompare, trimesh",
        ),
        (
            "`.ply --points`",
            "all points, no triangles",
            "the same",
            "no point",
            "the same",
            "the same",
        ),
    ),
)
STL = Format(
    name="STL",
    suffixes=(".stl",),
    content="a mesh",
    encoder="encode_stl",
    exported=(
        (
            "`.stl`",
            "triangles only, binary",
            "mm; in the 80-byte header, as STL has no field for it",
            "no triangle",
            "not marked",
            "CAD, slicers",
        ),
    ),
)
OBJ = Format(
    name="OBJ",
    suffixes=(".obj",),
    content="a mesh",
    encoder="encode_obj",
    exported=(
        (
            "`.obj`",
            "triangles only, text",
            "mm; in a comment",
            "no triangle",
            "not marked",
            "anything for meshes",
        ),
    ),
)


_PLY_TYPES = {"f4": "float", "u1": "uchar"}
_STL_HEAD = 80  # bytes of free text, which must not begin with "solid", the mark of a text STL


def encode_ply(result: Result, points: bool = False) -> Encoded:
    """Encode a surface of triangles, or points alone, as binary PLY."""
    notes = {"unit": "mm"} | notes_of(result)
    if points:
        columns = points_of(result)
        return Encoded(_ply(columns, None, notes), f"{len(columns['x'])} points")
    mesh = _surface(result)
    columns = points_of(result, mesh.pixels)
    if result.normals is not None:
        # Programs shade by the normals, and draw vertices without one black.
        missing = np.isnan(columns[NORMAL[0]])
        for name, values in zip(NORMAL, normals_around(mesh, missing).T, strict=True):
            columns[name] = columns[name].copy()
            columns[name][missing] = values
        notes["normals"] = "of the result where it has them, elsewhere of the triangles around"
    return Encoded(_ply(columns, mesh.faces, notes), _size(mesh))


def encode_stl(result: Result) -> Encoded:
    """Encode a surface as binary STL, with the unit in the header, because STL has no field for it."""
    mesh, notes = _surface(result), notes_of(result)
    title = ", ".join(["unit mm", *(notes[name] for name in (SOFTWARE, DATE, SOURCE) if name in notes)])
    normals = face_vectors(mesh)
    triangles = np.zeros(
        len(normals), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    triangles["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["corners"] = mesh.vertices[mesh.faces]
    head = as_ascii(title).encode()[:_STL_HEAD].ljust(_STL_HEAD, b" ")
    count = np.uint32(len(triangles)).astype("<u4").tobytes()
    return Encoded([head, count, triangles.tobytes()], _size(mesh))


def encode_obj(result: Result) -> Encoded:
    """Encode a surface as Wavefront OBJ: text, in mm, as stated in a comment."""
    mesh = _surface(result)
    head = "".join(
        f"# {name}: {as_ascii(note)}\n" for name, note in ({"unit": "mm"} | notes_of(result)).items()
    )
    file = BytesIO(head.encode())
    file.seek(0, 2)
    np.savetxt(file, mesh.vertices, "v %.9g %.9g %.9g")
    np.savetxt(file, mesh.faces + 1, "f %d %d %d")
    return Encoded([file.getvalue()], _size(mesh))


def _surface(result: Result) -> Mesh:
    mesh = surface_mesh(*grid_of(result), component=result.component)
    if not mesh.faces.size:
        raise InputError("no three adjacent pixels have heights, so there is no surface: export points, .xyz")
    return mesh


def _size(mesh: Mesh) -> str:
    size = " x ".join(f"{length:.4g}" for length in np.ptp(mesh.vertices, axis=0))
    return f"{len(mesh.faces)} triangles between {len(mesh.vertices)} points, {size} mm"


def _ply(
    columns: Mapping[str, NDArray[Any]], faces: NDArray[np.int32] | None, notes: Mapping[str, str]
) -> list[bytes]:
    vertices = np.empty(
        len(columns["x"]), [(name, f"<{values.dtype.str[1:]}") for name, values in columns.items()]
    )
    for name, values in columns.items():
        vertices[name] = values
    head = ["ply", "format binary_little_endian 1.0"]
    head += [f"comment {name}: {as_ascii(note)}" for name, note in notes.items()]
    head += [f"element vertex {len(vertices)}"]
    head += [f"property {_PLY_TYPES[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    body = [vertices.tobytes()]
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.empty(len(faces), [("count", "u1"), ("vertices", "<i4", 3)])
        triangles["count"], triangles["vertices"] = 3, faces
        body.append(triangles.tobytes())
    return ["\n".join([*head, "end_header\n"]).encode("ascii"), *body]
