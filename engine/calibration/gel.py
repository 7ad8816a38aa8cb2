"""How the gel gives way, learned from presses of a ball of known size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, optimize

from mirrorskin.engine.integration.validation import check_pixel_size
from mirrorskin.engine.press.elastic import threshold_at
from mirrorskin.io import Gel, InputError, Result, Source, pixel_axes

Doubles = NDArray[np.float64]

_NODES = 24
_THINNEST = 1e-3  # radii of the ball: the depth of a mirror on the very surface


def sphere_travel(touch: ArrayLike, radius: float, compliance: float = 0.0) -> Doubles:
    """Return how far a ball must be pressed for a touch of some radius, mm.

    The depth is ``a artanh(a / R)``, and the force over Young's modulus ``4/3 ((a^2 + R^2) artanh(a / R) -
    a R)``, by which the stage gives way as well (Sneddon, Int. J. Eng. Sci. 3, 1965, 47-57, at Poisson ratio
    0.5).
    """
    a = np.asarray(touch, np.float64)
    steep = np.arctanh(a / radius)
    return np.asarray(a * steep + compliance * 4 / 3 * ((a**2 + radius**2) * steep - a * radius))


def sphere_slope(distance: ArrayLike, touch: ArrayLike, radius: float, sheet: float = 0.0) -> Doubles:
    """Return how steep the mirror is under a ball and around it.

    A ball's press is one of flat punches of growing radius x, each pressed on by g'(x) dx, g(x) = x
    artanh(x / R). Of a punch pressed by 1 the harmonic continuation of the surface's displacement to the
    depth z is ::

        U = 2 / pi arcsin(2 x / (sqrt((r - x)^2 + z^2) + sqrt((r + x)^2 + z^2)))

    and the displacement of an incompressible body is U - z dU/dz (Johnson, Contact Mechanics, 1985, 3.8).
    """
    r, a = np.broadcast_arrays(np.asarray(distance, np.float64), np.asarray(touch, np.float64))
    depth = max(sheet, _THINNEST * radius)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    share, weights = (nodes + 1) / 2, weights / 2
    near, rest = np.minimum(r, a)[..., np.newaxis], np.maximum(a - r, 0.0)[..., np.newaxis]
    # Punches about as wide as the place is far make its slope: nodes crowd there.
    x = np.concatenate([near - near * share**2, near + rest * share**2], axis=-1)
    width = np.concatenate([2 * near * share * weights, 2 * rest * share * weights], axis=-1)
    part = x / radius
    pressed = width * (np.arctanh(part) + part / (1 - part**2))
    delay = depth / 2
    below, here, above = (_punch_slope(r[..., np.newaxis], x, depth + step) for step in (delay, 0.0, -delay))
    return np.asarray(np.sum(pressed * (here - depth * (below - above) / (2 * delay)), axis=-1))


def _punch_slope(r: Doubles, x: Doubles, z: float) -> Doubles:
    """Return -dU/dr of a punch of radius x, 1/mm."""
    inner, outer = np.hypot(r - x, z), np.hypot(r + x, z)
    mean = (inner + outer) / 2
    rise = ((r - x) / inner + (r + x) / outer) / 2
    return np.asarray(2 / np.pi * x * rise / (mean * np.sqrt(np.maximum(mean**2 - x**2, 0.0))))


_LIT, _DARK = 1, 2  # of an onset's status
_RIM = 0.1  # square of a rim pixel's error, by its circumference
_MOST = 600  # pixels of a press that are looked at
_FEWEST = 50


@dataclass(frozen=True, slots=True, eq=False)
class BallOnset:
    """When a ball pressed into the sheet turned pixels light.

    Attributes
    ----------
    travel : ndarray, (n,), float64
        At the onset of each pixel that turned light, mm.
    sigma : ndarray, (n,), float64
        Its standard deviation, mm.
    x, y : ndarray, (n,), float64
        The pixel's place, mm.
    radius : float
        Of the ball, mm.
    inner, inner_sigma : float
        Radius of the ball's dark top, mm, and its standard error; NaN where it was not seen whole.
    """

    travel: Doubles
    sigma: Doubles
    x: Doubles
    y: Doubles
    radius: float
    inner: float = math.nan
    inner_sigma: float = math.nan


def ball_onset(result: Result, source: Source, radius: float) -> BallOnset:
    """Take from the reconstruction of a ball's press, not corrected, when its pixels turned light.

    Parameters
    ----------
    result : Result
        With height, its sigma and status.
    source : Source
        Which tells the pixels' size.
    radius : float
        Of the ball, mm.

    Raises
    ------
    mirrorskin.io.InputError
        It is no press, has no pixel size, or less than 50 pixels turned light.
    """
    if result.status is None or result.height is None or result.height_sigma is None:
        raise InputError(f"{source.name} is no press: give a vertical recording of a ball")
    if source.header.pixel_size is None:
        raise InputError(f"{source.name} has no pixel size: calibrate the scale first, or give --pixel-size")
    return ball_pixels(
        result.height, result.height_sigma, result.status, source.header.pixel_size, radius, source.name
    )


def ball_pixels(
    height: ArrayLike,
    sigma: ArrayLike,
    status: ArrayLike,
    pixel_size: ArrayLike,
    radius: float,
    name: str = "the press",
) -> BallOnset:
    """Take from maps of a ball's press, as ``find_onset`` gives them, when its pixels turned light."""
    if not (math.isfinite(radius) and radius > 0):
        raise InputError(f"a ball of radius {radius:g} mm cannot be: give one above 0")
    heights, sigmas = np.asarray(height, np.float64), np.asarray(sigma, np.float64)
    lit = np.flatnonzero((np.asarray(status) == _LIT) & np.isfinite(heights))
    if len(lit) < _FEWEST:
        raise InputError(
            f"{name}: {len(lit)} pixels turned light, too few to learn from: press the ball deeper"
        )
    some = lit[:: math.ceil(len(lit) / _MOST)]
    size = check_pixel_size(pixel_size)
    x, y = np.meshgrid(*pixel_axes(heights.shape, size))
    parts = (-heights, np.broadcast_to(sigmas, heights.shape), x, y)
    travel, spread, across, up = (part.ravel()[some].astype(np.float64) for part in parts)
    return BallOnset(travel, spread, across, up, radius, *_dark_top(np.asarray(status), size))


