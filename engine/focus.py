"""Focus variation: the height of each pixel by the travel at which its surroundings are sharpest."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.operation import Operation, travel_function
from mirrorskin.engine.options import option
from mirrorskin.io import InputError, Map
from mirrorskin.io.maps import TABLE, FocusStatus, status_of
from mirrorskin.io.positions import check_strokes
from mirrorskin.io.types import FRAME_DTYPES
from mirrorskin.kernels.device import C_TYPES

Doubles = NDArray[np.float64]

_LEAST_CONTRAST = 5.0  # smallest contrast of a peak above that of noise, in standard errors
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
        self._best = self.device.array("best", shape, np.int32)
        self._peak = self.device.array("peak", (2 * self.reach + 1, *shape), np.float32)
        self._recent = self.device.array("recent", (self.reach, *shape), np.float32)
        self._samples = np.multiply.outer(*(_window(length, self.radius) for length in shape))

    def clear(self) -> None:
        """Do nothing: the first frame overwrites the maps."""

    def push(self, frames: NDArray[Any], *, travel: ArrayLike) -> None:
        """Take in the next frames, (n, H, W), and the travel of each, (n,) mm."""
        check_strokes(travel, len(frames), "travel")
        rows, columns = self.shape
        self._scan(
            -(-rows * columns // self.device.layout.tile), frames=self.device.seen("frames", frames),
            count=len(frames), rows=rows, columns=columns, first=self.count, radius=self.radius,
            reach=self.reach, best=self._best, peak=self._peak, recent=self._recent, moved=frames.nbytes,
        )  # fmt: skip
        self.device.finish()

    def result(self) -> dict[str, Any]:
        """Return height, status and sharpness of the frames so far."""
        assert self.noise is not None
        travel = self.pushed("travel")
        best, squares = self._best.download(), self._peak.download().astype(np.float64)
        frame = best + np.arange(-self.reach, self.reach + 1)[:, np.newaxis, np.newaxis]
        place = travel[np.clip(frame, 0, len(travel) - 1)] - travel[best]
        variance, freedom = self.noise * self.noise, self._samples - 1
        signal = squares - freedom * variance
        # One over the variance of the logarithm for noise of variance 1, of a non-central chi-square.
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = signal**2 / (2 * freedom * variance + 4 * signal)
            weight = np.where(signal > 0, weight, 0)
            value = np.log(np.where(signal > 0, signal, 1))
            peak = _fit(place, value, weight)
            points, top = (weight > 0).sum(axis=0), signal[self.reach]
            in_focus = points > 2  # two have no vertex
            in_focus &= top > _LEAST_CONTRAST * variance * np.sqrt(2 * freedom)
            in_focus &= peak.bent > _LEAST_CURVATURE**2 * variance
            misfit = _misfit(peak, points, in_focus, variance)
            neighbours = place[self.reach - 1 : self.reach + 2]
            in_focus &= (neighbours.min(axis=0) < peak.vertex) & (peak.vertex < neighbours.max(axis=0))
            sharpness = np.sqrt(np.maximum(top, 0) / np.maximum(freedom, 1))
        status = np.where(in_focus, FocusStatus.IN_FOCUS, FocusStatus.NO_PEAK)
        status[(best == 0) | (best == len(travel) - 1)] = FocusStatus.PEAK_AT_AN_END
        status[~np.isfinite(squares[self.reach])] = FocusStatus.INVALID_INPUT
        sigma = np.sqrt(variance * peak.variance + misfit * peak.gain)
        in_focus = status == FocusStatus.IN_FOCUS
        return {
            "height": np.where(in_focus, -(travel[best] + peak.vertex), np.nan),
            "height_sigma": np.where(in_focus, sigma, np.nan),
            "status": status,
            "sharpness": sharpness,
        }


find_focus = travel_function(
    Focus,
    "find_focus",
    """Find the travel at which each pixel's surroundings are sharpest (shape from focus).

    Sharpness S is the sum of squares of a window's samples about their mean, N - 1 times their variance,
    minus the contribution (N - 1) noise^2 of noise. A Gaussian is fitted to the peak and its neighbours, that
    is, a parabola through log S (Nayar and Nakagawa 1994), weighted by the inverse of the variance of log S,
    noise^2 (2 (N - 1) noise^2 + 4 S) / S^2 (a non-central chi-square). The standard error follows from these
    and, if reach is 2 or more, from the median misfit of such curves in the picture.

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


def _window(length: int, radius: int) -> Doubles:
    """Return the number of pixels of a row or column in the window around each."""
    place = np.arange(length)
    return np.minimum(place + radius, length - 1.0) - np.maximum(place - radius, 0) + 1


class _Peak(NamedTuple):
    """A parabola through the logarithms of the sharpness of each pixel, for values of variance 1 / weight."""

    vertex: Doubles
    variance: Doubles
    gain: Doubles  # variance of the vertex if all values had the variance 1
    bent: Doubles  # (curvature / its standard error)^2; 0 if the curve has a minimum
    residual: Doubles  # sum of weight * residual^2
    free: Doubles  # expectation of that sum if all values had the variance 1


def _fit(place: Doubles, value: Doubles, weight: Doubles) -> _Peak:
    """Fit a parabola to values, (n, H, W), by polynomials orthogonal over the places (Forsythe 1957)."""
    total = weight.sum(axis=0)
    mean = (weight * place).sum(axis=0) / total
    first = place - mean
    norm = (weight * first**2).sum(axis=0)
    skew = (weight * first**3).sum(axis=0) / norm
    second = first**2 - skew * first - norm / total
    bent = (weight * second**2).sum(axis=0)
    level = (weight * value).sum(axis=0) / total
    along, across = (weight * value * first).sum(axis=0) / norm, (weight * value * second).sum(axis=0) / bent
    variance = (1 / norm + (along / across) ** 2 / bent) / (2 * across) ** 2
    gain = (weight**2 * (first / norm - along / across * second / bent) ** 2).sum(axis=0) / (2 * across) ** 2
    residual = (weight * (value - level - along * first - across * second) ** 2).sum(axis=0)
    taken = (weight**2 * (1 / total + first**2 / norm + second**2 / bent)).sum(axis=0)
    vertex = mean + skew / 2 - along / (2 * across)
    bent = np.where(across < 0, across**2 * bent, 0)
    return _Peak(vertex, variance, gain, bent, residual, total - taken)


def _misfit(peak: _Peak, points: NDArray[np.intp], in_focus: NDArray[np.bool_], variance: float) -> float:
    """Return the variance of the logarithm of sharpness about the parabola, in excess of noise.

    It is the median over pixels with four points or more, or 0. Their residuals have a chi-square
    distribution with n degrees of freedom, whose median is (1 - 2 / 9n)^3 n (Wilson and Hilferty 1931).
    """
    tested = in_focus & (points > 3) & (peak.free > 0)
    if not tested.any():
        return 0.0
    freedom = points[tested] - 3
    residual = peak.residual[tested] / (1 - 2 / (9 * freedom)) ** 3
    return max(0.0, float(np.median((residual - freedom * variance) / peak.free[tested])))
