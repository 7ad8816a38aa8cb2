"""Maps from which motions are estimated: heights and normals with their variances, on a device."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.integration.validation import check_pixel_size
from mirrorskin.io import InputError, Result, pixel_axes
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.pose import FAR

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

_STEEPEST = 0.17  # cosine of the largest zenith at which slopes are used
_NOT_COMPARED = 1e6  # variance of normals that are not compared, radians^2
_BORDER = np.ones((5, 5), np.uint8)  # pixels around edges and the border of contact that are ignored


@dataclass(frozen=True, eq=False)
class PoseMap:
    """Records of a map, (H, W, 8), as `mirrorskin.kernels.pose` defines them, and their positions.

    Attributes
    ----------
    records : ndarray, (H, W, 8), float32
    grid : tuple of float
        x and y of the first pixel, and the pixel's size along x and y, mm.
    least : float
        Squared sine of the tilt that the normals were measured with, or 1.
    array : Array
        The same records on the device.
    """

    records: Floats
    grid: tuple[float, float, float, float]
    least: float
    array: Array

    @classmethod
    def of(cls, result: Result, pixel_size: ArrayLike | None, device: Device, curved: bool = True) -> PoseMap:
        """Return the map of a result; without ``curved`` the second derivatives are 0."""
        grid = _grid(result, pixel_size)
        height, variance = _heights(result)
        normals, square = _normals(result, height, grid, device)
        usable = (
            np.isfinite(height) & (normals[..., 2] > _STEEPEST) & np.isfinite(square) & ~_doubtful(result)
        )
        if not ((variance < FAR) & usable).any() and not ((square < _NOT_COMPARED) & usable).any():
            raise InputError(
                "a map has no usable pixel with a sigma: give heights with height_sigma, or with normals and "
                "normals_sigma"
            )
        records = np.zeros((*height.shape, 8), np.float32)
        records[..., :2], records[..., 2], records[..., 3] = normals[..., :2], square, height
        records[..., 4] = variance
        if curved:
            records[..., 5:] = _curvature(normals, usable, grid, device)
            usable &= np.isfinite(records[..., 5])
        records[~usable] = np.nan
        return cls(records, grid, _least(result), device.from_host("records", records))

    def halved(self, device: Device) -> PoseMap:
        """Return the map at half the resolution: means of 2 x 2 pixels, if all four are known."""
        rows, columns = (size // 2 for size in self.records.shape[:2])
        fours = self.records[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, 8)
        records = fours.mean(axis=(1, 3), dtype=np.float32)
        records[..., [2, 4]] /= 4
        x, y, step_x, step_y = self.grid
        grid = x + step_x / 2, y - step_y / 2, 2 * step_x, 2 * step_y
        return PoseMap(records, grid, self.least, device.from_host("records", records))

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Usable points of the surface, (n, 3), mm."""
        row, column = np.nonzero(np.isfinite(self.records[..., 0]))
        x, y, step_x, step_y = self.grid
        height = self.records[row, column, 3].astype(np.float64)
        return np.stack([x + column * step_x, y - row * step_y, height], axis=-1)

    @cached_property
    def middle(self) -> NDArray[np.float64]:
        """Mean of the points."""
        return np.asarray(self.points.mean(axis=0))

    @cached_property
    def size(self) -> float:
        """Root mean square distance of the points from their mean."""
        return float(np.sqrt(np.mean(np.sum((self.points - self.middle) ** 2, axis=1))))


def _grid(result: Result, pixel_size: ArrayLike | None) -> tuple[float, float, float, float]:
    height = result.height
    if height is None or np.ndim(height) != 2 or 0 in np.shape(height):
        raise InputError("a motion needs heights, (H, W): integrate the normals, or choose one turn")
    x, y = result.x, result.y
    if pixel_size is not None:
        x, y = pixel_axes(height.shape, check_pixel_size(pixel_size))
    if x is None or y is None or min(len(x), len(y)) < 2:
        raise InputError("the result has no pixel size, or has one row of pixels: give pixel_size")
    return float(x[0]), float(y[0]), float(x[1] - x[0]), float(y[0] - y[1])


def _heights(result: Result) -> tuple[Floats, Floats]:
    """Return heights and their variances; `FAR` where they contain no more than the normals."""
    height = np.asarray(result.height, np.float32)
    if result.height_sigma is None:
        return height, np.full(height.shape, FAR, np.float32)
    variance = np.asarray(_same(result.height_sigma, height.shape, "height_sigma"), np.float32) ** 2
    known = variance > 0
    if result.component is not None and result.offset_unknown is not None and result.offset_unknown.any():
        known &= ~np.append(result.offset_unknown, 1).astype(bool)[result.component]
    return height, np.where(known, variance, np.float32(FAR))


def _normals(
    result: Result, height: Floats, grid: tuple[float, float, float, float], device: Device
) -> tuple[Floats, Floats]:
    """Return normals and their mean square errors; without normals, those of the heights, not compared."""
    if result.normals is None:
        slopes = _gradient(height, grid, device)
        normals = np.dstack([-slopes, np.ones_like(height)])
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        return normals.astype(np.float32), np.full(height.shape, _NOT_COMPARED, np.float32)
    normals = np.asarray(_same(result.normals, (*height.shape, 3), "normals"), np.float32)
    if result.normals_sigma is None:
        return normals, np.full(height.shape, _NOT_COMPARED, np.float32)
    sigma = np.asarray(_same(result.normals_sigma, height.shape, "normals_sigma"), np.float32)
    return normals, np.where(sigma > 0, sigma, np.float32(np.nan)) ** 2


def _same(values: Any, shape: tuple[int, ...], name: str) -> Any:
    if np.shape(values) != shape:
        raise InputError(
            f"{name} has shape {np.shape(values)}, but the height needs {shape}: give maps of one size"
        )
    return values


def _doubtful(result: Result) -> Mask:
    """Return the unreliable pixels: filled, or close to edges or to the border of contact."""
    assert result.height is not None
    border = np.zeros(result.height.shape, np.uint8)
    for lines in (result.edges, None if result.contact is None else result.contact == 0):
        if lines is not None:
            border |= np.asarray(lines, bool).astype(np.uint8)
    near: Mask = cv2.dilate(border, _BORDER) != 0
    return near if result.filled is None else near | (result.filled != 0)


def _least(result: Result) -> float:
    tilt = result.process.get("tilt", result.process.get("axial_tilt"))
    known = isinstance(tilt, float) and 0 < tilt < math.pi / 2
    return math.sin(float(tilt)) ** 2 if known else 1.0  # type: ignore[arg-type]


def _gradient(values: Floats, grid: tuple[float, float, float, float], device: Device) -> Floats:
    rows, columns = values.shape
    gradient = device.array("gradient", (rows, columns, 2), np.float32)
    device.kernel("pose", "pose_gradient", BESIDE=0)(
        -(-values.size // device.layout.tile),
        rows=rows,
        columns=columns,
        step_x=grid[2],
        step_y=grid[3],
        values=device.from_host("values", values),
        gradient=gradient,
        moved=12 * values.size,
    )
    return gradient.release()


def _curvature(
    normals: Floats, usable: Mask, grid: tuple[float, float, float, float], device: Device
) -> Floats:
    """Return the second derivatives xx, xy and yy of the height, from adjacent slopes."""
    across, up = (
        _gradient(np.where(usable, -normals[..., axis] / normals[..., 2], np.float32(np.nan)), grid, device)
        for axis in (0, 1)
    )
    return np.dstack([across[..., 0], (across[..., 1] + up[..., 0]) / 2, up[..., 1]])
