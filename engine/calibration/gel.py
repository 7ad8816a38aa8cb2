"""The elastomer's compliance and the threshold of light, found from presses of a ball of known size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.integration.validation import check_pixel_size
from mirrorskin.engine.press.elastic import threshold_at
from mirrorskin.io import Gel, InputError, Result, Source, pixel_axes
from mirrorskin.io.maps import PressStatus

Doubles = NDArray[np.float64]

_NODES = 24
_THINNEST = 1e-3  # radii of the ball: the depth of a mirror on the very surface

_RIM = 0.1  # square of a rim pixel's error, by its circumference
_MOST = 600  # pixels of a press that are used
_FEWEST = 50

_SHARED = ("threshold", "compliance", "curvature")  # numbers that all presses have in common:
_START = (0.2, 0.005, 0.03)
_BOUNDS = ((0.02, 0.0, 0.0), (0.78, 2.0, 0.2))
_WORST = (0.01, 0.02, 0.02)  # standard errors above which they are not determined
_LATER = np.linspace(-0.1, 0.2, 13)  # radii of the ball by which it may be met later than it seems
_INDEPENDENT = 200  # pixels of a press with independent errors
_AROUND = 24  # directions in which a dark top's rim is looked at
_STEPS = 40
_TABLE = 400  # entries of a table of travels
_WIDEST = 0.999  # radii of the ball that the touch can be wide
_SLOPE_ERROR = 0.003  # of the sheet, that the theory may be wrong by
_TRAVEL_ERROR = 0.004  # mm, of onsets between two frames, at least
_DELAY = 1e-3  # mm of travel, of differences
_LEAST_RATE = 0.05  # 1/mm: below it the sheet touches already, and turns light by chance
_DIGITS = 8  # of 1/mm: what lies next to the bound at 0 is 0


def sphere_travel(touch: ArrayLike, radius: float, compliance: float = 0.0) -> Doubles:
    """Return how far a ball of a radius R must be pressed for a touch of radius a < R, mm.

    The depth is ``a artanh(a / R)``, and the force over Young's modulus ``4/3 ((a^2 + R^2) artanh(a / R) -
    a R)``, by which the stage gives way as well, its compliance times that (Sneddon, Int. J. Eng. Sci. 3,
    1965, 47-57, at Poisson ratio 0.5).

    Examples
    --------
    >>> float(sphere_travel(1.0, 2.0).round(3))
    0.549
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


@dataclass(frozen=True, slots=True, eq=False)
class BallOnset:
    """When a ball pressed into the sheet turned n pixels light; all in mm."""

    travel: Doubles  # (n,): at the onset
    sigma: Doubles  # (n,): its standard deviation
    x: Doubles  # (n,)
    y: Doubles  # (n,)
    radius: float  # of the ball
    inner: float = math.nan  # radius of the ball's dark top; NaN where it was not seen whole
    inner_sigma: float = math.nan


def ball_onset(result: Result, source: Source, radius: float) -> BallOnset:
    """Return when pixels turned light in the uncorrected reconstruction of a ball's press; radius in mm.

    InputError where it is no press, has no pixel size, or less than 50 pixels turned light.
    """
    from scipy import ndimage

    height, sigma, status = result.height, result.height_sigma, result.status
    if status is None or height is None or sigma is None:
        raise InputError(f"{source.name} is no press: give a vertical recording of a ball")
    if source.header.pixel_size is None:
        raise InputError(f"{source.name} has no pixel size: calibrate the scale first, or give --pixel-size")
    if not (math.isfinite(radius) and radius > 0):
        raise InputError(f"a ball of radius {radius:g} mm cannot be: give one above 0")
    lit = np.flatnonzero((status == PressStatus.ONSET) & np.isfinite(height))
    if len(lit) < _FEWEST:
        raise InputError(
            f"{source.name}: {len(lit)} pixels turned light, too few to learn from: press the ball deeper"
        )
    some = lit[:: math.ceil(len(lit) / _MOST)]
    size = check_pixel_size(source.header.pixel_size)
    x, y = np.meshgrid(*pixel_axes((height.shape[0], height.shape[1]), size))
    travel, error, across, up = (part.ravel()[some].astype(np.float64) for part in (-height, sigma, x, y))
    # The dark top is the largest dark patch that light surrounds.
    closed = ndimage.binary_closing(np.pad(status == PressStatus.ONSET, 1), np.ones((3, 3), bool))[1:-1, 1:-1]
    patches, count = ndimage.label(ndimage.binary_fill_holes(closed) & ~closed)
    if count == 0:
        return BallOnset(travel, error, across, up, radius)
    largest = patches == 1 + np.argmax(np.bincount(patches.ravel())[1:])
    area = float(np.count_nonzero(largest & (status == PressStatus.NEVER_LIGHT))) * size[0] * size[1]
    inner = math.sqrt(area / math.pi)
    # The rim falls at random within a pixel, in as many places as it has pixels.
    pixel = max(size)
    inner_sigma = pixel * math.sqrt(_RIM * pixel / max(inner, pixel))
    return BallOnset(travel, error, across, up, radius, inner, inner_sigma)


