"""Robust least squares: the one iteration, the losses and the scale that all fits share.

A fit has three parts that are independent of each other.

1. *A cost*. ``fit`` minimises, over the parameters p, the sum of a loss of the residuals r(p), in standard
   deviations, and of a prior::

       sum L(r / noise) + |rows p - values|^2

   A ``Loss`` is quadratic near 0; its weight L'(r) / 2 r limits the influence of outliers. Residuals are a
   function of p; their derivatives are another one, or forward differences.
2. *An iteration*. ``descend`` takes Levenberg-Marquardt steps: Gauss-Newton steps of the weighted residuals
   (iteratively reweighted least squares), damped while they do not decrease the cost. It ends when the
   relative decrease is below a tolerance. It needs of a model only its cost and its normal equations at some
   parameters (``Model``), so that a caller with sums from blocks of many samples, or with a penalty that
   changes, supplies these; ``fit`` supplies them from arrays.
3. *A scale*. ``mad_sigma`` is the standard deviation of most residuals. With ``rescale``,
   ``fit`` estimates the noise from the residuals, and fits again.

The covariance of a fit is the inverse of its normal matrix. It assumes independent residuals with the given
standard deviations; for others, the caller passes a factor (`Fit.covariance`).

Fits whose steps are of another kind have their own loops, with the losses and the scale of this module: many
small fits at once (`engine.calibration.marks`), rotations from sums on a device (`engine.pose.fit`), sparse
systems (`engine.slip.onset_map`), and fits that are linear but for their weights.

The module is in ``kernels`` because ``engine`` and ``hw`` fit, and may not import each other. SciPy's
``least_squares`` has neither a prior nor residuals whose number changes, it keeps parameters away from
bounds that are active in most of our fits, and importing it takes longer than most of them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.kernels.array_types import Doubles

_MEDIAN = 0.6744897501960817  # median magnitude of a standard normal variate
_OF_SECOND_DIFFERENCES = 6.0  # standard deviation of second differences along both axes, of noise of 1
_SAMPLES = 4096  # values that show where a median is
_COST_TOLERANCE = 1e-8  # relative decrease of the cost that ends the iteration
_MAX_STEPS = 100  # maximum number of steps
_RIDGE = 1e-12  # relative to the curvature: keeps the damped matrix regular
_SINGULAR = 1e-13  # relative to the largest eigenvalue of scaled equations: directions without information
_DIFFERENCE = 1e-8  # step of forward differences; relative for parameters above 1
_MAX_FITS = 8  # maximum number of fits with noise estimated from the preceding fit
_NOISE_TOLERANCE = 0.01  # relative change of this noise that ends the repetition


def median(values: NDArray[Any]) -> Any:
    """Return the median of finite values as `numpy.median` does, which takes ten times as long for many.

    Samples show between which values it probably is, so that only these are sorted.
    """
    flat = values.ravel()
    some, middle = np.sort(flat[:: max(1, flat.size // _SAMPLES)]), (flat.size - 1) // 2
    low, high = some[int(0.45 * some.size)], some[int(0.55 * some.size)]
    inside, below = flat[(flat >= low) & (flat <= high)], int(np.count_nonzero(flat < low))
    if not below <= middle < below + inside.size - 1:
        return np.median(flat)
    first, second = np.partition(inside, (middle - below, middle - below + 1))[middle - below :][:2]
    return first if flat.size % 2 else (first + second) / 2


def mad_sigma(residuals: Doubles) -> float:
    """Return the standard deviation of residuals about 0, from their median magnitude; 0 without any."""
    return float(median(np.abs(residuals))) / _MEDIAN if residuals.size else 0.0


def second_differences(values: Doubles) -> Doubles:
    """Return second differences along both axes, (H - 2, W - 2), as large as independent errors of values."""
    return np.diff(np.diff(values, 2, axis=0), 2, axis=1) / _OF_SECOND_DIFFERENCES


# --- losses -------------------------------------------------------------------------------------------------


class Loss(NamedTuple):
    """A loss of residuals in standard deviations: c^2 rho((r / c)^2) with a limit c."""

    limit: float
    rho: Callable[[Doubles], Doubles]
    slope: Callable[[Doubles], Doubles]  # derivative of rho
    curvature: Callable[[Doubles], Doubles] | None = None  # half of the loss's, if smooth and convex

    def cost(self, residuals: Doubles) -> float:
        """Return the sum of the losses."""
        return float(np.sum(self.rho((residuals / self.limit) ** 2))) * self.limit**2

    def weights(self, residuals: Doubles) -> Doubles:
        """Return the weights of residuals in least squares with the same gradient."""
        return np.asarray(self.slope((residuals / self.limit) ** 2))

    def information(self, residuals: Doubles) -> Doubles:
        """Return the weights of residuals in the normal matrix."""
        return np.asarray((self.curvature or self.slope)((residuals / self.limit) ** 2))


SQUARES = Loss(1.0, lambda z: z, np.ones_like)
"""The loss of ordinary least squares."""


def soft_l1(limit: float) -> Loss:
    """Return a smooth loss that is linear beyond a limit, in standard deviations."""
    return Loss(limit, lambda z: 2 * np.sqrt(1 + z) - 2, lambda z: (1 + z) ** -0.5, lambda z: (1 + z) ** -1.5)


def huber(limit: float) -> Loss:
    """Return the loss of Huber (1964), quadratic up to a limit and linear beyond."""
    return Loss(limit, lambda z: np.where(z > 1, 2 * np.sqrt(z) - 1, z), lambda z: np.maximum(z, 1) ** -0.5)


def cauchy(limit: float) -> Loss:
    """Return the loss of Cauchy, from the density of Student's t with one degree of freedom."""
    return Loss(limit, np.log1p, lambda z: 1 / (1 + z))


