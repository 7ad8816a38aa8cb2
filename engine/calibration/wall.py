"""Brightness as a function of position and normal, from presses of a ball."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration import wall_fit
from mirrorskin.engine.calibration import wall_model as model
from mirrorskin.engine.calibration.ball import moved
from mirrorskin.engine.calibration.sources import check_ball_radius, pixel_size_of
from mirrorskin.engine.calibration.wall_response import make_response
from mirrorskin.io import InputError, Precession, References, Source, WallResponse
from mirrorskin.io.model.calibration import PATTERNS
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma

Mask = NDArray[np.bool_]
Numbers = NDArray[np.intp]

BODY_RADIUS, BODY_HEIGHT = 17.5, 40.0
"""Radius and height of the paper's body, mm."""

BODY_ERROR = 0.1
"""Relative standard deviation of the body's nominal radius and height."""

FEWEST = 5
"""Minimum number of presses."""

_SAMPLES = 60_000  # number of samples of all presses
LIKELY = {
    **dict.fromkeys(("axis_x", "axis_y"), (0.0, 1.0)),
    "sight_0": (0.004, 0.004),  # a camera at 100 to 200 mm; 0 for a telecentric one
    "sight_2": (0.0, 3e-7),
    "scatter": (math.radians(3.0), math.radians(2.0)),
    **dict.fromkeys(("lamp_x", "lamp_y"), (0.0, 0.2)),
    **dict.fromkeys((f"shade_{number}" for number in range(5)), (0.0, 0.02)),
}
"""Prior means and standard deviations of a sensor's parameters."""

_FIRST_SAMPLES, _LAST_SAMPLES = 4_000, 30_000  # number of samples of the first fits, and of the last
_TOLERANCES = {
    _FIRST_SAMPLES: 1e-4,
    _LAST_SAMPLES: 3e-6,
}  # relative change of the sum of squares at which these fits end
_COARSE = 0.1  # share of full light: noise assumed in the first fit, large for convergence
_QUIET = 1e-3  # share of full light: minimum error of the model
_INNER = 0.7  # share of the outline's radius within which the sheet certainly touches the ball
_RING = 0.05  # share of the outline's radius: width of the rings that are added
_AT_ONCE = 2  # number of rings that are added at once
_MAX_RING_SPREAD = 1.2  # maximum standard deviation of a ring, in usual standard deviations
_BIASED = 0.3  # maximum median of a ring, in usual standard deviations
_CHANCE = 4.0  # allowance for chance in both, divided by the root of the number of samples of the ring
_BAD = 2.0  # maximum ratio of the noise of a press to the noise of the other presses
_MAX_PRIOR_DEVIATION = 1.5  # maximum RMS deviation of the sensor from its prior, standard deviations
_TOUCHED = 0.02  # mm: minimum height of a sample above the rest plane
_MODEST = 0.01  # share of full light: minimum noise assumed in a fit without one of the presses
_FEWEST_IN_RING = 30  # minimum number of samples to test a ring
_BINS = 6  # number of bins of brightness in which noise is estimated