def _dark_top(status: NDArray[Any], size: tuple[float, float]) -> tuple[float, float]:
    """Return the radius of the largest dark patch that light surrounds, and its standard error, mm."""
    lit = ndimage.binary_closing(np.pad(status == _LIT, 1), np.ones((3, 3), bool))[1:-1, 1:-1]
    patches, count = ndimage.label(ndimage.binary_fill_holes(lit) & ~lit)
    if count == 0:
        return math.nan, math.nan
    largest = patches == 1 + np.argmax(np.bincount(patches.ravel())[1:])
    area = float(np.count_nonzero(largest & (status == _DARK))) * size[0] * size[1]
    radius = math.sqrt(area / math.pi)
    # The rim falls at random within a pixel, in as many places as it has pixels.
    pixel = max(size)
    return radius, pixel * math.sqrt(_RIM * pixel / max(radius, pixel))


_INDEPENDENT = 200  # pixels of a press that err each for itself: neighbours err alike
_AROUND = 24  # directions in which a dark top's rim is looked at
_TRIES = 40
_DEPTHS = 400  # in a table of travels
_WIDEST = 0.999  # radii of the ball that the touch can be wide
_SLOPE_ERROR = 0.003  # of the sheet, that the theory may be wrong by
_TRAVEL_ERROR = 0.004  # mm, of onsets between two frames, at least
_DELAY = 1e-3  # mm of travel, to see how fast slopes rise
_LEAST_RATE = 0.05  # 1/mm: below it the sheet touches already, and turns light by chance
_DIGITS = 8  # of 1/mm: what lies next to the bound at 0 is 0
_WORST = {"threshold": 0.01, "compliance": 0.02, "curvature": 0.02}
"""Standard errors beyond which a press does not tell a number: radians, 1/mm and 1/mm."""

_SHARED = ("threshold", "compliance", "curvature")
_LATER = np.linspace(-0.1, 0.2, 13)  # radii of the ball by which it may be met later than it seems
_START = (0.2, 0.005, 0.03)
_BOUNDS = ((0.02, 0.0, 0.0), (0.78, 2.0, 0.2))


@dataclass(frozen=True, slots=True)
class BallPlace:
    """Where a ball was found."""

    x: float  # Of its centre, mm
    y: float  # Of its centre, mm
    travel_zero: float  # Travel at which the sheet met its top, mm
    pixels: int  # That were looked at


@dataclass(frozen=True, slots=True, eq=False)
class LearnedGel:
    """What balls tell of a gel.

    Attributes
    ----------
    gel : Gel
    places : tuple of BallPlace
    untold : tuple of str
        Numbers that the presses do not tell, and which were left at 0: "compliance", "curvature".
    """

    gel: Gel
    places: tuple[BallPlace, ...]
    untold: tuple[str, ...]


