"""The lit wall's place and print, fitted to the light of balls; and the samples of that light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.ball import find_ball, moved, pixel_size_of, read_turn
from mirrorskin.engine.calibration.wall_model import (
    CURVE_COEFFICIENTS,
    SENSOR,
    STEPS,
    LightSamples,
    curve_from_steps,
    curve_roughness,
    linearise,
    predict,
)
from mirrorskin.io import InputError, Precession, References, Source, pixel_axes

Doubles = NDArray[np.float64]

_STEEPEST = math.radians(50.0)  # zenith on the ball up to which samples are taken
_BEYOND = 1.35  # times the outline of the light up to which they are, too
_PLACE = 1.0  # mm by which the picture alone may misplace a ball
_DEPTH = 0.2  # mm by which the recorded press may be off from how deep the ball is pressed
_LEAST = 20  # samples of a frame
_FRAMES = 16  # of a recording that are held at most
_CLIPPED = 64  # samples at one value of the form 2^n - 1 from which on it is the camera's end
_FAR = 30.0  # mm of an unknown pivot
_NEAR = 3.0  # mm by which a recorded pivot may be off
_OFFSET = math.radians(2.0)  # by which a calibrated phase may be off
_ANY = math.radians(45.0)  # by which a recorded one may be off
_DOUBT = 0.02  # of these, by which calibrated ones may be off at least


@dataclass(frozen=True, slots=True, eq=False)
class BallPress:
    """Samples of M pixels of an axial recording of a ball, and what is known of it; lengths in mm."""

    name: str  # of its source
    light: Doubles  # (M,)
    place: Doubles  # (2, M): of each sample's pixel on the rest plane
    frame: NDArray[np.intp]  # (M,)
    lean: Doubles  # (T, 2): radians, of each frame
    centre: Doubles  # (3,): of the ball in the mean pose, as deep as the recording says if that can be
    centre_sigma: Doubles  # (3,): by how much that may be off
    outline: float  # radius of the circle in which light is seen
    pivot: tuple[float, float, float]  # what is known of it


@dataclass(frozen=True, slots=True)
class Pivot:
    """What the body turns about, mm, and the standard errors of that and of the phases' zero."""

    place: tuple[float, float, float]
    sigma: tuple[float, ...]
    phase_sigma: float


def read_press(
    source: Source, ball: float, references: References | None, precession: Precession | None, count: int
) -> BallPress:
    """Read a recording once, find the ball, and keep some samples of its neighbourhood."""
    levels, pixel_size = _levels(source, references), pixel_size_of(source)
    pivot = pivot_of(source, precession).place
    frames, phase = read_turn(source, _FRAMES)
    lean = _circle(source, phase) if precession is None else precession.lean(phase)
    try:
        centre, sigma = find_ball(frames, phase, pixel_size, ball), np.full(3, _PLACE)
    except InputError as error:
        raise InputError(f"{source.name}: {error}") from None
    outline = math.sqrt(max(ball**2 - centre[2] ** 2, 1e-6))
    press = source.header.press
    if press is not None and abs(press - centre[2] - ball) < _PLACE:
        centre[2], sigma[2] = press - ball, _DEPTH
    reach = min(ball * math.sin(_STEEPEST), _BEYOND * outline)
    places = np.stack([axis.ravel() for axis in np.meshgrid(*pixel_axes(frames.shape[1:], pixel_size))])
    chosen = _choose(frames, levels, places, moved(centre, lean, pivot), reach, count)
    total = sum(map(len, chosen))
    if total < _LEAST * len(frames):
        raise InputError(
            f"{source.name}: only {total} samples of the ball have references and are not at the ends of the"
            " camera's range: expose less, or take the references anew"
        )
    dark, bright = (level.ravel() for level in levels)
    light = [
        (frame.ravel()[some] - dark[some]) / (bright[some] - dark[some])
        for frame, some in zip(frames, chosen, strict=True)
    ]
    frame_of = np.repeat(np.arange(len(frames)), [len(some) for some in chosen])
    place = places[:, np.concatenate(chosen)]
    return BallPress(source.name, np.concatenate(light), place, frame_of, lean, centre, sigma, outline, pivot)