@dataclass(frozen=True, slots=True)
class BallPlace:
    """Where a ball was found, mm."""

    x: float
    y: float
    travel_zero: float  # travel at which the sheet met its top
    pixels: int  # that were used


@dataclass(frozen=True, slots=True, eq=False)
class GelFit:
    """What balls show of a gel; ``undetermined`` names the numbers that were left at 0."""

    gel: Gel
    places: tuple[BallPlace, ...]
    undetermined: tuple[str, ...]


def fit_gel(
    presses: Sequence[BallOnset], axis: tuple[float, float] = (0.0, 0.0), sheet: float = 0.05
) -> GelFit:
    """Find the gel that turns light as balls of known radius showed.

    At a pixel's onset the sheet is as steep there as the threshold (see `threshold_at`). How steep it is, is
    known in closed form of a ball (`sphere_slope`). Found are the threshold on the wall's axis, the wall's
    curvature, the stage's compliance, and of each press the ball's place and the travel at which it was met,
    by robust least squares over all pixels. Compliance and curvature that are not determined are 0. The
    ball's height over the stage's zero and that zero are one number. ``axis`` is the wall's in the picture,
    and ``sheet`` the thickness of what lies between mirror and ball, mm. More presses, of different balls or
    places, determine more; InputError where they do not determine the threshold.
    """
    if not presses:
        raise InputError("a gel is learned from a ball: give at least one press")
    free = list(_SHARED)
    while True:
        fit = _Fit(presses, axis, sheet, tuple(free))
        gel, errors = fit.solve()
        ratio = {
            name: errors[name] / worst for name, worst in zip(_SHARED, _WORST, strict=True) if name in free
        }
        name = max(ratio, key=lambda one: (ratio[one], one))
        if ratio[name] <= 1:
            break
        if free == ["threshold"]:
            raise InputError(
                f"the presses leave the zenith that turns pixels light uncertain by"
                f" {math.degrees(errors['threshold']):.1f} degrees: press the ball deeper, in smaller steps"
            )
        free.remove(name if name != "threshold" else free[-1])
    places = tuple(
        BallPlace(float(place[0]), float(place[1]), float(place[2]), len(press.travel))
        for place, press in zip(fit.places, presses, strict=True)
    )
    found = Gel(
        threshold=gel.threshold,
        compliance=round(gel.compliance, _DIGITS),
        curvature=round(gel.curvature, _DIGITS),
        axis=axis,
        travel_zero=places[0].travel_zero,
        error=fit.height_error(),
        sigma=errors,
    )
    return GelFit(found, places, tuple(name for name in _SHARED if name not in free))


