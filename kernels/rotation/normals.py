"""Surface normals from one turn of axial rotation: ``normals.cl`` in NumPy with float64.

At phase alpha the body's axis is a = (-sin d cos alpha, -sin d sin alpha, cos d), and a pixel shows its
zenith t relative to that axis: cos t = n . a (eq. 10). So a sample is a distance on the sphere, from the
normal n to a known point.

`normals_exact` starts from the linear fit: cos t is mean + cosine cos alpha + sine sin alpha with n =
(-cosine, -sine, mean tan d) / sin d. Two Gauss-Newton steps on the distances lead to the maximum-likelihood
normal: a third step would move it by less than a hundredth of its standard error. A distance grows by u . dn
when the normal moves, where u is the unit vector that points away from a; so sum u u' (gain / noise)^2 is the
Fisher information, and the trace of its inverse the predicted mean square of the angle to the true normal.

`normals_paper` implements eq. 14-22: t is approximated by theta + d cos(phi - alpha), which is valid only if
theta is much larger than d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.kernels.array_types import Doubles

Array = NDArray[Any]

MORE = 12
"""Steps after the first two, for pixels with a sample that is clipped, missing or out of range."""

_REACH = 0.25  # maximum step, radians
_NO_ANSWER = 1.0  # standard error, radians, above which there is no result
_LEAST = 3  # minimum number of valid samples within their range
_STEADY = 1e-6  # amplitude, radians, below which rounding determines the azimuth
_MARGIN = 3.0  # minimum distance of a sample within the range from its ends, standard deviations
_MODEL = 0.2  # RMS error of the model in contact, as a share of the tilt
_DOUBT = 2.0  # tolerated ratio of the actual to the assumed variance of the noise
_REST = 0.5  # share of the tilt below which a mean zenith is that of a sheet at rest
_HIGHEST_TILT = 2.0  # maximum amplitude, in tilts: a pixel with constant brightness looks level and tilted
_LOWEST_TILT = 0.25  # share of the tilt below which a sheet does not follow the object


class Variance(NamedTuple):
    """Variance of a sample of weight 1: base + slope x the mean of its pixel's samples, at least `floor`.

    Attributes
    ----------
    base, slope, floor : float
        Counts squared, counts, counts squared.
    """

    base: float
    slope: float
    floor: float


class Limits(NamedTuple):
    """Limits of the residuals of a fit with free tilt for lasting contact.

    Attributes
    ----------
    noise : float
        Largest sum of squares that is attributed to noise, in variances of a sample.
    model : float
        Largest sum of squares that is attributed to errors of the model, radians squared.
    lowest_tilt : float
        Minimum apparent tilt of a sheet in contact, radians; three standard errors are tolerated.
    highest_tilt : float
        Maximum apparent tilt of a sheet in contact, radians; three standard errors are tolerated.
    rest : float
        Minimum mean zenith of a sheet in contact, radians: the mean is 0 at rest, and at least the tilt in
        contact.
    """

    noise: float
    model: float
    lowest_tilt: float
    highest_tilt: float
    rest: float


def contact_limits(freedom: int, tilt: float) -> Limits:
    """Return the limits for a fit with a number of degrees of freedom, (frames - 3).

    ``noise`` is based on the 99.9 % quantile of chi-square, n + 4.37 sqrt(n) + 5.7 within 3 %.
    """
    noise = _DOUBT * (freedom + 4.37 * math.sqrt(freedom) + 5.7)
    return Limits(
        noise, (freedom + 3) * (_MODEL * tilt) ** 2, _LOWEST_TILT * tilt, _HIGHEST_TILT * tilt, _REST * tilt
    )


@dataclass(frozen=True, slots=True)
class Answer:
    """The result of each pixel.

    Attributes
    ----------
    vectors : ndarray, (n, 3), float64
        Unit normals; NaN without an answer.
    sigma : ndarray, (n,), float64
        Predicted RMS angle to the true normal, radians.
    contact : ndarray, (n,), bool
    mean, cosine, sine, residual : ndarray, (n,), float64
        Fit of the samples with one wave per turn, counts.
    """

    vectors: Doubles
    sigma: Doubles
    contact: NDArray[np.bool_]
    mean: Doubles
    cosine: Doubles
    sine: Doubles
    residual: Doubles


def normals_exact(
    frames: Array, turn: Doubles, scale: Doubles, tilt: float, noise: Variance, limits: Limits
) -> Answer:
    """Return the maximum-likelihood normals.

    Parameters
    ----------
    frames : (N, n), samples of n pixels. Integer counts at the ends of their type are clipped: their
        likelihood is the probability of a value beyond that end. NaN marks a missing sample
    turn : (6, N), cosine and sine of each phase, root of its weight, and its shares in mean, cosine and sine
    scale : (4,) or (4, n), counts at zenith 0, radians per count, and the range of zeniths in which
        brightness is linear. Samples expected outside this range carry no information on the direction
    tilt : radians
    """
    samples = Samples(frames, turn, scale, noise)
    normal, sums = most_likely(samples, _start(samples, turn, tilt), *_axes(turn, tilt))
    with np.errstate(invalid="ignore"):
        rest = samples.mean < limits.rest
    return conclude(normal, sums, samples, samples.usable, tilt, limits, limits.model, rest)


def most_likely(samples: Samples, start: Doubles, axes: Doubles, tilting: Doubles) -> tuple[Doubles, Sums]:
    """Return the maximum-likelihood normals and the normal equations near them.

    Steps start from given normals, (n, 3). ``axes`` are the body's axes in the frames, (N, 3), and
    ``tilting`` their derivatives with respect to the tilt.
    """
    normal, sums = start, None
    for number in range(2 + MORE):
        # Pixels with clipped, missing or out-of-range samples need all steps and their likelihood; others do
        # not.
        moves = samples.irregular if number >= 2 else np.ones_like(samples.irregular)
        if number == 2:
            normal = np.where(samples.irregular[:, np.newaxis], start, normal)
        if not moves.any():
            break
        latest = _look(normal, samples, axes, tilting, closely=number >= 2)
        sums = latest if sums is None or number < 2 else latest.where(moves, sums)
        normal = np.where(moves[:, np.newaxis], step(normal, latest), normal)
    assert sums is not None
    return normal, sums


def normals_paper(
    frames: Array, turn: Doubles, scale: Doubles, noise: Variance, limits: Limits, spread: Doubles
) -> Answer:
    """Return normals by the paper's approximation: the mean is the zenith, the wave's phase the azimuth.

    Clipped and missing samples are not handled here. ``spread`` contains the variances of mean and cosine,
    the covariance of cosine and sine, and the variance of the sine, relative to that of a sample. The
    standard errors include the noise only; the error of the approximation is additional.
    """
    samples = Samples(frames, turn, scale, noise)
    zenith, c, s = samples.mean, samples.cosine, samples.sine
    amplitude = np.hypot(c, s)
    with np.errstate(divide="ignore", invalid="ignore"):
        cp, sp = c / amplitude, s / amplitude
        both = 2 * cp * sp * spread[2]
        across = sp**2 * spread[1] - both + cp**2 * spread[3]
        along = cp**2 * spread[1] + both + sp**2 * spread[3]
        sigma = samples.error * np.sqrt(spread[0] + (np.sin(zenith) / amplitude) ** 2 * across)
        uncertainty = 3 * samples.error * np.sqrt(along)
        off_tilt = (amplitude + uncertainty < limits.lowest_tilt) | (
            amplitude - uncertainty > limits.highest_tilt
        )
        touching = (
            _like_noise(samples.square, samples, limits.noise, limits.model)
            & ~off_tilt
            & ~(zenith < limits.rest)
        )
    normal = np.stack([np.sin(zenith) * cp, np.sin(zenith) * sp, np.cos(zenith)], axis=1)
    return _answer(normal, np.where(amplitude > _STEADY, sigma, np.nan), touching, samples)


def add_turn(before: Answer, now: Answer, turns: int) -> Answer:
    """Return the combination of a turn with the mean of the ``turns`` - 1 before it, by inverse variances."""
    new_weight, old_weight = (
        np.where(np.isnan(answer.sigma), 0.0, 1 / answer.sigma**2) for answer in (now, before)
    )
    sums = new_weight[:, np.newaxis] * np.nan_to_num(now.vectors) + old_weight[:, np.newaxis] * np.nan_to_num(
        before.vectors
    )

    def mean(old: Doubles, new: Doubles) -> Doubles:
        joined = old + (new - old) / turns
        return np.where(np.isnan(new), old, np.where(np.isnan(old), new, joined))

    with np.errstate(divide="ignore"):
        sigma = 1 / np.sqrt(new_weight + old_weight)
    return Answer(
        vectors=normalise(sums),
        sigma=np.where(np.isinf(sigma), np.nan, sigma),
        contact=before.contact & now.contact,
        mean=mean(before.mean, now.mean),
        cosine=mean(before.cosine, now.cosine),
        sine=mean(before.sine, now.sine),
        residual=np.sqrt(mean(before.residual**2, now.residual**2)),
    )


class Samples:
    """Samples as zeniths, and their fit with one wave per turn."""

    offset: NDArray[Any]
    low: NDArray[Any]
    high: NDArray[Any]
    turn: Doubles
    freedom: NDArray[Any]
    under: NDArray[np.bool_]
    over: NDArray[np.bool_]
    mean: NDArray[Any]
    cosine: NDArray[Any]
    sine: NDArray[Any]

    def __init__(self, frames: Array, turn: Doubles, scale: Doubles, noise: Variance) -> None:
        count, pixels = frames.shape
        self.offset, per_count, self.low, self.high = np.broadcast_to(scale.reshape(4, -1), (4, pixels))
        self.per_count = per_count
        self.turn, self.freedom = turn, count - 3
        raw = frames.astype(np.float64)
        self.zenith: NDArray[Any] = (raw - self.offset) * per_count
        self.missing: NDArray[np.bool_] = np.isnan(raw)
        present = np.maximum((~self.missing).sum(axis=0), 1)
        level = np.where(self.missing, 0.0, raw).sum(axis=0) / present
        self.error: NDArray[Any] = np.sqrt(
            np.maximum(noise.base + noise.slope * level, noise.floor)
        ) * np.abs(per_count)
        self.under, self.over = np.zeros((2, count, pixels), bool)
        self.top: float = np.inf
        if frames.dtype.kind == "u":
            self.top = float(np.iinfo(frames.dtype).max)
            self.under, self.over = raw <= 0, raw >= self.top
        self.each: NDArray[Any] = self.error / turn[2][:, np.newaxis]  # standard deviation of each sample
        margin = _MARGIN * self.each
        usable = (self.zenith > self.low + margin) & (self.zenith < self.high - margin)
        self.whole: NDArray[Any] = usable & ~self.under & ~self.over
        self.keep(np.ones_like(self.whole))
        self.mean, self.cosine, self.sine = turn[3:] @ self.zenith
        wave = self.mean + np.multiply.outer(turn[0], self.cosine) + np.multiply.outer(turn[1], self.sine)
        self.square: NDArray[Any] = np.sum((turn[2][:, np.newaxis] * (self.zenith - wave)) ** 2, axis=0)

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Treat all samples as missing except for some, (N, n)."""
        self.missing = self.missing | ~kept
        self.usable: NDArray[Any] = (self.whole & kept).sum(axis=0)
        self.irregular: NDArray[Any] = self.usable < len(kept)


