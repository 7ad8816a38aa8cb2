"""Forms fitted to points by least squares of their distances, and the covariance of their parameters.

Errors of heights that were integrated from slopes are correlated over many pixels, and a fit is then far less
certain than so many independent pixels would make it. So residuals are projected on a few smooth shapes that
the fit leaves free. Errors with the form's own shape cannot be seen, but they are as large as those of the
other smooth shapes, if errors have no reason to look like the form: the mean square of the projections is the
variance of what the fit took in. This is the long-run variance by orthonormal series of Y. Sun, "A
heteroskedasticity and autocorrelation robust F test using an orthonormal series variance estimator", The
Econometrics Journal 16 (2013). It covers white errors, correlated ones and a form that does not fit. Where
errors are so smooth that the form takes most of them in, residuals are smaller than the heights' standard
deviations claim; the variance that is missing is counted as taken in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.metrology.quantity import Quantity, micrometres

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
_Frame = tuple[Doubles, Doubles]

_STEPS, _HALVINGS = 50, 10
_CONVERGED = 1e-6  # of the residuals, by which a step may still change them
_SINGULAR = 1e-14  # least eigenvalue of normal equations, of columns of length 1
_MEDIAN = 0.6745  # of the magnitude of a normal variate
_FAR = 5.0  # standard deviations, estimated by the median of the distances, beyond which points are outliers
_FEW = 0.15  # of the points: if more are that far, or that uncertain, they belong to the surface
_PASSES = 5  # over the outliers
_ENOUGH = 65536  # points to begin with
_CHUNK = 16384  # points at a time: their derivatives stay in the processor's cache
_NOTHING = 1e-300
_ROUNDING = 1e-9  # of the points' extent: distances below it are none; of a shape's squared length likewise
_UNCERTAIN = 5.0  # times the median standard deviation, beyond which a height shows its error alone
_OVERSTATED = 0.1  # of the claimed variance, that may be missing because claims are not exact


class Form(Protocol):
    """A surface with k parameters that can be fitted."""

    lift: int
    """Number of the parameter that moves it along z: distances go with that as with heights."""

    def start(self) -> Doubles:
        """Return parameters, (k,), to begin with."""

    def distance(self, points: Doubles, parameters: Doubles) -> Doubles:
        """Return the distances, (n,), of points, (3, n), positive on the camera's side."""

    def jacobian(self, points: Doubles, parameters: Doubles) -> Doubles:
        """Return their derivatives by the parameters, (k, n)."""