class _Fit:
    """The search for a gel's free numbers, the others being 0, and x, y and travel zero of each ball."""

    def __init__(
        self, presses: Sequence[BallOnset], axis: tuple[float, float], sheet: float, free: tuple[str, ...]
    ) -> None:
        self._presses, self._axis, self._sheet, self._free = presses, axis, sheet, free
        self._low, self._high, start = self._bounds()
        self._solution = self._latest_contact(start)
        self._rates = self._rising()

    def solve(self) -> tuple[Gel, dict[str, float]]:
        """Return the shared numbers and their standard errors."""
        from scipy.optimize import least_squares

        for _ in range(2):  # how fast slopes rise is known better from what was found
            found = least_squares(
                self._residuals,
                self._solution,
                bounds=(self._low, self._high),
                x_scale=np.where(np.arange(len(self._solution)) < len(self._free), 0.05, 0.2),
                loss="soft_l1",
                ftol=1e-6,
                max_nfev=_STEPS,
            )
            self._solution = np.clip(found.x, self._low + 1e-9, self._high - 1e-9)
            self._rates = self._rising()
        count = sum(len(press.travel) for press in self._presses)
        share = max(1.0, count / (_INDEPENDENT * len(self._presses)))
        excess = max(1.0, 2 * found.cost / count)
        errors = np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)) * excess * share)
        sigma = dict(zip(self._free, errors.tolist(), strict=False))
        sigma["travel_zero"] = float(errors[len(self._free) + 2])
        return self._gel(self._solution), sigma

    @property
    def places(self) -> Doubles:
        """Where the balls are, (presses, 3)."""
        return self._places(self._solution)

    def height_error(self) -> float:
        """Return the usual error of a height that is left, mm."""
        off = np.concatenate(
            [
                self._steeper(self._solution, number)[rate > _LEAST_RATE] / rate[rate > _LEAST_RATE]
                for number, rate in enumerate(self._rates)
            ]
        )
        return 1.4826 * float(np.median(np.abs(off))) if off.size else 0.0

    def _bounds(self) -> tuple[Doubles, Doubles, Doubles]:
        """Return lower and upper bounds, and where to begin."""
        chosen = [_SHARED.index(name) for name in self._free]
        start, low, high = ([row[index] for index in chosen] for row in (_START, *_BOUNDS))
        for number, press in enumerate(self._presses):
            x, y = float(np.median(press.x)), float(np.median(press.y))
            r = np.hypot(press.x - x, press.y - y)
            seen = press.inner if math.isfinite(press.inner) else float(np.quantile(r, 0.05))
            inner = min(seen, 0.7 * press.radius)
            first = float(np.median(press.travel[r <= np.quantile(r, 0.1)]))
            place = [x, y, first - float(sphere_travel(inner, press.radius))]
            start += place
            low += [one - press.radius for one in place]
            high += [one + press.radius for one in place]
            if number == 0:
                start[0] = float(np.clip(math.asin(inner / press.radius), low[0] * 1.1, high[0] * 0.9))
        return np.array(low), np.array(high), np.array(start)

    def _latest_contact(self, start: Doubles) -> Doubles:
        """Return the start with each ball met when the slopes at onsets fit best.

        Met too soon, the sheet would touch everywhere at the onsets, and nothing would lead out of that.
        """
        best = start.copy()
        for number, press in enumerate(self._presses):
            place = len(self._free) + 3 * number + 2
            costs = []
            for later in _LATER * press.radius:
                tried = start.copy()
                tried[place] += later
                costs.append(float(np.mean(np.abs(self._steeper(tried, number)))))
            best[place] += _LATER[int(np.argmin(costs))] * press.radius
        return best

    def _gel(self, parameters: Doubles) -> Gel:
        known = dict.fromkeys(_SHARED, 0.0)
        known |= dict(zip(self._free, parameters[: len(self._free)].tolist(), strict=True))
        return Gel(known["threshold"], known["compliance"], known["curvature"], self._axis)

    def _places(self, parameters: Doubles) -> Doubles:
        return parameters[len(self._free) :].reshape(-1, 3)

    def _residuals(self, parameters: Doubles) -> Doubles:
        parts = []
        for number, (press, rate) in enumerate(zip(self._presses, self._rates, strict=True)):
            error = np.hypot(_SLOPE_ERROR, rate * np.maximum(press.sigma, _TRAVEL_ERROR))
            parts.append(self._steeper(parameters, number) / error)
            if math.isfinite(press.inner):
                # As few pixels are independent, the dark top counts as many of them.
                weight = max(1.0, len(press.travel) / _INDEPENDENT)
                parts.append(np.array([self._rim(parameters, number)]) * math.sqrt(weight))
        return np.concatenate(parts)

    def _steeper(self, parameters: Doubles, number: int, later: float = 0.0) -> Doubles:
        """Return by how much the sheet is steeper at onsets, or a little later, than the threshold."""
        press, gel = self._presses[number], self._gel(parameters)
        x, y, zero = self._places(parameters)[number]
        across, up = press.x - x, press.y - y
        touches = np.linspace(0.0, _WIDEST * press.radius, _TABLE)
        travels = sphere_travel(touches, press.radius, gel.compliance)
        touch = np.interp(press.travel + later - zero, travels, touches)
        zenith = threshold_at(gel, press.x, press.y, np.arctan2(up, across))
        steep = sphere_slope(np.hypot(across, up), touch, press.radius, self._sheet)
        return np.asarray(steep - np.tan(np.where(np.isfinite(zenith), zenith, gel.threshold)))

    def _rim(self, parameters: Doubles, number: int) -> float:
        """Return by how many standard errors the ball's slope at its dark top's rim misses the threshold.

        The sheet lies on the ball there, and how it gives way does not matter.
        """
        press = self._presses[number]
        azimuth = np.linspace(0, 2 * math.pi, _AROUND, endpoint=False)
        x, y, _ = self._places(parameters)[number]
        at = x + press.inner * np.cos(azimuth), y + press.inner * np.sin(azimuth)
        zenith = math.asin(min(press.inner / press.radius, _WIDEST))
        error = math.hypot(_SLOPE_ERROR, press.inner_sigma / press.radius)
        return float(np.nanmean(zenith - threshold_at(self._gel(parameters), *at, azimuth))) / error

    def _rising(self) -> list[Doubles]:
        """Return how fast slopes rise at the onsets of each press, 1/mm."""
        each = range(len(self._presses))
        changes = (self._steeper(self._solution, k, _DELAY) - self._steeper(self._solution, k) for k in each)
        return [np.maximum(change / _DELAY, 0.0) for change in changes]