def conclude(normal: Doubles, sums: Sums, samples: Samples, usable: Array, tilt: float, limits: Limits,
             model: float | Doubles, rest: NDArray[np.bool_]) -> Answer:  # fmt: skip
    """Return the answer for a direction: its standard error, and whether there was contact in all frames.

    ``sums`` are evaluated at the direction or near it. ``usable`` is the number of valid samples within their
    range, ``model`` the sum of the squared model errors, in the squared unit of the samples, and ``rest``
    marks pixels where the sheet is at rest.
    """
    det = sums.m11 * sums.m22 - sums.m12**2
    touching, misfit = touches(sums, det, samples, tilt, limits, model, rest)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = samples.error * np.sqrt(np.where(det > 0, (sums.m11 + sums.m22) / det, np.inf))
    unknown = (usable < _LEAST) | ~(sigma < _NO_ANSWER)
    sigma = np.minimum(sigma * misfit, _NO_ANSWER)
    return _answer(normal, np.where(unknown, np.nan, sigma), touching, samples)


def touches(
    sums: Sums, det: Doubles, samples: Samples, tilt: float, limits: Limits, model: float | Doubles,
    rest: NDArray[np.bool_],
) -> tuple[NDArray[np.bool_], Doubles]:  # fmt: skip
    """Return where residuals indicate contact in all frames, and the ratio of the residuals to the noise.

    ``det`` is the determinant of the equations.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        more_tilt, information, residual = _free_tilt(sums, det)
        uncertainty = 3 * samples.error / np.sqrt(information)
        off_tilt = (tilt + more_tilt + uncertainty < limits.lowest_tilt) | (
            tilt + more_tilt - uncertainty > limits.highest_tilt
        )
        like_noise = _like_noise(residual, samples, limits.noise, model)
        misfit = _misfit(residual, samples, limits.noise)
    return np.asarray(like_noise & ~off_tilt & ~rest), misfit


@dataclass(frozen=True, slots=True)
class Sums:
    """Normal equations of the direction (along the meridian 1, across it 2) and of the tilt (3)."""

    m11: Doubles
    m12: Doubles
    m22: Doubles
    m13: Doubles
    m23: Doubles
    m33: Doubles
    b1: Doubles
    b2: Doubles
    b3: Doubles
    square: Doubles

    @classmethod
    def of(
        cls, u1: Doubles, u2: Doubles, u3: Doubles, information: Doubles, pull: Doubles, squares: Doubles
    ) -> Sums:
        """Return sums over the samples, (N, n): derivatives, information, gradients and squared misfits."""
        return cls(
            m11=(information * u1 * u1).sum(axis=0),
            m12=(information * u1 * u2).sum(axis=0),
            m22=(information * u2 * u2).sum(axis=0),
            m13=(information * u1 * u3).sum(axis=0),
            m23=(information * u2 * u3).sum(axis=0),
            m33=(information * u3 * u3).sum(axis=0),
            b1=(u1 * pull).sum(axis=0),
            b2=(u2 * pull).sum(axis=0),
            b3=(u3 * pull).sum(axis=0),
            square=squares.sum(axis=0),
        )

    def where(self, chosen: NDArray[np.bool_], other: Sums) -> Sums:
        """Return the selected pixels from here, the others from there."""
        return Sums(*(np.where(chosen, getattr(self, f.name), getattr(other, f.name)) for f in fields(self)))


def _start(samples: Samples, turn: Doubles, tilt: float) -> Doubles:
    level = np.cos(samples.zenith)
    if samples.missing.any():
        present = np.maximum((~samples.missing).sum(axis=0), 1)
        level = np.where(samples.missing, np.where(samples.missing, 0.0, level).sum(axis=0) / present, level)
    mean, cosine, sine = turn[3:] @ level
    return normalise(
        np.stack([-cosine * math.cos(tilt), -sine * math.cos(tilt), mean * math.sin(tilt)], axis=1)
    )


def _look(normal: Doubles, samples: Samples, axes: Doubles, tilting: Doubles, closely: bool) -> Sums:
    """Return the normal equations at a direction; `closely` for clipped or missing samples."""
    chord = np.linalg.norm(normal[np.newaxis] - axes[:, np.newaxis], axis=2)
    zenith = 2 * np.arcsin(np.clip(chord / 2, 1e-6, math.sqrt(0.5)))
    along, across = tangents(normal)
    root = samples.turn[2][:, np.newaxis]
    # d zenith = -d(n . a) / sin(zenith)
    by_sine = -root / np.sin(zenith)
    u1, u2, u3 = by_sine * (axes @ along.T), by_sine * (axes @ across.T), by_sine * (tilting @ normal.T)
    error = samples.zenith - zenith
    information, pull, misfit = np.ones_like(error), error, error**2
    if closely:
        inside = (zenith > samples.low) & (zenith < samples.high)
        information, pull, misfit = likelihood(samples, np.clip(zenith, samples.low, samples.high), inside)
    return Sums.of(u1, u2, u3, information, root * pull, root**2 * misfit)


def likelihood(
    samples: Samples, expected: Doubles, inside: NDArray[np.bool_]
) -> tuple[Doubles, Doubles, Doubles]:
    """Return for each sample its information, its residual, and its squared misfit.

    ``expected`` are the expected samples. One that is not ``inside`` the range contributes nothing.

    A clipped sample has the probability of being beyond its bound as its likelihood (Tobin 1958): with z the
    bound's distance in standard deviations and m the ratio of the normal density to its integral there, its
    residual is m and its information m (m + z).
    """
    from scipy import special

    error = samples.zenith - expected
    clipped = samples.under | samples.over
    bound = (np.where(samples.under, 0.5, samples.top - 0.5) - samples.offset) * samples.per_count
    side = np.where(samples.under == (samples.per_count > 0), -1.0, 1.0)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        z = side * (expected - bound) / samples.each
        slope = math.sqrt(2 / math.pi) / special.erfcx(-z / math.sqrt(2))
        information = np.where(clipped, slope * (slope + z), 1.0)
        pull = np.where(clipped, side * slope * samples.each, error)
        misfit = np.where(clipped, (np.minimum(z, 0) * samples.each) ** 2, error**2)
    present = ~samples.missing
    return (
        np.where(inside & present, information, 0.0),
        np.where(inside & present, pull, 0.0),
        np.where(present, misfit, 0.0),
    )


def _axes(turn: Doubles, tilt: float) -> tuple[Doubles, Doubles]:
    """Return the body's axis at each phase, (N, 3), and its derivative with respect to the tilt."""
    ones = np.ones_like(turn[0])
    axes = np.stack([-math.sin(tilt) * turn[0], -math.sin(tilt) * turn[1], math.cos(tilt) * ones], axis=1)
    tilting = np.stack([-math.cos(tilt) * turn[0], -math.cos(tilt) * turn[1], -math.sin(tilt) * ones], axis=1)
    return axes, tilting


