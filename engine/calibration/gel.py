"""The elastomer's compliance and the threshold of light, from presses of a ball of known size."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.calibration.sources import check_ball_radius, pixel_size_of
from mirrorskin.engine.press.elastic import threshold_at
from mirrorskin.io import Gel, InputError, Result, Source, pixel_axes
from mirrorskin.io.model.maps import PressStatus
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics import least_squares
from mirrorskin.kernels.numerics.least_squares import mad_sigma, soft_l1

_NODES = 24  # number of nodes of the Gauss-Legendre quadrature over punches
_THINNEST = 1e-3  # minimum depth of the mirror below the surface, in radii of the ball

_RIM = 0.1  # variance of the dark top's radius in pixels, times its radius in pixels
_MAX_PIXELS = 600  # maximum number of pixels used of a press
_MIN_PIXELS = 50  # minimum number of pixels of a press that turned bright

_SHARED = ("threshold", "compliance", "curvature")  # parameters common to all presses, with the numbers below
_START = (0.2, 0.005, 0.03)
_BOUNDS = ((0.02, 0.0, 0.0), (0.78, 2.0, 0.2))
_WORST = (0.01, 0.02, 0.02)  # standard errors above which they are not determined
_LATER = np.linspace(-0.1, 0.2, 13)  # delays of the contact tried for the start, in radii of the ball
_INDEPENDENT = 200  # number of pixels of a press with independent errors
_RIM_POINTS = 24  # points on a dark top's rim
_LOSS = soft_l1(1.0)  # standard deviations
_TABLE = 400  # entries of the table from travel to contact radius
_MAX_CONTACT_RADIUS = 0.999  # radii of the ball: largest contact radius
_SLOPE_ERROR = 0.003  # standard deviation of the sheet's slope computed by the theory
_TRAVEL_ERROR = 0.004  # mm: minimum standard deviation of onsets, which are between two frames
_DELAY = 1e-3  # mm of travel: step of numerical derivatives
_LEAST_RATE = 0.05  # 1/mm: below this rate the sheet is already in contact, and the onset is random
_DIGITS = 8  # decimals of compliance and curvature, so that a value next to the bound 0 becomes 0


def sphere_travel(touch: ArrayLike, radius: float, compliance: float = 0.0) -> Doubles:
    """Return the travel at which a ball of radius R has a contact of radius a < R, mm.

    The depth is ``a artanh(a / R)``, and the force divided by Young's modulus is
    ``4/3 ((a^2 + R^2) artanh(a / R) - a R)`` (Sneddon, Int. J. Eng. Sci. 3, 1965, 47-57, at Poisson ratio
    0.5). The stage gives way by ``compliance`` times the latter.

    Examples
    --------
    >>> float(sphere_travel(1.0, 2.0).round(3))
    0.549
    """
    a = np.asarray(touch, np.float64)
    steep = np.arctanh(a / radius)
    return np.asarray(a * steep + compliance * 4 / 3 * ((a**2 + radius**2) * steep - a * radius))


def sphere_slope(distance: ArrayLike, touch: ArrayLike, radius: float, sheet: float = 0.0) -> Doubles:
    """Return the slope of the mirror at a distance from a ball's centre, for a contact radius.

    A press of a ball is a sum of presses of flat punches of radius x by g'(x) dx, g(x) = x artanh(x / R). The
    surface's displacement under a punch pressed by 1 continues harmonically to the depth z as ::

        U = 2 / pi arcsin(2 x / (sqrt((r - x)^2 + z^2) + sqrt((r + x)^2 + z^2)))

    and the displacement of an incompressible body is U - z dU/dz (Johnson, Contact Mechanics, 1985, 3.8).
    """
    r, a = np.broadcast_arrays(np.asarray(distance, np.float64), np.asarray(touch, np.float64))
    depth = max(sheet, _THINNEST * radius)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    fraction, weights = (nodes + 1) / 2, weights / 2
    near, rest = np.minimum(r, a)[..., np.newaxis], np.maximum(a - r, 0.0)[..., np.newaxis]
    # Punches with x close to r have the largest slope, so nodes are denser there.
    x = np.concatenate([near - near * fraction**2, near + rest * fraction**2], axis=-1)
    width = np.concatenate([2 * near * fraction * weights, 2 * rest * fraction * weights], axis=-1)
    ratio = x / radius
    pressed = width * (np.arctanh(ratio) + ratio / (1 - ratio**2))
    step = depth / 2
    below, here, above = (_punch_slope(r[..., np.newaxis], x, depth + h) for h in (step, 0.0, -step))
    return np.asarray(np.sum(pressed * (here - depth * (below - above) / (2 * step)), axis=-1))


def _punch_slope(r: Doubles, x: Doubles, z: float) -> Doubles:
    """Return -dU/dr of a punch of radius x, 1/mm."""
    inner, outer = np.hypot(r - x, z), np.hypot(r + x, z)
    mean = (inner + outer) / 2
    rise = ((r - x) / inner + (r + x) / outer) / 2
    return np.asarray(2 / np.pi * x * rise / (mean * np.sqrt(np.maximum(mean**2 - x**2, 0.0))))


@dataclass(frozen=True, slots=True, eq=False)
class BallOnset:
    """Onset of light at n pixels while a ball was pressed into the sheet; all in mm."""

    travel: Doubles  # (n,): at the onset
    sigma: Doubles  # (n,): its standard deviation
    x: Doubles  # (n,)
    y: Doubles  # (n,)
    radius: float  # radius of the ball
    inner: float = math.nan  # radius of the ball's dark top; NaN if it was not completely visible
    inner_sigma: float = math.nan


def ball_onset(result: Result, source: Source, radius: float) -> BallOnset:
    """Return the onsets of a ball's press.

    Parameters
    ----------
    result : Result
        The press without correction for the elastomer and without filling, at the threshold 0.5.
    source : Source
        The recording, with a pixel size.
    radius : float
        Radius of the ball, mm.

    Raises
    ------
    mirrorskin.io.InputError
        The result is not a press, there is no pixel size, or fewer than 50 pixels turned bright.
    """
    import cv2
    from scipy import ndimage

    height, sigma, status = result.height, result.height_sigma, result.status
    if status is None or height is None or sigma is None:
        raise InputError(f"{source.name} is not a press: give a vertical recording of a ball")
    size = pixel_size_of(source)
    check_ball_radius(radius)
    lit = np.flatnonzero((status == PressStatus.ONSET) & np.isfinite(height))
    if len(lit) < _MIN_PIXELS:
        raise InputError(
            f"{source.name}: {len(lit)} pixels turned bright, and {_MIN_PIXELS} are needed:"
            " press the ball deeper"
        )
    some = lit[:: math.ceil(len(lit) / _MAX_PIXELS)]
    x, y = np.meshgrid(*pixel_axes((height.shape[0], height.shape[1]), size))
    maps = [values.ravel()[some].astype(np.float64) for values in (-height, sigma, x, y)]
    onset = BallOnset(maps[0], maps[1], maps[2], maps[3], radius)
    # The dark top is the largest dark patch that is surrounded by light.
    closed = ndimage.binary_closing(np.pad(status == PressStatus.ONSET, 1), np.ones((3, 3), bool))[1:-1, 1:-1]
    dark = ndimage.binary_fill_holes(closed) & ~closed
    count, patches = cv2.connectedComponents(dark.view(np.uint8), connectivity=4)
    if count == 1:
        return onset
    largest = patches == 1 + np.argmax(np.bincount(patches.ravel())[1:])
    area = float(np.count_nonzero(largest & (status == PressStatus.NEVER_LIGHT))) * size[0] * size[1]
    inner = math.sqrt(area / math.pi)
    # The rim crosses each of its pixels at a random position.
    pixel = max(size)
    return replace(onset, inner=inner, inner_sigma=pixel * math.sqrt(_RIM * pixel / max(inner, pixel)))


@dataclass(frozen=True, slots=True)
class BallPlace:
    """Fitted position of a ball, mm."""

    x: float
    y: float
    travel_zero: float  # travel at which the sheet met its top
    pixels: int  # number of pixels that were used


@dataclass(frozen=True, slots=True, eq=False)
class GelFit:
    """A gel and the balls' positions; ``undetermined`` names the parameters that were left at 0."""

    gel: Gel
    places: tuple[BallPlace, ...]
    undetermined: tuple[str, ...]