def fit_gel(
    presses: Sequence[BallOnset], axis: tuple[float, float] = (0.0, 0.0), sheet: float = 0.05
) -> LearnedGel:
    """Find what gel turns light as balls of known radius showed.

    At a pixel's onset the sheet is as steep there as the threshold (see `threshold_at`). How steep it is, is
    known in closed form of a ball (`sphere_slope`). Found are the threshold on the wall's axis, the wall's
    curvature, the stage's compliance, and of each press the ball's place and the travel at which it was met,
    by robust least squares over all pixels. What of compliance and curvature the presses do not tell is 0.

    The ball's height over the stage's zero and that zero are one number: only together are they told.

    Parameters
    ----------
    presses : sequence of BallOnset
        One or more; of different balls, or in different places, they tell more.
    axis : (float, float)
        Where the wall's axis meets the picture, mm.
    sheet : float
        How thick what lies between the mirror and the ball is, mm.

    Returns
    -------
    LearnedGel

    Raises
    ------
    mirrorskin.io.InputError
        There is no press, or the presses do not tell the threshold.
    """
    if not presses:
        raise InputError("a gel is learned from a ball: give at least one press")
    told = list(_SHARED)
    while True:
        fit = _Fit(presses, axis, sheet, tuple(told))
        values, errors = fit.solve()
        worst = {name: errors[name] / most for name, most in _WORST.items() if name in told}
        name = max(worst, key=lambda one: (worst[one], one))
        if worst[name] <= 1:
            break
        if told == ["threshold"]:
            raise InputError(
                f"the presses leave the zenith that turns pixels light uncertain by"
                f" {math.degrees(errors['threshold']):.1f} degrees: press the ball deeper, in smaller steps"
            )
        told.remove(name if name != "threshold" else told[-1])
    places = fit.places()
    gel = Gel(
        threshold=values["threshold"],
        compliance=round(values["compliance"], _DIGITS),
        curvature=round(values["curvature"], _DIGITS),
        axis=axis,
        travel_zero=places[0].travel_zero,
        error=fit.height_error(),
        sigma=errors,
    )
    return LearnedGel(gel, places, tuple(name for name in _SHARED if name not in told))


class _Model(NamedTuple):
    """What is supposed: numbers of all presses, and x, y and travel zero of each."""

    threshold: float
    compliance: float
    curvature: float
    places: Doubles


