"""What may be wrong with the brightness of a rotation: all of it at once, with priors.

The model of a sample is that of `mirrorskin.engine.diagnosis.turn_light`. The angle between normal and axis
contains an error of the tilt and of the phase. The normals of a grid of pixels are fitted together with these
nuisances, each of which has a prior (`mirrorskin.io.Header.prior`). What the pixels do not determine stays as
uncertain as its prior.

The covariance of the nuisances becomes that of normals, as a few *modes*: errors that all pixels have in
common, each a function of the normal and of the place. A slope that is wrong everywhere in the same way
changes heights by much more than errors that differ from pixel to pixel.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.correlation.design_matrix import basis
from mirrorskin.engine.diagnosis.residual_noise import valid
from mirrorskin.engine.diagnosis.turn_light import (
    GLOBALS,
    UNEVEN,
    AxisAngles,
    PixelScale,
    Sums,
    light_of,
    uneven_terms,
)
from mirrorskin.io import Header
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import gram

_MIN_PIXELS, _MOST_PIXELS, _MIN_FRAMES, _MAX_FRAMES = 16, 192, 4, 128
_STEEP, _UPRIGHT = 3.0, math.radians(80)  # range of zeniths that tell: minimum in tilts, and maximum
_LEVEL = 1.5  # tilts: least zenith at which errors are evaluated
_SWING = 0.75, 1.33  # range of the amplitude of the zenith of a usable pixel, in tilts
LEAST_LIGHT = 0.05  # share of full light of a usable sample: next to its dark end, a pattern is not linear
_OUTLIER_RATIO = 3.0  # pixels with a larger misfit are excluded; times the usual misfit
MAX_MISFIT = 4.0
"""Variance of residuals, relative to that of two waves a pixel, of a model that fits."""

_LEAST_NOISE = 0.3  # counts of 8 bits: rounding
_ITERATIONS = 3
_SWINGS = 0.03, 0.03, 0.03, *(0.01,) * UNEVEN  # of the swing by zenith and place: a pixel has an area
_SHIFTS = 3  # terms of the movement of points in the picture, by zenith
_UNKNOWN_SHIFT = 1.0  # pixels
_SWINGING = len(_SWINGS) + _SHIFTS
_LEAST_SPREAD = 0.05  # radians: least standard deviation of zeniths that counts as one
TERMS = 25
"""Number of functions that a mode is a sum of; see `_functions`."""
_NOISE = 1.5  # variance of noise that is taken from the scatter of normals, relative to the expected one
_WAVE = 1.5  # light that changes with the phase, relative to that of a frame
_OFFSETS = 0.5  # offsets of frames, and their drift, relative to that of the zenith
_WIDEST = 100.0  # most by which the variance of a prior grows
_FLOOR = 1e-14  # least share of a prior's variance, so that one of 0 can be inverted
_MOST_MODES, _SMALL_MODE = 6, 1e-3  # modes that are kept, and least share of the largest one
_POWERS = 4  # of the matrix of modes, until its largest ones are separate from the others
_ROUNDING = 1e-12  # share of a variance that rounding may make negative
_CONDITION = 1e-5  # least singular value, relative to the largest one, of their fit
_CLEAR = 2.0  # standard deviations of what remains: least effect that is corrected
_WORTH = 0.2  # standard deviations of the pixels' own errors: the same
_RELEVANT = 0.05  # standard deviations of the pixels' own errors: least effect of an unknown nuisance
_ODD_GAMMA, _LEAST_GAMMA = 2.5, 0.01  # least difference of gamma from 1: in prior deviations, and at all
_CLEAR_SWING = 3.5  # standard deviations: least swing that falls with the zenith
_SMALL_GAIN, _SMALL_OFFSET = 0.005, 1.0  # least flicker, and drift in counts of 8 bits, that has a name


def picture_axes(shape: tuple[int, int]) -> tuple[Doubles, Doubles]:
    """Return x of the columns and y of the rows of a picture, from -1 to 1, with y up."""
    return np.linspace(-1, 1, shape[1]), np.linspace(1, -1, shape[0])


class Grid(NamedTuple):
    """Where the samples are: their rows and columns, and the shape of the picture.

    ``shift`` is by how much points may move in the picture while the body leans, pixels.
    """

    rows: NDArray[np.integer[Any]]
    columns: NDArray[np.integer[Any]]
    shape: tuple[int, int]
    shift: float

    def places(self) -> tuple[Doubles, Doubles]:
        """Return the places of the pixels, (n,), x to the right and y up, from -1 to 1."""
        x, y = picture_axes(self.shape)
        x, y = np.meshgrid(x[self.columns], y[self.rows])
        return x.ravel(), y.ravel()

    def rise(self, zenith: Doubles, azimuth: Doubles) -> Doubles:
        """Return how much zeniths, (n,), grow along their azimuth, radians per pixel; 0 where unknown."""
        lengths = len(self.rows), len(self.columns)
        if min(lengths) < 2:
            return np.zeros(len(zenith))
        downwards, to_the_right = np.gradient(zenith.reshape(lengths), self.rows, self.columns)
        rise = to_the_right.ravel() * np.cos(azimuth) - downwards.ravel() * np.sin(azimuth)
        return np.where(np.isfinite(rise), rise, 0.0)


def shift_of(header: Header, tilt: float) -> float:
    """Return by how much points may move in the picture while the body leans about its pivot, pixels."""
    pivot, press, size = header.pivot, header.press, header.pixel_size
    if pivot is None or press is None or size is None:
        return _UNKNOWN_SHIFT
    return float(tilt * abs(press - pivot[2]) / min(size))


class Scale(NamedTuple):
    """How counts depend on the zenith at some pixels: each a number or (n,), counts."""

    gain: ArrayLike  # per radian
    base: ArrayLike  # at zenith 0
    dark: ArrayLike
    bright: float | None  # full light; None: the brightest sample


@dataclass(frozen=True, slots=True)
class TurnNuisances:
    """Estimated nuisances of a rotation, and the errors of normals that remain.

    Attributes
    ----------
    gain, offset : ndarray, (T,), float64
        Light of each frame divided by the usual one, and its offset, counts.
    gamma, zenith_gain, zenith_offset : float
        Estimates of c, r and z.
    uneven : ndarray, (5,), float64
        Factors of x, y, x^2, xy, y^2, with x and y from -1 to 1.
    full, count : float
        Full light R, and a count of 8 bits, counts.
    modes : ndarray, (M, 2, 25), float64
        Errors of normals along the meridian and across it; see `mode_errors`.
    variance : (float, float)
        Coefficients a and b of the modes' variance, a + b sin(zenith)^2, radians^2.
    worth_removing : bool
        Whether the estimates are clear, and not small compared with the pixels' own errors.
    unknown : tuple of str
        Names of the nuisances that this object shows hardly better than their priors, the largest first.
    is_odd : bool
        Whether gamma differs from 1 by more than its prior, and the swing by zenith does not contradict it,
        or shows it alone.
    """

    gain: Doubles
    offset: Doubles
    gamma: float
    zenith_gain: float
    zenith_offset: float
    uneven: Doubles
    full: float
    count: float
    modes: Doubles
    variance: tuple[float, float]
    worth_removing: bool
    unknown: tuple[str, ...]
    is_odd: bool

    def remove(
        self, frames: NDArray[Any], first: int, dark: ArrayLike, base: ArrayLike
    ) -> NDArray[np.float32]:
        """Return frames, (n, H, W), from number ``first`` on, as they were meant to be; NaN where clipped."""
        part = slice(first, first + len(frames))
        gain, offset = (values[part, np.newaxis, np.newaxis] for values in (self.gain, self.offset))
        low, start = np.asarray(dark, np.float64), np.asarray(base, np.float64)
        light = (frames - offset - low) / gain
        if self.uneven.any():
            x, y = picture_axes((frames.shape[1], frames.shape[2]))
            terms = uneven_terms(x, y[:, np.newaxis])
            light /= 1 + sum(factor * term for factor, term in zip(self.uneven, terms, strict=True))
        if self.gamma:
            light = self.full * np.maximum(light / self.full, 0) ** (1 / (1 + self.gamma))
        steady = start + (light + low - start - self.zenith_offset) / (1 + self.zenith_gain)
        return np.where(valid(frames), steady, np.nan).astype(np.float32)

    @property
    def process(self) -> dict[str, str]:
        """Entries of a result's process about the correction."""
        flicker, drift = float(np.std(self.gain)), _range(self.offset)
        sizes = {
            "flicker": (flicker > _SMALL_GAIN, f"{100 * flicker:.2g} %"),
            "drift": (drift > _SMALL_OFFSET * self.count, f"{drift:.2g} counts"),
        }
        return {name: f"{size}, corrected" for name, (large, size) in sizes.items() if large}


