"""Surface normals from samples at any known poses: ``normals_pose.cl`` in NumPy with float64.

In frame k the body's axis is the unit vector a_k, and a pixel shows its zenith t_k relative to that axis, cos
t_k = n . a_k. Least squares over the frames give an initial normal, and the steps of `normals_exact` lead
from there to the maximum-likelihood normal.

If all axes are in one vertical plane, as for a body that rocks about one axis, the normal's component across
that plane has no influence. `normals_rock` estimates the other two, p along the plane and q upwards, in the
same way: the slope of the surface along the plane is -p / q.

If travel differs from frame to frame, a pixel may be out of contact in some frames: it then shows the zenith
0, or the least visible zenith. Samples that are not deeper than the deepest such frame are excluded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.rotation.normals import (
    _LEAST,
    _NO_ANSWER,
    _REACH,
    MORE,
    Answer,
    Array,
    Limits,
    Samples,
    Sums,
    Variance,
    conclude,
    likelihood,
    most_likely,
    normalise,
    touches,
)

AXIS, LEAN, TRAVEL = slice(6, 9), slice(9, 12), 12
"""Rows of a table of poses, (13, N), after those of a turn: the axis, its derivative by the tilt, travel."""

_AT_REST = 4.0  # standard deviations of a sample up to which it may be that of a sheet at rest


@dataclass(frozen=True, slots=True)
class Slopes:
    """Results of rocking for each pixel, (n,); NaN without a result.

    Attributes
    ----------
    slope, sigma : ndarray, float64
        Along the plane of rocking, and its standard deviation.
    zenith : ndarray, float64
        Radians: the angle to the vertical, but not in which direction.
    contact : ndarray, bool
    """

    slope: Doubles
    sigma: Doubles
    zenith: Doubles
    contact: NDArray[np.bool_]


def normals_pose(
    frames: Array,
    table: Doubles,
    scale: Doubles,
    tilt: float,
    noise: Variance,
    limits: Limits,
    presses: bool = False,
) -> Answer:
    """Return the maximum-likelihood normals; arguments as for `normals_exact`, except table and `presses`.

    The tilt is the root mean square over the frames; ``presses`` states that travel differs between frames.
    """
    samples = _samples(frames, table, scale, noise, limits, presses)
    axes = table[AXIS].T
    level, weight = _levels(samples)
    gram = np.einsum("kn,ki,kj->nij", weight, axes, axes)
    right = np.einsum("kn,ki->ni", weight * level, axes)
    start = normalise(np.einsum("nij,nj->ni", np.linalg.pinv(gram), right))
    normal, sums = most_likely(samples, start, axes, table[LEAN].T)
    return conclude(
        normal, sums, samples, samples.usable, tilt, limits, limits.model, _rests(samples, limits, presses)
    )


def normals_rock(
    frames: Array,
    table: Doubles,
    scale: Doubles,
    tilt: float,
    noise: Variance,
    limits: Limits,
    presses: bool = False,
) -> Slopes:
    """Return the slopes along the plane of rocking; the axes are (along it, 0, up)."""
    samples = _samples(frames, table, scale, noise, limits, presses)
    axes, leaning = table[AXIS].T[:, ::2], table[LEAN].T[:, ::2]
    level, weight = _levels(samples)
    gram = np.einsum("kn,ki,kj->nij", weight, axes, axes)
    right = np.einsum("kn,ki->ni", weight * level, axes)
    start = np.einsum("nij,nj->ni", np.linalg.pinv(gram), right)
    part, sums = start, None
    for number in range(2 + MORE):
        moves = samples.irregular if number >= 2 else np.ones_like(samples.irregular)
        if number == 2:
            part = np.where(samples.irregular[:, np.newaxis], start, part)
        latest = _look(_within(part), samples, axes, leaning, closely=number >= 2)
        sums = latest if sums is None or number < 2 else latest.where(moves, sums)
        part = np.where(moves[:, np.newaxis], _within(part) + _step(latest), part)
    assert sums is not None
    det = sums.m11 * sums.m22 - sums.m12**2
    rests = _rests(samples, limits, presses)
    touching, misfit = touches(sums, det, samples, tilt, limits, limits.model, rests)
    with np.errstate(divide="ignore", invalid="ignore"):
        p, q = part.T
        slope = -p / q
        variance = (sums.m22 - 2 * slope * sums.m12 + slope**2 * sums.m11) / det / q**2
        sigma = samples.error * np.sqrt(np.where(det > 0, variance, np.inf))
        answered = (samples.usable >= _LEAST) & (sigma < _NO_ANSWER) & (q > 0)
        sigma = np.minimum(sigma * misfit, _NO_ANSWER)
        zenith = np.arctan2(np.sqrt(np.maximum(1 - q**2, 0)), q)
    slope, sigma, zenith = (np.where(answered, values, np.nan) for values in (slope, sigma, zenith))
    return Slopes(slope, sigma, zenith, touching & answered)


def _samples(
    frames: Array, table: Doubles, scale: Doubles, noise: Variance, limits: Limits, presses: bool
) -> Samples:
    """Return the samples, with those out of contact marked as missing."""
    samples = Samples(frames, table[:6], scale, noise)
    if presses:
        with np.errstate(invalid="ignore"):
            rest_zenith = np.maximum(samples.low, 0.0) + _AT_REST * samples.each
            resting = samples.zenith < np.maximum(limits.rest, rest_zenith)
            resting |= np.where(samples.per_count > 0, samples.under, samples.over)
        travel = table[TRAVEL][:, np.newaxis]
        lost = np.where(resting, travel, -np.inf).max(axis=0)
        samples.keep(travel > lost)
    return samples


def _rests(samples: Samples, limits: Limits, presses: bool) -> NDArray[np.bool_]:
    """Return where the sheet is always at rest; elsewhere samples at rest are excluded."""
    with np.errstate(invalid="ignore"):
        return np.zeros(samples.mean.shape, bool) if presses else samples.mean < limits.rest


def _levels(samples: Samples) -> tuple[Doubles, Doubles]:
    """Return the cosines of the zeniths, and their weights: 0 for missing and clipped samples."""
    none = samples.missing | samples.under | samples.over
    weight = np.where(none, 0.0, samples.turn[2][:, np.newaxis] ** 2)
    return np.where(none, 0.0, np.cos(samples.zenith)), weight


def _look(part: Doubles, samples: Samples, axes: Doubles, leaning: Doubles, closely: bool) -> Sums:
    """Return the normal equations of both components, like those of a direction."""
    half = np.clip(0.5 - 0.5 * (axes @ part.T), 1e-12, 0.5)
    zenith, root = 2 * np.arcsin(np.sqrt(half)), samples.turn[2][:, np.newaxis]
    by_sine = -root / np.sin(zenith)
    u1, u2, u3 = by_sine * axes[:, :1], by_sine * axes[:, 1:], by_sine * (leaning @ part.T)
    error = samples.zenith - zenith
    information, pull, misfit = np.ones_like(error), error, error**2
    if closely:
        inside = (zenith > samples.low) & (zenith < samples.high)
        information, pull, misfit = likelihood(samples, np.clip(zenith, samples.low, samples.high), inside)
    return Sums.of(u1, u2, u3, information, root * pull, root**2 * misfit)


def _within(part: Doubles) -> Doubles:
    """Return components of a unit vector limited to length 1."""
    return np.asarray(part / np.maximum(np.linalg.norm(part, axis=1, keepdims=True), 1))


def _step(sums: Sums) -> Doubles:
    """Return a Gauss-Newton step of both components."""
    with np.errstate(divide="ignore", invalid="ignore"):
        det = sums.m11 * sums.m22 - sums.m12**2
        d1 = (sums.m22 * sums.b1 - sums.m12 * sums.b2) / det
        d2 = (sums.m11 * sums.b2 - sums.m12 * sums.b1) / det
        shorter = _REACH / np.maximum(np.hypot(d1, d2), _REACH)
    return np.stack([shorter * d1, shorter * d2], axis=1)
