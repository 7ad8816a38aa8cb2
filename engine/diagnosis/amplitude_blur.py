"""The blur of a lens, by what it takes away from the strength of a signal whose direction changes.

A lens with a Gaussian point spread of variance b^2, pixels^2, averages a signal s u of strength s and unit
direction u: fringes of a phase, or light in proportion to normals. To second order it shows s u + (b^2 / 2)
laplace(s u), whose strength is s (1 - (b^2 / 2) |grad u|^2), and whose direction is wrong by (b^2 / 2) times
the part of laplace(u) across it. The one determines b, the other is its error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, on_host
from mirrorskin.engine.base.frames import take_places
from mirrorskin.engine.base.picture import Picture
from mirrorskin.engine.diagnosis.footprint import LEAST_BLUR, PIXEL
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.numerics.least_squares import CLEAR_Z_SCORE, fit_clipped

GRID_LINES = 48
"""Lines of pixels along a side that are used."""
MIN_PIXELS = 400
"""Least number of pixels that determine a blur."""

LEAST = PIXEL + LEAST_BLUR**2
"""Variance of what a pixel sees at best, square pixels: its area, and the blur of the best lens."""
BEND_NOISE = 20.0
"""Variance of a sum of four neighbours less four times the middle, of a variance of 1."""

_MIN_BLUR = 0.4  # pixels: least standard deviation of a point spread that is reported
_SIDE_Z_SCORE = 2.0  # standard errors from which on the blur of a side of the picture is one


def add_blur(maps: Picture, sigma: str, vectors: Sequence[str], strength: str, least: float = 0.0) -> None:
    """Add the error because of blur to the standard deviations of directions, radians, a map of a picture.

    ``vectors`` are the maps of the components of a signal, (H, W) each or (H, W, 3) together, of any length
    and NaN where unknown; ``strength`` is that of the signal, (H, W).
    ``least`` is the variance of the blur, square pixels, if none is clear.
    """
    found = find_blur([maps.view(name) for name in vectors], maps.view(strength))
    # Noise is not subtracted from the bend for a blur that is found, and as uncertain as that.
    variance, noise = (least, BEND_NOISE) if found == 0 else (found, 0.0)
    if variance == 0:
        return
    if len(maps.bands) > 1:  # the picture does not fit on one device
        deviation, *parts = maps.read(sigma, *vectors)
        maps.fill(sigma, _with_bands(parts, deviation, variance, noise, (0.0, 0.0), maps.bands[0].device))
        return
    _add([maps.array(name) for name in vectors], maps.array(sigma), variance, noise)


def with_bend(
    vectors: AnyArray,
    sigma: AnyArray,
    variance: float,
    noise: float,
    common: tuple[float, float],
    device: Device,
) -> AnyArray:
    """Return standard deviations of unit vectors, (H, W), with the error because of a point spread.

    They are where ``sigma`` is.

    Parameters
    ----------
    vectors : array, (H, W, 3)
    sigma : array, (H, W)
    variance : float
        Of the point spread, square pixels; 0 adds nothing.
    noise : float
        Variance of the vectors' Laplacian because of noise, relative to that of a vector.
    common : (float, float)
        Coefficients a and b of a variance to add, a + b sin(zenith)^2.
    device : Device
    """
    if isinstance(sigma, Array) and isinstance(vectors, Array):
        spread = sigma.copy_region(0, sigma.shape)
        _add([vectors], spread, variance, noise, common)
        return spread
    return _with_bands([on_host(vectors)], on_host(sigma), variance, noise, common, device)


def _with_bands(
    vectors: Sequence[NDArray[Any]],
    sigma: NDArray[Any],
    variance: float,
    noise: float,
    common: tuple[float, float],
    device: Device,
) -> NDArray[Any]:
    """Return standard deviations with the error of directions, by bands that fit on a device."""
    rows, around = len(sigma), 2 * _reach(variance)
    row = max(values[:1].nbytes for values in vectors)
    most = device.max_allocation // row  # rows at once
    step, changed = rows if most >= rows else max(1, most - 2 * around), np.empty_like(sigma)
    for first in range(0, rows, step):
        start = max(0, first - around)
        part = slice(start, min(rows, first + step + around))
        spread = device.from_host("sigma", sigma[part], np.float32)
        arrays = [device.from_host("vectors", values[part], np.float32) for values in vectors]
        _add(arrays, spread, variance, noise, common)
        changed[first : first + step] = spread.read()[first - start :][:step]
    return changed


def _reach(variance: float) -> int:
    """Return the distance of the pixels whose directions are compared."""
    return max(1, round(2 * math.sqrt(variance)))


def _add(
    arrays: Sequence[Array],
    spread: Array,
    variance: float,
    noise: float = 0.0,
    common: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Add the error of directions to their standard deviations on a device, (H, W)."""
    device, (rows, columns), reach = spread.device, spread.shape, _reach(variance)
    tile, count = device.layout.tile, 3 if len(arrays) == 1 else 2
    bend = device.array("bend", spread.shape, np.float32, zeroed=False)
    base, rise = common

    def launch(name: str, planes: int, **arguments: Any) -> None:
        kernel = device.kernel("blur", name, TILE=tile, PARTS=count)
        sizes = {"rows": rows, "columns": columns, "reach": reach, "moved": planes * spread.nbytes}
        kernel(-(-rows * columns // tile), first=arrays[0], bend=bend, **sizes, **arguments)

    launch("blur_bend", count + 1, second=arrays[-1])
    launch("blur_add", count + 3, factor=variance / 2, noise=noise, base=base, rise=rise, sigma=spread)


def find_blur(vectors: Sequence[AnyArray], strength: AnyArray) -> float:
    """Return the variance of the point spread, pixels^2; 0 if it is not significant.

    The logarithm of the strength is fitted by a quadratic of the place, as of uneven light, and the square
    of the gradient of the direction.
    """
    rows, columns = strength.shape
    if min(rows, columns) < 3:
        return 0.0
    thin = max(1, math.isqrt(rows * columns) // GRID_LINES)
    down, right = range(1, rows - 1, thin), range(1, columns - 1, thin)
    sampled = take_places([*vectors, strength], down, right, [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)])
    *parts, levels = sampled
    if vectors[0].ndim == 2:  # a map for each component
        parts = [[np.stack(components) for components in zip(*parts, strict=True)]]
    with np.errstate(divide="ignore", invalid="ignore"):
        east, west, south, north = (_unit(part) for part in parts[0][1:])
    turning = np.sum((east - west) ** 2 + (south - north) ** 2, axis=0) / 4
    level = levels[0].astype(np.float64)
    usable = np.isfinite(turning) & (level > 0) & np.isfinite(level)
    if np.count_nonzero(usable) < MIN_PIXELS:
        return 0.0
    y, x = (
        np.broadcast_to(positions, usable.shape)[usable]
        for positions in np.ix_(2 * np.array(down) / (rows - 1) - 1, 2 * np.array(right) / (columns - 1) - 1)
    )
    turning, values = turning[usable], np.log(level[usable])
    terms = np.stack([turning, np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    variance, error = _fit(terms, values)
    if not variance > max(CLEAR_Z_SCORE * error, _MIN_BLUR**2):
        return 0.0
    # Reflectance that changes with the place may look like blur somewhere, but not on all sides.
    sides = (_fit(terms[half], values[half]) for half in (x < 0, x >= 0, y < 0, y >= 0))
    clear = all(side > max(variance / 2, _SIDE_Z_SCORE * its_error) for side, its_error in sides)
    return variance if clear else 0.0


def _unit(vectors: NDArray[Any]) -> Doubles:
    """Return vectors, (components, ...), of length 1."""
    vectors = vectors.astype(np.float64)
    return np.asarray(vectors / np.sqrt(np.sum(vectors**2, axis=0)))


def _fit(terms: Doubles, values: Doubles) -> tuple[float, float]:
    """Return the variance of the point spread by the first of some terms, and its standard error."""
    result = fit_clipped(terms, values)
    if result is None:
        return 0.0, math.inf
    fit, inverse, residual, kept = result
    return -2 * float(fit[0]), 2 * math.sqrt(inverse[0, 0] * float(np.mean(residual[kept] ** 2)))