class _Fit:
    """The search for a gel's numbers, some of which may be left at 0."""

    def __init__(
        self,
        presses: Sequence[BallOnset],
        axis: tuple[float, float],
        sheet: float,
        told: tuple[str, ...],
    ) -> None:
        self._presses, self._axis, self._sheet, self._told = presses, axis, sheet, told
        self._start, self._low, self._high = self._range()
        self._solution = self._begin()
        self._rates = [self._rate(press, number) for number, press in enumerate(presses)]

    def solve(self) -> tuple[dict[str, float], dict[str, float]]:
        """Return the shared numbers and their standard errors."""
        for _ in range(2):  # how fast slopes rise is told better by what was found
            found = optimize.least_squares(
                self._residuals,
                self._solution,
                bounds=(self._low, self._high),
                x_scale=np.where(np.arange(len(self._solution)) < len(self._told), 0.05, 0.2),
                loss="soft_l1",
                ftol=1e-6,
                max_nfev=_TRIES,
            )
            self._solution = np.clip(found.x, self._low + 1e-9, self._high - 1e-9)
            self._rates = [self._rate(press, number) for number, press in enumerate(self._presses)]
        count = sum(len(press.travel) for press in self._presses)
        share = max(1.0, count / (_INDEPENDENT * len(self._presses)))
        worse = max(1.0, 2 * found.cost / count)
        errors = np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)) * worse * share)
        model = self._model(self._solution)
        values = {name: float(getattr(model, name)) for name in _SHARED}
        numbers = dict(zip(self._told, errors.tolist(), strict=False))
        numbers["travel_zero"] = float(errors[len(self._told) + 2])
        return values, numbers

    def places(self) -> tuple[BallPlace, ...]:
        """Return where the balls were found."""
        model = self._model(self._solution)
        return tuple(
            BallPlace(float(place[0]), float(place[1]), float(place[2]), len(press.travel))
            for place, press in zip(model.places, self._presses, strict=True)
        )

    def height_error(self) -> float:
        """Return the usual error of a height that is left, mm."""
        model = self._model(self._solution)
        left = [
            self._missing(press, model, number)[rate > _LEAST_RATE] / rate[rate > _LEAST_RATE]
            for number, (press, rate) in enumerate(zip(self._presses, self._rates, strict=True))
        ]
        all_left = np.concatenate(left)
        return 1.4826 * float(np.median(np.abs(all_left))) if all_left.size else 0.0

    def _range(self) -> tuple[Doubles, Doubles, Doubles]:
        """Return where to begin, and the bounds."""
        chosen = [_SHARED.index(name) for name in self._told]
        start, low, high = ([row[index] for index in chosen] for row in (_START, *_BOUNDS))
        for press in self._presses:
            x, y = float(np.median(press.x)), float(np.median(press.y))
            r = np.hypot(press.x - x, press.y - y)
            seen = press.inner if math.isfinite(press.inner) else float(np.quantile(r, 0.05))
            inner = min(seen, 0.7 * press.radius)
            zero = float(np.median(press.travel[r <= np.quantile(r, 0.1)])) - float(
                sphere_travel(inner, press.radius)
            )
            start += [x, y, zero]
            low += [x - press.radius, y - press.radius, zero - press.radius]
            high += [x + press.radius, y + press.radius, zero + press.radius]
            if press is self._presses[0]:
                start[0] = float(np.clip(math.asin(inner / press.radius), low[0] * 1.1, high[0] * 0.9))
        return np.array(start), np.array(low), np.array(high)

    def _begin(self) -> Doubles:
        """Return the start with each ball met when the slopes at onsets fit best.

        Met too soon, the sheet would touch everywhere at the onsets, and nothing would lead out of that.
        """
        best = self._start.copy()
        for number, press in enumerate(self._presses):
            place = len(self._told) + 3 * number + 2
            costs = []
            for later in _LATER * press.radius:
                tried = self._start.copy()
                tried[place] += later
                costs.append(float(np.mean(np.abs(self._missing(press, self._model(tried), number)))))
            best[place] += _LATER[int(np.argmin(costs))] * press.radius
        return best

    def _model(self, parameters: Doubles) -> _Model:
        count = len(self._told)
        shared = dict.fromkeys(_SHARED, 0.0) | dict(zip(self._told, parameters[:count].tolist(), strict=True))
        return _Model(**shared, places=parameters[count:].reshape(-1, 3))

    def _residuals(self, parameters: Doubles) -> Doubles:
        model = self._model(parameters)
        parts = []
        for number, (press, rate) in enumerate(zip(self._presses, self._rates, strict=True)):
            error = np.hypot(_SLOPE_ERROR, rate * np.maximum(press.sigma, _TRAVEL_ERROR))
            parts.append(self._missing(press, model, number) / error)
            if math.isfinite(press.inner):
                parts.append(np.array([self._top(press, model, number)]) * math.sqrt(self._weight(press)))
        return np.concatenate(parts)

    def _missing(self, press: BallOnset, model: _Model, number: int, later: float = 0.0) -> Doubles:
        """Return by how much the sheet is steeper at onsets, or a little later, than the threshold."""
        x, y, zero = model.places[number]
        across, up = press.x - x, press.y - y
        touches = np.linspace(0.0, _WIDEST * press.radius, _DEPTHS)
        travels = sphere_travel(touches, press.radius, model.compliance)
        touch = np.interp(press.travel + later - zero, travels, touches)
        gel = Gel(model.threshold, model.compliance, model.curvature, self._axis)
        zenith = threshold_at(gel, press.x, press.y, np.arctan2(up, across))
        steep = sphere_slope(np.hypot(across, up), touch, press.radius, self._sheet)
        return np.asarray(steep - np.tan(np.where(np.isfinite(zenith), zenith, model.threshold)))

    def _top(self, press: BallOnset, model: _Model, number: int) -> float:
        """Return by how many standard errors the ball's slope at its dark top's rim misses the threshold.

        The sheet lies on the ball there, and how it gives way does not matter.
        """
        azimuth = np.linspace(0, 2 * math.pi, _AROUND, endpoint=False)
        x, y, _ = model.places[number]
        gel = Gel(model.threshold, model.compliance, model.curvature, self._axis)
        at = x + press.inner * np.cos(azimuth), y + press.inner * np.sin(azimuth)
        zenith = math.asin(min(press.inner / press.radius, _WIDEST))
        error = math.hypot(_SLOPE_ERROR, press.inner_sigma / press.radius)
        return float(np.nanmean(zenith - threshold_at(gel, *at, azimuth))) / error

    def _weight(self, press: BallOnset) -> float:
        """Tell as how many pixels a dark top counts: as what all pixels tell is told by few of them."""
        return max(1.0, len(press.travel) / _INDEPENDENT)

    def _rate(self, press: BallOnset, number: int) -> Doubles:
        """Return how fast slopes rise at onsets, 1/mm."""
        model = self._model(self._solution)
        ahead, now = (self._missing(press, model, number, later) for later in (_DELAY, 0.0))
        return np.maximum((ahead - now) / _DELAY, 0.0)
