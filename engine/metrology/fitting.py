"""Forms fitted to points by least squares of their distances, and the covariance of their parameters.

Errors of heights that were integrated from slopes are correlated over many pixels, so a fit is far less
certain than with independent errors. Therefore residuals are projected onto a few smooth shapes that are not
part of the form. Errors with the shape of the form cannot be observed. They are assumed to be as large as
errors with other smooth shapes: the mean square of the projections is the variance absorbed by the fit. This
is the orthonormal series estimator of the long-run variance of Y. Sun, "A heteroskedasticity and
autocorrelation robust F test using an orthonormal series variance estimator", The Econometrics Journal 16
(2013). It covers white errors, correlated errors, and a form that does not fit. If errors are so smooth that
the form absorbs most of them, the residuals are smaller than the heights' standard deviations predict; the
missing variance is counted as absorbed.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.metrology.noise import covariance_of
from mirrorskin.engine.metrology.patch import independent_share, step_share
from mirrorskin.engine.metrology.quantity import Quantity, micrometres
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics import least_squares
from mirrorskin.kernels.numerics.least_squares import mad_sigma

Mask = NDArray[np.bool_]
_Frame = tuple[Doubles, Doubles]

_DAMPING = 1e-9  # damping of the first step; forms are nearly linear in their parameters
_CONVERGED = 1e-12  # maximum relative decrease of the sum of squares by the last step
_SINGULAR = 1e-14  # minimum eigenvalue of normal equations with columns of length 1
FAR = 5.0
"""Standard deviations, estimated from the median distance, beyond which points are outliers."""
FEW = 0.15
"""Maximum share of outliers or uncertain points; if there are more, they belong to the surface."""

_PASSES = 5  # maximum number of updates of the outliers
_FIRST_POINTS = 65536  # number of points for the first fit
_CHUNK = 16384  # points per block, whose derivatives fit into the processor's cache
_NOTHING = 1e-300  # avoids a division by 0
_ROUNDING = 1e-9  # relative to the points' extent: smaller distances count as 0; also for squared lengths
_OWN_SHAPE = 1e-3  # least squared length of a shape beside the form, relative to the whole shape
_UNCERTAIN = 5.0  # times the median standard deviation, above which a height counts as uncertain
_OVERSTATED = 0.1  # share of the predicted variance that may be missing because predictions are not exact


class Form(Protocol):
    """A surface with k parameters that can be fitted."""

    @property
    def lift(self) -> int:
        """Index of the parameter that moves it along z."""

    @property
    def degree(self) -> int:
        """Degree of the polynomials of x and y that it takes up; 1 for a sphere, too."""

    def start(self) -> Doubles:
        """Return first parameters, (k,)."""

    def distance(self, points: Doubles, parameters: Doubles) -> Doubles:
        """Return the distances, (n,), of points, (3, n), positive on the camera's side."""

    def jacobian(self, points: Doubles, parameters: Doubles) -> Doubles:
        """Return the derivatives of the distances with respect to the parameters, (k, n)."""


