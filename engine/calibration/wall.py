"""Brightness by place and normal, from presses of a ball."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.ball import moved
from mirrorskin.engine.calibration.wall_fit import (
    BallPress,
    Pivot,
    Prior,
    WallFit,
    fit_wall,
    join,
    pivot_of,
    read_press,
    start_curve,
)
from mirrorskin.engine.calibration.wall_model import (
    CURVE_COEFFICIENTS,
    SENSOR,
    STEPS,
    LightSamples,
    meet_balls,
    predict,
    split,
)
from mirrorskin.engine.calibration.wall_response import make_response
from mirrorskin.io import InputError, Precession, References, Source, WallResponse
from mirrorskin.io.calibration.types import PATTERNS

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Numbers = NDArray[np.intp]

BODY_RADIUS, BODY_HEIGHT = 17.5, 40.0
"""Of the paper's body, mm."""

FEWEST = 5
"""Presses that are needed."""

_SAMPLES = 60_000  # of all presses
_KNOWN = {
    **dict.fromkeys(("axis_x", "axis_y"), (0.0, 1.0)),
    "sight_0": (0.004, 0.004),  # a camera 100 to 200 mm away; 0 is telecentric
    "sight_2": (0.0, 3e-7),
    "scatter": (math.radians(3.0), math.radians(2.0)),
    **dict.fromkeys(("lamp_x", "lamp_y"), (0.0, 0.2)),
    **dict.fromkeys((f"shade_{number}" for number in range(5)), (0.0, 0.02)),
}
"""What is likely of a sensor: means and standard deviations of its parameters."""

