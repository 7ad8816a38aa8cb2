"""An object out of a file: a map of heights, as NumPy array or as 16-bit picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.twin.objects.surface import difference_slope
from mirrorskin.io.types import Floats, InputError, pixel_axes

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

    @property
    def radius(self) -> float:
        """Distance of the furthest sample above the lowest level, which is the table, mm."""
        raised = self.heights > np.nanmin(self.heights)
        rows, columns = np.nonzero(raised if raised.any() else np.isfinite(self.heights))
        x, y = pixel_axes(self.heights.shape, self.pixel_size)
        return float(np.hypot(x[columns], y[rows]).max())

    def height(self, x: Floats, y: Floats, /) -> Floats:
        """Return z in mm, bilinear between the samples; NaN outside the map and next to its NaN samples."""
        rows, columns = self.heights.shape
        # Rounded, so that a sample's own place gives that sample and none of a neighbour that may be NaN.
        left, share_x = _cell(np.round(x / self.pixel_size[0] + (columns - 1) / 2, 9), columns)
        top, share_y = _cell(np.round((rows - 1) / 2 - y / self.pixel_size[1], 9), rows)
        # One index into all samples is quicker than two. A neighbour without a share may be NaN: not met.
        samples, corner = self.heights.ravel(), top * columns + left
        to_right, down = (share_x > 0).astype(np.intp), columns * (share_y > 0)
        upper, lower = (
            (1 - share_x) * samples[start] + share_x * samples[start + to_right]
            for start in (corner, corner + down)
        )
        height: Floats = (1 - share_y) * upper + share_y * lower
        return height

    def slope(self, x: Floats, y: Floats, /) -> tuple[Floats, Floats]:
        """Return dz/dx and dz/dy by differences to the next samples, one-sided at the object's edge."""
        return difference_slope(self.height, x, y, self.pixel_size)


def _cell(place: Floats, samples: int) -> tuple[NDArray[np.intp], Floats]:
    """Return the sample before a place on the grid, and how far on the place is; NaN off the grid."""
    inside = (place >= 0) & (place <= samples - 1)
    before = np.where(inside, place, 0).astype(np.intp)
    return before, np.where(inside, place - before, np.nan)


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
