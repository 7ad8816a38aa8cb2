"""When a ball's press turned pixels light: what a gel is learned from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from mirrorskin.engine.integration.inputs import check_pixel_size
from mirrorskin.io import InputError, Result, Source, pixel_axes

Doubles = NDArray[np.float64]

_LIT, _DARK = 1, 2  # of an onset's status
_RIM = 0.1  # square of a rim pixel's error, by its circumference
_MOST = 600  # pixels of a press that are looked at
_FEWEST = 50


@dataclass(frozen=True, slots=True, eq=False)
class BallOnset:
    """When a ball pressed into the sheet turned pixels light.

    Attributes
    ----------
    travel : ndarray, (n,), float64
        At the onset of each pixel that turned light, mm.
    sigma : ndarray, (n,), float64
        Its standard deviation, mm.
    x, y : ndarray, (n,), float64
        The pixel's place, mm.
    radius : float
        Of the ball, mm.
    inner, inner_sigma : float
        Radius of the ball's dark top, mm, and its standard error; NaN where it was not seen whole.
    """

    travel: Doubles
    sigma: Doubles
    x: Doubles
    y: Doubles
    radius: float
    inner: float = math.nan
    inner_sigma: float = math.nan


def ball_onset(result: Result, source: Source, radius: float) -> BallOnset:
    """Take from the reconstruction of a ball's press, not corrected, when its pixels turned light.

    Parameters
    ----------
    result : Result
        With height, its sigma and status.
    source : Source
        Which tells the pixels' size.
    radius : float
        Of the ball, mm.

    Raises
    ------
    mirrorskin.io.InputError
        It is no press, has no pixel size, or less than 50 pixels turned light.
    """
    if result.status is None or result.height is None or result.height_sigma is None:
        raise InputError(f"{source.name} is no press: give a vertical recording of a ball")
    if source.header.pixel_size is None:
        raise InputError(f"{source.name} has no pixel size: calibrate the scale first, or give --pixel-size")
    return ball_pixels(
        result.height, result.height_sigma, result.status, source.header.pixel_size, radius, source.name
    )


def ball_pixels(
    height: ArrayLike,
    sigma: ArrayLike,
    status: ArrayLike,
    pixel_size: ArrayLike,
    radius: float,
    name: str = "the press",
) -> BallOnset:
    """Take from maps of a ball's press, as ``find_onset`` gives them, when its pixels turned light.

    Raises
    ------
    mirrorskin.io.InputError
        Less than 50 pixels turned light, or the radius cannot be.
    """
    if not (math.isfinite(radius) and radius > 0):
        raise InputError(f"a ball of radius {radius:g} mm cannot be: give one above 0")
    heights, sigmas = np.asarray(height, np.float64), np.asarray(sigma, np.float64)
    lit = np.flatnonzero((np.asarray(status) == _LIT) & np.isfinite(heights))
    if len(lit) < _FEWEST:
        raise InputError(
            f"{name}: {len(lit)} pixels turned light, too few to learn from: press the ball deeper"
        )
    some = lit[:: math.ceil(len(lit) / _MOST)]
    size = check_pixel_size(pixel_size)
    x, y = np.meshgrid(*pixel_axes(heights.shape, size))
    parts = (-heights, np.broadcast_to(sigmas, heights.shape), x, y)
    travel, spread, across, up = (part.ravel()[some].astype(np.float64) for part in parts)
    return BallOnset(travel, spread, across, up, radius, *_dark_top(np.asarray(status), size))


def _dark_top(status: NDArray[Any], size: tuple[float, float]) -> tuple[float, float]:
    """Return the radius of the largest dark patch that light surrounds, and its standard error, mm."""
    lit = ndimage.binary_closing(np.pad(status == _LIT, 1), np.ones((3, 3), bool))[1:-1, 1:-1]
    patches, count = ndimage.label(ndimage.binary_fill_holes(lit) & ~lit)
    if count == 0:
        return math.nan, math.nan
    largest = patches == 1 + np.argmax(np.bincount(patches.ravel())[1:])
    area = float(np.count_nonzero(largest & (status == _DARK))) * size[0] * size[1]
    radius = math.sqrt(area / math.pi)
    # The rim falls at random within a pixel, in as many places as it has pixels.
    pixel = max(size)
    return radius, pixel * math.sqrt(_RIM * pixel / max(radius, pixel))
