"""Realisations of the errors of heights, from their standard deviations and the length of their correlation.

Heights from slopes and absolute heights minimise sum (z - h)^2 / sh^2 + sum |grad z - s|^2 / ss^2, so the
spectrum of their errors is proportional to 1 / (k^2 + 1 / L^2) with L = sh / ss: white for L = 0, as of a
press; that of integrated slopes for L = infinity.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]

_PERIODIC_MARGIN = 4.0  # correlation lengths between the map and its periodic continuation
_LARGEST = 2  # times the size of the map: the periodic picture where the correlation is longer
# Distance in pixels at which (ln d) / (2 pi) is 0 in the structure function of heights from slopes on a grid.
_GRID = math.exp(-np.euler_gamma) / 2**1.5
_SEED = 20  # realisations are the same in each call


def realisations(
    sigma: Doubles, measured: Mask, pixel_size: tuple[float, float], length: float, count: int
) -> Iterator[Doubles]:
    """Yield independent errors of heights, (H, W) mm, 0 where a height is not measured.

    ``sigma``, (H, W) mm, are standard deviations, and ``length``, mm, is that of the correlation. With an
    infinite length, heights are relative: their mean error is 0.
    """
    rng = np.random.default_rng(_SEED)
    spread = np.where(measured, sigma, 0.0)
    if not length > 0:
        for _ in range(count):
            yield spread * rng.standard_normal(measured.shape, np.float32)
        return
    gain, shape = _gain(measured.shape, pixel_size, length)
    for _ in range(count):
        field = _filtered(rng.standard_normal(shape, np.float32), gain)[
            : measured.shape[0], : measured.shape[1]
        ]
        if math.isinf(length):
            field = (field - np.mean(field[measured])) * _relative_gain(measured, gain, shape)
        yield spread * field


def _gain(
    shape: tuple[int, ...], pixel_size: tuple[float, float], length: float
) -> tuple[Doubles, tuple[int, int]]:
    """Return by what to multiply the waves of a periodic picture, and its shape; fields have variance 1."""
    from scipy import fft

    sizes = pixel_size[::-1]
    margin = [
        min(_PERIODIC_MARGIN * length / size, (_LARGEST - 1) * n)
        for n, size in zip(shape, sizes, strict=True)
    ]
    rows, columns = (
        fft.next_fast_len(math.ceil(n + more), real=True) for n, more in zip(shape, margin, strict=True)
    )
    up, across = fft.fftfreq(rows)[:, np.newaxis], fft.rfftfreq(columns)[np.newaxis]
    power = (2 * np.sin(np.pi * up) / sizes[0]) ** 2 + (2 * np.sin(np.pi * across) / sizes[1]) ** 2
    power = power + (0.0 if math.isinf(length) else length**-2)
    if math.isinf(length):
        power[0, 0] = np.inf
    spectrum = 1 / power
    # Waves of the real transform count twice, except for the first and the last column.
    twice = np.full(across.shape, 2.0)
    twice[0, 0] = 1.0
    if columns % 2 == 0:
        twice[0, -1] = 1.0
    variance = float(np.sum(spectrum * twice)) / (rows * columns)
    return np.sqrt(spectrum / variance).astype(np.float32), (rows, columns)


def _filtered(white: NDArray[np.float32], gain: Doubles) -> Doubles:
    from scipy import fft

    return np.asarray(fft.irfft2(fft.rfft2(white) * gain, white.shape))


def _relative_gain(measured: Mask, gain: Doubles, shape: tuple[int, int]) -> float:
    """Return by what errors relative to their mean are smaller than fields of variance 1, inverted.

    The variance of the mean over the measured pixels is the mean covariance of all their pairs.
    """
    from scipy import fft

    wave = fft.rfft2(measured.astype(np.float32), shape)
    covariance = np.sum(fft.irfft2(np.abs(wave) ** 2 * gain**2, shape)[0, 0])
    relative = float(covariance) / np.count_nonzero(measured) ** 2
    return 1 / math.sqrt(max(1 - relative, 1e-6))


def covariance_of(
    functionals: Doubles, sigma: Doubles, measured: Mask, pixel_size: tuple[float, float], length: float
) -> Doubles:
    """Return the covariance, (k, k), of linear functionals, (k, H, W), of errors of heights.

    They are correlated over a length above 0, mm. Errors of integrated slopes are those in a rectangle with
    free borders, scaled to ``sigma``.
    """
    from scipy import fft

    weighted = np.where(measured, functionals * np.where(measured, sigma, 0.0), 0.0)
    if math.isinf(length):
        variance, power = _free_errors(measured.shape, pixel_size)
        weighted = weighted / np.sqrt(variance)
        means = weighted.sum(axis=(1, 2)) / np.count_nonzero(measured)
        weighted -= means[:, np.newaxis, np.newaxis] * measured
        waves = fft.dctn(weighted, axes=(1, 2), norm="ortho") * np.sqrt(power)
    else:
        gain, shape = _gain(measured.shape, pixel_size, length)
        waves = fft.irfft2(fft.rfft2(weighted, shape) * gain, shape)
    flat = waves.reshape(len(waves), -1)
    return np.asarray(flat @ flat.T)


def _free_errors(shape: tuple[int, ...], pixel_size: tuple[float, float]) -> tuple[Doubles, Doubles]:
    """Return the variance of heights in a rectangle for slopes of variance 1, and that of cosine waves."""
    from mirrorskin.engine.integration.height_variance import find_rectangle_variance

    rows, columns = shape
    weights = 1 / pixel_size[0] ** 2, 1 / pixel_size[1] ** 2
    up, across = (4 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2 for n in (rows, columns))
    total = np.add.outer(weights[1] * up, weights[0] * across)
    total[0, 0] = np.inf
    return find_rectangle_variance((rows, columns), weights, 0.0).astype(np.float64), 1 / total


def correlation(
    distance: Doubles, shape: tuple[int, int], pixel_size: tuple[float, float], length: float
) -> Doubles:
    """Return the correlation of two errors of heights at distances, mm, in a picture of so many pixels.

    With an infinite length only differences of heights are known, and the correlation is about their mean: it
    is 1 - g(d) / g, with g(d) = ln(d / e) / (2 pi) half the mean square of differences on a grid of pixels
    for links of variance 1, and g the mean variance. With a length L it is K0(d / L) / K0(e / L).
    """
    from scipy.special import k0

    if not length > 0:
        return np.asarray(distance == 0, np.float64)
    least = _GRID * math.sqrt(pixel_size[0] * pixel_size[1])
    far = np.maximum(distance, least)
    if math.isinf(length):
        return np.asarray(1 - np.log(far / least) / (2 * math.pi * _mean_variance(*shape)))
    return np.asarray(k0(far / length) / k0(least / length))


@functools.cache
def _mean_variance(rows: int, columns: int) -> float:
    """Return the mean variance of heights from slopes about their mean, for links of variance 1."""
    from mirrorskin.engine.integration.height_variance import find_rectangle_variance

    return float(find_rectangle_variance((rows, columns), (1.0, 1.0), 0.0).mean())
