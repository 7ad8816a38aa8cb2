"""Where the lit wall stands and what is printed on it, fitted to the light of balls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.optimize import lsq_linear, nnls

from mirrorskin.engine.calibration.wall import curve
from mirrorskin.engine.calibration.wall.model import SENSOR, STEPS, Samples, linearise, predict

Doubles = NDArray[np.float64]

_OUTLIER = 3.0  # times the noise beyond which a sample counts less
_ROUGH = 0.05  # of full light: third differences of the curve's coefficients that are likely
_SCATTER = (1e-3, 0.3)  # radians between which it is looked for
_CHUNK = 8192  # samples whose slopes are held at a time
_ROUNDS = 60
_DAMPING = 1e-4  # of the first step, as a share of the curvature
_EASED = 30.0  # by which damping falls after a step that helped
_STUCK = 1e8  # damping at which no step helps


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known of the parameters before the fit.

    Attributes
    ----------
    mean, sigma : ndarray, (P,), float64
        Standard deviations may be infinite; a parameter whose is 0 stays as it is.
    rising : bool
        Whether the curve rises from the rim to the rest plane.
    """

    mean: Doubles
    sigma: Doubles
    rising: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class WallFit:
    """What was found.

    Attributes
    ----------
    parameters : ndarray, (P,), float64
        See `mirrorskin.engine.calibration.wall.model.split`.
    covariance : ndarray, (P, P), float64
        0 for what was not fitted.
    residuals : ndarray, (N,), float64
        Light of the samples less what the fit says.
    rising : bool
        As of the prior.
    """

    parameters: Doubles
    covariance: Doubles
    residuals: Doubles
    rising: bool


def fit_wall(
    samples: Samples, prior: Prior, start: Doubles, noise: float | Doubles, tolerance: float = 1e-7
) -> WallFit:
    """Find the most likely parameters, by damped Gauss-Newton steps (Levenberg and Marquardt).

    A sample that misses by r counts as ``c^2 log(1 + (r / c)^2)`` with c three times its noise: as a square
    at first, and hardly more the farther off it is, so that dust and glare do little (Cauchy's estimator).

    Parameters
    ----------
    samples : Samples
        N of them.
    prior : Prior
    start : ndarray, (P,), float64
        Where to begin.
    noise : float or ndarray, (N,)
        Standard deviation of each sample's light.
    tolerance : float
        Change of the sum, as a share, at which it ends.

    Returns
    -------
    WallFit
    """
    problem = _Problem(samples, prior, np.broadcast_to(noise, samples.light.shape))
    parameters, sum_, damping = start.copy(), problem.sum(start), _DAMPING
    for _ in range(_ROUNDS):
        curvature, pull = problem.normal_equations(parameters)
        while True:
            tried = parameters + problem.step(parameters, curvature, pull, damping)
            after = problem.sum(tried)
            if after <= sum_ or damping > _STUCK:
                break
            damping *= 10
        gained, sum_ = sum_ - after, min(after, sum_)
        parameters, damping = (tried if gained >= 0 else parameters), damping / _EASED
        if gained <= tolerance * sum_:
            break
    residuals = samples.light - predict(samples, parameters, prior.rising)
    return WallFit(parameters, problem.covariance(parameters, residuals), residuals, prior.rising)


def start_curve(samples: Samples, start: Doubles) -> tuple[Doubles, bool]:
    """Return parameters with the curve that fits best to what the others say, and whether it rises."""
    fits = []
    for rising in (True, False):
        basis = linearise(samples, start, rising)[1][:, STEPS]
        rough = curve.roughness() @ curve.from_steps(rising) * np.sqrt(len(basis))
        known = np.concatenate([samples.light, np.zeros(len(rough))])
        steps, left = nnls(np.concatenate([basis, rough]), known)
        fits.append((left, rising, steps))
    _, rising, steps = min(fits, key=lambda fit: fit[0])
    parameters = start.copy()
    parameters[STEPS] = steps
    return parameters, rising


