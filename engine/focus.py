"""Focus variation: the height of each pixel by the travel at which its surroundings are sharpest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import check_dtype, check_frames
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.io import InputError
from mirrorskin.io.arguments import checked
from mirrorskin.io.maps import FocusStatus, Map, status_of
from mirrorskin.io.positions import check_strokes
from mirrorskin.io.result import Shown
from mirrorskin.kernels.device import C_TYPES, Device, open_device

Doubles = NDArray[np.float64]

_SURELY = 5.0  # standard errors by which a contrast is above that of noise
_BENT = 3.0  # standard errors by which a peak is bent


@dataclass(frozen=True, slots=True, repr=False)
class Focus(Shown):
    """Where each pixel is in focus.

    Attributes
    ----------
    height, height_sigma : ndarray, (H, W), float32
        Millimetres, minus the travel of the sharpest focus, and the standard error; NaN unless status is 1.
    status : ndarray, (H, W), uint8
        0 invalid input, 1 in focus, 2 no peak that stands out of the noise, 3 peak at an end of the stack.
    sharpness : ndarray, (H, W), float32
        Counts: the standard deviation of the window's samples in the sharpest frame, less the noise.
    """

    height: NDArray[np.float32]
    height_sigma: NDArray[np.float32]
    status: NDArray[np.uint8]
    sharpness: NDArray[np.float32]


class FocusEstimator(ThreadSafe):
    """An `Estimator` for frames of a focus stack that come block by block; see `find_focus`.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    noise, radius, reach, device
        As for `find_focus`.

    Examples
    --------
    >>> focus = FocusEstimator((20, 20), "float32", noise=0.1)
    >>> texture = np.random.default_rng(0).normal(size=(20, 20)).astype(np.float32)
    >>> for travel in range(9):
    ...     focus.push((np.exp(-((travel - 3.7) ** 2) / 9) * texture[None]).astype("f4"), travel=[travel])
    >>> round(float(focus.result().height[10, 10]), 2)
    -3.7
    """

    device: Device
    maps: ClassVar[dict[str, Map]] = {
        "status": status_of(FocusStatus),
        "sharpness": Map("standard deviation of the samples around the pixel in the best frame", "counts"),
    }

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        *,
        noise: float,
        radius: int = 4,
        reach: int = 2,
        device: str | Device | None = None,
    ) -> None:
        if not 0 <= noise < np.inf:
            raise InputError(f"noise {noise}: the standard deviation of a sample is needed, counts")
        if not all(isinstance(one, int | np.integer) and 1 <= one <= 50 for one in (radius, reach)):
            raise InputError(f"radius {radius} and reach {reach}: whole numbers from 1 to 50 are needed")
        self._shape, self._dtype, self.device = shape, check_dtype(dtype), open_device(device)
        self._noise, self._radius, self._reach = noise, radius, reach
        self._scan = self.device.kernel("focus", "focus_scan", FRAME=C_TYPES[self._dtype.name])
        self._best = self.device.array("best", shape, np.int32)
        self._peak = self.device.array("peak", (2 * reach + 1, *shape), np.float32)
        self._recent = self.device.array("recent", (reach, *shape), np.float32)
        self._inside = np.multiply.outer(*(_window(length, radius) for length in shape))
        self._travel: Doubles = np.empty(0)

    def push(self, frames: NDArray[Any], *, travel: ArrayLike) -> None:
        """Take in the next frames, (n, H, W), and the travel of each, mm."""
        check_frames(frames, self._dtype, self._shape)
        first, (rows, columns) = len(self._travel), self._shape
        self._travel = np.concatenate([self._travel, check_strokes(travel, len(frames), "travel")])
        self._scan(
            -(-rows * columns // self.device.layout.tile), frames=self.device.seen("frames", frames),
            count=len(frames), rows=rows, columns=columns, first=first, radius=self._radius,
            reach=self._reach, best=self._best, peak=self._peak, recent=self._recent, moved=frames.nbytes,
        )  # fmt: skip
        self.device.finish()

    def result(self) -> Focus:
        """Return the focus of the frames so far."""
        if not len(self._travel):
            raise InputError("no frame was pushed: at least one is needed")
        best, squares = self._best.download(), self._peak.download().astype(np.float64)
        frame = best + np.arange(-self._reach, self._reach + 1)[:, np.newaxis, np.newaxis]
        place = self._travel[np.clip(frame, 0, len(self._travel) - 1)] - self._travel[best]
        variance, freedom = self._noise * self._noise, self._inside - 1
        signal = squares - freedom * variance
        # One over the variance of the logarithm for noise of variance 1, of a non-central chi-square.
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = signal**2 / (2 * freedom * variance + 4 * signal)
            weight = np.where(signal > 0, weight, 0)
            value = np.log(np.where(signal > 0, signal, 1))
            peak = _fit(place, value, weight)
            points, top = (weight > 0).sum(axis=0), signal[self._reach]
            found = points > 2  # two have no vertex
            found &= (top > _SURELY * variance * np.sqrt(2 * freedom)) & (peak.bent > _BENT**2 * variance)
            misfit = _misfit(peak, points, found, variance)
            beside = place[self._reach - 1 : self._reach + 2]
            found &= (beside.min(axis=0) < peak.vertex) & (peak.vertex < beside.max(axis=0))
            sharpness = np.sqrt(np.maximum(top, 0) / np.maximum(freedom, 1))
        status = np.where(found, FocusStatus.IN_FOCUS, FocusStatus.NO_PEAK)
        status[(best == 0) | (best == len(self._travel) - 1)] = FocusStatus.PEAK_AT_AN_END
        status[~np.isfinite(squares[self._reach])] = FocusStatus.INVALID_INPUT
        height = -(self._travel[best] + peak.vertex)
        sigma = np.sqrt(variance * peak.variance + misfit * peak.gain)
        in_focus = status == FocusStatus.IN_FOCUS
        height, sigma = (np.where(in_focus, one, np.nan).astype(np.float32) for one in (height, sigma))
        return Focus(height, sigma, status.astype(np.uint8), sharpness.astype(np.float32))

    def reset(self) -> None:
        """Forget the frames so far."""
        self._travel = np.empty(0)


@checked
def find_focus(
    frames: NDArray[Any],
    travel: ArrayLike,
    *,
    noise: float,
    radius: int = 4,
    reach: int = 2,
    device: str | Device | None = None,
) -> Focus:
    """Find the travel at which each pixel's surroundings are sharpest (shape from focus).

    Sharpness S is the sum of squares of a window's samples less their mean, N - 1 times their variance, less
    (N - 1) noise^2, which noise adds. A Gaussian is fitted through the peak and its neighbours, a parabola
    through log S (Nayar and Nakagawa 1994), with weights one over the variance of log S, which is
    noise^2 (2 (N - 1) noise^2 + 4 S) / S^2 (a non-central chi-square). The standard error follows from them
    and, if reach is 2 or more, from the picture's median misfit of such a curve.

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
        Counts, linear in the light, the camera or its plane of focus being lowered from frame to frame.
    travel : array_like, (T,)
        Millimetres by which it was lowered, one a frame, in steps of any size.
    noise : float
        Counts: standard deviation of a sample.
    radius : int
        Pixels of the window on each side, 1 to 50: N = (2 radius + 1)^2, fewer at the picture's border.
    reach : int
        Frames on each side of the sharpest that enter the fit, 1 to 50, as far as there are any.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Focus

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
    >>> focus = engine.find_focus(frames.astype(np.float32), travel, noise=0.01)
    >>> round(float(focus.height[10, 10]), 2), round(float(focus.height_sigma[10, 10]), 4)
    (-3.7, 0.0023)
    """
    if frames.ndim != 3 or 0 in frames.shape:
        raise InputError(f"frames have shape {frames.shape}: (T, H, W) is needed")
    rows, columns = frames.shape[1:]
    focus = FocusEstimator(
        (rows, columns), frames.dtype, noise=noise, radius=radius, reach=reach, device=device
    )
    focus.push(frames, travel=travel)
    return focus.result()


def _window(length: int, radius: int) -> Doubles:
    """Return how many pixels of a row or column are in the window around each."""
    place = np.arange(length)
    return np.minimum(place + radius, length - 1.0) - np.maximum(place - radius, 0) + 1


class _Peak(NamedTuple):
    """A parabola through the logarithms of the sharpness of each pixel, for values of variance 1 / weight."""

    vertex: Doubles
    variance: Doubles
    gain: Doubles  # the variance of the vertex where all values had the variance 1
    bent: Doubles  # the square of the curvature by its standard error, 0 of a curve that is bent up
    residual: Doubles  # the sum of weight * residual^2
    free: Doubles  # the mean of that sum where all values had the variance 1


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


def _misfit(peak: _Peak, points: NDArray[np.intp], found: NDArray[np.bool_], variance: float) -> float:
    """Return the variance by which logarithms of the sharpness differ from a parabola beyond the noise's.

    It is the median of what pixels with four points or more tell, whose residuals are a chi-square; its
    median is (1 - 2 / 9n)^3 of its mean n (Wilson and Hilferty 1931). 0 if no pixel has as many.
    """
    some = found & (points > 3) & (peak.free > 0)
    if not some.any():
        return 0.0
    freedom = points[some] - 3
    residual = peak.residual[some] / (1 - 2 / (9 * freedom)) ** 3
    return max(0.0, float(np.median((residual - freedom * variance) / peak.free[some])))
