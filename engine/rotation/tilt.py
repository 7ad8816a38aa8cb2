"""The half-angle of the precession: whether it can be one, and what it is if nobody knows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mirrorskin.engine.rotation.design_matrix import Doubles, basis
from mirrorskin.engine.rotation.residual_noise import CountNoise, whole
from mirrorskin.io import InputError

_STEEPEST = math.radians(30.0)  # no sheet follows a body that leans further
_CLEAR = 4.0  # tilts that a zenith must have for one wave a turn to be nearly all of it
_FEWEST = 30  # pixels that tell a tilt
_ROUNDS = 5


def check_tilt(tilt: float) -> float:
    """Return the tilt, radians, if a body can lean so far, else raise InputError."""
    if not 0 < tilt <= _STEEPEST:
        raise InputError(
            f"tilt {math.degrees(tilt):g} deg: above 0 and up to 30 deg is needed, such as 2.5deg"
        )
    return float(tilt)


def one_wave(wave: Doubles, scale: Doubles) -> NDArray[np.bool_]:
    """Tell which pixels are steep, or level, enough to show one wave a turn and little else.

    Parameters
    ----------
    wave : ndarray, (3, n), float64
        Mean, cosine and sine of the samples, counts.
    scale : ndarray, (4,) or (4, n), float64
        See `mirrorskin.engine.rotation.scale.Scale`.
    """
    offset, per_count = np.broadcast_to(scale.reshape(4, -1)[:2], (2, wave.shape[1]))
    told = (wave[0] - offset) * per_count > _CLEAR * np.hypot(*wave[1:]) * np.abs(per_count)
    return np.asarray(told)


def estimate_tilt(
    samples: NDArray[Any],
    phase: Doubles,
    weights: Doubles,
    matrix: Doubles,
    scale: Doubles,
    noise: CountNoise,
) -> float:
    """Estimate the tilt from the amplitude of the zenith's wave, which it is but for its third power.

    Amplitudes are averaged as squares, from which the noise's share is taken: the mean of amplitudes would be
    too large by the noise's variance over twice the tilt. Pixels count that have a zenith of four tilts or
    more and show nothing but one wave and noise.

    The pivot's shift changes amplitudes too. Where the heights differ much from the pivot's, what comes out
    is no tilt.

    Parameters
    ----------
    samples : ndarray, (N, n), uint8, uint16 or float32
        Of n pixels in one turn.
    phase, weights : ndarray, (N,), float64
        Radians, and weights above 0.
    matrix : ndarray, (3, N), float64
        See `mirrorskin.engine.rotation.design_matrix.fit_matrix`.
    scale : ndarray, (4,) or (4, n), float64
        See `mirrorskin.engine.rotation.scale.Scale`.
    noise : CountNoise

    Returns
    -------
    float
        Radians.

    Raises
    ------
    InputError
        Too few pixels tell it.
    """
    offset, per_count, low, high = np.broadcast_to(scale.reshape(4, -1), (4, samples.shape[1]))
    zeniths = (samples - offset) * per_count
    error = noise.at(samples.mean(axis=0)) * np.abs(per_count)
    with np.errstate(invalid="ignore"):
        inside = ((zeniths > low + 3 * error) & (zeniths < high - 3 * error)).all(axis=0)
    usable = whole(samples).all(axis=0) & inside
    zeniths, error = zeniths[:, usable], error[usable]
    mean, cosine, sine = wave = matrix @ zeniths
    left = np.sum(weights[:, np.newaxis] * (zeniths - basis(phase) @ wave) ** 2, axis=0)
    clean = left <= special.chdtri(max(1, len(phase) - 3), 1e-3) * error**2 * 1.5
    covariance = matrix @ (matrix / weights).T
    square = cosine**2 + sine**2 - (covariance[1, 1] + covariance[2, 2]) * error**2

    tilt = math.sqrt(max(0.0, float(np.median(square[clean])))) if clean.any() else 0.0
    for _ in range(_ROUNDS):
        told = clean & (mean > max(_CLEAR * tilt, 1e-3))
        if np.count_nonzero(told) < _FEWEST or not tilt > 0:
            raise InputError("too few pixels tell the tilt: give it, such as 2.5deg")
        azimuth = np.arctan2(sine[told], cosine[told])
        expected = matrix @ zenith_seen(mean[told], azimuth, phase, tilt)
        growth = np.sum(square[told]) / np.sum(expected[1] ** 2 + expected[2] ** 2)
        tilt *= math.sqrt(max(0.0, float(growth)))
    return check_tilt(tilt)


def zenith_seen(zenith: Doubles, azimuth: Doubles, phase: Doubles, tilt: float) -> Doubles:
    """Return the zenith at each phase, (N, n), radians, by eq. 10 as a sum that loses no digits."""
    lean = np.sin(zenith) * math.sin(tilt) * (1 + np.cos(azimuth - phase[:, np.newaxis])) / 2
    return np.asarray(2 * np.arcsin(np.sqrt(np.sin((zenith - tilt) / 2) ** 2 + lean)))