class Fit(NamedTuple):
    """A fitted form."""

    parameters: Doubles  # (k,), float64
    covariance: Doubles  # (k, k), float64: NaN if there are too few points
    kept: Mask  # (n,), bool: False for outliers, which only a robust fit leaves out
    # Birge's ratio: root mean square of the weighted residuals over that expected from standard deviations;
    # much larger than 1 if the surface does not have this form. NaN without standard deviations.
    birge: float

    def sigma(self, *direction: float) -> float:
        """Return the standard deviation of a linear combination of parameters."""
        along = np.asarray(direction)
        return float(np.sqrt(np.maximum(along @ self.covariance @ along, 0)))  # rounding may make it negative


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """The known points of a height map."""

    points: Doubles  # (3, n), float64: millimetres
    sigma: Doubles  # (n,), float64: standard deviations of their heights, mm; all NaN where there are none
    where: Mask  # (H, W), bool: which pixels they are
    pixel_size: tuple[float, float]  # millimetres
    noise_length: float | None  # millimetres over which errors of heights are correlated; None: unknown
    share: float = 1.0  # of the variance that is common, or as smooth as a form
    independent: bool = False  # whether the rest is independent

    @classmethod
    def of(
        cls,
        height: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        sigma: ArrayLike | None,
        noise_length: float | None = None,
    ) -> PointCloud:
        """Return the points of a height map, which is NaN where undefined; see `fit_plane`."""
        z = np.asarray(height, np.float64)
        where = np.isfinite(z)
        if sigma is not None:
            where &= np.isfinite(sigma)
        across, up = np.meshgrid(np.asarray(x, np.float64), np.asarray(y, np.float64))
        points = np.stack([across[where], up[where], z[where]])
        sigmas = np.full(points.shape[1], np.nan) if sigma is None else np.asarray(sigma, np.float64)[where]
        sizes = [abs(float(np.mean(np.diff(axis)))) if np.size(axis) > 1 else 0.0 for axis in (x, y)]
        size = sizes[0] or sizes[1] or 1.0, sizes[1] or sizes[0] or 1.0
        if sigma is None or noise_length != 0:
            return cls(points, sigmas, where, size, noise_length)
        common = 1 - independent_share(z, np.asarray(sigma, np.float64))
        share = common * step_share(points[2], sigmas)
        return cls(points, sigmas, where, size, noise_length, share, True)

    @property
    def common_sigma(self) -> float:
        """Common error of all heights, mm: a share of the mean standard deviation; 0 if unknown."""
        return math.sqrt(self.share) * float(np.nan_to_num(np.mean(self.sigma)))

    def residual(self, distance: Doubles) -> tuple[Doubles, Quantity]:
        """Return the points' distances from a form, (n,), mm, as a map, and their root mean square."""
        residual = np.full(self.where.shape, np.nan)
        residual[self.where] = distance
        noise = np.sqrt(np.mean(self.sigma**2))
        return residual, micrometres(float(np.sqrt(np.mean(distance**2))), float(noise))

    def fit(self, form: Form, *, robust: bool = True) -> Fit | None:
        """Fit a form; None if the points do not determine it.

        Distances have inverse-variance weights, capped at the median weight. A ``robust`` fit ignores
        outliers: points beyond five standard deviations, estimated from the median of the weighted distances,
        if they are at most 15 %. If there are more, they belong to the surface, and all points count.
        """
        points, sigma = self.points, self.sigma
        weight = _weights(sigma)
        rounding = _ROUNDING * float(np.ptp(points, axis=1).max())
        step = max(
            1, weight.size // _FIRST_POINTS
        )  # the first fit takes most steps, with a subset of the points
        few = points[:, ::step], weight[::step]
        first = (_fit_robustly if robust else _minimise)(form, *few, form.start(), rounding)
        if first is None:
            return None
        if robust:
            final = _fit_without_outliers(form, points, weight, first, rounding)
            if final is None:
                return None
            parameters, kept = final
        else:
            minimum = _minimise(form, points, weight, first, rounding)
            if minimum is None:
                return None
            parameters, kept = minimum, _near(form, points, weight, minimum, rounding)
        used = kept if robust else np.ones_like(kept)
        if not used.all():
            points, weight, sigma = points[:, used], weight[used], sigma[used]
        gram = _gram(form, points, weight, parameters, _frame(points))
        claimed = 0.0
        if np.isfinite(sigma[0]):
            steepness = form.jacobian(points, parameters)[form.lift]
            claimed = float(np.sum(weight * (sigma * steepness) ** 2))
        birge = float(np.sqrt(gram[-1, -1] / claimed)) if claimed > 0 else np.nan
        spread = covariance(gram, parameters.size, weight.size, 0.0 if self.independent else claimed)
        if self.independent:
            spread = spread + _of_smooth_errors(gram, parameters.size, self.share * claimed)
        elif self.noise_length and claimed > 0:
            spread = at_least(spread, self._predicted(form, points, weight, parameters, used))
        return Fit(parameters, spread, kept, birge)

    def _predicted(
        self, form: Form, points: Doubles, weight: Doubles, parameters: Doubles, kept: Mask
    ) -> Doubles:
        """Return the covariance of parameters that the correlated errors of heights cause."""
        rows = form.jacobian(points, parameters)
        influence = (
            np.linalg.pinv((rows * weight) @ rows.T, hermitian=True) @ (rows * weight) * rows[form.lift]
        )
        places = np.zeros_like(self.where)
        places[self.where] = kept
        maps = np.zeros((parameters.size, *self.where.shape))
        maps[:, places] = influence
        sigma = np.zeros(self.where.shape)
        sigma[self.where] = self.sigma
        assert self.noise_length is not None
        return covariance_of(maps, sigma, places, self.pixel_size, self.noise_length)


