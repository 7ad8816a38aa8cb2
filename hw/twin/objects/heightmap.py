"""An object out of a file: a map of heights, as NumPy array or as 16-bit picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.twin.objects.surface import difference_slope
from mirrorskin.io.types import Floats, InputError

HEIGHT_MAP_SUFFIXES = (".npy", ".png", ".tif", ".tiff")
DEFAULT_SCALE = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """A surface given by its heights on a grid whose centre lies under the picture's.

    Attributes
    ----------
    heights : ndarray, (H, W), float64
        Millimetres, at most 0; NaN where there is no object. Row 0 is the upper edge, as in a picture.
    pixel_size : (float, float)
        Millimetres between its samples along x and y.
    name : str
        What to call it.
    """

    heights: Floats
    pixel_size: tuple[float, float]
    name: str = "height map"

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return z in mm, bilinear between the samples; NaN outside the map and next to its NaN samples."""
        rows, columns = self.heights.shape
        # Rounded, so that a sample's own place gives that sample and none of a neighbour that may be NaN.
        column = np.round(x / self.pixel_size[0] + (columns - 1) / 2, 9)
        row = np.round((rows - 1) / 2 - y / self.pixel_size[1], 9)
        row, column = np.broadcast_arrays(row, column)
        left, top = np.floor(column), np.floor(row)
        total = np.zeros(row.shape)
        for i, weight_i in ((top, 1 - (row - top)), (top + 1, row - top)):
            for j, weight_j in ((left, 1 - (column - left)), (left + 1, column - left)):
                weight = weight_i * weight_j
                total += np.where(weight == 0, 0.0, weight * self._sample(i, j))
        return total

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return dz/dx and dz/dy by differences to the next samples, one-sided at the object's edge."""
        return difference_slope(self.height, x, y, self.pixel_size)

    def _sample(self, row: Floats, column: Floats) -> Floats:
        rows, columns = self.heights.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        at = np.where(inside, row, 0).astype(np.intp), np.where(inside, column, 0).astype(np.intp)
        return np.where(inside, self.heights[at], np.nan)


def load_height_map(
    path: str | Path, pixel_size: tuple[float, float], *, scale: float = DEFAULT_SCALE
) -> HeightMap:
    """Read a height map and place it so that its highest point is at z = 0.

    Parameters
    ----------
    path : str or Path
        ``.npy``, ``.png``, ``.tif`` or ``.tiff`` of one channel. Floating-point values are millimetres, and
        NaN means no object; 16-bit values are counts.
    pixel_size : (float, float)
        Millimetres between its samples along x and y.
    scale : float
        Millimetres a count, for 16-bit values.

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
        raise InputError(f"{path}: scale {scale} mm a count cannot be: give a positive number")
    values = _read_array(path)
    if values.ndim != 2 or values.size == 0:
        raise InputError(f"{path}: a height map has rows and columns only, this has shape {values.shape}")
    if values.dtype == np.uint16:
        heights = values * float(scale)
    elif values.dtype in (np.float32, np.float64):
        heights = values.astype(np.float64)
    else:
        raise InputError(f"{path}: holds {values.dtype}: save heights as 16-bit counts or as floats in mm")
    if np.isinf(heights).any() or np.isnan(heights).all():
        raise InputError(f"{path}: heights must be finite, or NaN where there is no object")
    return HeightMap(heights - np.nanmax(heights), pixel_size, path.name)


def _read_array(path: Path) -> NDArray[Any]:
    try:
        if path.suffix.lower() == ".npy":
            array: NDArray[Any] = np.load(path, allow_pickle=False)
            return array
        encoded = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, EOFError) as error:
        raise InputError(f"{path}: is no NumPy array of numbers: save it with numpy.save") from error
    return _decode_picture(path, encoded)


def _decode_picture(path: Path, encoded: NDArray[np.uint8]) -> NDArray[Any]:
    import cv2

    try:
        picture: NDArray[Any] | None = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        picture = None
    if picture is None:
        raise InputError(
            f"{path}: is no PNG or TIFF picture that can be decoded: save it again as 16-bit PNG"
        )
    return picture