def geman_mcclure(limit: float) -> Loss:
    """Return a bounded loss, under which far outliers have no influence."""
    return Loss(limit, lambda z: z / (1 + z), lambda z: (1 + z) ** -2)


# --- the iteration ------------------------------------------------------------------------------------------


class Model(Protocol):
    """A sum of losses at some parameters, (k,)."""

    @property
    def parameters(self) -> Doubles:
        """The parameters."""

    @property
    def cost(self) -> float:
        """The sum that is minimised."""

    def equations(self) -> tuple[Doubles, Doubles]:
        """Return matrix, (k, k), and right side, (k,), of the normal equations of a Gauss-Newton step."""


AnyModel = TypeVar("AnyModel", bound=Model)
Bounds = tuple[Doubles, Doubles]


class Damping(NamedTuple):
    """Damping of steps: a matrix times a factor is added to the normal matrix."""

    first: float = 1e-4  # factor of the first step
    relaxed: float = 30.0  # divisor of the factor after each step that decreases the cost
    stuck: float = 1e8  # factor at which the search for a better step ends
    matrix: Doubles | None = None  # by default the diagonal of the normal matrix


def descend(
    at: Callable[[Doubles], AnyModel],
    start: Doubles,
    *,
    bounds: Bounds | None = None,
    shorten: Callable[[Doubles], Doubles] | None = None,
    damping: Damping = Damping(),  # noqa: B008
    tolerance: float = _COST_TOLERANCE,
    rounding: float = 0.0,
    steps: int = _MAX_STEPS,
    solve: Callable[..., Any] = np.linalg.solve,
) -> AnyModel:
    """Return the model at the minimum of its cost.

    Parameters
    ----------
    at : function
        Returns the model at some parameters.
    start : ndarray, (k,)
    bounds : (ndarray, ndarray), optional
        Lower and upper limits of the parameters.
    shorten : function, optional
        Limits a step, (k,).
    damping : Damping
    tolerance, rounding : float
        Relative and absolute decrease of the cost below which the iteration ends.
    steps : int
        Largest number of successful steps.
    solve : function
        Solves the equations of a step without bounds.
    """
    best, factor = at(start), damping.first
    for _ in range(steps):
        matrix, right = best.equations()
        added = np.diag(np.diag(matrix)) if damping.matrix is None else damping.matrix
        while True:
            step = _step(matrix + factor * added, right, solve, best.parameters, bounds)
            candidate = best.parameters + (step if shorten is None else shorten(step))
            trial = at(candidate if bounds is None else np.clip(candidate, *bounds))
            if trial.cost <= best.cost + rounding or factor > damping.stuck:
                break
            factor *= 10
        gain, factor = best.cost - trial.cost, factor / damping.relaxed
        if gain >= 0:
            best = trial
        if not gain > tolerance * best.cost + rounding:
            break
    return best


