"""Focus variation: the height of each pixel by the travel at which its surroundings are sharpest."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.functions import travel_function
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.picture import Picture
from mirrorskin.engine.base.tiling import Planes
from mirrorskin.engine.diagnosis.footprint import with_curvature
from mirrorskin.engine.optical.focus_travel import CurveShape, TravelJump, common_shape, curves_of
from mirrorskin.io import InputError, Map
from mirrorskin.io.base.types import FRAME_DTYPES
from mirrorskin.io.model.maps import TABLE, FocusStatus, status_of
from mirrorskin.io.model.positions import check_strokes
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma

_TILE = 16384  # pixels of a work-item on a CPU: some rows, whose sums along columns it moves down
_LARGEST = 1e18  # noise whose square a float32 holds
_LEAST_CONTRAST = 5.0  # smallest contrast of a peak above that of noise, in standard errors
_BETWEEN = 2 / 3  # variance of noise between pixels two reaches apart, whose windows overlap
_UNUSUAL = 3.0  # standard deviations from the median misfit, beyond which a pixel has its own
_LEAST_SHARE = 0.1  # of the pixels of a window with a peak, below which errors do not grow any more
_LEAST_CURVATURE = 3.0  # smallest curvature of a peak, in standard errors
_FLOATS = "height", "sharpness", "spread", "gain", "misfit"  # maps of focus.cl


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
    checks = (TravelJump,)
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
        maps: dict[str, Any] = {"best": np.int32, "status": np.uint8, **dict.fromkeys(_FLOATS, np.float32)}
        maps |= {"peak": Planes(2 * self.reach + 1, np.float32), "recent": Planes(self.reach, np.float32)}
        self._maps = Picture(self, "focus", maps, around=self.radius, tile=_TILE)

    def peaks(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the contrast in the frames around the sharpest one of each pixel, and its number."""
        best, *peak = self._maps.read("best", *(("peak", place) for place in range(2 * self.reach + 1)))
        return np.stack(peak), best

    def push(self, frames: NDArray[Any], *, travel: ArrayLike) -> None:
        """Take in the next frames, (n, H, W), and the travel of each, (n,) mm."""
        check_strokes(travel, len(frames), "travel")
        self._maps.scan("focus_scan", frames, radius=self.radius, reach=self.reach)

    def result(self) -> dict[str, Any]:
        """Return height, status and sharpness of the frames so far."""
        assert self.noise is not None
        travel = self.positions_so_far("travel")
        unit = float(np.ptp(travel)) / max(len(travel) - 1, 1) or 1.0
        around = np.arange(len(travel))[:, np.newaxis] + np.arange(-self.reach, self.reach + 1)
        places = (travel[np.clip(around, 0, len(travel) - 1)] - travel[:, np.newaxis]) / unit
        variance = min(self.noise, _LARGEST) ** 2
        self._maps.run(
            "focus_fit", count=len(travel), radius=self.radius, reach=self.reach, variance=variance,
            least_contrast=_LEAST_CONTRAST, least_curvature=_LEAST_CURVATURE, places=places, travel=travel,
            unit=unit,
        )  # fmt: skip
        status, *floats = self._maps.take("status", *_FLOATS)
        height, sharpness, spread, gain, misfit = map(np.asarray, floats)
        shape = self._shape(travel, unit)
        sigma = np.sqrt(np.float32(variance) * spread + self._excess(misfit, shape) * gain)
        if shape is not None:
            sigma = np.hypot(sigma, np.float32(shape.bias))
        # The window shows the mean of its heights, which is not that of its middle on a curved surface.
        footprint = ((2 * self.radius + 1) ** 2 - 1) / 12
        off_centre = _off_centre(height, sigma, sharpness, footprint)
        sigma = np.hypot(with_curvature(height, sigma, footprint), off_centre)
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


def _off_centre(
    height: NDArray[Any], sigma: NDArray[Any], sharpness: NDArray[Any], variance: float
) -> NDArray[np.float32]:
    """Return standard deviations, mm, because uneven texture is not centred in the window.

    The squares of samples of a texture whose logarithm rises by g per pixel have their centre g times the
    variance of the window away.
    """
    reach = math.ceil(math.sqrt(variance))
    texture = 2 * np.log(np.where(sharpness > 0, sharpness, np.float32(np.nan)))
    noise = sigma**2 * np.float32(_BETWEEN / reach**2)
    slope = np.maximum(_slopes(height, reach) - noise, 0)
    product = np.float32(variance**2) * _slopes(texture, reach) * slope
    return np.sqrt(_mean_around(product, reach))


def _slopes(values: NDArray[Any], reach: int) -> NDArray[np.float32]:
    """Return the sum of the squares of both slopes over ``reach`` pixels on each side."""
    padded = cv2.copyMakeBorder(values.astype(np.float32), reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    across = padded[reach:-reach, 2 * reach :] - padded[reach:-reach, : -2 * reach]
    down = padded[2 * reach :, reach:-reach] - padded[: -2 * reach, reach:-reach]
    return np.asarray((across**2 + down**2) / (4 * reach**2), np.float32)


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
    peaks is added. Where the surface is curved, half of the window's variance, ((2 radius + 1)^2 - 1) /
    12 square pixels, times its second derivatives is added; where it is inclined and the texture uneven,
    that variance times its slope and the slope of log S. The sum is divided by the square of the share of
    the window's pixels that have a peak. With ``reach=1``, which fits three samples exactly, it is
    unknown: NaN.

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
    (-3.7, 0.0023)
    """,
    "Distance that the camera or its plane of focus was lowered, mm, in steps of any size.",
)
