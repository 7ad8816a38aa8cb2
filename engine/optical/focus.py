"""Focus variation: the height of each pixel by the travel at which its surroundings are sharpest."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.functions import travel_function
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.picture import Picture
from mirrorskin.engine.base.tiling import Planes
from mirrorskin.engine.optical.focus_curves import (
    GRID_LINES,
    CurveShape,
    LightTrend,
    TravelJump,
    common_shape,
    curves_of,
)
from mirrorskin.io import InputError, Map
from mirrorskin.io.base.types import FRAME_DTYPES
from mirrorskin.io.model.maps import TABLE, FocusStatus, status_of
from mirrorskin.io.model.positions import check_strokes
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma, median

_TILE = 16384  # pixels of a work-item on a CPU: some rows, whose sums along columns it moves down
_LARGEST = 1e18  # noise whose square a float32 holds
_LEAST_CONTRAST = 5.0  # smallest contrast of a peak above that of noise, in standard errors
_UNUSUAL = 3.0  # standard deviations from the median misfit, beyond which a pixel has its own
_LEAST_SHARE = 0.1  # of the pixels of a window with a peak, below which errors do not grow any more
_LEAST_CURVATURE = 3.0  # smallest curvature of a peak, in standard errors
_FLOATS = "height", "sharpness", "spread", "gain", "misfit"  # maps of focus.cl
_OWN = "shifted", "shifted_noise", "texture", "texture_noise", "left"  # maps of focus.cl
_ALL_ROWS = 2**18  # most pixels of a picture of which all rows show the relief
# Relief inside the window: see the documentation.
_UNSEEN = 1.4  # variance of the errors of pixels, over that which texture shows
_VARIED = 0.4  # standard deviation of the relief of a part of the picture, over that of a larger one
_PARTS = 9, 3, 1  # blocks along a side of a part; a block has radius^2 pixels
_LEAST_RELIEF = 0.1  # of a part, over that of a larger one
_LEAST_TEXTURE = 0.25  # square of what a pixel varies by because of focus, over that because of noise
_OUTLYING = 25.0  # variance by a pixel's residuals over the median, from which on it is left out
_TINY, _VAST = np.float32(1e-18), np.float32(1e18)  # their squares are numbers


class Focus(Operation):
    """Height by the travel at which the surroundings of a pixel are sharpest (shape from focus).

    Examples
    --------
    >>> from mirrorskin import engine
    >>> texture = np.random.default_rng(0).normal(size=(20, 20))
    >>> sharp = [np.exp(-((travel - 3.7) ** 2) / 9) * texture for travel in range(9)]
    >>> found = engine.run(sharp, engine.optical.Focus(noise=0.1), travel=range(9))
    >>> round(float(found.height[10, 10]), 2)
    -3.7
    """

    motions = ("vertical",)
    dtypes = FRAME_DTYPES
    checks = (TravelJump, LightTrend)
    usual_findings = "not a press", "reversed"  # each pixel is sharp in between
    for_device = True

    noise: float | None = option(
        default=None,
        unit="counts",
        within=(0, None),
        help="standard deviation of a sample; it must be specified",
    )
    radius: int = option(
        default=4,
        unit="pixels",
        within=(1, 50),
        help="half of the window's side: sharpness is that of N = (2 radius + 1)^2 pixels, fewer at the"
        " picture's border",
    )
    reach: int = option(
        default=2,
        unit="frames",
        within=(1, 50),
        help="frames on each side of the sharpest one that the peak is fitted to, as far as there are any",
    )

    height = TABLE["height"]
    status = status_of(FocusStatus)
    sharpness = Map("standard deviation of the samples around the pixel in the sharpest frame", "counts")

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare the kernel and its maps."""
        if self.noise is None:
            raise InputError("noise is missing: give the standard deviation of a sample in counts, such as 2")
        maps: dict[str, Any] = dict.fromkeys(_FLOATS + _OWN, np.float32)
        maps |= {"best": np.int32, "status": np.uint8, "recent": Planes(self.reach, np.float32)}
        maps |= dict.fromkeys(("peak", "detail", "last"), Planes(2 * self.reach + 1, np.float32))
        self._maps = Picture(self, "focus", maps, around=self.radius, tile=_TILE)

    @property
    def _every(self) -> int:
        """Rows from one to the next that pixels' own samples are kept in: in large pictures, some suffice."""
        return max(1, self.radius // 2) if math.prod(self.shape) > _ALL_ROWS else 1

    def peaks(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the contrast in the frames around the sharpest one, and its number, on a grid of pixels."""
        parts = self._maps.read("best", *(("peak", place) for place in range(2 * self.reach + 1)))
        thin = max(1, min(self.shape) // GRID_LINES)
        best, *peak = (part[::thin, ::thin] for part in parts)
        return np.stack(peak), best

    def push(self, frames: NDArray[Any], *, travel: ArrayLike) -> None:
        """Take in the next frames, (n, H, W), and the travel of each, (n,) mm."""
        check_strokes(travel, len(frames), "travel")
        self._maps.scan("focus_scan", frames, radius=self.radius, reach=self.reach, every=self._every)

    def result(self) -> dict[str, Any]:
        """Return height, status and sharpness of the frames so far."""
        assert self.noise is not None
        travel = self.positions_so_far("travel")
        unit = float(np.ptp(travel)) / max(len(travel) - 1, 1) or 1.0
        around = np.arange(len(travel))[:, np.newaxis] + np.arange(-self.reach, self.reach + 1)
        places = (travel[np.clip(around, 0, len(travel) - 1)] - travel[:, np.newaxis]) / unit
        variance = min(self.noise, _LARGEST) ** 2
        self._maps.run(
            "focus_fit", count=len(travel), radius=self.radius, reach=self.reach, every=self._every,
            variance=variance, least_contrast=_LEAST_CONTRAST, least_curvature=_LEAST_CURVATURE,
            places=places, travel=travel, unit=unit,
        )  # fmt: skip
        status, *floats = self._maps.take("status", *_FLOATS)
        height, _, spread, gain, misfit = map(np.asarray, floats)
        shape = self._shape(travel, unit)
        sigma = np.sqrt(np.float32(variance) * spread + self._excess(misfit, shape) * gain)
        if shape is not None:
            sigma = np.hypot(sigma, np.float32(shape.bias))
        own = _OwnCurves(*map(np.asarray, self._maps.take(*_OWN)))
        sigma = np.sqrt(sigma**2 + _relief(own, variance, self.radius))
        # Where few pixels around have a peak, noise and their surroundings decided which ones.
        peaks = cv2.blur(np.isfinite(height).astype(np.float32), (2 * self.radius + 1,) * 2)
        sigma = sigma / np.maximum(peaks, _LEAST_SHARE) ** 2
        return {"height": floats[0], "height_sigma": sigma, "status": status, "sharpness": floats[1]}

    def _excess(self, misfit: NDArray[Any], shape: CurveShape | None) -> NDArray[np.float32]:
        """Return the variance of log S in excess of noise: the median, or more where curves fit less well.

        What all curves have in common is subtracted.
        """
        fitted = np.isfinite(misfit)
        usual = max(0.0, float(np.median(misfit[fitted]))) if fitted.any() else np.nan
        common = 0.0 if shape is None else max(0.0, usual - shape.excess)
        around = _mean_around(misfit, self.radius // 2)
        unusual = (
            around > usual + _UNUSUAL * mad_sigma(around[fitted].astype(np.float64))
            if fitted.any()
            else False
        )
        return np.where(unusual, around, np.float32(usual)) - np.float32(common)

    def _shape(self, travel: Doubles, unit: float) -> CurveShape | None:
        """Return what the curves of sharpness have in common; None if too few pixels show it."""
        freedom = (2 * self.radius + 1) ** 2 - 1
        assert self.noise is not None
        if self.reach < 2 or not 0 < self.noise < _LARGEST:
            return None
        curves = curves_of(*self.peaks(), travel, unit, freedom, self.noise**2)
        return None if curves is None else common_shape(*curves, self.noise**2, unit)


def _mean_around(values: NDArray[Any], reach: int) -> NDArray[np.float32]:
    """Return the means of the values that are numbers, over ``reach`` pixels on each side; 0 of none."""
    finite = np.isfinite(values)
    size = 2 * reach + 1, 2 * reach + 1
    total, weight = (
        cv2.blur(part.astype(np.float32), size) for part in (np.where(finite, values, 0), finite)
    )
    return np.asarray(np.divide(total, weight, out=np.zeros_like(total), where=weight > 0))


_Sums = NDArray[np.float32]


class _OwnCurves(NamedTuple):
    """What the samples of the pixels themselves show, maps; see `mirrorskin.kernels.optical.focus`."""

    shifted: NDArray[Any]
    shifted_noise: NDArray[Any]
    texture: NDArray[Any]
    texture_noise: NDArray[Any]
    left: NDArray[Any]


def _relief(own: _OwnCurves, variance: float, radius: int) -> NDArray[np.float32]:
    """Return the variance, mm^2, of the heights of pixels about those that their windows show.

    See the documentation, "Relief inside the window". It is that of a part of the picture, the less exact
    ones being drawn towards that of a larger part.
    """
    pixels = own.texture > 0
    if not pixels.any():
        return np.zeros(pixels.shape, np.float32)
    outlying = own.left > _OUTLYING * median(own.left[pixels])
    if outlying.any():  # as at a hot sample
        own, pixels = _OwnCurves(*(np.where(outlying, 0, values) for values in own)), pixels & ~outlying
    excess, count = float(np.sum(own.left, dtype=np.float64)), np.count_nonzero(pixels)
    # Curves of another shape leave more than noise does; noise that is less than stated leaves less.
    share = np.float32(min(1.0, variance * count / excess) if excess > 0 else 0.0)
    blocks = [_in_blocks(values, radius) for values in (*own[:-1], pixels)]
    blocks[1], blocks[3] = share * blocks[1], share * blocks[3]
    mean, error = _mean_relief(*(np.full_like(part, np.sum(part, dtype=np.float64)) for part in blocks))
    found = (mean + np.hypot(mean, error)) / 2  # as it is not negative
    for size in _PARTS:
        mean, error = _mean_relief(*(_around(part, size) for part in blocks))
        usual = error**2 / (error**2 + (_VARIED * found) ** 2)
        # A block has too few pieces of texture to show that it has less relief than its surroundings.
        least = _LEAST_RELIEF if size > 1 else 1.0
        found = np.maximum(usual * found + (1 - usual) * mean, least * found)
    rows, columns = pixels.shape
    whole = found.shape[1] * radius, found.shape[0] * radius
    smooth = cv2.resize(np.float32(_UNSEEN) * found, whole, interpolation=cv2.INTER_LINEAR)
    return np.asarray(smooth, np.float32)[:rows, :columns]


def _mean_relief(
    shifted: _Sums, noise: _Sums, texture: _Sums, texture_noise: _Sums, count: _Sums
) -> tuple[_Sums, _Sums]:
    """Return the mean relief, mm^2, of parts of the picture by sums over them, and its standard error."""
    signal = shifted - noise
    weight = np.maximum(texture - texture_noise, _LEAST_TEXTURE * texture_noise) + _TINY
    error = np.sqrt((3 * noise + 4 * np.maximum(signal, 0)) * noise / np.maximum(count, 1))
    return signal / weight, np.where(count > 0, error / weight + _TINY, _VAST)


def _around(blocks: _Sums, size: int) -> _Sums:
    """Return sums over size x size blocks."""
    border = cv2.BORDER_CONSTANT
    return np.asarray(cv2.boxFilter(blocks, -1, (size, size), normalize=False, borderType=border), np.float32)


def _in_blocks(values: NDArray[Any], side: int) -> _Sums:
    """Return sums of blocks of side x side pixels, those at the end being filled with 0."""
    down, across = (-length % side for length in values.shape)
    whole = np.asarray(values, np.float32)
    if down or across:
        whole = np.asarray(cv2.copyMakeBorder(whole, 0, down, 0, across, cv2.BORDER_CONSTANT))
    shape = whole.shape[1] // side, whole.shape[0] // side
    return np.asarray(cv2.resize(whole, shape, interpolation=cv2.INTER_AREA)) * np.float32(side**2)


find_focus = travel_function(
    Focus,
    "find_focus",
    """Find the travel at which each pixel's surroundings are sharpest (shape from focus).

    Sharpness S is the sum of squares of a window's samples about their mean, N - 1 times their variance,
    minus the contribution (N - 1) noise^2 of noise. A Gaussian is fitted to the peak and its neighbours,
    that is, a parabola through log S (Nayar and Nakagawa 1994), weighted by the inverse of the variance
    of log S, noise^2 (2 (N - 1) noise^2 + 4 S) / S^2 (a non-central chi-square). The standard error
    follows from these and from the median misfit of such curves in the picture, or that in the window if
    it is unusual; what all curves have in common in the fourth order is no misfit, but its effect on the
    peaks is added. So is the relief inside the window: by how much peaks of pixels' own samples differ
    from that of the window. The sum is divided by the square of the share of the window's pixels that
    have a peak, and what light that changes over the stack shifts peaks by is added. With ``reach=1``,
    which fits three samples exactly, it is unknown: NaN.

    Returns
    -------
    Result
        ``height`` and ``height_sigma`` are undefined where ``status`` is not 1. ``sharpness`` is the standard
        deviation of the window's samples in the sharpest frame, corrected for noise.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, travel or parameters that cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> texture = np.random.default_rng(0).normal(size=(20, 20))
    >>> travel = np.arange(9.0)
    >>> frames = np.exp(-((travel - 3.7) ** 2) / 9)[:, None, None] * texture
    >>> focus = engine.optical.find_focus(frames.astype(np.float32), travel, noise=0.01)
    >>> round(float(focus.height[10, 10]), 2), round(float(focus.height_sigma[10, 10]), 4)
    (-3.7, 0.0049)
    """,
    "Distance that the camera or its plane of focus was lowered, mm, in steps of any size.",
)
