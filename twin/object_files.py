"""Objects from files: height maps, and triangle meshes seen from above."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.system import read_regular
from mirrorskin.io.base.types import Floats, InputError, pixel_axes
from mirrorskin.io.files.arrays import read_array
from mirrorskin.io.formats.pictures import decode_picture
from mirrorskin.twin.objects import difference_slope

if TYPE_CHECKING:
    from trimesh import Trimesh

HEIGHT_MAP_SUFFIXES = (".npy", ".png", ".tif", ".tiff")
DEFAULT_SCALE = 0.001

_DTYPES = ("uint8", "uint16", "float32", "float64")  # types of TIFFs; those of height maps are checked later


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """A surface given by its heights on a grid centred on the picture's centre.

    Attributes
    ----------
    heights : ndarray, (H, W), float64
        Millimetres, at most 0; NaN where there is no object. Row 0 is the upper edge, as in a picture.
    pixel_size : (float, float)
        Millimetres between its samples along x and y.
    name : str
        Name in messages.
    """

    heights: Floats
    pixel_size: tuple[float, float]
    name: str = "height map"

    @property
    def radius(self) -> float:
        """Distance of the farthest sample above the lowest level (the table), mm."""
        raised = self.heights > np.nanmin(self.heights)
        rows, columns = np.nonzero(raised if raised.any() else np.isfinite(self.heights))
        x, y = pixel_axes(self.heights.shape, self.pixel_size)
        return float(np.hypot(x[columns], y[rows]).max())

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return z in mm, bilinear between the samples; NaN outside the map and next to its NaN samples."""
        rows, columns = self.heights.shape
        # Rounded, so that a position on a sample uses only that sample and no neighbour that may be NaN.
        column, share_x = _cell(np.round(x / self.pixel_size[0] + (columns - 1) / 2, 9), columns)
        top, share_y = _cell(np.round((rows - 1) / 2 - y / self.pixel_size[1], 9), rows)
        # One flat index is faster than two. A neighbour with weight 0 may be NaN and is excluded.
        samples, corner = self.heights.ravel(), top * columns + column
        to_right, down = (share_x > 0).astype(np.intp), columns * (share_y > 0)
        upper, lower = (
            (1 - share_x) * samples[start] + share_x * samples[start + to_right]
            for start in (corner, corner + down)
        )
        height: Floats = (1 - share_y) * upper + share_y * lower
        return height

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return dz/dx and dz/dy by differences of neighbouring samples, one-sided at the object's edge."""
        return difference_slope(self.height, x, y, self.pixel_size)


def _cell(place: Floats, samples: int) -> tuple[NDArray[np.intp], Floats]:
    """Return the sample before a position on the grid, and the fraction beyond it; NaN off the grid."""
    inside = (place >= 0) & (place <= samples - 1)
    before = np.where(inside, place, 0).astype(np.intp)
    return before, np.where(inside, place - before, np.nan)


def load_height_map(
    path: str | Path, pixel_size: tuple[float, float], *, scale: float = DEFAULT_SCALE
) -> HeightMap:
    """Return a height map from a file, placed so that its highest point is at z = 0.

    Parameters
    ----------
    path : str or Path
        ``.npy``, ``.png``, ``.tif`` or ``.tiff`` of one channel. Floating-point values are millimetres, and
        NaN means no object; 16-bit values are counts.
    pixel_size : (float, float)
        Millimetres between its samples along x and y.
    scale : float
        mm per count, for 16-bit values.

    Returns
    -------
    HeightMap
        Named as the file.

    Raises
    ------
    InputError
        The file is missing or unreadable, is not two-dimensional, or its values are of another type, infinite
        or all NaN; or the scale is not positive.
    """
    path = Path(path)
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"{path}: a scale of {scale} mm per count is not possible: give a positive number")
    values = _read_array(path)
    if values.ndim != 2 or values.size == 0:
        raise InputError(
            f"{path}: a height map has rows and columns only, but this file has shape {values.shape}"
        )
    if values.dtype == np.uint16:
        heights = values * float(scale)
    elif values.dtype in (np.float32, np.float64):
        heights = values.astype(np.float64)
    else:
        raise InputError(f"{path}: contains {values.dtype}: save heights as 16-bit counts or as floats in mm")
    if np.isinf(heights).any() or np.isnan(heights).all():
        raise InputError(f"{path}: heights must be finite, or NaN where there is no object")
    return HeightMap(heights - np.nanmax(heights), pixel_size, path.name)


