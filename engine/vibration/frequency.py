"""Frequency of oscillating brightness: the maximum of the periodogram, refined by least squares."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize

from mirrorskin.engine.correlation.design_matrix import basis
from mirrorskin.io import InputError, Source
from mirrorskin.io.base.arguments import as_array, checked, in_unit
from mirrorskin.kernels.array_types import Doubles

_MIN_FRAMES = 8  # minimum number of frames
_PIXELS, _SAMPLES = 4096, 2**22  # maximum numbers of pixels and of samples that are used
_GREATEST = 1e12  # counts: maximum sample
_FINER = 4  # lines of the periodogram per independent line
_SPARSE = 64  # maximum mean interval between frames, in median intervals
_SIGNIFICANT = 8.0  # minimum power of an oscillation, in standard deviations of the power of noise
_NEWTON_STEPS = 3  # Gauss-Newton steps


class Frequency(NamedTuple):
    """A frequency and its standard deviation, hertz."""

    hertz: float
    sigma: float


@checked(samples=as_array, time=in_unit("s"))
def estimate_frequency(samples: NDArray[Any], time: ArrayLike) -> Frequency:
    """Estimate the common frequency of all pixels, whose amplitudes and phases differ.

    The initial value is the maximum of the sum of all pixels' periodograms, between one period per recording
    and half the frame rate. Gauss-Newton steps then minimise the squared residuals of mean +
    cosine cos(2 pi f t) + sine sin(2 pi f t) over f and the pixels' coefficients: the maximum-likelihood
    estimate for white noise. Its variance is the Cramer-Rao bound (Rife and Boorstyn 1974).

    Parameters
    ----------
    samples : ndarray, (T, ...), uint8, uint16 or float
        Frames, or samples of some pixels.
    time : array_like, (T,)
        Seconds, increasing; need not be evenly spaced.

    Raises
    ------
    mirrorskin.io.InputError
        Fewer than 8 frames, times that do not increase, or no significant oscillation.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> time = np.arange(100) / 30
    >>> wave = 100 + 20 * np.cos(2 * np.pi * 3.21 * time) + np.random.default_rng(1).normal(0, 1, 100)
    >>> found = engine.vibration.estimate_frequency(wave, time)
    >>> round(found.hertz, 2), found.sigma < 0.01
    (3.21, True)
    """
    seconds = np.asarray(time, np.float64)
    if not samples.ndim:
        raise InputError("samples are one number: (T, ...) is needed")
    if len(samples) < _MIN_FRAMES or seconds.shape != (len(samples),):
        raise InputError(
            f"{len(samples)} frames with {seconds.size} times: at least {_MIN_FRAMES} are needed"
        )
    if not np.all(np.diff(seconds) > 0):
        raise InputError("frame times do not increase: give the frame rate instead")
    flat = samples.reshape(len(samples), -1)
    flat = flat[:, :: max(1, flat.shape[1] * len(flat) // min(_SAMPLES, _PIXELS * len(flat)))].astype(float)
    counts = flat[:, np.isfinite(flat).all(axis=0)]
    if counts.shape[1] == 0:
        raise InputError("every pixel has a missing sample: no frequency can be estimated")
    if (greatest := np.abs(counts).max()) > _GREATEST:
        raise InputError(f"a sample is {greatest:.3g}: at most {_GREATEST:g} is supported")
    counts -= counts.mean(axis=0)
    if not counts.any():
        raise InputError("nothing oscillates: all samples of a pixel are the same")
    apart = seconds - seconds.mean()

    def unexplained(frequency: float) -> float:
        return -float(np.sum((_waves(apart, frequency).T @ counts) ** 2))

    start, width = _periodogram_peak(counts, seconds)
    frequency = float(
        optimize.minimize_scalar(
            unexplained, bounds=(max(start - width, width / 2), start + width), method="bounded"
        ).x
    )
    for _ in range(_NEWTON_STEPS):
        step, information, variance = _newton(counts, apart, frequency)
        frequency += step
    explained = -unexplained(frequency) / max(variance, np.finfo(float).tiny)
    pixels = counts.shape[1]
    if not explained > 2 * pixels + _SIGNIFICANT * math.sqrt(4 * pixels) + 4 * math.log(len(counts)):
        raise InputError("no oscillation exceeds the noise: give the frequency")
    return Frequency(frequency, math.sqrt(variance / information))


def frequency_of(source: Source, time: Doubles) -> Frequency:
    """Estimate the frequency of a source's frames, and rewind it; see `estimate_frequency`."""
    step = max(1, math.prod(source.shape[1:]) // min(_PIXELS, max(1, _SAMPLES // source.shape[0])))
    source.rewind()
    samples: list[NDArray[Any]] = []
    while (block := source.read()) is not None:
        samples += [frame.reshape(-1)[::step].copy() for frame in block.frames]
    source.rewind()
    return estimate_frequency(np.stack(samples), time)


def _periodogram_peak(counts: Doubles, time: Doubles) -> tuple[float, float]:
    """Return the maximum of the sum of periodograms, and the half-width of a line, hertz."""
    step = float(np.median(np.diff(time)))
    place = np.rint((time - time[0]) / step)
    if not place[-1] <= _SPARSE * len(time):
        raise InputError("frame times are too uneven to find a frequency in: give it")
    place = place.astype(np.intp)
    grid = np.zeros((place[-1] + 1, counts.shape[1]))
    grid[place] = counts
    lines = np.fft.rfft(grid, _FINER * len(grid), axis=0)
    power = np.sum(lines.real**2 + lines.imag**2, axis=1)
    hertz = np.fft.rfftfreq(_FINER * len(grid), step)
    width = 1 / (step * len(grid))
    power[hertz < width] = 0
    return float(hertz[np.argmax(power)]), width / 2


def _waves(time: Doubles, frequency: float) -> Doubles:
    """Return an orthonormal basis of cosine and sine without their means, (T, 2)."""
    base = basis(2 * math.pi * frequency * time)[:, 1:]
    return np.asarray(np.linalg.qr(base - base.mean(axis=0)).Q)


def _newton(counts: Doubles, time: Doubles, frequency: float) -> tuple[float, float, float]:
    """Return a Gauss-Newton step, the Fisher information times the variance, and the variance of samples."""
    full = basis(2 * math.pi * frequency * time)
    parts = np.linalg.lstsq(full, counts, rcond=None)[0]
    residual = counts - full @ parts
    variance = float(np.sum(residual**2)) / (counts.shape[1] * (len(counts) - 3) - 1)
    turn = 2 * math.pi * time[:, np.newaxis] * np.stack([-full[:, 2], full[:, 1]], axis=1)
    turn -= full @ np.linalg.lstsq(full, turn, rcond=None)[0]
    growth = turn @ parts[1:]
    square = float(np.sum(growth**2))
    # Amplitudes due to noise do not contain information.
    by_noise = variance * np.trace(turn.T @ turn @ np.linalg.inv(full.T @ full)[1:, 1:])
    information = max(square - counts.shape[1] * float(by_noise), np.finfo(float).tiny)
    return float(np.sum(growth * residual)) / square, information, variance