def fit_gel(
    presses: Sequence[BallOnset], axis: tuple[float, float] = (0.0, 0.0), sheet: float = 0.05
) -> GelFit:
    """Fit a gel to the onsets of light in presses of balls of known radius.

    At the onset of a pixel, the slope of the sheet there equals the threshold (see `threshold_at` of
    `mirrorskin.engine.press.elastic`); the slope next to a ball has a closed form (`sphere_slope`). Robust
    least squares over all pixels determine the threshold on the wall's axis, the wall's curvature, the
    stage's compliance, and for each press the ball's position and the travel of first contact. Compliance and
    curvature are 0 if they are not determined. The ball's height above the stage's zero and this zero cannot
    be separated. More presses, of different balls or at other positions, determine more parameters.

    Parameters
    ----------
    presses : sequence of BallOnset
    axis : (float, float)
        Position of the wall's axis in the picture, mm.
    sheet : float
        Thickness of the material between mirror and ball, mm.

    Raises
    ------
    mirrorskin.io.InputError
        The presses do not determine the threshold.
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
        name = max(ratio, key=lambda parameter: (ratio[parameter], parameter))
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
    gel = replace(
        gel,
        compliance=round(gel.compliance, _DIGITS),
        curvature=round(gel.curvature, _DIGITS),
        travel_zero=places[0].travel_zero,
        error=fit.height_error(),
        sigma=errors,
    )
    return GelFit(gel, places, tuple(name for name in _SHARED if name not in free))


class _Fit:
    """A fit of the free parameters, with the others at 0, and of x, y and travel zero of each ball."""

    def __init__(
        self, presses: Sequence[BallOnset], axis: tuple[float, float], sheet: float, free: tuple[str, ...]
    ) -> None:
        self._presses, self._axis, self._sheet, self._free = presses, axis, sheet, free
        self._low, self._high, start = self._bounds()
        self._solution = self._latest_contact(start)
        self._rates = self._rates_of_slopes()

    def solve(self) -> tuple[Gel, dict[str, float]]:
        """Return the shared parameters and their standard errors."""
        for _ in range(2):  # the rates of slopes are more accurate in the second fit
            residuals = functools.partial(self._residuals, self._rates)
            solution = least_squares.fit(
                residuals, self._solution, bounds=(self._low, self._high), loss=_LOSS, tolerance=1e-6
            )
            self._solution = solution.parameters
            self._rates = self._rates_of_slopes()
        count = sum(len(press.travel) for press in self._presses)
        dependent = max(1.0, count / (_INDEPENDENT * len(self._presses)))
        errors = np.sqrt(np.diag(solution.covariance(max(1.0, solution.cost / count) * dependent)))
        sigma = dict(zip(self._free, errors.tolist(), strict=False))
        sigma["travel_zero"] = float(errors[len(self._free) + 2])
        return self._gel(self._solution), sigma

    @property
    def places(self) -> Doubles:
        """Positions of the balls, (presses, 3)."""
        return self._places(self._solution)

    def height_error(self) -> float:
        """Return the robust standard deviation of the residual heights, mm."""
        residuals = [self._excess(self._solution, number) for number in range(len(self._presses))]
        residual, rate = np.concatenate(residuals), np.concatenate(self._rates)
        return mad_sigma(residual[rate > _LEAST_RATE] / rate[rate > _LEAST_RATE])

    def _bounds(self) -> tuple[Doubles, Doubles, Doubles]:
        """Return lower and upper bounds, and the start."""
        chosen = [_SHARED.index(name) for name in self._free]
        start, low, high = ([row[index] for index in chosen] for row in (_START, *_BOUNDS))
        for number, press in enumerate(self._presses):
            x, y = float(np.median(press.x)), float(np.median(press.y))
            r = np.hypot(press.x - x, press.y - y)
            inner = press.inner if math.isfinite(press.inner) else float(np.quantile(r, 0.05))
            inner = min(inner, 0.7 * press.radius)
            first = float(np.median(press.travel[r <= np.quantile(r, 0.1)]))
            place = [x, y, first - float(sphere_travel(inner, press.radius))]
            start += place
            low += [coordinate - press.radius for coordinate in place]
            high += [coordinate + press.radius for coordinate in place]
            if number == 0:
                start[0] = float(np.clip(math.asin(inner / press.radius), low[0] * 1.1, high[0] * 0.9))
        return np.array(low), np.array(high), np.array(start)

    def _latest_contact(self, start: Doubles) -> Doubles:
        """Return the start with the travel of first contact at which slopes fit best, for each ball.

        If the first contact is too early, the sheet touches the ball at all onsets, which is a local minimum.
        """
        best = start.copy()
        for number, press in enumerate(self._presses):
            place = len(self._free) + 3 * number + 2
            costs = []
            for later in _LATER * press.radius:
                trial = start.copy()
                trial[place] += later
                costs.append(float(np.mean(np.abs(self._excess(trial, number)))))
            best[place] += _LATER[int(np.argmin(costs))] * press.radius
        return best

    def _gel(self, parameters: Doubles) -> Gel:
        shared = dict.fromkeys(_SHARED, 0.0)
        shared |= dict(zip(self._free, parameters[: len(self._free)].tolist(), strict=True))
        return Gel(shared["threshold"], shared["compliance"], shared["curvature"], self._axis)

    def _places(self, parameters: Doubles) -> Doubles:
        return parameters[len(self._free) :].reshape(-1, 3)

    def _residuals(self, rates: list[Doubles], parameters: Doubles) -> Doubles:
        parts = []
        for number, (press, rate) in enumerate(zip(self._presses, rates, strict=True)):
            error = np.hypot(_SLOPE_ERROR, rate * np.maximum(press.sigma, _TRAVEL_ERROR))
            parts.append(self._excess(parameters, number) / error)
            if math.isfinite(press.inner):
                # Pixels are correlated, so the dark top has the weight of several of them.
                weight = max(1.0, len(press.travel) / _INDEPENDENT)
                parts.append(np.array([self._rim(parameters, number)]) * math.sqrt(weight))
        return np.concatenate(parts)

    def _excess(self, parameters: Doubles, number: int, later: float = 0.0) -> Doubles:
        """Return the slope of the sheet minus the threshold at the onsets, or ``later`` mm after them."""
        press, gel = self._presses[number], self._gel(parameters)
        x, y, zero = self._places(parameters)[number]
        from_x, from_y = press.x - x, press.y - y
        touches = np.linspace(0.0, _MAX_CONTACT_RADIUS * press.radius, _TABLE)
        travels = sphere_travel(touches, press.radius, gel.compliance)
        touch = np.interp(press.travel + later - zero, travels, touches)
        zenith = threshold_at(gel, press.x, press.y, np.arctan2(from_y, from_x))
        slope = sphere_slope(np.hypot(from_x, from_y), touch, press.radius, self._sheet)
        return np.asarray(slope - np.tan(np.where(np.isfinite(zenith), zenith, gel.threshold)))

    def _rim(self, parameters: Doubles, number: int) -> float:
        """Return the ball's slope at the rim of its dark top minus the threshold, in standard errors.

        The sheet touches the ball there, so the residual does not depend on the elastomer.
        """
        press = self._presses[number]
        azimuth = np.linspace(0, 2 * math.pi, _RIM_POINTS, endpoint=False)
        x, y, _ = self._places(parameters)[number]
        rim = x + press.inner * np.cos(azimuth), y + press.inner * np.sin(azimuth)
        zenith = math.asin(min(press.inner / press.radius, _MAX_CONTACT_RADIUS))
        error = math.hypot(_SLOPE_ERROR, press.inner_sigma / press.radius)
        return float(np.nanmean(zenith - threshold_at(self._gel(parameters), *rim, azimuth))) / error

    def _rates_of_slopes(self) -> list[Doubles]:
        """Return the rates at which slopes increase with travel at the onsets of each press, 1/mm."""
        rates = []
        for number in range(len(self._presses)):
            change = self._excess(self._solution, number, _DELAY) - self._excess(self._solution, number)
            rates.append(np.maximum(change / _DELAY, 0.0))
        return rates