def at_least(spread: Doubles, predicted: Doubles) -> Doubles:
    """Return a covariance whose variances are at least those of another one."""
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.sqrt(np.fmax(1.0, np.diag(predicted) / np.diag(spread)))
    factor = np.where(np.isfinite(factor), factor, 1.0)
    return np.asarray(spread * np.multiply.outer(factor, factor))


def find_uncertain(sigma: Doubles, measured: Mask) -> Mask:
    """Return the measured pixels, (H, W), with more than five times the median sigma, if at most 15 % are.

    Their errors would determine the highest and the lowest point. If there are more, none is excluded.
    """
    uncertain = measured & (sigma > _UNCERTAIN * np.median(sigma[measured]))
    return np.asarray(uncertain & (np.count_nonzero(uncertain) <= FEW * np.count_nonzero(measured)))


def _fit_robustly(
    form: Form, points: Doubles, weight: Doubles, parameters: Doubles, rounding: float
) -> Doubles | None:
    """Fit with Huber weights (Huber 1964), so that outliers on one side have a limited effect."""
    confidence = np.ones_like(weight)
    for _ in range(_PASSES):
        minimum = _minimise(form, points, weight * confidence, parameters, rounding)
        if minimum is None:
            return None
        parameters = minimum
        misfit = form.distance(points, parameters) * np.sqrt(weight)
        confidence = least_squares.huber(1.0).weights(misfit / (mad_sigma(misfit) + rounding))
    return parameters


def _fit_without_outliers(
    form: Form, points: Doubles, weight: Doubles, parameters: Doubles, rounding: float
) -> tuple[Doubles, Mask] | None:
    """Fit without outliers until these no longer change; return the parameters and the points used."""
    kept = np.zeros(weight.size, bool)
    for _ in range(_PASSES):
        near = _near(form, points, weight, parameters, rounding)
        if np.array_equal(kept, near):
            break
        kept = near
        part = (points, weight) if kept.all() else (points[:, kept], weight[kept])
        minimum = _minimise(form, *part, parameters, rounding)
        if minimum is None:
            return None
        parameters = minimum
    return parameters, kept


def _near(form: Form, points: Doubles, weight: Doubles, parameters: Doubles, rounding: float) -> Mask:
    """Return which points, (n,), are no outliers; all if too many would be."""
    misfit = form.distance(points, parameters) * np.sqrt(weight)
    near = np.abs(misfit) <= FAR * max(mad_sigma(misfit), rounding)
    if np.count_nonzero(~near) > FEW * near.size:
        near[:] = True
    return near


def _weights(sigma: Doubles) -> Doubles:
    """Return inverse variances, (n,), relative to the median and capped there; 1 without variances."""
    typical = float(np.median(sigma))
    if not typical > 0:
        return np.ones_like(sigma)
    return np.asarray(np.maximum(sigma / typical, 1.0) ** -2)


class _Sums:
    """The weighted sum of squares of a form's distances: a model of `least_squares.descend`."""

    def __init__(self, form: Form, points: Doubles, weight: Doubles, parameters: Doubles) -> None:
        self.parameters: Doubles = parameters
        self.gram: Doubles = _gram(form, points, weight, parameters)
        self.cost: float = float(self.gram[-1, -1])

    def equations(self) -> tuple[Doubles, Doubles]:
        return self.gram[:-1, :-1], -self.gram[:-1, -1]


def _minimise(
    form: Form, points: Doubles, weight: Doubles, parameters: Doubles, rounding: float
) -> Doubles | None:
    """Minimise the sum of squares; None if the points do not determine the parameters."""
    solution = least_squares.descend(
        functools.partial(_Sums, form, points, weight),
        parameters,
        damping=least_squares.Damping(first=_DAMPING),
        tolerance=_CONVERGED,
        rounding=rounding**2 * weight.size,
    )
    lengths = np.sqrt(np.diag(solution.gram)[:-1])
    if not np.all(lengths > 0):
        return None
    normal = solution.gram[:-1, :-1] / np.multiply.outer(lengths, lengths)
    return solution.parameters if np.linalg.eigvalsh(normal)[0] >= _SINGULAR else None


