"""STL: triangles alone; binary."""

from __future__ import annotations

import numpy as np

from mirrorskin.io.export.mesh import Mesh, face_vectors

_HEAD = 80  # bytes of free text, which must not begin with "solid": that would be STL as text


def stl(mesh: Mesh, title: str) -> list[bytes]:
    """Encode a surface.

    Parameters
    ----------
    mesh : Mesh
    title : str
        What the head says, cut at 80 bytes; the format has no other place for a unit.

    Returns
    -------
    list of bytes
        The file's parts.
    """
    normals = face_vectors(mesh)
    triangles = np.zeros(
        len(normals), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    triangles["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["corners"] = mesh.vertices[mesh.faces]
    head = title.encode("ascii", "backslashreplace")[:_HEAD].ljust(_HEAD, b" ")
    return [head, np.uint32(len(triangles)).astype("<u4").tobytes(), triangles.tobytes()]
