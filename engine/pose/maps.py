"""Maps from which motions are estimated: heights and normals with their variances, on a device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.base.device_arrays import operand_of
from mirrorskin.engine.pose.motion import cross_matrix
from mirrorskin.io import InputError, Result, pixel_axes
from mirrorskin.io.base.arguments import check_pixel_size
from mirrorskin.io.model.result import shape_of
from mirrorskin.kernels.array import Array, Operand, fetch
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.skin.pose_maps import STRIP, SUMMARY

Grid = tuple[float, float, float, float]
"""x and y of the first pixel, and the pixel's size along x and y, mm."""


class Workspace:
    """Memory on a device for maps that are needed one after the other.

    Attributes
    ----------
    inputs : list of Operand
        Maps of the last result, which the device may still be reading.
    """

    def __init__(self, device: Device) -> None:
        self.inputs: list[Operand] = []
        self._device = device
        self._arrays: dict[tuple[str | int, ...], Array] = {}

    def array(self, name: str, *shape: int) -> Array:
        """Return the array of a name and shape."""
        key: tuple[str | int, ...] = (name, *shape)
        if key not in self._arrays:
            self._arrays[key] = self._device.array(name, shape, np.float32, zeroed=False)
        return self._arrays[key]


@dataclass(frozen=True, slots=True)
class Extent:
    """Contents of a map.

    Attributes
    ----------
    pixels, compared : int
        Number of usable points, and number with a standard deviation.
    middle : ndarray, (3,)
        Mean of the points, mm.
    size : float
        Root mean square distance of the points from their mean, mm.
    """

    pixels: int
    compared: int
    middle: Doubles
    size: float

    @classmethod
    def of(cls, strips: NDArray[np.float32]) -> Extent:
        """Return the extent from the sums of `mirrorskin.kernels.skin.pose_maps.pose_summary`."""
        count, compared, *sums, spread = strips.astype(np.float64).T
        pixels, places = count.sum(), np.stack(sums, axis=-1)
        middle = places.sum(axis=0) / max(pixels, 1.0)
        from_middle = places / np.maximum(count, 1.0)[:, np.newaxis] - middle
        square = np.sum(spread + count * np.sum(from_middle**2, axis=1)) / max(pixels, 1.0)
        return cls(int(pixels), int(compared.sum()), middle, math.sqrt(square))


@dataclass(frozen=True, eq=False)
class PoseMap:
    """Records of a map, (H, W, 8), as `mirrorskin.kernels.skin.pose` defines them, and their positions.

    Attributes
    ----------
    records : Array, (H, W, 8), float32
        On the device.
    grid : tuple of float
    flat_limit : float
        Squared sine of the tilt with which the normals were measured, or 1.
    """

    records: Array
    grid: Grid
    flat_limit: float
    known_extent: Extent | None = None

    @classmethod
    def of(
        cls,
        result: Result,
        pixel_size: ArrayLike | None,
        device: Device,
        curved: bool = True,
        spiky: bool = True,
        size: int = 1,
        workspace: Workspace | None = None,
    ) -> PoseMap:
        """Return the map of a result; without ``curved`` the second derivatives are 0.

        Spikes are left out, unless ``spiky`` is False. A pixel is the mean of ``size`` x ``size`` ones. A map
        in a ``workspace`` is valid until the next one is made there; by default, its memory is its own.
        """
        x, y, step_x, step_y = _grid(result, pixel_size)
        middle = (size - 1) / 2
        grid = x + middle * step_x, y - middle * step_y, size * step_x, size * step_y
        records = _records(result, grid, device, curved, spiky, size, workspace or Workspace(device))
        return cls(records, grid, _least(result))

    @cached_property
    def extent(self) -> Extent:
        """Contents of the map; InputError if there is nothing to compare."""
        if self.known_extent is not None:
            return self.known_extent
        (extent,) = _extents([(self.records, self.grid)])
        if not extent.compared:
            raise InputError(
                "a map has no usable pixel with a sigma: give heights with height_sigma, or with normals and "
                "normals_sigma"
            )
        return extent

    @cached_property
    def at_origin(self) -> Doubles:
        """Matrix, (6, 6), that converts motions about the middle, in units of the size, to those about 0."""
        moved = np.eye(6)
        moved[3:, :3] = cross_matrix(self.extent.middle)
        moved[:, :3] /= self.extent.size
        return moved

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.records.shape[0], self.records.shape[1]

    @cached_property
    def points(self) -> Doubles:
        """Usable points of the surface, (n, 3), mm."""
        records = self.records.read()
        row, column = np.nonzero(np.isfinite(records[..., 0]))
        x, y, step_x, step_y = self.grid
        height = records[row, column, 3].astype(np.float64)
        return np.stack([x + column * step_x, y - row * step_y, height], axis=-1)


def coarser(maps: Sequence[PoseMap], min_size: int) -> list[list[PoseMap]]:
    """Return maps at half of their resolution, a quarter and so on, while the first has ``min_size`` pixels.

    They are means of 2 x 2 pixels, if all four are valid.
    """
    levels = [[(map_.records, map_.grid) for map_ in maps]]
    while min(levels[-1][0][0].shape[:2]) >= 2 * min_size and min(levels[-1][-1][0].shape[:2]) >= 2:
        levels.append([_halved(*pair) for pair in levels[-1]])
    pairs = [pair for level in levels[1:] for pair in level]
    extents = iter(_extents(pairs) if pairs else ())
    return [
        [PoseMap(*pair, map_.flat_limit, next(extents)) for pair, map_ in zip(level, maps, strict=True)]
        for level in levels[1:]
    ]