def _step(
    matrix: Doubles,
    right: Doubles,
    solve: Callable[..., Any],
    parameters: Doubles,
    bounds: Bounds | None,
) -> Doubles:
    """Return the step within the bounds; parameters are scaled to a curvature of 1."""
    scale = _scale(matrix)
    scaled = matrix * np.outer(scale, scale) + _RIDGE * np.eye(len(matrix))
    step: Doubles = solve(scaled, right * scale)
    if bounds is not None:
        low, high = ((bound - parameters) / scale for bound in bounds)
        if np.any((step < low) | (step > high)):
            from scipy.optimize import lsq_linear

            root = np.linalg.cholesky(scaled)
            limits = np.minimum(low, -_RIDGE), np.maximum(high, _RIDGE)
            step = lsq_linear(root.T, np.linalg.solve(root, right * scale), limits, method="bvls").x
    return np.asarray(step * scale)


def inverse(matrix: Doubles) -> Doubles:
    """Return the pseudoinverse of a normal matrix, whose parameters may have any units."""
    scale = np.outer(_scale(matrix), _scale(matrix))
    return np.asarray(np.linalg.pinv(matrix * scale, _SINGULAR, hermitian=True) * scale)


def _scale(matrix: Doubles) -> Doubles:
    """Return the units of parameters in which the diagonal is 1, or 0."""
    diagonal = np.diag(matrix)
    return np.asarray(1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))


# --- linear fits without outliers ---------------------------------------------------------------------------

MEDIAN_SQUARE = 0.455
"""Median of the square of a standard normal variate."""
CLEAR_Z_SCORE = 6.0
"""Standard errors from which on an effect that a clipped fit determines is reported."""
OUTLYING = 4.0
"""Standard deviations beyond which a value is left out of a linear fit."""

_CLIPS, _LEAST_SPREAD = 4, 1e-12  # rounds, and least standard deviation of residuals


class ClippedFit(NamedTuple):
    """A linear fit without outliers."""

    parameters: Doubles  # (k,)
    inverse: Doubles  # (k, k): the inverse of the normal matrix
    residuals: Doubles  # (n,): of all values, in units of their noise
    kept: NDArray[np.bool_]  # (n,): values that are no outliers


def gram(columns: Doubles) -> Doubles:
    """Return the products of columns, (k, k); unlike a product of matrices, it starts no threads."""
    return np.asarray(np.einsum("ni,nj->ij", columns, columns))


def fit_clipped(
    columns: Doubles, values: Doubles, noise: Doubles | None = None, *, condition: float = 1e12
) -> ClippedFit | None:
    """Fit values, (n,), by columns, (n, k), and leave out those that are `OUTLYING` and more away.

    ``noise`` are the standard deviations of the values, (n,). Returns None if the columns are alike: if the
    condition of the normal matrix is above a limit.

    Examples
    --------
    >>> columns = np.stack([np.ones(9), np.arange(9.0)], axis=1)
    >>> values = 2 + 3 * np.arange(9.0)
    >>> values[4] = 99
    >>> fit_clipped(columns, values).parameters.round(6).tolist()
    [2.0, 3.0]
    """
    if noise is not None:
        columns, values = columns / noise[:, np.newaxis], values / noise
    kept = np.full(len(values), True)
    for _ in range(_CLIPS):
        used = columns.compress(kept, axis=0)
        matrix = gram(used)
        if np.linalg.cond(matrix) > condition:
            return None
        inverted: Doubles = np.asarray(np.linalg.inv(matrix), np.float64)
        parameters: Doubles = inverted @ np.einsum("ni,n->i", used, values.compress(kept))
        residuals: Doubles = np.asarray(values - np.einsum("ni,i->n", columns, parameters))
        before, kept = kept, np.abs(residuals) <= OUTLYING * max(mad_sigma(residuals), _LEAST_SPREAD)
        if np.array_equal(before, kept):
            break
    return ClippedFit(parameters, inverted, residuals, kept)


# --- fits of arrays -----------------------------------------------------------------------------------------


class Prior(NamedTuple):
    """Prior information: linear combinations of the parameters, divided by their standard deviations."""

    rows: Doubles  # (m, k)
    values: Doubles  # (m,): their means

    def off(self, parameters: Doubles) -> Doubles:
        """Return the deviations of parameters, (m,), in standard deviations."""
        return np.asarray(self.rows @ parameters - self.values)