def tangents(normal: Doubles) -> tuple[Doubles, Doubles]:
    """Return unit vectors along the meridian, away from the pole, and across it, (n, 3) each."""
    x, y, z = normal.T
    st = np.hypot(x, y)
    level = st < 1e-10
    cp, sp = np.where(level, [[1.0], [0.0]], normal.T[:2] / np.where(level, 1.0, st))
    return np.stack([z * cp, z * sp, -st], axis=1), np.stack([-sp, cp, np.zeros_like(sp)], axis=1)


def step(normal: Doubles, sums: Sums) -> Doubles:
    """Return the direction after a Gauss-Newton step."""
    along, across = tangents(normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        det = sums.m11 * sums.m22 - sums.m12**2
        d1 = (sums.m22 * sums.b1 - sums.m12 * sums.b2) / det
        d2 = (sums.m11 * sums.b2 - sums.m12 * sums.b1) / det
        shorter = _REACH**2 / np.maximum(d1**2 + d2**2, _REACH**2)
        moved = normal + (shorter * d1)[:, np.newaxis] * along + (shorter * d2)[:, np.newaxis] * across
    return normalise(moved)


def _free_tilt(sums: Sums, det: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Return the step of a free tilt, its information, and the remaining sum of squares."""
    d1, d2 = (sums.m22 * sums.b1 - sums.m12 * sums.b2) / det, (sums.m11 * sums.b2 - sums.m12 * sums.b1) / det
    w1 = (sums.m22 * sums.m13 - sums.m12 * sums.m23) / det
    w2 = (sums.m11 * sums.m23 - sums.m12 * sums.m13) / det
    information = np.maximum(sums.m33 - sums.m13 * w1 - sums.m23 * w2, 1e-12)
    pull = sums.b3 - sums.m13 * d1 - sums.m23 * d2
    return pull / information, information, sums.square - sums.b1 * d1 - sums.b2 * d2 - pull**2 / information


def _like_noise(square: Doubles, samples: Samples, noise: float, model: float | Doubles) -> NDArray[np.bool_]:
    """Return where a sum of squares is explained by noise and model error; everywhere for three frames."""
    if samples.freedom == 0:
        return np.ones(len(square), bool)
    explained: NDArray[np.bool_] = square <= noise * samples.error**2 + model
    return explained


def _misfit(square: Doubles, samples: Samples, noise: float) -> Doubles:
    """Return the residual over the noise where noise does not explain the sum of squares; 1 elsewhere."""
    chi2 = square / samples.error**2
    unexplained = (chi2 > noise) & (samples.freedom > 0)
    return np.where(unexplained, np.sqrt(np.abs(chi2) / np.maximum(samples.freedom, 1)), 1.0)


def _answer(normal: Doubles, sigma: Doubles, touching: NDArray[np.bool_], samples: Samples) -> Answer:
    with np.errstate(divide="ignore", invalid="ignore"):
        answered = np.isfinite(sigma) & (normal[:, 2] > 0)  # a sheet does not face away
        gain = 1 / samples.per_count
        freedom = samples.freedom or np.nan
        residual = np.sqrt(samples.square / freedom) * np.abs(gain)
    return Answer(
        vectors=np.where(answered[:, np.newaxis], normal, np.nan),
        sigma=np.where(answered, sigma, np.nan),
        contact=touching & answered,
        mean=samples.offset + samples.mean * gain,
        cosine=samples.cosine * gain,
        sine=samples.sine * gain,
        residual=residual,
    )


def normalise(vectors: Doubles) -> Doubles:
    """Return vectors, (n, 3), of length 1."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def zenith_of(normals: ArrayLike) -> NDArray[np.float32]:
    """Return the angle to the body's axis in the mean pose, (H, W), radians."""
    x, y, z = np.moveaxis(np.asarray(normals), -1, 0)
    return np.asarray(np.arctan2(np.hypot(x, y), z))


def azimuth_of(normals: ArrayLike) -> NDArray[np.float32]:
    """Return the direction in which the surface faces, (H, W), radians from x towards y; NaN where level."""
    x, y, _ = np.moveaxis(np.asarray(normals), -1, 0)
    return np.where((x == 0) & (y == 0), np.float32(np.nan), np.arctan2(y, x))