def _read_array(path: Path) -> NDArray[Any]:
    return read_array(path) if path.suffix.lower() == ".npy" else decode_picture(path, _DTYPES).samples


MESH_SUFFIXES = (".stl", ".ply", ".obj")

_SAMPLES_MAX = 20_000_000
_FARTHEST = 1e9  # maximum distance from the origin, mm; beyond it float64 differences lose precision


def load_mesh(path: str | Path, shape: tuple[int, int], pixel_size: tuple[float, float]) -> HeightMap:
    """Return the heights of a mesh as seen from above, from +z.

    The middle of its bounding box is at the picture's centre, and its highest point at z = 0. Several bodies
    in a file make one object. The heights are exact at the field's pixel centres, and beyond the field on the
    same grid; overhangs and the lower side are hidden.

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
    # Vertical triangles have no area seen from above; their edges belong to their neighbours.
    triangles = triangles[_areas_from_above(triangles) > 0]
    if len(triangles) == 0:
        raise InputError(f"{path}: has no area seen from above: rotate it so that its z axis points upwards")
    corners = triangles.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    triangles = triangles - [*(low[:2] + high[:2]) / 2, high[2]]
    grid = (
        _samples(high[1] - low[1], pixel_size[1], shape[0]),
        _samples(high[0] - low[0], pixel_size[0], shape[1]),
    )
    size = f"{path}: its size is {high[0] - low[0]:.4g} x {high[1] - low[1]:.4g} mm"
    if grid[0] * grid[1] > _SAMPLES_MAX:
        raise InputError(
            f"{size}, which is too large for pixels this small: meshes are in millimetres, scale it"
        )
    heights = top_surface(triangles, grid, pixel_size)
    if not np.isfinite(heights).any():
        raise InputError(f"{size}, which contains no pixel: meshes are in millimetres, scale it")
    return HeightMap(heights, pixel_size, path.name)


def _read_triangles(path: Path) -> Floats:
    mesh = _read_mesh(path)
    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices, np.float64)
    if len(faces) == 0 or len(vertices) == 0:
        raise InputError(f"{path}: contains no triangles, only points: export it as a mesh")
    if faces.shape[1:] != (3,) or vertices.shape[1:] != (3,):
        raise InputError(
            f"{path}: needs three coordinates per corner and three corners per triangle: export it again"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: has triangles without corners: export the mesh again")
    triangles: Floats = vertices[faces]
    if not (np.abs(triangles) <= _FARTHEST).all():
        raise InputError(
            f"{path}: has corners that are not finite, or beyond {_FARTHEST:g} mm: repair the mesh"
        )
    return triangles


def _check_surface(path: Path, triangles: Floats) -> None:
    """Refuse triangles that are not connected, or an odd number of three or more that share an edge.

    Four share an edge where two bodies touch.
    """
    _, corner = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    ends = np.sort(corner.reshape(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    ends = ends[ends[:, 0] < ends[:, 1]]
    _, uses = np.unique(ends[:, 0] * (corner.max() + 1) + ends[:, 1], return_counts=True)
    torn = int(np.count_nonzero((uses > 2) & (uses % 2 == 1)))
    if torn:
        raise InputError(
            f"{path}: is not a surface: at {torn} of its edges three triangles meet; repair the mesh"
        )
    if len(triangles) > 1 and not (uses == 2).any():
        raise InputError(f"{path}: is not a surface: its triangles are not connected; repair the mesh")


def _read_mesh(path: Path) -> Trimesh:
    try:
        import trimesh
    except ImportError:
        raise InputError(f"{path}: meshes need trimesh: pip install 'mirrorskin[mesh]'") from None

    # From memory, because trimesh opens files that a named file refers to, such as materials.
    data = BytesIO(read_regular(path))
    try:
        return trimesh.load_mesh(data, file_type=path.suffix[1:].lower(), process=False)
    except Exception as error:  # exceptions of its parsers have no common base
        raise InputError(
            f"{path}: is not a readable {path.suffix[1:].upper()} mesh: export it again"
        ) from error


def _areas_from_above(triangles: Floats) -> Floats:
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    areas: Floats = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    return areas


def _samples(extent: float, pixel_size: float, pixels: int) -> int:
    """Return the number of samples within the extent, at the positions of the field's pixel centres."""
    half = extent / 2 / pixel_size + 1e-9
    return 2 * int(half) + 1 if pixels % 2 else 2 * int(half + 0.5)


