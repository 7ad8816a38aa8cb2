"""What relief in a pixel adds to standard deviations of heights: ``relief.cl`` in NumPy, and its use."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array import Array, Operand
from mirrorskin.kernels.device import Device

_NEXT_ORDER = 0.25  # of a bend, what a footprint of one square pixel removes from the heights that show it
_CREASE, _ALONG_CREASE = 0.2, 0.03  # square pixels: what creases add to a footprint across and along slopes
_SHAPE = 0.06  # error of a crossing between frames over the bend along the slope, pixels
_REACH = 2.0  # of a footprint: where the slopes on both sides have different signs
_ACROSS, _DOWN = 256, 16  # columns and rows of a work-item


def relief_sigma(
    height: NDArray[Any], sigma: NDArray[Any], across: float, along: float, shape_factor: float, twice: float,
    reach: float, per_slope: float, offset: float,
) -> NDArray[np.float64]:  # fmt: skip
    """Return standard deviations, mm, with what relief and slopes add to their squares.

    Where a surface bends inside the footprint of a pixel, the median of its heights differs from the height
    in the middle. With the slope along one direction, it is the second derivative across, along the line of
    equal height, that moves the median; the derivative along the slope does so only where the slope changes
    its sign inside the footprint. Derivatives are differences of neighbours; a missing neighbour has the
    height in the middle.

    Parameters
    ----------
    height, sigma : ndarray, (H, W)
        Heights and standard deviations, mm; NaN without a height.
    across, along, twice : float
        Factors of the squares of the second derivatives along the slope and along the line of equal height,
        and of twice their product, pixels^4.
    shape_factor : float
        Factor of the square of the former whatever the slope, pixels^4.
    reach : float
        Factor by which the square of a second derivative exceeds that of the slope where its sign changes.
    per_slope : float
        A quarter of the variance to add over the square of the slope, pixels^2.
    offset : float
        Variance to add everywhere, mm^2.
    """
    wide = np.pad(height.astype(np.float64), 2, "edge")
    rows, columns = (size + 2 for size in height.shape)
    middle = wide[1:-1, 1:-1]

    def at(down: int, right: int) -> NDArray[np.float64]:
        values = wide[1 + down : 1 + down + rows, 1 + right : 1 + right + columns]
        return np.where(np.isnan(values), middle, values)

    left, right, above, below = at(0, -1), at(0, 1), at(-1, 0), at(1, 0)
    x, y = right - left, below - above
    square = x**2 + y**2
    xx, yy = left + right - 2 * middle, above + below - 2 * middle
    xy = at(-1, -1) + at(1, 1) - at(-1, 1) - at(1, -1)
    level = (xx * y**2 + yy * x**2 - xy * x * y / 2) / (square + 1e-30)
    steep = xx + yy - level
    spread = reach * steep**2
    near = spread**2 / (spread**2 + square**2 + 1e-36)
    bend = (
        along * level**2
        + (across * near + shape_factor) * steep**2
        + twice * near * np.maximum(2 * level * steep, 0)
    )
    bend = np.nan_to_num(bend)
    sums = bend[:-2] + bend[1:-1] + bend[2:]
    mean = (sums[:, :-2] + sums[:, 1:-1] + sums[:, 2:]) / 9
    variance = sigma.astype(np.float64) ** 2 + np.maximum(bend[1:-1, 1:-1], mean)
    return np.asarray(np.sqrt(variance + per_slope * square[1:-1, 1:-1] + offset))


def add_relief(
    device: Device, height: Operand, sigma: Operand, footprint: float, per_slope: float, offset: float
) -> Array:
    """Return standard deviations of heights, mm, with what a pixel's area and errors of levels add.

    Parameters
    ----------
    height, sigma : (H, W), float32
        Heights and their standard deviations, mm, on the device.
    footprint : float
        Variance of the area that a pixel sees, square pixels; 0 adds nothing for it.
    per_slope : float
        Variance to add over the square of the slope, pixels^2.
    offset : float
        Variance to add everywhere, mm^2.
    """
    rows, columns = height.shape
    wider = footprint * (1 + _NEXT_ORDER * footprint)
    factors: dict[str, Any] = {
        "across": (wider + _CREASE) ** 2 / 4,
        "along": (wider + _ALONG_CREASE) ** 2 / 4,
        "shape_factor": _SHAPE**2,
        "twice": wider**2 / 4,
    }
    factors = {name: factor if footprint else 0.0 for name, factor in factors.items()}
    combined = device.array("height_sigma", (rows, columns), np.float32, zeroed=False)
    items = -(-rows // _DOWN) * -(-columns // min(device.layout.tile, _ACROSS))
    device.kernel("relief", "relief_sigma")(
        items, rows=rows, columns=columns, height=height, sigma=sigma, **factors,
        reach=4 * _REACH * footprint, per_slope=per_slope / 4, offset=offset, combined=combined,
        moved=3 * combined.nbytes,
    )  # fmt: skip
    return combined
