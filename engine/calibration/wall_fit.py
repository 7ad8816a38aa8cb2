"""Samples of the light of balls, and the fit of the lit wall's geometry and print to them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.provenance import naming
from mirrorskin.engine.calibration.ball import find_ball, moved
from mirrorskin.engine.calibration.sources import pixel_size_of, read_turn
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
from mirrorskin.io.watch.saturation import scale_top
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics import least_squares

_MAX_ZENITH = math.radians(50.0)  # maximum zenith of the ball at a sample
_MAX_RADIUS = 1.35  # distance of a sample from the ball's centre, relative to the outline of the light
_CENTRE_SIGMA = 1.0  # mm: standard deviation of a ball's centre located in the picture
_DEPTH = 0.2  # mm: standard deviation of the recorded press
_MIN_SAMPLES_PER_FRAME = 20  # minimum of the mean number of samples per frame
_FRAMES = 16  # maximum number of frames used of a recording
_CLIPPED = 64  # number of samples at a value 2^n - 1 above which it is assumed to be the camera's full scale
_UNKNOWN_PIVOT = 30.0  # mm: standard deviation of a pivot without information
_RECORDED_PIVOT = 3.0  # mm: standard deviation of a recorded pivot
_CALIBRATED_PHASE = math.radians(2.0)  # standard deviation of a calibrated phase without a standard error
_RECORDED_PHASE = math.radians(45.0)  # standard deviation of a recorded phase
_MIN_RELATIVE_ERROR = 0.02  # standard error of a calibrated value, relative to that without calibration


@dataclass(frozen=True, slots=True, eq=False)
class BallPress:
    """M samples of an axial recording of a ball, with prior information; lengths in mm."""

    name: str  # name of its source
    light: Doubles  # (M,)
    place: Doubles  # (2, M): position of each sample's pixel on the rest plane
    frame: NDArray[np.intp]  # (M,)
    lean: Doubles  # (T, 2): lean in each frame, radians
    centre: Doubles  # (3,): centre of the ball in the mean pose, at the recorded depth if that is plausible
    centre_sigma: Doubles  # (3,): its standard deviation
    outline: float  # radius of the circle in which light is visible
    pivot: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Pivot:
    """Centre of the body's rotation, mm, with its standard errors and the standard error of phase zero."""

    place: tuple[float, float, float]
    sigma: tuple[float, ...]
    phase_sigma: float