_Indices = NDArray[np.intp]

# Triangles are widened by this share of a sample, so that rounding leaves no gaps between neighbours.
_MARGIN = 1e-9
# Samples (or rows of triangles) processed at a time, which limits the memory.
_PART = 300_000


def top_surface(triangles: Floats, shape: tuple[int, int], pixel_size: tuple[float, float]) -> Floats:
    """Return the height of the highest triangle at each sample of a centred grid; NaN without a triangle.

    Each triangle, with three corners (x, y, z) in mm, is cut along the grid's rows; a cut is a straight line
    between two edges, on which the height is linear. Of overlapping triangles the highest counts (a depth
    buffer), whatever their orientation.
    """
    rows, columns = shape
    x = triangles[..., 0] / pixel_size[0] + (columns - 1) / 2
    y = (rows - 1) / 2 - triangles[..., 1] / pixel_size[1]
    z = triangles[..., 2]
    top = np.full(rows * columns, -np.inf)
    low, high = y.min(axis=1), y.max(axis=1)
    first, count = _samples_between(low, high, rows)
    count[low == high] = 0  # only neighbouring triangles have area there
    for part in _parts(count):
        triangle, row = _expand(first[part], count[part])
        start, end = _cut(x[part][triangle], y[part][triangle], z[part][triangle], row)
        _fill(top.reshape(shape), row, start, end)
    top[np.isneginf(top)] = np.nan
    return top.reshape(shape)


def _cut(x: Floats, y: Floats, z: Floats, row: _Indices) -> tuple[Floats, Floats]:
    """Return the left and the right end, (x, z), of each triangle's cut along its row."""
    ends = np.full((2, 3, len(row)), np.nan)
    for edge, (a, b) in enumerate(((0, 1), (1, 2), (2, 0))):
        low, high = np.minimum(y[:, a], y[:, b]), np.maximum(y[:, a], y[:, b])
        crosses = (low < high) & (row >= low - _MARGIN) & (row <= high + _MARGIN)
        rise = np.where(crosses, y[:, b] - y[:, a], 1.0)
        fraction = np.where(crosses, np.clip((row - y[:, a]) / rise, 0.0, 1.0), np.nan)
        ends[0, edge] = x[:, a] + fraction * (x[:, b] - x[:, a])
        ends[1, edge] = z[:, a] + fraction * (z[:, b] - z[:, a])
    # At a corner three edges are cut, elsewhere two.
    every = np.arange(len(row))
    first, right = np.nanargmin(ends[0], axis=0), np.nanargmax(ends[0], axis=0)
    return ends[:, first, every], ends[:, right, every]


def _fill(top: Floats, rows: _Indices, start: Floats, end: Floats) -> None:
    """Raise the samples between the ends of each cut to it."""
    first, count = _samples_between(start[0], end[0], top.shape[1])
    for part in _parts(count):
        triangle, column = _expand(first[part], count[part])
        (x0, z0), (x1, z1) = start[:, part][:, triangle], end[:, part][:, triangle]
        length = np.where(x1 > x0, x1 - x0, 1.0)
        z = z0 + np.clip((column - x0) / length, 0.0, 1.0) * (z1 - z0)
        np.maximum.at(top, (rows[part][triangle], column), z)


def _samples_between(start: Floats, end: Floats, samples: int) -> tuple[_Indices, _Indices]:
    """Return the first sample between start and end, and the number of samples."""
    first = np.clip(np.ceil(start - _MARGIN), 0, samples).astype(np.intp)
    stop = np.clip(np.floor(end + _MARGIN) + 1, 0, samples).astype(np.intp)
    return first, np.maximum(stop - first, 0)


def _parts(count: _Indices) -> Iterator[slice]:
    """Yield runs of counts whose sums are below a limit, unless a single count exceeds it."""
    sums = np.cumsum(count)
    start = 0
    while start < len(count):
        before = sums[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(sums, before + _PART, side="right")))
        yield slice(start, stop)
        start = stop


def _expand(first: _Indices, count: _Indices) -> tuple[_Indices, _Indices]:
    """Return for all members of all runs, concatenated, the number of the run and the member."""
    run = np.repeat(np.arange(len(count)), count)
    return run, np.arange(len(run)) + (first - np.cumsum(count) + count)[run]