def _choose(
    frames: NDArray[Any],
    levels: tuple[Doubles, Doubles],
    places: Doubles,
    middle: Doubles,
    reach: float,
    count: int,
) -> list[NDArray[np.intp]]:
    """Return the numbers of some pixels of each frame about the ball's middle that can be used."""
    span = (levels[1] - levels[0]).ravel()
    usable = np.isfinite(span) & (span > 0)
    clipped = _ends(frames)
    generator = np.random.default_rng(0)  # the same samples in every run
    chosen = []
    for frame, (x, y, _) in zip(frames.reshape(len(frames), -1), middle, strict=True):
        near = usable & ((places[0] - x) ** 2 + (places[1] - y) ** 2 <= reach**2)
        inside = np.flatnonzero(near & np.isfinite(frame) & ~np.isin(frame, clipped))
        some = generator.choice(inside, min(max(1, count // len(frames)), len(inside)), replace=False)
        chosen.append(np.sort(some))
    return chosen


def pivot_of(source: Source, precession: Precession | None) -> Pivot:
    """Return what is known of the pivot: of the calibration, else of the recording, else not much."""
    if precession is not None and np.isfinite(precession.pivot).all():
        sigma = tuple(_error(precession, f"pivot_{axis}", _NEAR) for axis in "xyz")
        return Pivot(precession.pivot, sigma, _error(precession, "phase_offset", _OFFSET))
    offset = _ANY if precession is None else _error(precession, "phase_offset", _OFFSET)
    pivot = source.header.pivot
    if pivot is None:
        return Pivot((0.0, 0.0, 0.0), (_FAR,) * 3, offset)
    return Pivot(pivot, (_NEAR,) * 3, offset)


def _error(precession: Precession, name: str, unknown: float) -> float:
    """Return a calibration's standard error, but not less than a share of the usual one."""
    known = precession.sigma.get(name, math.nan)
    return math.hypot(known, _DOUBT * unknown) if math.isfinite(known) else unknown


def join(presses: Sequence[BallPress], ball: float) -> LightSamples:
    """Return the samples of all presses."""
    frames = np.array([len(press.lean) for press in presses])
    first = np.cumsum(frames) - frames
    return LightSamples(
        np.concatenate([press.light for press in presses]),
        np.concatenate([press.place for press in presses], axis=1),
        np.concatenate([press.frame + start for press, start in zip(presses, first, strict=True)]),
        np.repeat(np.arange(len(presses)), frames),
        np.concatenate([press.lean for press in presses]),
        ball,
    )


def _levels(source: Source, references: References | None) -> tuple[Doubles, Doubles]:
    header = source.header
    dark, bright = header.dark, header.bright
    if references is not None:
        dark, bright = references.dark, references.bright
    if dark is None or bright is None:
        raise InputError(
            f"{source.name}: there are no dark and bright references: make them first with"
            " 'mirrorskin calibrate references'"
        )
    if dark.shape != source.shape[1:] or bright.shape != source.shape[1:]:
        raise InputError(
            f"{source.name}: frames of {source.shape[1:]} pixels do not fit references of {dark.shape}:"
            " take both with the same region of the camera"
        )
    return np.asarray(dark, np.float64), np.asarray(bright, np.float64)


def _circle(source: Source, phase: Doubles) -> Doubles:
    if source.header.tilt is None:
        raise InputError(
            f"{source.name}: the tilt of its rotation is not known: give it, as in --tilt 2.5deg"
        )
    return source.header.tilt * np.stack([np.cos(phase), np.sin(phase)], axis=1)


def _ends(frames: NDArray[Any]) -> NDArray[Any]:
    """Return the counts at which samples may be clipped: 0, and the most that so many bits can hold."""
    if frames.dtype.kind == "f":
        return np.empty(0, frames.dtype)
    most = int(frames.max())
    ends = [0, int(np.iinfo(frames.dtype).max)]
    if most & (most + 1) == 0 and np.count_nonzero(frames == most) >= _CLIPPED:
        ends.append(most)
    return np.array(ends, frames.dtype)


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
    """What is known of the parameters before the fit."""

    mean: Doubles  # (P,)
    sigma: Doubles  # (P,): standard deviations, also infinite; a parameter whose is 0 stays as it is
    rising: bool = True  # Whether the curve rises from the rim to the rest plane


@dataclass(frozen=True, slots=True, eq=False)
class WallFit:
    """What was found."""

    parameters: Doubles  # (P,): See `mirrorskin.engine.calibration.wall_model.split`
    covariance: Doubles  # (P, P): 0 for what was not fitted
    residuals: Doubles  # (N,): Light of the samples less what the fit says
    rising: bool  # As of the prior


def fit_wall(
    samples: LightSamples, prior: Prior, start: Doubles, noise: float | Doubles, tolerance: float = 1e-7
) -> WallFit:
    """Find the most likely parameters, by damped Gauss-Newton steps (Levenberg and Marquardt).

    A sample that misses by r counts as ``c^2 log(1 + (r / c)^2)`` with c three times its noise: as a square
    at first, and hardly more the farther off it is, so that dust and glare do little (Cauchy's estimator).
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


def start_curve(samples: LightSamples, start: Doubles) -> tuple[Doubles, bool]:
    """Return parameters with the curve that fits best to what the others say, and whether it rises."""
    from scipy.optimize import nnls

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

    def __init__(self, samples: LightSamples, prior: Prior, noise: Doubles) -> None:
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
        from scipy.linalg import cholesky
        from scipy.optimize import lsq_linear

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
