"""An object out of a file: a mesh of triangles, as CAD and scanners save it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mirrorskin.hw.twin.objects.heightmap import HeightMap
from mirrorskin.hw.twin.objects.raster import top_surface
from mirrorskin.io.types import InputError

if TYPE_CHECKING:
    import trimesh

    from mirrorskin.io.types import Floats

MESH_SUFFIXES = (".stl", ".ply", ".obj")

_SAMPLES_MAX = 20_000_000


def load_mesh(path: str | Path, shape: tuple[int, int], pixel_size: tuple[float, float]) -> HeightMap:
    """Read a mesh and take its heights as seen from above, from +z.

    The middle of its bounding box lies under the picture's centre and its highest point at z = 0. Several
    bodies in a file make one object. The heights are exact at the field's pixel centres, and beyond the
    field on the same grid; overhangs and the lower side are hidden.

    Parameters
    ----------
    path : str or Path
        ``.stl``, ``.ply`` or ``.obj``, in millimetres (the formats name no unit), z upwards.
    shape : (int, int)
        Rows and columns of the field.
    pixel_size : (float, float)
        Millimetres between the field's pixels along x and y.

    Returns
    -------
    HeightMap
        Named as the file.

    Raises
    ------
    InputError
        trimesh is not installed; the file is missing or unreadable; its triangles are no surface, or none
        that can be seen from above; or its size cannot be in millimetres.
    """
    path = Path(path)
    triangles = _read_triangles(path)
    _check_surface(path, triangles)
    # Upright triangles have no area seen from above; their neighbours' edges are theirs.
    triangles = triangles[_areas_from_above(triangles) > 0]
    if len(triangles) == 0:
        raise InputError(f"{path}: shows no area seen from above: turn it so that its z axis points upwards")
    corners = triangles.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    triangles = triangles - [*(low[:2] + high[:2]) / 2, high[2]]
    grid = (
        _samples(high[1] - low[1], pixel_size[1], shape[0]),
        _samples(high[0] - low[0], pixel_size[0], shape[1]),
    )
    size = f"{path}: is {high[0] - low[0]:.4g} x {high[1] - low[1]:.4g} mm"
    if grid[0] * grid[1] > _SAMPLES_MAX:
        raise InputError(f"{size}, too large for pixels this small: a mesh is in millimetres, scale it")
    heights = top_surface(triangles, grid, pixel_size)
    if not np.isfinite(heights).any():
        raise InputError(f"{size}, no pixel meets it: a mesh is in millimetres, scale it")
    return HeightMap(heights, pixel_size, path.name)


def _read_triangles(path: Path) -> Floats:
    mesh = _read_mesh(path)
    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices, np.float64)
    if len(faces) == 0:
        raise InputError(f"{path}: holds no triangles, and points alone are no surface: export it as a mesh")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: has triangles without corners: export the mesh again")
    triangles: Floats = vertices[faces]
    if not np.isfinite(triangles).all():
        raise InputError(f"{path}: has corners that are not finite: repair the mesh")
    return triangles


def _check_surface(path: Path, triangles: Floats) -> None:
    """Refuse triangles that do not join, or of which three or another odd number meet at an edge.

    Four meet where two bodies share an edge.
    """
    _, corner = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    ends = np.sort(corner.reshape(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    ends = ends[ends[:, 0] < ends[:, 1]]
    _, uses = np.unique(ends[:, 0] * (corner.max() + 1) + ends[:, 1], return_counts=True)
    torn = int(np.count_nonzero((uses > 2) & (uses % 2 == 1)))
    if torn:
        raise InputError(
            f"{path}: is no surface: at {torn} of its edges three triangles meet; repair the mesh"
        )
    if len(triangles) > 1 and not (uses == 2).any():
        raise InputError(f"{path}: is no surface: its triangles do not join; repair the mesh")


def _read_mesh(path: Path) -> trimesh.Trimesh:
    try:
        import trimesh
    except ImportError:
        raise InputError(f"{path}: meshes need trimesh: pip install 'mirrorskin[mesh]'") from None

    try:
        with path.open("rb") as file:
            return trimesh.load_mesh(file, file_type=path.suffix[1:].lower(), process=False)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # what its parsers raise on a broken file has no common base
        raise InputError(
            f"{path}: is no {path.suffix[1:].upper()} mesh that can be read: export it again"
        ) from error


def _areas_from_above(triangles: Floats) -> Floats:
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    areas: Floats = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    return areas


def _samples(extent: float, pixel_size: float, pixels: int) -> int:
    """Return how many samples lie within the extent, if they lie where the field's pixel centres do."""
    half = extent / 2 / pixel_size + 1e-9
    return 2 * int(half) + 1 if pixels % 2 else 2 * int(half + 0.5)