def mode_errors(modes: Doubles, normals: NDArray[np.floating], x: Doubles, y: Doubles) -> Doubles:
    """Return the errors of normals, (n, 3), along the meridian and across it, (M, 2, n) radians.

    ``x`` and ``y``, (n,), are places in the picture, from -1 to 1.
    """
    flat = np.hypot(normals[:, 0], normals[:, 1]).astype(np.float64)
    zenith = np.arctan2(flat, normals[:, 2])
    safe = np.maximum(flat, 1e-12)
    return np.asarray(modes @ _functions(zenith, normals[:, 0] / safe, normals[:, 1] / safe, x, y))


def light_sigma(normals: NDArray[np.floating], variance: tuple[float, float]) -> NDArray[np.float32]:
    """Return the standard deviation of normals, (..., 3), by modes; see `TurnNuisances.variance`."""
    base, rise = variance
    sine = 1 - normals[..., 2].astype(np.float64) ** 2
    return np.asarray(np.sqrt(np.maximum(base + rise * sine, 0)), np.float32)


def find_nuisances(
    samples: NDArray[Any],
    phase: Doubles,
    tilt: float,
    scale: Scale,
    grid: Grid,
    header: Header,
    informed: bool = True,
) -> TurnNuisances | None:
    """Return the nuisances of a rotation; None if there are too few frames, or no valid pixels.

    If too few pixels follow the model, as on a plate, everything stays as uncertain as its prior.

    Parameters
    ----------
    samples : ndarray, (T, n)
        Counts at a grid of pixels.
    phase : ndarray, (T,)
        Radians.
    tilt : float
        Half-angle of the precession, radians.
    scale : Scale
    grid : Grid
        Where the pixels are, row by row.
    header : Header
        Priors, or the standard deviations that it states.
    informed : bool
        Whether the samples are used, or the priors alone.
    """
    count = len(samples)
    if not _MIN_FRAMES <= count <= _MAX_FRAMES or count != len(phase):
        return None
    whole = valid(samples).all(axis=0)
    numbers = [np.broadcast_to(np.asarray(values, np.float64), whole.shape) for values in scale[:3]]
    whole &= np.isfinite(numbers).all(axis=0) & (numbers[0] != 0)
    if not whole.any():
        return None
    counts, (x, y) = samples[:, whole].astype(np.float64), (values[whole] for values in grid.places())
    gain, base, dark = (values[whole] for values in numbers)
    # Not by lstsq: the threads that it starts for many pixels wait for those of OpenCL.
    wave = np.linalg.pinv(basis(phase)) @ ((counts - base) / gain)
    seen = np.full((3, len(whole)), np.nan)
    seen[:, whole] = wave
    rise = grid.rise(seen[0], np.arctan2(seen[2], seen[1]))[whole]
    faces = (wave[0] > -tilt) & (wave[0] < _UPRIGHT)
    full = max(float(np.max(counts - dark)) if scale.bright is None else scale.bright, 1e-9)
    usable = shows_model(wave, np.min(counts - dark, axis=0), tilt, full)
    priors = _priors_of(header, phase, np.ndim(scale.gain) > 0, counts, grid.shift)

    def fit_to(part: NDArray[np.bool_]) -> _Fit:
        return _Fit(
            counts[:, part], phase, tilt, gain[part], base[part], dark[part], wave[:, part],
            (x[part], y[part]), rise[part], full, priors, header.prior("gamma") - 1,
        )  # fmt: skip

    usable, faces = (_thinned(part) for part in (usable, faces))
    try:
        return _found(fit_to, usable, faces, wave, tilt, informed)
    except np.linalg.LinAlgError:  # a tilt or a gain that no sensor has
        return None