def fit_zenith(
    presses: Sequence[Source],
    ball: float,
    *,
    references: References | None = None,
    precession: Precession | None = None,
    pattern: str = "graded",
    body: tuple[float, float] = (BODY_RADIUS, BODY_HEIGHT),
    progress: Callable[[int], None] | None = None,
) -> WallResponse:
    """Fit the brightness of mirrors to axial recordings of one ball pressed at several positions.

    The wall and the balls' positions are fitted jointly to the light of tens of thousands of samples. The
    parameters of the wall are its radius, rim and axis, the camera's lines of sight, the lamps, the scatter,
    the shading, and the printed pattern as a monotone curve. A sphere looks the same in any orientation, so
    the tilt of the rotation has little influence except through the movement of the ball; the pivot is fitted
    as well.

    The area in which the sheet touches the ball is estimated from the data: rings of samples are added from
    the centre outwards until one does not fit.

    Parameters
    ----------
    presses : sequence of Source
        At least five, preferably nine, spread over the field; each is read once, one after the other.
    ball : float
        Radius of the ball, mm.
    references, precession : optional
        Calibrated parts; by default the levels, tilt and pivot of each recording.
    pattern : {"graded", "uniform"}
        Whether the wall's brightness changes with its height.
    body : (float, float)
        Nominal radius of the body and height of the wall, mm, within 10 %: the start of the fit.
    progress : callable, optional
        Called with the number of presses read so far.

    Raises
    ------
    mirrorskin.io.InputError
        There are too few presses, or the named one shows no ball or does not fit the others.
    """
    check_zenith(presses, ball, references, pattern, body)
    samples = []
    for number, source in enumerate(presses, 1):
        samples.append(wall_fit.read_press(source, ball, references, precession, _SAMPLES // len(presses)))
        if progress:
            progress(number)
    prior = _prior(samples, wall_fit.pivot_of(presses[0], precession), pattern, body)
    touch = fit_touch(wall_fit.join(samples, ball), samples, prior)
    return make_response(touch.fit, touch.samples, touch.noise, pattern, presses[0])


def _prior(
    presses: Sequence[wall_fit.BallPress], pivot: wall_fit.Pivot, pattern: str, body: tuple[float, float]
) -> wall_fit.Prior:
    radius, rim = body
    sensor = dict(LIKELY, radius=(radius, BODY_ERROR * radius), rim=(rim, BODY_ERROR * rim))
    for axis, place, sigma in zip("xyz", pivot.place, pivot.sigma, strict=True):
        sensor[f"pivot_{axis}"] = place, sigma
    sensor["phase_offset"] = (0.0, pivot.phase_sigma)
    mean, sigma = np.array([sensor[name] for name in model.SENSOR], np.float64).T
    centres = np.concatenate([press.centre for press in presses])
    steps = np.zeros(model.CURVE_COEFFICIENTS), np.full(model.CURVE_COEFFICIENTS, np.inf)
    if pattern == "uniform":
        steps[0][0], steps[1][1:] = 1.0, 0.0
    return wall_fit.Prior(
        np.concatenate([mean, steps[0], centres]),
        np.concatenate([sigma, steps[1], *(press.centre_sigma for press in presses)]),
    )


def check_zenith(
    presses: Sequence[Source],
    ball: float,
    references: References | None,
    pattern: str,
    body: tuple[float, float],
) -> None:
    """Raise what `fit_zenith` would refuse without looking at frames."""
    if len(presses) < FEWEST:
        raise InputError(f"{len(presses)} presses do not determine the wall: take {FEWEST} or more")
    check_ball_radius(ball)
    if pattern not in PATTERNS:
        raise InputError(f"pattern {pattern!r} is unknown: take {' or '.join(PATTERNS)}")
    check_body(body)
    first = presses[0]
    for source in presses[1:]:
        pixels = source.shape[1:], source.header.pixel_size
        if pixels != (first.shape[1:], first.header.pixel_size):
            raise InputError(f"{source.name} and {first.name} differ in pixels or their size: take all alike")
    for source in presses:
        wall_fit.levels_of(source, references)
        pixel_size_of(source)


def check_body(body: tuple[float, float]) -> None:
    """Raise InputError unless radius and height of a body, mm, are above 0."""
    if not (min(body) > 0 and max(body) < math.inf):
        raise InputError(f"a body of {body[0]} mm radius and {body[1]} mm height: both must be above 0")


# --- the area in which the sheet takes the ball's shape -----------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """A fit, the samples in contact that it is based on, and their noise, (n,), as shares of full light."""

    fit: wall_fit.WallFit
    samples: model.LightSamples
    noise: Doubles


def fit_touch(
    samples: model.LightSamples, presses: Sequence[wall_fit.BallPress], prior: wall_fit.Prior
) -> Touch:
    """Fit the wall to samples where the sheet touches the ball.

    Starting well within the outline of the light, rings are added to each press as long as they fit as well
    as the inner ones, because an elastomer leaves the ball earlier than a perfectly flexible sheet. If a ring
    does not fit, the next inner ring is excluded as well.
    """
    rings = _Rings(samples, presses)
    taken = np.full(len(presses), round(_INNER / _RING))
    inner = rings.within(taken)
    fit = _first_fit(samples[_evenly(inner, _FIRST_SAMPLES)], prior)
    prior = replace(prior, rising=fit.rising)
    touch, off = _refit(samples, _noise(samples, fit, inner), inner, prior, fit, _FIRST_SAMPLES)
    noise = _noise(samples, touch.fit, inner)
    _check_presses(touch, np.where(inner, off, np.nan), rings, presses, prior)
    grows = np.ones(len(presses), bool)
    while grows.any():
        touch, off = _refit(
            samples, noise, rings.within(taken + _AT_ONCE * grows), prior, touch.fit, _FIRST_SAMPLES
        )
        for press in np.flatnonzero(grows):
            chosen = (rings.press == press) & np.isfinite(off)
            taken[press], grows[press] = _grow(off[chosen], rings.number[chosen], int(taken[press]))
    touch, off = _refit(samples, noise, rings.within(taken), prior, touch.fit, _LAST_SAMPLES)
    _check_presses(touch, np.where(rings.within(taken), off, np.nan), rings, presses, prior)
    return touch


class _Rings:
    """The press of each sample, and its ring around the ball's centre."""

    def __init__(self, samples: model.LightSamples, presses: Sequence[wall_fit.BallPress]) -> None:
        middle = np.concatenate([moved(press.centre, press.lean, press.pivot) for press in presses])
        self.press: Numbers = samples.press[samples.pose]
        outline = np.array([press.outline for press in presses])[self.press]
        away = np.hypot(*(samples.place - middle[samples.pose, :2].T)) / outline
        self.number: Numbers = np.floor(away / _RING).astype(np.intp)

    def within(self, rings: Numbers) -> Mask:
        """Return which samples are within a number of rings, (presses,), of their press."""
        return np.asarray(self.number < rings[self.press])


def _first_fit(samples: model.LightSamples, prior: wall_fit.Prior) -> wall_fit.WallFit:
    """Return a first fit, starting at the nominal sensor and the curve that fits best to it."""
    start, rising = prior.mean, prior.rising
    if prior.sigma[model.STEPS].all():
        start, rising = wall_fit.start_curve(samples, start)
    return wall_fit.fit_wall(samples, replace(prior, rising=rising), start, _COARSE, 1e-4)


def _refit(
    samples: model.LightSamples,
    noise: Doubles,
    inside: Mask,
    prior: wall_fit.Prior,
    fit: wall_fit.WallFit,
    count: int,
) -> tuple[Touch, Doubles]:
    """Fit again, to at most ``count`` of the samples that are inside and in contact.

    Also return the residuals of all samples in standard deviations, NaN without contact.
    """
    named, _, centres = model.split(fit.parameters)
    touched = model.meet_balls(samples, named, centres).z >= _TOUCHED
    chosen = _evenly(inside & touched, count)
    fit = wall_fit.fit_wall(samples[chosen], prior, fit.parameters, noise[chosen], _TOLERANCES[count])
    off = (samples.light - model.predict(samples, fit.parameters, fit.rising)) / noise
    return Touch(fit, samples[chosen], noise[chosen]), np.where(touched, off, np.nan)


def _grow(off: Doubles, ring: Numbers, taken: int) -> tuple[int, bool]:
    """Return the number of rings of a press that fit, and whether more may fit.

    ``off`` are the residuals of its samples in standard deviations, and ``ring`` their rings.
    """
    usual = max(1.0, _scale(off[ring < taken]))
    if not np.isfinite(usual):
        return taken, False
    for number in range(taken, taken + _AT_ONCE):
        part = off[ring == number]
        if len(part) < _FEWEST_IN_RING:
            return number, False
        chance = _CHANCE / np.sqrt(len(part))
        if (
            _scale(part) / usual > _MAX_RING_SPREAD + chance
            or abs(np.median(part)) / usual > _BIASED + chance
        ):
            return number - 1, False
    return taken + _AT_ONCE, True


def _noise(samples: model.LightSamples, fit: wall_fit.WallFit, inside: Mask) -> Doubles:
    """Return the noise of all samples, (N,), from the residuals of those inside.

    Its square is linear in the light; it is estimated from the medians in bins of brightness.
    """
    light = model.predict(samples, fit.parameters, fit.rising)
    residual = samples.light - light
    order = np.flatnonzero(inside)[np.argsort(light[inside])]
    bins = np.array_split(order, _BINS)
    level = np.array([np.median(light[part]) for part in bins])
    square = np.array([_scale(residual[part]) ** 2 for part in bins])
    slope, offset = np.polyfit(level, square, 1) if np.ptp(level) > 0 else (0.0, float(square.mean()))
    floor = 0.25 * float(np.median(square)) + _QUIET**2
    return np.asarray(np.sqrt(np.maximum(offset + slope * light, floor)))


def _scale(off: Doubles) -> float:
    return mad_sigma(off) if len(off) else np.inf


def _evenly(mask: Mask, count: int) -> Numbers:
    """Return the numbers of at most ``count`` chosen samples, evenly spaced."""
    chosen = np.flatnonzero(mask)
    return chosen[np.linspace(0, len(chosen) - 1, min(count, len(chosen))).round().astype(np.intp)]


def _check_presses(
    touch: Touch, off: Doubles, rings: _Rings, presses: Sequence[wall_fit.BallPress], prior: wall_fit.Prior
) -> None:
    """Raise InputError if a press does not fit the others.

    Either its residuals are larger, or the fitted sensor is unlikely with it and likely without it.
    """
    finite = np.isfinite(off)
    scales = np.array([_scale(off[finite & (rings.press == number)]) for number in range(len(presses))])
    worst = int(np.argmax(scales))
    misfit = "{}: its ball does not fit to the other presses: leave it out or take it again"
    if scales[worst] > _BAD * max(1.0, float(np.median(scales))):
        raise InputError(misfit.format(presses[worst].name))
    if _prior_misfit(touch.fit, prior) > _MAX_PRIOR_DEVIATION:
        misfits = [_prior_misfit(_without(touch, prior, number), prior) for number in range(len(presses))]
        best = int(np.argmin(misfits))
        if misfits[best] < _MAX_PRIOR_DEVIATION:
            raise InputError(misfit.format(presses[best].name))
        raise InputError(
            "no likely sensor fits the presses: check the ball's diameter, pixel size, and the body's radius"
            " and height"
        )


def _without(touch: Touch, prior: wall_fit.Prior, press: int) -> wall_fit.WallFit:
    """Return the fit without a press."""
    samples = touch.samples
    others = _evenly(samples.press[samples.pose] != press, _FIRST_SAMPLES)
    start = prior.mean.copy()
    start[model.STEPS] = touch.fit.parameters[model.STEPS]
    noise = np.maximum(touch.noise[others], _MODEST)
    return wall_fit.fit_wall(samples[others], prior, start, noise, _TOLERANCES[_FIRST_SAMPLES])


def _prior_misfit(fit: wall_fit.WallFit, prior: wall_fit.Prior) -> float:
    """Return the RMS deviation of a sensor from its prior, standard deviations."""
    off = (fit.parameters - prior.mean) / np.where(prior.sigma > 0, prior.sigma, np.inf)
    return float(np.sqrt(np.mean(off[: model.STEPS.start] ** 2)))