def _gram(
    form: Form, points: Doubles, weight: Doubles, parameters: Doubles, frame: _Frame | None = None
) -> Doubles:
    """Return the weighted sums of products for steps; with a frame of smooth shapes, for `covariance`."""
    total: Doubles | float = 0.0
    for start in range(0, weight.size, _CHUNK):
        part = points[:, start : start + _CHUNK]
        shapes = [] if frame is None else _shapes(part, frame, form.degree)
        rows = np.stack([*form.jacobian(part, parameters), *shapes, form.distance(part, parameters)])
        rows *= np.sqrt(weight[start : start + _CHUNK])
        total = total + rows @ rows.T
    return np.asarray(total)


def _frame(points: Doubles) -> _Frame:
    """Return the middle of the points along x and y, and half their extent."""
    low, high = points[:2].min(axis=1), points[:2].max(axis=1)
    return (low + high) / 2, np.maximum((high - low) / 2, _NOTHING)


def _shapes(points: Doubles, frame: _Frame, degree: int) -> list[Doubles]:
    """Return the monomials of x and y, (n,) each, of the next two degrees, scaled to -1 to 1."""
    (x_middle, y_middle), (x_reach, y_reach) = frame
    x, y = (points[0] - x_middle) / x_reach, (points[1] - y_middle) / y_reach
    return [term for power in (degree + 1, degree + 2) for term in monomials(x, y, power)]


def monomials(x: Doubles, y: Doubles, degree: int) -> list[Doubles]:
    """Return the products of x and y of a degree, from the highest power of x to that of y."""
    return [np.asarray(x ** (degree - power) * y**power) for power in range(degree + 1)]


def covariance(gram: Doubles, parameters: int, count: int, claimed: float = 0.0) -> Doubles:
    """Estimate the covariance, (k, k), of k least-squares parameters; NaN if there are too few residuals.

    ``gram``, (k + m + 1, k + m + 1), contains the weighted sums over ``count`` residuals of all products of:
    the derivatives of a residual with respect to the parameters, m similarly smooth functions of its
    position, and the residual. Weights are any multiple of the inverse variances. ``claimed`` is the weighted
    sum of squares predicted by the standard deviations, 0 without these.
    """
    scale = np.sqrt(np.diag(gram))
    lengths = np.where(scale > 0, scale, np.inf)
    gram = gram / np.multiply.outer(lengths, lengths)
    inverse = _inverse(gram[:parameters, :parameters])
    across = gram[:parameters, parameters:]
    rest = gram[parameters:, parameters:] - across.T @ inverse @ across  # shapes and residuals
    variance = scale[-1] ** 2 * _variance(rest, count - parameters)
    # Divided by fewer than all parameters, because very smooth errors are not shared equally among them.
    absorbed = max((1 - _OVERSTATED) * claimed - scale[-1] ** 2, 0.0) / max(parameters - 1, 1)
    lengths = lengths[:parameters]
    return np.asarray((variance + absorbed) * inverse / np.multiply.outer(lengths, lengths))


def _of_smooth_errors(gram: Doubles, parameters: int, smooth: float) -> Doubles:
    """Return the covariance, (k, k), because of smooth errors with a weighted sum of squares."""
    lengths = np.sqrt(np.diag(gram)[:parameters])
    normal = gram[:parameters, :parameters] / np.multiply.outer(lengths, lengths)
    return np.asarray(smooth / parameters * _inverse(normal) / np.multiply.outer(lengths, lengths))


def _inverse(normal: Doubles) -> Doubles:
    """Return the pseudoinverse of normal equations with columns of length 1."""
    lengths, directions = np.linalg.eigh(normal)
    real = directions[:, lengths > _SINGULAR] / np.sqrt(lengths[lengths > _SINGULAR])
    return np.asarray(real @ real.T)


def _variance(rest: Doubles, freedom: int) -> float:
    """Return the variance of the amplitudes of smooth shapes, or of a pixel's error if that is larger."""
    lengths, directions = np.linalg.eigh(rest[:-1, :-1])
    real = lengths > _OWN_SHAPE
    white = max(float(rest[-1, -1]), 0.0)
    free = min(int(np.count_nonzero(real)), freedom)
    if free < 3:
        return np.nan if freedom < 1 else white / freedom
    power = (directions[:, real].T @ rest[:-1, -1]) ** 2 / lengths[real]
    # The variance of Student's t, because the mean square of few amplitudes is uncertain.
    smooth = float(np.sum(power)) / (free - 2)
    return max(smooth, white / freedom)