def shows_model(
    wave: Doubles, least: Doubles, tilt: float, full: float, gentlest: float = _STEEP
) -> NDArray[np.bool_]:
    """Return the pixels at which the model holds, (...).

    ``wave`` is the wave of the zenith with the phase, (3, ...) radians: mean, cosine and sine. ``least`` is
    the light of the darkest frame, (...), and ``full`` full light, counts above the dark level. The least
    zenith is ``gentlest`` tilts.
    """
    swing = np.hypot(wave[1], wave[2]) / tilt
    usable = (wave[0] > gentlest * tilt) & (wave[0] < _UPRIGHT) & (swing > _SWING[0]) & (swing < _SWING[1])
    return np.asarray(usable & (least > LEAST_LIGHT * full))


def misfit_of(counts: Doubles, left: Doubles, phase: Doubles, unknowns: int, floor: float) -> float:
    """Return the variance of residuals of a fit, relative to that of any two waves a pixel.

    ``counts`` and ``left``, (T, n), are the samples and their residuals, ``unknowns`` is the number of those
    that the fit has for each pixel, and ``floor`` the least noise of a sample, counts. 0 for too few frames.
    """
    waves = np.linalg.qr(np.concatenate([basis(phase), basis(2 * phase)[:, 1:]], axis=1))[0]
    if len(phase) <= waves.shape[1] + 1:
        return 0.0
    scatter = counts - waves @ (waves.T @ counts)
    noise = float(np.median(np.sum(scatter**2, axis=0))) / (len(phase) - waves.shape[1])
    misfit = float(np.median(np.sum(left**2, axis=0))) / max(1, len(phase) - unknowns)
    return float(misfit / max(noise, floor**2))