def _halved(fine: Array, grid: Grid) -> tuple[Array, Grid]:
    """Return records at half the resolution, and their positions."""
    rows, columns = (size // 2 for size in fine.shape[:2])
    records = fine.device.array("records", (rows, columns, 8), np.float32, zeroed=False)
    _run(
        fine.device, "pose_halve", rows, columns,
        wide=fine.shape[1], fine=fine, records=records, moved=fine.nbytes + records.nbytes,
    )  # fmt: skip
    x, y, step_x, step_y = grid
    return records, (x + step_x / 2, y - step_y / 2, 2 * step_x, 2 * step_y)


def _extents(maps: Sequence[tuple[Array, Grid]]) -> list[Extent]:
    """Wait once, and return the extents of records."""
    summaries: list[Array] = []
    for records, (x, y, step_x, step_y) in maps:
        device, (rows, columns) = records.device, records.shape[:2]
        strips = rows * -(-columns // STRIP)
        summary = device.array("summary", (strips, SUMMARY), np.float32, zeroed=False)
        device.kernel("pose_maps", "pose_summary")(
            strips, rows=rows, columns=columns, x0=x, y0=y, step_x=step_x, step_y=step_y, records=records,
            summary=summary, moved=records.nbytes,
        )  # fmt: skip
        summaries.append(summary)
    return [Extent.of(values) for values in fetch([(summary, slice(None)) for summary in summaries])]


def _grid(result: Result, pixel_size: ArrayLike | None) -> Grid:
    name = result.name_of("height")
    shape = () if name is None else shape_of(result, name)
    if len(shape) != 2 or 0 in shape:
        raise InputError("a motion needs heights, (H, W): integrate the normals, or choose one turn")
    x, y = result.x, result.y
    if pixel_size is not None:
        x, y = pixel_axes((shape[0], shape[1]), check_pixel_size(pixel_size))
    if x is None or y is None or min(len(x), len(y)) < 2:
        raise InputError("the result has no pixel size, or has one row of pixels: give pixel_size")
    return float(x[0]), float(y[0]), float(x[1] - x[0]), float(y[0] - y[1])


def _records(
    result: Result, grid: Grid, device: Device, curved: bool, spiky: bool, size: int, workspace: Workspace
) -> Array:
    """Return the records of a result's maps on a device."""

    def map_of(quantity: str, dtype: DTypeLike, *components: int) -> Operand | None:
        operand = operand_of(result, quantity, dtype, (high, wide, *components), device)
        if operand is not None:
            inputs.append(operand)
        return operand

    array, inputs = workspace.array, list[Operand]()

    high, wide = shape_of(result, result.name_of("height") or "")
    rows, columns = shape = high // size, wide // size
    pixels, (_, _, step_x, step_y) = rows * columns, grid
    height, normals = map_of("height", np.float32), map_of("normals", np.float32, 3)
    sigma = map_of("height_sigma", np.float32)
    if size > 1 and normals is None:
        means = array("mean", *shape), None if sigma is None else array("mean_sigma", *shape)
        _run(
            device, "pose_means", rows, columns, size,
            wide=wide, height=height, height_sigma=sigma, mean=means[0], mean_sigma=means[1],
            moved=8 * high * wide,
        )  # fmt: skip
        height, sigma = means
    # Twice, because of spikes next to spikes, unless pixels are averaged; the last time with the records,
    # unless normals are computed from the heights.
    passes = (size == 1) + (normals is None)
    for number in range(passes if spiky and sigma is not None else 0):
        clean = array(f"clean {number}", *shape)
        _run(
            device, "pose_spikes", rows, columns,
            height=height, height_sigma=sigma, clean=clean, moved=12 * pixels,
        )  # fmt: skip
        height = clean
    gradient = None
    if normals is None:
        gradient = array("gradient", *shape, 2)
        _run(
            device, "pose_gradient", rows, columns,
            step_x=step_x, step_y=step_y, values=height, gradient=gradient, moved=12 * pixels,
        )  # fmt: skip
    unknown: Any = None if result.component is None else result.offset_unknown
    apart = unknown is not None and np.any(unknown)
    maps: dict[str, Any] = {
        "spiky": int(spiky and normals is not None),
        "height": height,
        "height_sigma": sigma,
        "component": map_of("component", np.int32) if apart else None,
        "offset_unknown": device.from_host("offset_unknown", unknown, np.uint8) if apart else None,
        "normals": normals,
        "gradient": gradient,
        "normals_sigma": None if normals is None else map_of("normals_sigma", np.float32),
        **{name: map_of(name, np.uint8) for name in ("filled", "contact", "edges")},
        "records": array("records", *shape, 8),
        "slopes": array("slopes", 2, *shape) if curved else None,
    }
    moved = sum(values.nbytes for values in inputs) + maps["records"].nbytes
    _run(device, "pose_records", rows, columns, size, high=high, wide=wide, **maps, moved=moved)
    workspace.inputs = inputs
    records: Array = maps["records"]
    if curved:
        _run(
            device, "pose_curvature", rows, columns,
            step_x=step_x, step_y=step_y, slopes=maps["slopes"], records=records, moved=72 * pixels,
        )  # fmt: skip
    return records


def _run(device: Device, name: str, rows: int, columns: int, size: int = 1, **arguments: Any) -> None:
    """Run a kernel over the pixels of a picture."""
    items = -(-rows * columns // device.layout.tile)
    device.kernel("pose_maps", name, SIZE=size)(items, rows=rows, columns=columns, **arguments)


def _least(result: Result) -> float:
    tilt = result.fitted.tilt
    return math.sin(tilt) ** 2 if tilt is not None and 0 < tilt < math.pi / 2 else 1.0