_FEW, _MANY = 4_000, 30_000  # samples of the first fits, and of the last
_TOLERANCES = {_FEW: 1e-4, _MANY: 3e-6}  # change of the sum of squares at which these end, as a share
_COARSE = 0.1  # of full light: noise assumed by the first fit, so that it converges
_QUIET = 1e-3  # of full light, which the model may always be off
_INNER = 0.7  # of the light's outline, within which the ball is surely touched
_RING = 0.05  # of the outline: width of the rings by which that grows
_AT_ONCE = 2  # rings that are tried at a time
_USUAL = 1.2  # times the usual spread that a ring may show
_BIASED = 0.3  # times the usual spread that its median may be off
_CHANCE = 4.0  # over the root of the ring's samples, by which it may be more by chance
_BAD = 2.0  # times the other presses' noise that one may show
_UNLIKELY = 1.5  # standard deviations, root mean square, by which the sensor may be unlikely
_TOUCHED = 0.02  # mm above the rest plane
_MODEST = 0.01  # of full light: noise assumed by a fit without a press
_FEWEST_IN_RING = 30  # samples that a ring is judged by
_BINS = 6  # of brightness, in which noise is estimated


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
    """Learn how bright a mirror looks, from axial recordings of one ball pressed at several places.

    What the wall is like (its radius, rim and axis, the camera's lines of sight, the lamps, the scatter, the
    shading, and the printed pattern as a monotone curve) and where the balls are is fitted to the light of
    some ten thousand samples at once. A sphere looks the same however it is turned: the tilt of the rotation
    hardly matters, only where the ball moves to, and the pivot is fitted too.

    How far the sheet takes the ball's shape is found from the data: from the middle on, rings of samples are
    taken in until one does not fit.

    Parameters
    ----------
    presses : sequence of Source
        At least five, better nine, spread over the field; read one after the other, once.
    ball : float
        Radius of the ball, mm.
    references, precession : optional
        Calibrated ones; by default the levels, tilt and pivot of each recording.
    pattern : {"graded", "uniform"}
        Whether the wall's brightness changes with its height.
    body : (float, float)
        Nominal radius of the body and height of the wall, mm, known within a tenth: the fit begins there.
    progress : callable, optional
        Called with the number of presses read so far.

    Raises
    ------
    InputError
        There are too few presses, or the one that is named shows no ball or does not fit to the others.
    """
    _check(presses, ball, pattern, body)
    read = []
    for number, source in enumerate(presses, 1):
        read.append(read_press(source, ball, references, precession, _SAMPLES // len(presses)))
        if progress:
            progress(number)
    prior = _prior(read, pivot_of(presses[0], precession), pattern, body)
    touch = fit_touch(join(read, ball), read, prior)
    return make_response(touch.fit, touch.samples, touch.noise, pattern, presses[0])


def _prior(presses: Sequence[BallPress], pivot: Pivot, pattern: str, body: tuple[float, float]) -> Prior:
    """Return what is known before."""
    radius, rim = body
    known = dict(_KNOWN, radius=(radius, 0.1 * radius), rim=(rim, 0.1 * rim))
    for axis, place, sigma in zip("xyz", pivot.place, pivot.sigma, strict=True):
        known[f"pivot_{axis}"] = place, sigma
    known["phase_offset"] = (0.0, pivot.phase_sigma)
    mean, sigma = np.array([known[name] for name in SENSOR], np.float64).T
    centres = np.concatenate([press.centre for press in presses])
    steps = np.zeros(CURVE_COEFFICIENTS), np.full(CURVE_COEFFICIENTS, np.inf)
    if pattern == "uniform":
        steps[0][0], steps[1][1:] = 1.0, 0.0
    return Prior(
        np.concatenate([mean, steps[0], centres]),
        np.concatenate([sigma, steps[1], *(press.centre_sigma for press in presses)]),
    )


def _check(presses: Sequence[Source], ball: float, pattern: str, body: tuple[float, float]) -> None:
    """Raise where the call itself cannot be."""
    if len(presses) < FEWEST:
        raise InputError(f"{len(presses)} presses do not determine the wall: take {FEWEST} or more")
    if not (math.isfinite(ball) and ball > 0):
        raise InputError(f"a ball of radius {ball} mm cannot be: give its diameter, as in --ball 4mm")
    if pattern not in PATTERNS:
        raise InputError(f"pattern {pattern!r} is unknown: take {' or '.join(PATTERNS)}")
    if not (min(body) > 0 and max(body) < math.inf):
        raise InputError(f"a body of {body[0]} mm radius and {body[1]} mm height cannot be: give more")
    first = presses[0]
    for source in presses[1:]:
        pixels = source.shape[1:], source.header.pixel_size
        if pixels != (first.shape[1:], first.header.pixel_size):
            raise InputError(f"{source.name} and {first.name} differ in pixels or their size: take all alike")


# --- how far the sheet takes the ball's shape ---------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """A fit, the samples of touched places that went into it, and their noise, (n,), as shares of light."""

    fit: WallFit
    samples: LightSamples
    noise: Doubles


def fit_touch(samples: LightSamples, presses: Sequence[BallPress], prior: Prior) -> Touch:
    """Fit the wall to samples where the sheet lies on the ball.

    From well within the light's outline on, each press grows by rings as long as these can be fitted as well
    as those within: a gel leaves the ball earlier than a sheet that takes any shape. Where a ring could not,
    the one before it is left out as well.
    """
    rings = _Rings(samples, presses)
    taken = np.full(len(presses), round(_INNER / _RING))
    fit = _first_fit(samples[_evenly(rings.within(taken), _FEW)], prior)
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

    def __init__(self, samples: LightSamples, presses: Sequence[BallPress]) -> None:
        middle = np.concatenate([moved(press.centre, press.lean, press.pivot) for press in presses])
        self.press: Numbers = samples.press[samples.pose]
        outline = np.array([press.outline for press in presses])[self.press]
        away = np.hypot(*(samples.place - middle[samples.pose, :2].T)) / outline
        self.number: Numbers = np.floor(away / _RING).astype(np.intp)

    def within(self, rings: Numbers) -> Mask:
        """Return which samples lie within so many rings of their press."""
        return np.asarray(self.number < rings[self.press])


def _first_fit(samples: LightSamples, prior: Prior) -> WallFit:
    """Return a first fit, from the nominal sensor and the curve that goes best with it."""
    start, rising = prior.mean, prior.rising
    if prior.sigma[STEPS].all():
        start, rising = start_curve(samples, start)
    return fit_wall(samples, Prior(prior.mean, prior.sigma, rising), start, _COARSE, 1e-4)


def _refit(
    samples: LightSamples, noise: Doubles, inside: Mask, prior: Prior, fit: WallFit, count: int
) -> tuple[Touch, Doubles]:
    """Fit once more, to at most so many of the touched samples that are chosen.

    Returns it, and by how many standard deviations all samples are off, NaN where the sheet does not touch.
    """
    named, _, centres = split(fit.parameters)
    touched = meet_balls(samples, named, centres).z >= _TOUCHED
    chosen = _evenly(inside & touched, count)
    fit = fit_wall(samples[chosen], prior, fit.parameters, noise[chosen], _TOLERANCES[count])
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
        if len(own) < _FEWEST_IN_RING:
            return number, False
        chance = _CHANCE / np.sqrt(len(own))
        if _scale(own) / usual > _USUAL + chance or abs(np.median(own)) / usual > _BIASED + chance:
            return number - 1, False
    return taken + _AT_ONCE, True


def _noise(samples: LightSamples, fit: WallFit, inside: Mask) -> Doubles:
    """Return the noise of all samples, (N,), from what is left of some: its square is linear in the light.

    Estimated by the medians of some bins of brightness.
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
    """Return the root mean square of normal values, estimated by the median of their sizes; inf of none."""
    return 1.4826 * float(np.median(np.abs(off))) if len(off) else np.inf


def _evenly(mask: Mask, count: int) -> Numbers:
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
    if _prior_misfit(touch.fit, prior) > _UNLIKELY:
        misfits = [_prior_misfit(_without(touch, prior, number), prior) for number in range(len(presses))]
        least = int(np.argmin(misfits))
        if misfits[least] < _UNLIKELY:
            raise InputError(_misfit(presses[least].name))
        raise InputError(
            "the presses go together with no likely sensor: check the ball's diameter, pixel size, and the"
            " body's radius and height"
        )


def _without(touch: Touch, prior: Prior, press: int) -> WallFit:
    """Return the fit without a press."""
    samples = touch.samples
    others = _evenly(samples.press[samples.pose] != press, _FEW)
    start = prior.mean.copy()
    start[STEPS] = touch.fit.parameters[STEPS]
    return fit_wall(
        samples[others], prior, start, np.maximum(touch.noise[others], _MODEST), _TOLERANCES[_FEW]
    )


def _prior_misfit(fit: WallFit, prior: Prior) -> float:
    """Return by how many standard deviations a sensor is off what was known before, root mean square."""
    off = (fit.parameters - prior.mean) / np.where(prior.sigma > 0, prior.sigma, np.inf)
    return float(np.sqrt(np.mean(off[: STEPS.start] ** 2)))


def _misfit(name: str) -> str:
    return f"{name}: its ball does not fit to the other presses: leave it out or take it again"