class Fit:
    """Residuals at some parameters.

    Attributes
    ----------
    parameters : ndarray, (k,)
    residuals : ndarray, (n,)
        In the unit of the samples.
    noise : float or ndarray, (n,)
        Standard deviations of the residuals.
    cost : float
    """

    def __init__(
        self,
        function: Callable[[Doubles], Doubles],
        slopes: Callable[[Doubles, Doubles], Doubles],
        loss: Loss,
        noise: float | Doubles,
        prior: Prior | None,
        parameters: Doubles,
    ) -> None:
        self._slopes, self._loss, self._prior = slopes, loss, prior
        self.parameters: Doubles = parameters
        self.residuals: Doubles = function(parameters)
        self.noise: float | Doubles = noise
        self.cost: float = loss.cost(self.residuals / noise)
        if prior is not None:
            self.cost += float(np.sum(prior.off(parameters) ** 2))

    @functools.cached_property
    def jacobian(self) -> Doubles:
        """Derivatives of the residuals in standard deviations, (n, k)."""
        slopes = self._slopes(self.parameters, self.residuals)
        return np.asarray(slopes / np.reshape(self.noise, (-1, 1)))

    @property
    def information(self) -> Doubles:
        """Weights of the residuals in the normal matrix, (n,)."""
        return self._loss.information(self.residuals / self.noise)

    def equations(self) -> tuple[Doubles, Doubles]:
        """Return matrix, (k, k), and right side, (k,), of the normal equations of a step."""
        residuals = self.residuals / self.noise
        right = -np.einsum("nk,n->k", self.jacobian, self._loss.weights(residuals) * residuals)
        if self._prior is not None:
            right -= self._prior.rows.T @ self._prior.off(self.parameters)
        return self._matrix(), right

    def covariance(self, excess: float = 1.0) -> Doubles:
        """Return the covariance of the parameters, (k, k).

        ``excess`` is the ratio of the actual to the assumed variance of the residuals, or, if residuals are
        correlated, of their means.
        """
        return inverse(self._matrix(excess))

    def _matrix(self, excess: float = 1.0) -> Doubles:
        # Without BLAS: its threads wait for each other while other programs use the cores.
        weighted = self.jacobian * (self.information / excess)[:, np.newaxis]
        matrix: Doubles = np.einsum("nk,nl->kl", weighted, self.jacobian)
        return matrix if self._prior is None else matrix + self._prior.rows.T @ self._prior.rows


def fit(
    residuals: Callable[[Doubles], Doubles],
    start: ArrayLike,
    *,
    jacobian: Callable[[Doubles], Doubles] | None = None,
    noise: float | Doubles = 1.0,
    rescale: Callable[[Doubles], float | Doubles] | None = None,
    rounds: int = _MAX_FITS,
    loss: Loss = SQUARES,
    prior: Prior | None = None,
    bounds: Bounds | None = None,
    tolerance: float = _COST_TOLERANCE,
) -> Fit:
    """Fit parameters to residuals; see the module.

    Parameters
    ----------
    residuals : function
        Returns the residuals, (n,), for parameters, (k,). It must not change while the fit is used, because
        derivatives are computed when they are needed.
    start : array_like, (k,)
    jacobian : function, optional
        Returns the residuals' derivatives, (n, k); by default forward differences.
    noise : float or ndarray, (n,)
        Standard deviations of the residuals.
    rescale : function, optional
        Estimates the noise from the residuals of a fit, such as `mad_sigma`; the fit is then repeated, until
        the noise changes by less than 1 %, and at most ``rounds`` fits are done.
    loss : Loss
    prior : Prior, optional
    bounds, tolerance
        See `descend`.

    Examples
    --------
    >>> x = np.arange(6.0)
    >>> y = 2 * x + [0, 0, 0, 9, 0, 0]  # one outlier
    >>> fit(lambda p: p[0] * x - y, [1.0], loss=cauchy(3.0), noise=0.1).parameters.round(3)
    array([2.001])
    """
    parameters = np.asarray(start, np.float64)

    def slopes(at: Doubles, here: Doubles) -> Doubles:
        if jacobian is not None:
            return jacobian(at)
        h = _DIFFERENCE * np.maximum(1.0, np.abs(at))
        if bounds is not None:
            h = np.where(at + h > bounds[1], -h, h)
        return np.stack([(residuals(at + step) - here) / step.sum() for step in np.diag(h)], axis=1)

    for _ in range(rounds):
        at = functools.partial(Fit, residuals, slopes, loss, noise, prior)
        fitted = descend(at, parameters, bounds=bounds, tolerance=tolerance)
        parameters, before = fitted.parameters, noise
        if rescale is None or np.allclose(noise := rescale(fitted.residuals), before, rtol=_NOISE_TOLERANCE):
            break
    return fitted
