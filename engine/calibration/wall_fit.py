"""Where the lit wall stands and what is printed on it, fitted to the light of balls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.optimize import lsq_linear, nnls

from mirrorskin.engine.calibration.ball import moved
from mirrorskin.engine.calibration.wall import BallPress
from mirrorskin.engine.calibration.wall_model import (
    CURVE_COEFFICIENTS,
    SENSOR,
    STEPS,
    Samples,
    curve_from_steps,
    curve_roughness,
    linearise,
    meet_balls,
    predict,
    split,
)
from mirrorskin.io import InputError

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
        See `mirrorskin.engine.calibration.wall_model.split`.
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
        rough = curve_roughness() @ curve_from_steps(rising) * np.sqrt(len(basis))
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
        self._rough = np.zeros((CURVE_COEFFICIENTS - 3, len(prior.mean)))
        if np.any(self._per_sigma[STEPS] < np.inf) and prior.sigma[STEPS].all():
            self._rough[:, STEPS] = curve_roughness() @ curve_from_steps(prior.rising) / _ROUGH
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


Mask = NDArray[np.bool_]
Numbers = NDArray[np.intp]

_FEW, _MANY = 4_000, 30_000  # samples of the first fits, and of the last
_SETTLES = {_FEW: 1e-4, _MANY: 3e-6}  # change of the sum of squares at which these end, as a share
_COARSE = 0.1  # of full light: noise that the first fit reckons with, so that it finds its way
_QUIET = 1e-3  # of full light, which the model may always be off
_INNER = 0.7  # of the light's outline, within which the ball is surely touched
_RING = 0.05  # of the outline: width of the rings by which that grows
_AT_ONCE = 2  # rings that are tried at a time
_SETTLED = 1.2  # times the usual spread that a ring may show
_ASIDE = 0.3  # times the usual spread that its median may be off
_CHANCE = 4.0  # over the root of the ring's samples, by which it may be more by chance
_BAD = 2.0  # times the other presses' noise that one may show
_STRAIN = 1.5  # standard deviations, root mean square, by which the sensor may be unlikely
_TOUCHED = 0.02  # mm above the rest plane
_MODEST = 0.01  # of full light: noise that such a fit reckons with
_LEAST = 30  # samples that a ring is judged by
_BINS = 6  # of brightness, in which noise is told


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """A fit, the samples of touched places that went into it, and their noise, (n,), as shares of light."""

    fit: WallFit
    samples: Samples
    noise: Doubles


def fit_touch(samples: Samples, presses: Sequence[BallPress], prior: Prior) -> Touch:
    """Fit the wall to samples where the sheet lies on the ball.

    From well within the light's outline on, each press grows by rings as long as these can be fitted as well
    as those within: a gel leaves the ball earlier than a sheet that takes any shape. Where a ring could not,
    the one before it is left out as well.

    Raises
    ------
    InputError
        A press does not fit to the others.
    """
    rings = _Rings(samples, presses)
    taken = np.full(len(presses), round(_INNER / _RING))
    fit = _begin(samples[_some(rings.within(taken), _FEW)], prior)
    prior = Prior(prior.mean, prior.sigma, fit.rising)
    noise = _noise(samples, fit, rings.within(taken))
    touch, off = _refit(samples, noise, rings.within(taken), prior, fit, _FEW)
    noise = _noise(samples, touch.fit, rings.within(taken))
    _check_presses(touch, np.where(rings.within(taken), off, np.nan), rings, presses, prior)
    grows = np.ones(len(presses), bool)
    while grows.any():
        touch, off = _refit(samples, noise, rings.within(taken + _AT_ONCE * grows), prior, touch.fit, _FEW)
        for press in np.flatnonzero(grows):
            own = (rings.press == press) & np.isfinite(off)
            taken[press], grows[press] = _grow(off[own], rings.number[own], int(taken[press]))
    touch, off = _refit(samples, noise, rings.within(taken), prior, touch.fit, _MANY)
    _check_presses(touch, np.where(rings.within(taken), off, np.nan), rings, presses, prior)
    return touch


class _Rings:
    """In which ring about where its ball was found each sample lies, and of which press it is."""

    def __init__(self, samples: Samples, presses: Sequence[BallPress]) -> None:
        middle = np.concatenate([moved(press.centre, press.lean, press.pivot) for press in presses])
        self.press: Numbers = samples.press[samples.pose]
        outline = np.array([press.outline for press in presses])[self.press]
        away = np.hypot(*(samples.place - middle[samples.pose, :2].T)) / outline
        self.number: Numbers = np.floor(away / _RING).astype(np.intp)

    def within(self, rings: Numbers) -> Mask:
        """Return which samples lie within so many rings of their press."""
        return np.asarray(self.number < rings[self.press])


def _begin(samples: Samples, prior: Prior) -> WallFit:
    """Return a first fit, from the nominal sensor and the curve that goes best with it."""
    start, rising = prior.mean, prior.rising
    if prior.sigma[STEPS].all():
        start, rising = start_curve(samples, start)
    return fit_wall(samples, Prior(prior.mean, prior.sigma, rising), start, _COARSE, 1e-4)


def _refit(
    samples: Samples, noise: Doubles, inside: Mask, prior: Prior, fit: WallFit, count: int
) -> tuple[Touch, Doubles]:
    """Fit once more, to at most so many of the touched samples that are chosen.

    Returns it, and by how many standard deviations all samples are off, NaN where the sheet does not touch.
    """
    named, _, centres = split(fit.parameters)
    touched = meet_balls(samples, named, centres).z >= _TOUCHED
    chosen = _some(inside & touched, count)
    fit = fit_wall(samples[chosen], prior, fit.parameters, noise[chosen], _SETTLES[count])
    off = (samples.light - predict(samples, fit.parameters, fit.rising)) / noise
    return Touch(fit, samples[chosen], noise[chosen]), np.where(touched, off, np.nan)


def _grow(off: Doubles, ring: Numbers, taken: int) -> tuple[int, bool]:
    """Return how many rings of a press can be fitted, and whether there may be more.

    ``off`` is by how many standard deviations its samples are off, and ``ring`` their ring.
    """
    usual = max(1.0, _scale(off[ring < taken]))
    if not np.isfinite(usual):
        return taken, False
    for number in range(taken, taken + _AT_ONCE):
        own = off[ring == number]
        if len(own) < _LEAST:
            return number, False
        chance = _CHANCE / np.sqrt(len(own))
        if _scale(own) / usual > _SETTLED + chance or abs(np.median(own)) / usual > _ASIDE + chance:
            return number - 1, False
    return taken + _AT_ONCE, True


def _noise(samples: Samples, fit: WallFit, inside: Mask) -> Doubles:
    """Return the noise of all samples, (N,), from what is left of some: its square is linear in the light.

    The medians of some bins of brightness tell it.
    """
    light = predict(samples, fit.parameters, fit.rising)
    left = samples.light - light
    order = np.flatnonzero(inside)[np.argsort(light[inside])]
    bins = np.array_split(order, _BINS)
    level = np.array([np.median(light[part]) for part in bins])
    square = np.array([_scale(left[part]) ** 2 for part in bins])
    slope, offset = np.polyfit(level, square, 1) if np.ptp(level) > 0 else (0.0, float(square.mean()))
    least = 0.25 * float(np.median(square)) + _QUIET**2
    return np.asarray(np.sqrt(np.maximum(offset + slope * light, least)))


def _scale(off: Doubles) -> float:
    """Return the root mean square of normal values, told by the median of their sizes; inf of none."""
    return 1.4826 * float(np.median(np.abs(off))) if len(off) else np.inf


def _some(mask: Mask, count: int) -> Numbers:
    """Return the numbers of at most so many of the chosen samples, evenly spread."""
    chosen = np.flatnonzero(mask)
    return chosen[np.linspace(0, len(chosen) - 1, min(count, len(chosen))).round().astype(np.intp)]


def _check_presses(
    touch: Touch, off: Doubles, rings: _Rings, presses: Sequence[BallPress], prior: Prior
) -> None:
    """Raise where a press does not fit to the others.

    Its samples are off by more than those of the others; or all of them are explained, but by a sensor that
    cannot be, and without it by a likely one.
    """
    known = np.isfinite(off)
    scales = np.array([_scale(off[known & (rings.press == number)]) for number in range(len(presses))])
    worst = int(np.argmax(scales))
    if scales[worst] > _BAD * max(1.0, float(np.median(scales))):
        raise InputError(_misfit(presses[worst].name))
    if _strain(touch.fit, prior) > _STRAIN:
        strains = [_strain(_without(touch, prior, number), prior) for number in range(len(presses))]
        least = int(np.argmin(strains))
        if strains[least] < _STRAIN:
            raise InputError(_misfit(presses[least].name))
        raise InputError(
            "the presses go together with no likely sensor: check the ball's diameter, pixel size, and the"
            " body's radius and height"
        )


def _without(touch: Touch, prior: Prior, press: int) -> WallFit:
    """Return the fit without a press."""
    samples = touch.samples
    others = _some(samples.press[samples.pose] != press, _FEW)
    start = prior.mean.copy()
    start[STEPS] = touch.fit.parameters[STEPS]
    return fit_wall(samples[others], prior, start, np.maximum(touch.noise[others], _MODEST), _SETTLES[_FEW])


def _strain(fit: WallFit, prior: Prior) -> float:
    """Return by how many standard deviations a sensor is off what was known before, root mean square."""
    off = (fit.parameters - prior.mean) / np.where(prior.sigma > 0, prior.sigma, np.inf)
    return float(np.sqrt(np.mean(off[: STEPS.start] ** 2)))


def _misfit(name: str) -> str:
    return f"{name}: its ball does not fit to the other presses: leave it out or take it again"