def read_press(
    source: Source, ball: float, references: References | None, precession: Precession | None, count: int
) -> BallPress:
    """Read a recording once, find the ball, and select about ``count`` samples around it."""
    levels, pixel_size = levels_of(source, references), pixel_size_of(source)
    pivot = pivot_of(source, precession).place
    frames, phase = read_turn(source, _FRAMES)
    if precession is not None:
        lean = precession.lean(phase)
    elif source.header.tilt is not None:
        lean = source.header.tilt * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    else:
        raise InputError(f"{source.name} has no tilt: give it, as in --tilt 2.5deg")
    with naming(source):
        centre, sigma = find_ball(frames, phase, pixel_size, ball), np.full(3, _CENTRE_SIGMA)
    outline = math.sqrt(max(ball**2 - centre[2] ** 2, 1e-6))
    press = source.header.press
    if press is not None and abs(press - centre[2] - ball) < _CENTRE_SIGMA:
        centre[2], sigma[2] = press - ball, _DEPTH
    reach = min(ball * math.sin(_MAX_ZENITH), _MAX_RADIUS * outline)
    places = np.stack([axis.ravel() for axis in np.meshgrid(*pixel_axes(frames.shape[1:], pixel_size))])
    chosen = _choose(frames, levels, places, moved(centre, lean, pivot), reach, count)
    total = sum(map(len, chosen))
    if total < _MIN_SAMPLES_PER_FRAME * len(frames):
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
    """Return the numbers of some usable pixels of each frame around the ball's centre."""
    span = (levels[1] - levels[0]).ravel()
    usable = np.isfinite(span) & (span > 0)
    clipped = _clipped_counts(frames)
    generator = np.random.default_rng(0)  # the same samples in every run
    chosen = []
    for frame, (x, y, _) in zip(frames.reshape(len(frames), -1), middle, strict=True):
        near = usable & ((places[0] - x) ** 2 + (places[1] - y) ** 2 <= reach**2)
        inside = np.flatnonzero(near & np.isfinite(frame) & ~np.isin(frame, clipped))
        some = generator.choice(inside, min(max(1, count // len(frames)), len(inside)), replace=False)
        chosen.append(np.sort(some))
    return chosen


def pivot_of(source: Source, precession: Precession | None) -> Pivot:
    """Return the pivot of the calibration, else of the recording, else 0, with standard deviations."""
    phase_sigma = _RECORDED_PHASE
    if precession is not None:
        phase_sigma = _calibrated_sigma(precession, "phase_offset", _CALIBRATED_PHASE)
        if np.isfinite(precession.pivot).all():
            sigma = tuple(_calibrated_sigma(precession, f"pivot_{axis}", _RECORDED_PIVOT) for axis in "xyz")
            return Pivot(precession.pivot, sigma, phase_sigma)
    if source.header.pivot is None:
        return Pivot((0.0, 0.0, 0.0), (_UNKNOWN_PIVOT,) * 3, phase_sigma)
    return Pivot(source.header.pivot, (_RECORDED_PIVOT,) * 3, phase_sigma)


def _calibrated_sigma(precession: Precession, name: str, without: float) -> float:
    """Return a calibration's standard error, or the standard deviation without one."""
    sigma = precession.sigma.get(name, math.nan)
    return math.hypot(sigma, _MIN_RELATIVE_ERROR * without) if math.isfinite(sigma) else without


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


def levels_of(source: Source, references: References | None) -> tuple[Doubles, Doubles]:
    """Return the dark and the bright level of each pixel, (H, W), counts; InputError without them."""
    levels = source.header if references is None else references
    dark, bright = levels.dark, levels.bright
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


def _clipped_counts(frames: NDArray[Any]) -> NDArray[Any]:
    """Return the counts at which samples may be clipped: 0, and the full scale."""
    if frames.dtype.kind == "f":
        return np.empty(0, frames.dtype)
    top = scale_top(float(frames.max()), integer=True)
    ends = [0, int(np.iinfo(frames.dtype).max)]
    if top is not None and np.count_nonzero(frames == top) >= _CLIPPED:
        ends.append(int(top))
    return np.array(ends, frames.dtype)


# --- the fit ------------------------------------------------------------------------------------------------

_LOSS = least_squares.cauchy(3.0)  # standard deviations
ROUGH = 0.05
"""Prior standard deviation of third differences of the curve's coefficients, share of full light."""

_SCATTER = (1e-3, 0.3)  # radians: bounds of the scatter
_CHUNK = 8192  # samples whose derivatives are computed at a time


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Prior distribution of the parameters."""

    mean: Doubles  # (P,)
    sigma: Doubles  # (P,): standard deviations; inf for no information, 0 for a fixed parameter
    rising: bool = True  # whether the curve rises from the rim to the rest plane

    def equations(self, free: NDArray[np.intp]) -> least_squares.Prior:
        """Return the prior of the free parameters; the curve, if it is free, is smooth."""
        rows = np.diag(1 / self.sigma[free])[np.isfinite(self.sigma[free])]
        values = rows @ self.mean[free]
        if self.sigma[STEPS].all():
            rough = np.zeros((CURVE_COEFFICIENTS - 3, len(self.mean)))
            rough[:, STEPS] = curve_roughness() @ curve_from_steps(self.rising) / ROUGH
            rows = np.concatenate([rows, rough[:, free]])
            values = np.concatenate([values, np.zeros(len(rough))])
        return least_squares.Prior(rows, values)


@dataclass(frozen=True, slots=True, eq=False)
class WallFit:
    """Result of a fit."""

    parameters: Doubles  # (P,): see `mirrorskin.engine.calibration.wall_model.split`
    covariance: Doubles  # (P, P): 0 for fixed parameters
    residuals: Doubles  # (N,): light of the samples minus that of the model
    rising: bool  # as in the prior


def fit_wall(
    samples: LightSamples, prior: Prior, start: Doubles, noise: float | Doubles, tolerance: float = 1e-7
) -> WallFit:
    """Find the maximum a posteriori parameters.

    Dust and glare have little influence under the Cauchy loss beyond three standard deviations. The fit ends
    when the relative decrease of the sum is less than ``tolerance``.
    """
    free = np.flatnonzero(prior.sigma > 0)
    every = start.copy()

    def filled(parameters: Doubles) -> Doubles:
        every[free] = parameters
        return every

    def residuals(parameters: Doubles) -> Doubles:
        return predict(samples, filled(parameters), prior.rising) - samples.light

    def jacobian(parameters: Doubles) -> Doubles:
        parts = [samples[first : first + _CHUNK] for first in range(0, len(samples.light), _CHUNK)]
        slopes = [linearise(part, filled(parameters), prior.rising)[1][:, free] for part in parts]
        return np.concatenate(slopes)

    low, high = np.full_like(start, -np.inf), np.full_like(start, np.inf)
    low[STEPS] = 0
    scatter = SENSOR.index("scatter")
    low[scatter], high[scatter] = _SCATTER
    solution = least_squares.fit(
        residuals,
        start[free],
        jacobian=jacobian,
        noise=noise,
        loss=_LOSS,
        prior=prior.equations(free),
        bounds=(low[free], high[free]),
        tolerance=tolerance,
    )
    covariance = np.zeros((len(start), len(start)))
    covariance[np.ix_(free, free)] = solution.covariance(_excess(solution.residuals / noise))
    return WallFit(filled(solution.parameters), covariance, -solution.residuals, prior.rising)


def _excess(residuals: Doubles) -> float:
    """Return the factor of the covariance due to the size of the residuals, in standard deviations.

    It is Huber's proposal: the variance of the weighted residuals divided by the square of their mean slope.
    """
    weights = _LOSS.weights(residuals)
    slope = weights**2 * (1 - (residuals / _LOSS.limit) ** 2)
    return float(np.mean((weights * residuals) ** 2) / np.mean(slope) ** 2 * np.mean(weights))


def start_curve(samples: LightSamples, start: Doubles) -> tuple[Doubles, bool]:
    """Return parameters with the curve that fits best to the other parameters, and whether it rises."""
    from scipy.optimize import nnls

    fits = []
    for rising in (True, False):
        basis = linearise(samples, start, rising)[1][:, STEPS]
        rough = curve_roughness() @ curve_from_steps(rising) * np.sqrt(len(basis))
        values = np.concatenate([samples.light, np.zeros(len(rough))])
        steps, norm = nnls(np.concatenate([basis, rough]), values)
        fits.append((norm, rising, steps))
    _, rising, steps = min(fits, key=lambda fit: fit[0])
    parameters = start.copy()
    parameters[STEPS] = steps
    return parameters, rising
