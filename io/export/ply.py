"""PLY: points with what is known of them, and triangles between them; binary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NAMES = {"f4": "float", "u1": "uchar"}


def ply(
    columns: Mapping[str, NDArray[Any]], faces: NDArray[np.int32] | None, notes: Mapping[str, str]
) -> list[bytes]:
    """Encode a surface, or points alone.

    Parameters
    ----------
    columns : mapping of ndarray, (N,), float32 or uint8
        A vertex's properties: ``x, y, z``, and others.
    faces : ndarray, (M, 3), int32, or None
        Numbers of vertices.
    notes : mapping of str
        Comments, one line each.

    Returns
    -------
    list of bytes
        The file's parts.
    """
    vertices = np.empty(
        len(columns["x"]), [(name, f"<{values.dtype.str[1:]}") for name, values in columns.items()]
    )
    for name, values in columns.items():
        vertices[name] = values
    head = ["ply", "format binary_little_endian 1.0"]
    head += [f"comment {name}: {_ascii(said)}" for name, said in notes.items()]
    head += [f"element vertex {len(vertices)}"]
    head += [f"property {_NAMES[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    body = [vertices.tobytes()]
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.empty(len(faces), [("count", "u1"), ("vertices", "<i4", 3)])
        triangles["count"], triangles["vertices"] = 3, faces
        body.append(triangles.tobytes())
    return ["\n".join([*head, "end_header\n"]).encode("ascii"), *body]


def _ascii(text: str) -> str:
    return text.encode("ascii", "backslashreplace").decode()