class _Problem:
    """The sum of squares that is made least, and its normal equations."""

    def __init__(self, samples: Samples, prior: Prior, noise: Doubles) -> None:
        self._samples, self._prior, self._noise = samples, prior, noise
        self._free = np.flatnonzero(prior.sigma > 0)
        self._per_sigma = 1 / np.where(prior.sigma > 0, prior.sigma, np.inf)
        self._rough = np.zeros((curve.COEFFICIENTS - 3, len(prior.mean)))
        if np.any(self._per_sigma[STEPS] < np.inf) and prior.sigma[STEPS].all():
            self._rough[:, STEPS] = curve.roughness() @ curve.from_steps(prior.rising) / _ROUGH
        self._low, self._high = np.full((2, len(prior.mean)), -np.inf)
        self._high[:] = np.inf
        self._low[STEPS] = 0
        scatter = SENSOR.index("scatter")
        self._low[scatter], self._high[scatter] = _SCATTER

    def sum(self, parameters: Doubles) -> float:
        """Return what is made least."""
        left = (self._samples.light - predict(self._samples, parameters, self._prior.rising)) / self._noise
        soft = _OUTLIER**2 * np.log1p((left / _OUTLIER) ** 2)
        return float(np.sum(soft) + np.sum(self._before(parameters) ** 2))

    def normal_equations(self, parameters: Doubles) -> tuple[Doubles, Doubles]:
        """Return curvature, (P, P), and pull, (P,): the undamped step is curvature^-1 pull."""
        curvature = np.diag(self._per_sigma**2) + self._rough.T @ self._rough
        pull = self._per_sigma**2 * (self._prior.mean - parameters)
        pull -= self._rough.T @ (self._rough @ parameters)
        for first in range(0, len(self._samples.light), _CHUNK):
            part = slice(first, first + _CHUNK)
            light, slopes = linearise(self._samples[part], parameters, self._prior.rising)
            left = (self._samples.light[part] - light) / self._noise[part]
            slopes /= self._noise[part, np.newaxis]
            weighted = slopes * _weight(left)[:, np.newaxis]
            # Not by BLAS, whose threads wait for each other where other programs run as well.
            curvature += np.einsum("na,nb->ab", weighted, slopes)
            pull += np.einsum("na,n->a", weighted, left)
        return curvature, pull

    def step(self, parameters: Doubles, curvature: Doubles, pull: Doubles, damping: float) -> Doubles:
        """Return the damped step, as far as the bounds let it go."""
        free = self._free
        scale = 1 / np.sqrt(np.diag(curvature)[free])
        scaled = curvature[np.ix_(free, free)] * np.outer(scale, scale) + damping * np.eye(len(free))
        root = cholesky(scaled + 1e-12 * np.eye(len(free)))
        target = np.linalg.solve(root.T, pull[free] * scale)
        room = [(bound[free] - parameters[free]) / scale for bound in (self._low, self._high)]
        room = [np.minimum(room[0], -1e-12), np.maximum(room[1], 1e-12)]
        found = lsq_linear(root, target, room, method="bvls")
        step = np.zeros_like(parameters)
        step[free] = np.clip(found.x, *room) * scale
        return step

    def covariance(self, parameters: Doubles, residuals: Doubles) -> Doubles:
        """Return the parameters' covariance, by how large the residuals really are.

        Huber's proposal: the variance of the weighted residuals by the square of their mean slope.
        """
        left = residuals / self._noise
        weight = _weight(left)
        slope = weight**2 * (1 - (left / _OUTLIER) ** 2)
        ratio = float(np.mean((weight * left) ** 2) / np.mean(slope) ** 2 * np.mean(weight))
        before = np.diag(self._per_sigma**2) + self._rough.T @ self._rough
        curvature = (self.normal_equations(parameters)[0] - before) / ratio + before
        covariance = np.zeros_like(curvature)
        inner = np.ix_(self._free, self._free)
        scale = np.sqrt(np.diag(curvature)[self._free])
        scaled = curvature[inner] / np.outer(scale, scale)
        covariance[inner] = np.linalg.pinv(scaled, 1e-13, hermitian=True) / np.outer(scale, scale)
        return covariance

    def _before(self, parameters: Doubles) -> Doubles:
        """Return by how many standard deviations parameters are off what was known, and the curve rough."""
        return np.concatenate([(parameters - self._prior.mean) * self._per_sigma, self._rough @ parameters])


def _weight(left: Doubles) -> Doubles:
    """Return how much samples count by how far they are off, in standard deviations."""
    return np.asarray(1 / (1 + (left / _OUTLIER) ** 2))
