"""Realisations of the errors of heights, from their standard deviations and the length of their correlation.

Heights from slopes and absolute heights minimise sum (z - h)^2 / sh^2 + sum |grad z - s|^2 / ss^2, so the
spectrum of their errors is proportional to 1 / (k^2 + 1 / L^2) with L = sh / ss: white for L = 0, as of a
press; that of integrated slopes for L = infinity.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]

_PERIODIC_MARGIN = 4.0  # correlation lengths between the map and its periodic continuation
_LARGEST = 2  # times the size of the map: the periodic picture where the correlation is longer
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