def _found(
    fit_to: Callable[[NDArray[np.bool_]], _Fit],
    usable: NDArray[np.bool_],
    faces: NDArray[np.bool_],
    wave: Doubles,
    tilt: float,
    informed: bool,
) -> TurnNuisances | None:
    """Return the nuisances by usable pixels, or else, by those that face the camera, from priors alone."""
    fit = fit_to(usable) if informed and np.count_nonzero(usable) >= _MIN_PIXELS else None
    for _ in range(0 if fit is None else _ITERATIONS):
        assert fit is not None
        fit.keep(fit.misfit < _OUTLIER_RATIO * max(float(np.median(fit.misfit)), fit.floor))
        if fit.pixels < _MIN_PIXELS:
            break
        fit.improve()
        fit.widen()
    if fit is not None and fit.pixels >= _MIN_PIXELS and fit.follows_model:
        return fit.nuisances()
    if not faces.any():
        return None
    wave[0] = np.maximum(wave[0], _LEVEL * tilt)  # the model has no derivatives of level surfaces
    return fit_to(faces).nuisances(informed=False)


def _thinned(chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return every n-th of the chosen pixels, at most `_MOST_PIXELS`."""
    numbers = np.flatnonzero(chosen)
    thinned = np.zeros_like(chosen)
    thinned[numbers[:: max(1, -(-len(numbers) // _MOST_PIXELS))]] = True
    return thinned


def _priors_of(header: Header, phase: Doubles, has_map: bool, counts: Doubles, shift: float) -> Doubles:
    """Return the covariance of the nuisances: gains of T frames, offsets, `GLOBALS`, uneven light, swings.

    Uneven light is known if the zenith gain is a map.
    """
    frames = len(phase)
    offset = offset_prior(header, counts)
    uneven = 0.0 if has_map else header.prior("uneven_light_sigma")
    numbers = [header.prior(f"{name}_sigma") for name in GLOBALS]
    numbers[GLOBALS.index("zenith_offset")] = offset
    swings = [*_SWINGS, *[shift] * _SHIFTS]
    size = 2 * frames + len(numbers) + UNEVEN + len(swings)
    covariance = np.zeros((size, size))
    blocks = frame_priors(header, phase, offset)
    covariance[:frames, :frames], covariance[frames : 2 * frames, frames : 2 * frames] = blocks
    ends = np.square([*numbers, *[uneven] * UNEVEN, *swings])
    covariance[2 * frames :, 2 * frames :] = np.diag(ends)
    diagonal = np.einsum("ii->i", covariance)
    diagonal += _FLOOR * max(float(diagonal.max()), 1.0) * (diagonal == 0)
    return covariance


def offset_prior(header: Header, counts: Doubles) -> float:
    """Return the standard deviation of the zenith offset, counts; by default, counts of 8 bits."""
    offset = header.prior("zenith_offset_sigma")
    return offset if header.zenith_offset_sigma is not None else offset * count_of(counts)


def count_of(counts: Doubles) -> float:
    """Return a count of 8 bits in counts of a camera."""
    return max(1.0, float(np.ptp(counts)) / 255)


def frame_priors(header: Header, phase: Doubles, offset: float) -> tuple[Doubles, Doubles]:
    """Return the covariances of the gains and of the offsets of T frames, (T, T).

    The light of a frame may differ by chance, may drift, and may change with the phase: what moves with the
    body reflects it. ``offset`` is the standard deviation of the zenith offset, counts.
    """
    chance, ramp = np.eye(len(phase)), np.linspace(-0.5, 0.5, len(phase))
    wave, drift = basis(phase)[:, 1:], np.outer(ramp, ramp)
    gains = header.prior("frame_gain_sigma") ** 2 * (chance + _WAVE**2 * wave @ wave.T)
    return gains + header.prior("drift_sigma") ** 2 * drift, (_OFFSETS * offset) ** 2 * (chance + drift)


class _Equations(NamedTuple):
    """Normal equations of the nuisances after the normals are eliminated."""

    inverses: Doubles  # of the normals' matrices
    through: Doubles  # their products with the cross terms
    own: Doubles  # of the nuisances
    noise: float
    push: Doubles  # of the normals
    pull: Doubles  # of the nuisances, without normals


class _Fit:
    """Gauss-Newton fit of normals of pixels, and of the nuisances."""

    def __init__(
        self, counts: Doubles, phase: Doubles, tilt: float, gain: Doubles, base: Doubles, dark: Doubles,
        wave: Doubles, places: tuple[Doubles, Doubles], rise: Doubles, full: float, priors: Doubles,
        gamma: float,
    ) -> None:  # fmt: skip
        self._counts, self._phase, self._tilt, self._full = counts, phase[:, np.newaxis], tilt, full
        self._gain, self._base, self._dark = gain, base, dark
        self._zenith, self._azimuth = wave[0].copy(), np.arctan2(wave[2], wave[1])
        (self._x, self._y), self._rise = places, rise
        self._stated, self._priors = priors, priors.copy()
        self._stated_precision = np.linalg.inv(priors)
        self._precision = self._stated_precision.copy()
        self._scales: dict[int, float] = {}  # of the variances of nuisances, by group
        self._means = np.zeros(len(priors))
        self._means[2 * len(phase) + GLOBALS.index("gamma")] = gamma
        self._values = self._means.copy()
        self._count = count_of(counts)
        self.floor = _LEAST_NOISE * self._count
        self._look()

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return len(self._zenith)

    @property
    def misfit(self) -> Doubles:
        """RMS residual of each pixel, counts."""
        return np.asarray(np.sqrt(np.mean(self._left**2, axis=0)))

    @property
    def follows_model(self) -> bool:
        """Whether samples differ from the model hardly more than from any two waves a pixel."""
        return misfit_of(self._counts, self._left, self._phase[:, 0], 2, self.floor) < MAX_MISFIT

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Exclude the other pixels."""
        if chosen.all():
            return
        for name in ("_gain", "_base", "_dark", "_zenith", "_azimuth", "_x", "_y", "_rise"):
            setattr(self, name, getattr(self, name)[chosen])
        self._counts = self._counts[:, chosen]
        self._look()

    def _look(self) -> None:
        """Compute the residuals, and their derivatives by normals, (2, T, n), and nuisances, (K, T, n).

        Derivatives are those at normals without noise, as far as it can be told: to pixels of a plane, noise
        gives many directions, which seem to determine what the plane does not show.
        """
        self._equations: _Equations | None = None
        self._left, normal, *_ = self._parts(self._zenith, self._azimuth, all_derivatives=False)
        self._clear = self._without_noise(normal)
        _, self._by_normal, self._by_gain, self._by_rest = self._parts(*self._clear)

    def _without_noise(self, by_normal: Doubles) -> tuple[Doubles, Doubles]:
        """Return zeniths and azimuths whose scatter along each axis is that of the normals without noise."""
        if self.pixels < _MIN_PIXELS:
            return self._zenith, self._azimuth
        noise = self._noise
        variance = np.einsum("ati,bti->iab", by_normal, by_normal)
        variance[:, [0, 1], [0, 1]] *= 1 + 1e-12
        variance = noise * np.linalg.inv(variance)
        sine, turn = np.sin(self._zenith), np.stack([np.cos(self._azimuth), np.sin(self._azimuth)])
        flat = sine * turn
        across = np.stack([-turn[1], turn[0]])
        axes = np.stack([np.cos(self._zenith) * turn, across])  # (meridian or across it, x or y, n)
        own = np.median(np.einsum("api,iab,bqi->ipq", axes, variance, axes), axis=0)
        middle = np.median(flat, axis=1, keepdims=True)
        scatter, directions = np.linalg.eigh(np.cov(flat))
        of_noise = np.einsum("pk,pq,qk->k", directions, own, directions)
        kept = np.sqrt(np.maximum(1 - _NOISE * of_noise / np.maximum(scatter, 1e-30), 0))
        flat = middle + directions @ (kept[:, np.newaxis] * (directions.T @ (flat - middle)))
        return np.arcsin(np.minimum(np.hypot(*flat), 1.0)), np.arctan2(flat[1], flat[0])

    @property
    def _noise(self) -> float:
        """Variance of a sample."""
        freedom = max(1, self._left.size - 2 * self.pixels - 2 * len(self._counts))
        return max(float(np.sum(self._left**2)) / freedom, self.floor**2)

    def _parts(
        self, zenith: Doubles, azimuth: Doubles, all_derivatives: bool = True
    ) -> tuple[Doubles, Doubles, Doubles, Doubles]:
        """Return the residuals for normals, and their derivatives by normals, gains and other nuisances.

        The last ones are empty unless all are asked for.
        """
        frames = len(self._counts)
        gains, offsets = self._values[:frames, np.newaxis], self._values[frames : 2 * frames, np.newaxis]
        values, swings = np.split(self._values[2 * frames :], [len(GLOBALS) + UNEVEN])
        half, shift = (values[GLOBALS.index(name)] for name in ("tilt", "phase"))
        half = self._tilt * (1 + half)
        angles = AxisAngles.of(zenith, azimuth, self._phase + shift, math.sin(half), math.cos(half))
        places = np.stack(uneven_terms(self._x, self._y))
        steepness = self._zenith - np.mean(self._zenith)
        steepness /= max(float(np.std(steepness)), _LEAST_SPREAD)
        powers = np.stack([np.ones_like(steepness), steepness, steepness**2])
        patterns = np.concatenate([powers, places, powers * self._rise / self._tilt])
        swing = angles.angle - np.mean(angles.angle, axis=0)
        scale = PixelScale(self._gain, self._base, self._dark, self._full)
        seen = light_of(
            angles, (swings @ patterns) * swing, scale, gains, offsets, values, places, all_derivatives
        )
        left = self._counts - self._dark - seen.light
        by_normal = np.stack([seen.by_angle * angles.by_zenith, seen.by_angle * angles.by_azimuth])
        if not all_derivatives:
            return left, by_normal, seen.by_gain, seen.by_globals
        seen.by_globals[GLOBALS.index("tilt")] *= self._tilt
        by_swings = seen.by_angle * swing * patterns[:, np.newaxis]
        return left, by_normal, seen.by_gain, np.concatenate([seen.by_globals, by_swings])

    def _normal_equations(self) -> _Equations:
        """Return what the samples say of the nuisances at the present normals, which keep it."""
        if self._equations is not None:
            return self._equations
        noise = self._noise
        sums = Sums.of(self._left, self._by_normal, self._by_gain, self._by_rest)
        matrices, cross, own = sums.matrices, sums.cross, sums.own
        matrices[:, [0, 1], [0, 1]] += 1e-12 * np.trace(matrices, axis1=1, axis2=2)[:, np.newaxis]
        inverses: Doubles = np.asarray(np.linalg.inv(matrices), np.float64)
        through = inverses @ cross
        # Not by products of matrices: the threads that they start wait for those of OpenCL.
        own -= np.einsum("nk,nl->kl", cross.reshape(-1, len(own)), through.reshape(-1, len(own)))
        pull = sums.pull - np.einsum("iak,ia->k", through, sums.push)
        self._equations = _Equations(inverses, through, own, noise, sums.push, pull)
        return self._equations

    def improve(self) -> None:
        """Do one step."""
        inverses, through, own, noise, push, pull = self._normal_equations()
        pull = pull - noise * (self._precision @ (self._values - self._means))
        step = np.linalg.solve(own + noise * self._precision, pull)
        turn = np.einsum("iab,ib->ia", inverses, push) - through @ step
        self._values += step
        self._zenith += turn[:, 0]
        self._azimuth += turn[:, 1] / np.maximum(np.sin(self._zenith), 1e-3)
        self._look()

    def widen(self) -> None:
        """Widen the priors of gains, of offsets, of swings and of the rest as far as the pixels show more.

        The scale is that of greatest evidence (MacKay 1992): the sum of squares of estimates, relative to the
        prior, over the number of those that the pixels determine.
        """
        _, _, own, noise, *_ = self._normal_equations()
        covariance, frames = np.linalg.inv(own / noise + self._precision), len(self._counts)
        ends = 0, frames, 2 * frames, len(own) - _SWINGING, len(own)
        for part in itertools.starmap(slice, itertools.pairwise(ends)):
            prior = self._stated_precision[part, part]  # of a group, which others do not depend on
            scale = self._scales.get(part.start, 1.0)
            determined = len(prior) - float(np.sum(prior * covariance[part, part])) / scale
            away = self._values[part] - self._means[part]
            size = float(away @ prior @ away)
            if determined > 1:
                self._scales[part.start] = scale = min(max(1.0, size / determined), _WIDEST)
            self._priors[part, part] = scale * self._stated[part, part]
            self._precision[part, part] = prior / scale

    def nuisances(self, informed: bool = True) -> TurnNuisances:
        """Return the estimates, and what remains; unless ``informed``, only the priors are used."""
        inverses, through, own, noise, *_ = self._normal_equations()
        if not informed:
            own = np.zeros_like(own)
        covariance = np.linalg.inv(own / noise + self._precision)
        covariance = (covariance + covariance.T) / 2
        frames, values = self._counts.shape[0], self._values
        removable = np.ones(len(values), bool)
        removable[2 * frames + GLOBALS.index("tilt") : 2 * frames + len(GLOBALS)] = False
        removable[-_SWINGING:] = False
        effect = through @ np.where(removable, values, 0.0)  # (n, 2)
        own_error = math.sqrt(noise * float(np.median(np.trace(inverses, axis1=1, axis2=2))))
        # The swing of a pixel's area is that of a bent surface, whose errors are the pixels' own.
        named = slice(0, len(values) - _SWINGING)
        sizes = np.sqrt(np.maximum(np.diag(covariance)[named], 1e-300))
        scaled = covariance[named, named] / np.multiply.outer(sizes, sizes) + _ROUNDING * np.eye(len(sizes))
        common = through[:, :, named] @ (sizes[:, np.newaxis] * np.linalg.cholesky(scaled))
        size = math.sqrt(float(np.mean(np.sum(effect**2, axis=1))))
        products = gram(through.reshape(-1, len(values)))
        both = np.ix_(removable, removable)
        spread = math.sqrt(max(float(np.sum(products[both] * covariance[both])) / len(through), 0.0))
        worth = size > max(_CLEAR * spread, _WORTH * own_error)
        kept = (np.where(removable, 0.0, values) if worth else values)[named]
        errors = np.concatenate([common, (through[:, :, named] @ kept)[:, :, np.newaxis]], axis=2)
        modes, variance = self._modes(errors)
        gains, offsets = values[:frames], values[frames : 2 * frames]
        gamma, gain, offset = values[2 * frames :][:3]
        uneven = values[2 * frames + len(GLOBALS) :][:UNEVEN]
        return TurnNuisances(
            1 + gains, offsets.copy(), float(gamma), float(gain), float(offset),
            uneven.copy(), self._full, self._count, modes, variance, worth,
            self._unknown(products, covariance, own_error), self._is_odd(covariance),
        )  # fmt: skip

    def _modes(self, errors: Doubles) -> tuple[Doubles, tuple[float, float]]:
        """Return the largest modes of errors, (n, 2, k), and their variance by the zenith."""
        count, _, kinds = errors.shape
        lines = errors.reshape(-1, kinds)
        squares, directions = _largest(gram(lines))
        kept = squares > max(_SMALL_MODE * squares[-1], 0.0)
        kept[:-_MOST_MODES] = False
        parts = np.einsum("nk,km->nm", lines, directions[:, kept]).reshape(count, 2, -1)
        zenith, azimuth = self._clear
        functions = _functions(zenith, np.cos(azimuth), np.sin(azimuth), self._x, self._y)
        values, vectors = np.linalg.eigh(gram(functions.T))
        inverse = np.where(values > _CONDITION**2 * values[-1], 1 / np.maximum(values, 1e-300), 0.0)
        inverted = np.einsum("pq,q,rq->pr", vectors, inverse, vectors)
        modes = np.einsum("nam,pn,pr->amr", parts, functions, inverted, optimize=True)  # (2, M, terms)
        total = np.sum(lines**2, axis=1).reshape(count, 2).sum(axis=1)
        sine = np.sin(zenith) ** 2
        if np.ptp(sine) > 1e-6:
            rise, base = np.polyfit(sine, total, 1)
        else:
            rise, base = float(np.mean(total) / np.mean(sine)), 0.0
        if base < 0 or rise < 0:
            rise, base = float(np.mean(total) / np.mean(sine)), 0.0
        return np.ascontiguousarray(np.moveaxis(modes, 1, 0)), (float(base), float(rise))

    def _is_odd(self, covariance: Doubles) -> bool:
        """Return whether gamma differs from 1, and the swing by zenith does not contradict it."""
        gamma, steepness = 2 * len(self._counts), len(self._values) - _SWINGING + 1
        value, swing = self._values[gamma] - self._means[gamma], self._values[steepness]
        error = math.sqrt(covariance[steepness, steepness])
        least = max(_ODD_GAMMA * math.sqrt(self._stated[gamma, gamma]), _LEAST_GAMMA)
        least = max(least, _CLEAR * math.sqrt(covariance[gamma, gamma]))
        if abs(value) > least and not (value * swing < 0 and abs(swing) > _CLEAR * error):
            return True
        # An area makes swings larger on steep surfaces, as they are less bent than tops: never smaller.
        return bool(value < 0 and swing < -_CLEAR_SWING * error)

    def _unknown(self, products: Doubles, covariance: Doubles, own_error: float) -> tuple[str, ...]:
        """Return the names of nuisances that the object shows hardly better than their priors."""
        frames = self._counts.shape[0]
        parts = {"light of the frames": slice(0, frames), "dark level": slice(frames, 2 * frames)}
        for number, name in enumerate(GLOBALS):
            parts[name.replace("_", " ")] = slice(2 * frames + number, 2 * frames + number + 1)
        parts["uneven light"] = slice(2 * frames + len(GLOBALS), len(self._values) - _SWINGING)
        sizes = {}
        for name, part in parts.items():
            before = float(np.sum(products[part, part] * self._priors[part, part]))
            after = float(np.sum(products[part, part] * covariance[part, part]))
            if after > max(before / 4, self.pixels * (_RELEVANT * own_error) ** 2):
                sizes[name] = after
        largest = max(sizes.values(), default=0.0)
        ordered = sorted(sizes, key=lambda name: -sizes[name])
        return tuple(name for name in ordered if sizes[name] > largest / 4)


def _largest(square: Doubles) -> tuple[Doubles, Doubles]:
    """Return the largest eigenvalues of a matrix, in ascending order, and their vectors, by powers of it.

    `numpy.linalg.eigh` of more than 32 rows starts threads, which wait for those of OpenCL.
    """
    kept = np.argsort(-np.diag(square))[: 2 * _MOST_MODES]
    vectors = square[:, kept]
    for _ in range(_POWERS):
        vectors = square @ np.linalg.qr(vectors)[0]
    axes = np.linalg.qr(vectors)[0]
    values, turned = np.linalg.eigh(axes.T @ square @ axes)
    return values, axes @ turned


def _functions(zenith: Doubles, cosine: Doubles, sine: Doubles, x: Doubles, y: Doubles) -> Doubles:
    """Return the functions of zenith, azimuth and place that modes are sums of, (25, n)."""
    one = np.ones_like(zenith)
    powers = one, zenith, zenith**2
    turns = one, cosine, sine, cosine**2 - sine**2, 2 * cosine * sine
    terms = [power * turn for power in powers for turn in turns]
    terms += [power * place for power in powers[:2] for place in uneven_terms(x, y)]
    return np.stack(terms)


def _range(offset: Doubles) -> float:
    """Return the range of smoothed offsets."""
    parts = [float(np.mean(part)) for part in np.array_split(offset, 4)]
    return max(parts) - min(parts)
