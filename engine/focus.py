"""Focus variation: the height of each pixel by the travel at which its surroundings are sharpest."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine import focus_travel
from mirrorskin.engine.footprint import with_curvature
from mirrorskin.engine.operation import Operation, travel_function
from mirrorskin.engine.options import option
from mirrorskin.io import InputError, Map
from mirrorskin.io.findings import Finding, in_process
from mirrorskin.io.maps import TABLE, FocusStatus, status_of
from mirrorskin.io.positions import check_strokes
from mirrorskin.io.traces import FrameSamples
from mirrorskin.io.types import FRAME_DTYPES
from mirrorskin.kernels.array import fetch
from mirrorskin.kernels.device import C_TYPES
from mirrorskin.kernels.least_squares import mad_sigma

_LARGEST = 1e18  # noise whose square a float32 holds
_LEAST_CONTRAST = 5.0  # smallest contrast of a peak above that of noise, in standard errors
_BETWEEN = 2 / 3  # variance of noise between pixels two reaches apart, whose windows overlap
_UNUSUAL = 3.0  # standard deviations from the median misfit, beyond which a pixel has its own
_LEAST_SHARE = 0.1  # of the pixels of a window with a peak, below which errors do not grow any more
_LEAST_CURVATURE = 3.0  # smallest curvature of a peak, in standard errors


class Focus(Operation):
    """Height by the travel at which the surroundings of a pixel are sharpest (shape from focus).

    Examples
    --------
    >>> from mirrorskin import engine
    >>> focus = engine.focus.Focus(noise=0.1)
    >>> texture = np.random.default_rng(0).normal(size=(20, 20)).astype(np.float32)
    >>> for travel in range(9):
    ...     focus.push((np.exp(-((travel - 3.7) ** 2) / 9) * texture[None]).astype("f4"), travel=[travel])
    >>> round(float(focus.result().height[10, 10]), 2)
    -3.7
    """

    motions = ("vertical",)
    takes_device_arrays = True
    _jump: Finding | None = None  # of the travel
    dtypes = FRAME_DTYPES
    on_device = True

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
        self._scan = self.device.kernel("focus", "focus_scan", FRAME=C_TYPES[dtype.name])
        self._fit = self.device.kernel("focus", "focus_fit", FRAME=C_TYPES[dtype.name])
        self._best = self.device.array("best", shape, np.int32, zeroed=False)
        self._peak = self.device.array("peak", (2 * self.reach + 1, *shape), np.float32, zeroed=False)
        self._recent = self.device.array("recent", (self.reach, *shape), np.float32, zeroed=False)

    def clear(self) -> None:
        """Forget what the frames so far showed; the next one overwrites their maps."""
        self._jump = None

    def reconsider(self, samples: FrameSamples) -> bool:
        """Look whether the peaks fit to the travel, which only shows after the last frame."""
        assert self.noise is not None
        if 0 < self.noise < _LARGEST and self.reach > 1:
            kept = (self._peak, self._best)
            peak, best = fetch([(array, slice(None)) for array in kept], keep=[True, True])
            freedom = (2 * self.radius + 1) ** 2 - 1
            self._jump = focus_travel.find_travel_jump(
                peak, best, self.pushed("travel"), freedom, self.noise**2
            )
        return False

    def push(self, frames: NDArray[Any], *, travel: ArrayLike) -> None:
        """Take in the next frames, (n, H, W), and the travel of each, (n,) mm."""
        check_strokes(travel, len(frames), "travel")
        rows, columns = self.shape
        self._scan(
            -(-rows * columns // self.device.layout.tile), frames=self.device.share("frames", frames),
            count=len(frames), rows=rows, columns=columns, first=self.count, radius=self.radius,
            reach=self.reach, best=self._best, peak=self._peak, recent=self._recent, moved=frames.nbytes,
        )  # fmt: skip
        self.device.finish()

    def result(self) -> dict[str, Any]:
        """Return height, status and sharpness of the frames so far."""
        assert self.noise is not None
        (rows, columns), travel = self.shape, self.pushed("travel")
        unit = float(np.ptp(travel)) / max(len(travel) - 1, 1) or 1.0
        around = np.arange(len(travel))[:, np.newaxis] + np.arange(-self.reach, self.reach + 1)
        places = (travel[np.clip(around, 0, len(travel) - 1)] - travel[:, np.newaxis]) / unit
        names = ("height", "spread", "gain", "misfit", "sharpness")
        maps: dict[str, Any] = {
            name: self.device.array(name, self.shape, np.float32, zeroed=False) for name in names
        }
        maps["status"] = self.device.array("status", self.shape, np.uint8, zeroed=False)
        variance = min(self.noise, _LARGEST) ** 2
        self._fit(
            -(-rows * columns // self.device.layout.tile), rows=rows, columns=columns, count=len(travel),
            radius=self.radius, reach=self.reach, variance=variance, least_contrast=_LEAST_CONTRAST,
            least_curvature=_LEAST_CURVATURE, places=self.device.from_host("places", places),
            travel=self.device.from_host("travel", travel), unit=unit, best=self._best, peak=self._peak,
            **maps, moved=self._peak.nbytes + sum(array.nbytes for array in maps.values()),
        )  # fmt: skip
        found = fetch([(array, slice(None)) for array in maps.values()])
        height, spread, gain, misfit, sharpness, status = found
        sigma = np.sqrt(np.float32(variance) * spread + self._excess(misfit) * gain)
        # The window shows the mean of its heights, which is not that of its middle on a curved surface.
        footprint = ((2 * self.radius + 1) ** 2 - 1) / 12
        off_centre = _off_centre(height, sigma, sharpness, footprint)
        sigma = np.hypot(with_curvature(height, sigma, footprint), off_centre)
        # Where few pixels around have a peak, noise and their surroundings decided which ones.
        peaks = cv2.blur(np.isfinite(height).astype(np.float32), (2 * self.radius + 1,) * 2)
        sigma = sigma / np.maximum(peaks, _LEAST_SHARE) ** 2
        maps = {"height": height, "height_sigma": sigma, "status": status, "sharpness": sharpness}
        return maps | in_process([] if self._jump is None else [self._jump], {})

    def _excess(self, misfit: NDArray[Any]) -> NDArray[np.float32]:
        """Return the variance of log S in excess of noise: the median, or more where curves fit less well."""
        known = np.isfinite(misfit)
        usual = max(0.0, float(np.median(misfit[known]))) if known.any() else np.nan
        around = _mean_around(misfit, self.radius // 2)
        unusual = (
            around > usual + _UNUSUAL * mad_sigma(around[known].astype(np.float64)) if known.any() else False
        )
        return np.where(unusual, around, np.float32(usual))


def _mean_around(values: NDArray[Any], reach: int) -> NDArray[np.float32]:
    """Return the means of the values that are numbers, over ``reach`` pixels on each side; 0 of none."""
    known = np.isfinite(values)
    size = 2 * reach + 1, 2 * reach + 1
    total, share = (cv2.blur(part.astype(np.float32), size) for part in (np.where(known, values, 0), known))
    return np.asarray(np.divide(total, share, out=np.zeros_like(total), where=share > 0))


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
    minus the contribution (N - 1) noise^2 of noise. A Gaussian is fitted to the peak and its neighbours, that
    is, a parabola through log S (Nayar and Nakagawa 1994), weighted by the inverse of the variance of log S,
    noise^2 (2 (N - 1) noise^2 + 4 S) / S^2 (a non-central chi-square). The standard error follows from these
    and from the median misfit of such curves in the picture, or that in the window if it is unusual. Where
    the surface is curved, half of the window's variance, ((2 radius + 1)^2 - 1) / 12 square pixels, times its
    second derivatives is added; where it is inclined and the texture uneven, that variance times its slope
    and the slope of log S. The sum is divided by the square of the share of the window's pixels that have a
    peak. With ``reach=1``, which fits three samples exactly, it is unknown: NaN.

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
    >>> focus = engine.focus.find_focus(frames.astype(np.float32), travel, noise=0.01)
    >>> round(float(focus.height[10, 10]), 2), round(float(focus.height_sigma[10, 10]), 4)
    (-3.7, 0.0023)
    """,
    "Distance that the camera or its plane of focus was lowered, mm, in steps of any size.",
)
