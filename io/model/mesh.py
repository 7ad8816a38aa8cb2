"""Triangle meshes of height maps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.base.types import Floats


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh.

    Attributes
    ----------
    vertices : ndarray, (N, 3), float64
        x, y and z, mm.
    faces : ndarray, (M, 3), int32
        Rows of ``vertices``, counter-clockwise as seen from +z.
    pixels : ndarray, (N,), int64
        The pixel of each vertex, as an index into the flattened map.
    """

    vertices: Floats
    faces: NDArray[np.int32]
    pixels: NDArray[np.int64]


def surface_mesh(
    height: ArrayLike, x: ArrayLike, y: ArrayLike, *, component: ArrayLike | None = None
) -> Mesh:
    """Return triangles between the pixels that have a height.

    A cell of 2 x 2 pixels with four heights becomes two triangles, a cell with three becomes one. Pixels
    without a triangle are omitted.

    Parameters
    ----------
    height : array_like, (H, W)
        Millimetres; NaN for holes.
    x, y : array_like, (W,) and (H,)
        Millimetres of the pixel centres; x increases with the column, y decreases with the row.
    component : array_like, (H, W), int, optional
        Piece of each height, -1 for none; no triangle connects two pieces.

    Returns
    -------
    Mesh

    Examples
    --------
    >>> surface_mesh([[0, 0], [0, 1]], x=[0, 1], y=[1, 0]).faces.tolist()
    [[0, 2, 1], [1, 2, 3]]
    """
    heights = np.asarray(height, np.float64)
    pieces = np.zeros(heights.shape, np.int32) if component is None else np.asarray(component)
    faces = _faces(np.where(np.isfinite(heights), pieces, -1))
    used = np.zeros(heights.size, bool)
    used[faces] = True
    pixels = np.flatnonzero(used)
    number = np.cumsum(used, dtype=np.int32) - 1
    row, column = np.unravel_index(pixels, heights.shape)
    places = np.asarray(x, np.float64)[column], np.asarray(y, np.float64)[row], heights.ravel()[pixels]
    return Mesh(np.stack(places, axis=1), number[faces], pixels)


def face_vectors(mesh: Mesh) -> Floats:
    """Return the normals of the triangles, (M, 3), with lengths of twice their areas."""
    first, second, third = (mesh.vertices[corner] for corner in mesh.faces.T)
    vectors: Floats = np.cross(second - first, third - first)
    return vectors


def normals_around(mesh: Mesh, vertices: NDArray[np.bool_]) -> Floats:
    """Return the unit normals of some vertices: area-weighted means of the adjacent triangles."""
    near = replace(mesh, faces=mesh.faces[vertices[mesh.faces].any(axis=1)])
    vectors = face_vectors(near)
    sums = np.zeros_like(mesh.vertices)
    for corner in near.faces.T:
        for axis, along in enumerate(vectors.T):
            sums[:, axis] += np.bincount(corner, along, len(sums))
    normals: Floats = sums[vertices] / np.linalg.norm(sums[vertices], axis=1, keepdims=True)
    return normals


def _faces(pieces: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the pixels of each triangle of a map of pieces, -1 for none."""
    a, b, c, d = _corners(pieces)
    without_d = (a >= 0) & (a == b) & (a == c)
    without_a = (d >= 0) & (d == b) & (d == c)
    without_b = (a >= 0) & (a == c) & (a == d) & (a != b)
    without_c = (a >= 0) & (a == b) & (a == d) & (a != c)
    at_a, at_b, at_c, at_d = _corners(np.arange(pieces.size).reshape(pieces.shape))
    triangles = (
        (without_d, (at_a, at_c, at_b)),
        (without_a, (at_b, at_c, at_d)),
        (without_b, (at_a, at_c, at_d)),
        (without_c, (at_a, at_d, at_b)),
    )
    return np.concatenate(
        [np.stack([corner[inside] for corner in corners], axis=1) for inside, corners in triangles]
    )


def _corners(values: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return a map's values at the corners of its cells: top left, top right, bottom left, bottom right."""
    return values[:-1, :-1], values[:-1, 1:], values[1:, :-1], values[1:, 1:]
