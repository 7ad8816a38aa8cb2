"""The tilt, the half-angle of the precession: checks, and its estimate from a turn."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.correlation.design_matrix import TurnFit, basis
from mirrorskin.engine.diagnosis.residual_noise import CountNoise, valid
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles

STEEP = 4.0
"""Ratio of zenith and tilt above which one wave per turn is a good approximation."""

_MAX_TILT = math.radians(30.0)  # maximum tilt that the sheet can follow
_MIN_PIXELS = 30  # minimum number of pixels of an estimate
_ITERATIONS = 5  # iterations


def check_tilt(tilt: float) -> float:
    """Return the tilt, radians, or raise InputError if it is impossible."""
    if not 0 < tilt <= _MAX_TILT:
        raise InputError(
            f"tilt {math.degrees(tilt):g} deg: above 0 and up to 30 deg is needed, such as 2.5deg"
        )
    return float(tilt)


def check_tilts(tilt: ArrayLike, count: int) -> Doubles:
    """Return the tilts of ``count`` frames, radians within +-30 degrees, as float64."""
    values = np.asarray(tilt, np.float64)
    if values.shape not in ((), (count,)):
        raise InputError(f"tilt has shape {values.shape} for {count} frames: one number, or one a frame")
    wrong = ~(np.abs(values) <= _MAX_TILT)
    if np.any(wrong):
        at = f" at frame {int(np.argmax(wrong))}" if values.ndim else ""
        raise InputError(f"tilt {math.degrees(values[wrong].flat[0]):g} deg{at}: 30 deg at most is needed")
    return np.broadcast_to(values, count)


def estimate_tilt(samples: NDArray[Any], fit: TurnFit, scale: Doubles, noise: CountNoise) -> float:
    """Estimate the tilt from the amplitude of the zenith's wave, which equals it except for third order.

    The squares of amplitudes are averaged and corrected for the noise: the mean of amplitudes would be biased
    by the noise's variance over twice the tilt. Only pixels with a zenith of at least four tilts are used,
    and only if one wave and noise explain their samples.

    The shift of the pivot changes amplitudes as well: if the pivot is far from the surface, the estimate is
    wrong. Samples are (N, n), of n pixels in one turn; ``scale`` is the planes of a `Scale`, (4,) or (4, n).
    """
    from scipy import special

    offset, per_count, low, high = np.broadcast_to(scale.reshape(4, -1), (4, samples.shape[1]))
    zeniths = (samples - offset) * per_count
    error = noise.at(samples.mean(axis=0)) * np.abs(per_count)
    with np.errstate(invalid="ignore"):
        inside = ((zeniths > low + 3 * error) & (zeniths < high - 3 * error)).all(axis=0)
    usable = valid(samples).all(axis=0) & inside
    zeniths, error = zeniths[:, usable], error[usable]
    mean, cosine, sine = wave = fit.matrix @ zeniths
    residual = np.sum(fit.weights[:, np.newaxis] * (zeniths - basis(fit.phase) @ wave) ** 2, axis=0)
    clean = residual <= special.chdtri(max(1, len(fit.phase) - 3), 1e-3) * error**2 * 1.5
    square = cosine**2 + sine**2 - (fit.covariance[1, 1] + fit.covariance[2, 2]) * error**2

    tilt = math.sqrt(max(0.0, float(np.median(square[clean])))) if clean.any() else 0.0
    for _ in range(_ITERATIONS):
        chosen = clean & (mean > max(STEEP * tilt, 1e-3))
        if np.count_nonzero(chosen) < _MIN_PIXELS or not tilt > 0:
            raise InputError(
                "too few pixels are steep and clear enough to estimate the tilt: give it, such as 2.5deg"
            )
        azimuth = np.arctan2(sine[chosen], cosine[chosen])
        expected = fit.matrix @ zenith_seen(mean[chosen], azimuth, fit.phase, tilt)
        growth = np.sum(square[chosen]) / np.sum(expected[1] ** 2 + expected[2] ** 2)
        tilt *= math.sqrt(max(0.0, float(growth)))
    return check_tilt(tilt)


def zenith_seen(zenith: Doubles, azimuth: Doubles, phase: Doubles, tilt: float) -> Doubles:
    """Return the zenith at each phase, (N, n), radians: eq. 10 as a sum without cancellation."""
    lean = np.sin(zenith) * math.sin(tilt) * (1 + np.cos(azimuth - phase[:, np.newaxis])) / 2
    return np.asarray(2 * np.arcsin(np.sqrt(np.sin((zenith - tilt) / 2) ** 2 + lean)))