class Fit(NamedTuple):
    """A form that fits, and how well."""

    parameters: Doubles  # (k,), float64
    covariance: Doubles  # (k, k), float64: naN where points are too few
    kept: Mask  # (n,), bool: false of outliers
    # Birge's ratio: root mean square of the weighted residuals over that by the standard deviations; much
    # more than 1 if the surface is not of this form. NaN where these are unknown.
    birge: float

    def sigma(self, *direction: float) -> float:
        """Return the standard deviation of a linear combination of parameters."""
        along = np.asarray(direction)
        # Of parameters that nearly cancel, rounding may leave less than nothing.
        return float(np.sqrt(np.maximum(along @ self.covariance @ along, 0)))


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """The known points of a height map."""

    points: Doubles  # (3, n), float64: millimetres
    sigma: Doubles  # (n,), float64: standard deviations of their heights, mm; all NaN where there are none
    where: Mask  # (H, W), bool: which pixels they are

    @classmethod
    def of(cls, height: ArrayLike, x: ArrayLike, y: ArrayLike, sigma: ArrayLike | None) -> PointCloud:
        """Take a height map, with NaN where there is none, and where its pixels are; see `fit_plane`."""
        z = np.asarray(height, np.float64)
        where = np.isfinite(z)
        if sigma is not None:
            where &= np.isfinite(sigma)
        across, up = np.meshgrid(np.asarray(x, np.float64), np.asarray(y, np.float64))
        points = np.stack([across[where], up[where], z[where]])
        known = np.full(points.shape[1], np.nan) if sigma is None else np.asarray(sigma, np.float64)[where]
        return cls(points, known, where)

    @property
    def common_sigma(self) -> float:
        """Mean standard deviation, mm: by so much heights may be wrong together; 0 where it is not known."""
        return float(np.nan_to_num(np.mean(self.sigma)))

    def residual(self, distance: Doubles) -> tuple[Doubles, Quantity]:
        """Return the points' distances from a form, (n,), mm, as a map, and their root mean square."""
        residual = np.full(self.where.shape, np.nan)
        residual[self.where] = distance
        noise = np.sqrt(np.mean(self.sigma**2))
        return residual, micrometres(float(np.sqrt(np.mean(distance**2))), float(noise))

    def fit(self, form: Form) -> Fit | None:
        """Fit a form; None where none of its kind fits.

        Distances are weighted by their inverse variances; no weight is above that of the median. Outliers
        are left out: points beyond five standard deviations, estimated by the median of the weighted
        distances, if they are at most 15 %. If more are that far, they are part of the surface and all count.
        """
        points, sigma = self.points, self.sigma
        weight = _weights(sigma)
        rounding = _ROUNDING * float(np.ptp(points, axis=1).max())
        # Nearly all steps are taken with few points, and the last ones with all.
        every = max(1, weight.size // _ENOUGH)
        near = _fit_robustly(form, points[:, ::every], weight[::every], form.start(), rounding)
        found = None if near is None else _leave_outliers_out(form, points, weight, near, rounding)
        if found is None:
            return None
        parameters, kept = found
        if not kept.all():
            points, weight, sigma = points[:, kept], weight[kept], sigma[kept]
        gram = _gram(form, points, weight, parameters, _frame(points))
        claimed = 0.0
        if np.isfinite(sigma[0]):
            steepness = form.jacobian(points, parameters)[form.lift]
            claimed = float(np.sum(weight * (sigma * steepness) ** 2))
        birge = float(np.sqrt(gram[-1, -1] / claimed)) if claimed > 0 else np.nan
        return Fit(parameters, covariance(gram, parameters.size, weight.size, claimed), kept, birge)


def find_uncertain(sigma: Doubles, known: Mask) -> Mask:
    """Return the known pixels, (H, W), of more than five times the median sigma, if at most 15 % are.

    The highest and the lowest of all would be their errors. If more are that uncertain, all count.
    """
    uncertain = known & (sigma > _UNCERTAIN * np.median(sigma[known]))
    return np.asarray(uncertain & (np.count_nonzero(uncertain) <= _FEW * np.count_nonzero(known)))


def _fit_robustly(
    form: Form, points: Doubles, weight: Doubles, parameters: Doubles, rounding: float
) -> Doubles | None:
    """Fit so that far points pull no more than near ones (Huber 1964): some to one side do not spoil it."""
    share = np.ones_like(weight)
    for _ in range(_PASSES):
        found = _minimise(form, points, weight * share, parameters, rounding)
        if found is None:
            return None
        parameters = found
        misfit = abs(form.distance(points, parameters)) * np.sqrt(weight)
        share = 1 / np.maximum(misfit / (_typical(misfit) + rounding), 1)
    return parameters


def _leave_outliers_out(
    form: Form, points: Doubles, weight: Doubles, parameters: Doubles, rounding: float
) -> tuple[Doubles, Mask] | None:
    """Leave out what is far, and fit, until the same points are left out."""
    kept = np.zeros(weight.size, bool)
    for _ in range(_PASSES):
        misfit = abs(form.distance(points, parameters)) * np.sqrt(weight)
        near = misfit <= _FAR * max(_typical(misfit), rounding)
        if np.count_nonzero(~near) > _FEW * near.size:
            near[:] = True
        if np.array_equal(kept, near):
            break
        kept = near
        part = (points, weight) if kept.all() else (points[:, kept], weight[kept])
        found = _minimise(form, *part, parameters, rounding)
        if found is None:
            return None
        parameters = found
    return parameters, kept


def _typical(misfit: Doubles) -> float:
    """Return the standard deviation of normal variates with that median of magnitudes."""
    return float(np.median(misfit)) / _MEDIAN


def _weights(sigma: Doubles) -> Doubles:
    """Return inverse variances, (n,), as shares of a typical one; ones where there are none."""
    typical = float(np.median(sigma))
    if not typical > 0:
        return np.ones_like(sigma)
    return np.asarray(np.maximum(sigma / typical, 1.0) ** -2)


def _minimise(
    form: Form, points: Doubles, weight: Doubles, parameters: Doubles, rounding: float
) -> Doubles | None:
    """Find the parameters of the least sum of squares by Gauss-Newton steps."""
    gram = _gram(form, points, weight, parameters)
    least = rounding**2 * weight.size
    for _ in range(_STEPS):
        found = _step(gram)
        if found is None:
            return None
        step, gain = found
        before = gram[-1, -1]
        for _ in range(_HALVINGS):
            gram = _gram(form, points, weight, parameters + step)
            if gram[-1, -1] <= before + least:
                break
            step = step / 2
        parameters = parameters + step
        if gain <= _CONVERGED**2 * before + least:
            return parameters
    return None


def _step(gram: Doubles) -> tuple[Doubles, float] | None:
    """Return the step that is best where distances are linear, and the sum of squares that it takes away."""
    scale = np.sqrt(np.diag(gram)[:-1])
    if not np.all(scale > 0):
        return None
    normal, right = gram[:-1, :-1] / np.multiply.outer(scale, scale), -gram[:-1, -1] / scale
    if np.linalg.eigvalsh(normal)[0] < _SINGULAR:
        return None
    step = np.linalg.solve(normal, right)
    return step / scale, float(step @ normal @ step)


def _gram(
    form: Form, points: Doubles, weight: Doubles, parameters: Doubles, frame: _Frame | None = None
) -> Doubles:
    """Return the weighted sums that steps and `covariance` need, the latter with smooth shapes in a frame."""
    total: Doubles | float = 0.0
    for start in range(0, weight.size, _CHUNK):
        part = points[:, start : start + _CHUNK]
        shapes = [] if frame is None else _shapes(part, frame)
        rows = np.stack([*form.jacobian(part, parameters), *shapes, form.distance(part, parameters)])
        rows *= np.sqrt(weight[start : start + _CHUNK])
        total = total + rows @ rows.T
    return np.asarray(total)


def _frame(points: Doubles) -> _Frame:
    """Return the middle of the points along x and y, and how far they reach from it."""
    low, high = points[:2].min(axis=1), points[:2].max(axis=1)
    return (low + high) / 2, np.maximum((high - low) / 2, _NOTHING)


def _shapes(points: Doubles, frame: _Frame) -> list[Doubles]:
    """Return the products of two and of three of x and y, (n,) each, within -1 and 1."""
    (x_middle, y_middle), (x_reach, y_reach) = frame
    x, y = (points[0] - x_middle) / x_reach, (points[1] - y_middle) / y_reach
    xx, xy, yy = x * x, x * y, y * y
    return [xx, xy, yy, xx * x, xx * y, yy * x, yy * y]


def covariance(gram: Doubles, parameters: int, count: int, claimed: float = 0.0) -> Doubles:
    """Estimate the covariance, (k, k), of k least-squares parameters; NaN where residuals are too few.

    ``gram``, (k + m + 1, k + m + 1), is the weighted sums over ``count`` residuals of the products of: the
    derivatives of a residual by the parameters, m functions of its place, about as smooth, and the residual
    itself. Weights are any multiple of the inverse variances; ``claimed`` is the expected weighted sum of
    squares by standard deviations, 0 without these.
    """
    scale = np.sqrt(np.diag(gram))
    lengths = np.where(scale > 0, scale, np.inf)
    gram = gram / np.multiply.outer(lengths, lengths)
    inverse = _inverse(gram[:parameters, :parameters])
    across = gram[:parameters, parameters:]
    rest = gram[parameters:, parameters:] - across.T @ inverse @ across  # of shapes and residuals
    variance = scale[-1] ** 2 * _variance(rest, count - parameters)
    # Not by all: errors that are so smooth go more into one parameter than into another.
    taken_in = max((1 - _OVERSTATED) * claimed - scale[-1] ** 2, 0.0) / max(parameters - 1, 1)
    own = lengths[:parameters]
    return np.asarray((variance + taken_in) * inverse / np.multiply.outer(own, own))


def _inverse(normal: Doubles) -> Doubles:
    """Invert normal equations, of columns of length 1; undetermined directions are left out."""
    lengths, directions = np.linalg.eigh(normal)
    real = directions[:, lengths > _SINGULAR] / np.sqrt(lengths[lengths > _SINGULAR])
    return np.asarray(real @ real.T)


def _variance(rest: Doubles, freedom: int) -> float:
    """Return the variance of a smooth shape's amplitude, or of a pixel's error if that is larger."""
    lengths, directions = np.linalg.eigh(rest[:-1, :-1])
    real = lengths > _ROUNDING
    white = max(float(rest[-1, -1]), 0.0)
    free = min(int(np.count_nonzero(real)), freedom)
    if free < 3:
        return np.nan if freedom < 1 else white / freedom
    power = (directions[:, real].T @ rest[:-1, -1]) ** 2 / lengths[real]
    # Of so few amplitudes the mean square is uncertain itself: the variance of Student's t.
    smooth = float(np.sum(power)) / (free - 2)
    return max(smooth, white / freedom)
