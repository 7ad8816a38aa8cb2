"""What the swing of the brightness of a rotation shows about its response.

The mean of a pixel's brightness determines the zenith; how much it swings follows from the slope of the
response there. Three errors change the swing, each in its own way:

- gains of pixels: it differs from pixel to pixel, in excess of noise;
- blur: it is smaller where the azimuth changes from pixel to pixel;
- a response that is not linear: it depends on the zenith. A little of it, and uneven light, are nuisances
  of `mirrorskin.engine.diagnosis.turn_nuisances`.

Points that move in the picture while the body leans change it where the surface is curved; a sphere shows
nothing of all this, as its zenith, its place and its curvature change together.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import AnyArray
from mirrorskin.engine.base.frames import take_places
from mirrorskin.engine.diagnosis.amplitude_blur import GRID_LINES, MIN_PIXELS
from mirrorskin.engine.diagnosis.footprint import PIXEL
from mirrorskin.engine.diagnosis.residual_noise import CountNoise
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import CLEAR_Z_SCORE, OUTLYING, fit_clipped, gram, mad_sigma
from mirrorskin.kernels.rotation.normals_wall import Wall, light_of_turn

if TYPE_CHECKING:
    from mirrorskin.engine.rotation.response import Response

_MIN_ZENITH = 1.5  # tilts, from which on the zenith and the swing are independent
_REACH = 1  # pixels between the middle and its neighbours
_GAIN_Z_SCORE = 5.0  # standard errors from which on the scatter of gains is reported
_MIN_BLUR = 0.8  # pixels: least standard deviation of a blur that is more than a larger area of a pixel
_MIN_UNEXPLAINED = 0.25  # least share of an effect's variance that the others do not explain
_ERROR_RATIO = 1.25  # ratio of that error to that of independent values
_MIN_DECIDING_PIXELS = 100  # that show a blur: a tip does not
_MIN_TURNING = 0.02  # square of the turning of azimuths, 1/pixel^2
_MAX_TURNING = 0.05  # the same, of pixels that show a response: a pixel's area does not change their swing
_AREA_ITERATIONS = 4
_MOST_TURNED = 0.2  # square of the angle by which azimuths turn over an area: its effect is proportional
_TURNING, _ZENITH = 1, 3  # numbers of the columns of a fit
_PHASES = 8  # of a turn, at which the light under a wall is computed
_STEP = 1e-3  # relative increase of the slope, for derivatives
_MOST_STEEP = 0.7  # relative change of the swing for that of the light, of a pixel that shows a change
_MIN_RANGE = 0.05  # least range of the swing, as a share of it, that is a response
_MIN_GAIN = 0.01  # least standard deviation of the gains of pixels


class Swing(NamedTuple):
    """The swing of the brightness, relative to the expected one, at some pixels: each (n,)."""

    ratio: Doubles
    sigma: Doubles
    response: Doubles  # relative change of the ratio for that of the light, whose zenith is wrong, too
    x: Doubles  # from -1 to 1
    y: Doubles
    turning: Doubles  # square of the angle by which azimuths turn, 1/pixel^2
    bending: Doubles  # increase of the zenith along its azimuth, radians per pixel
    zenith: Doubles  # minus its mean, radians


@dataclass(frozen=True, slots=True)
class ModulationEffects:
    """Effects on the swing of the brightness; 0 if one is not significant.

    Attributes
    ----------
    gain : float
        Standard deviation of the gains of pixels.
    area : float
        Variance of the area that a pixel sees, square pixels.
    blur : float
        Standard deviation of the lens's point spread, pixels, if it is a large one.
    response : float
        Range over the picture of the swing that changes with the zenith, relative to the swing.
    swing : Swing, optional
        What they are found in.
    """

    gain: float = 0.0
    area: float = 0.0
    blur: float = 0.0
    response: float = 0.0
    swing: Swing | None = None


def find_modulation_effects(
    normals: AnyArray,
    mean: AnyArray,
    cosine: AnyArray,
    sine: AnyArray,
    usable: NDArray[Any],
    zenith_gain: ArrayLike,
    tilt: float,
    noise_of_mean: CountNoise,
) -> ModulationEffects:
    """Return what the swing of brightness shows.

    ``normals``, (H, W, 3), and the fit of ``mean``, ``cosine`` and ``sine``, (H, W) counts, are used at
    ``usable`` pixels, (H, W).
    """
    rows, columns = usable.shape
    thin = max(1, math.isqrt(int(np.count_nonzero(usable))) // GRID_LINES)
    if min(rows, columns) <= 2 * _REACH:
        return ModulationEffects()
    down, right = range(_REACH, rows - _REACH, thin), range(_REACH, columns - _REACH, thin)
    places = (0, 0), (0, _REACH), (0, -_REACH), (-_REACH, 0), (_REACH, 0)
    scale = np.broadcast_to(np.abs(np.asarray(zenith_gain, np.float64)), usable.shape)
    used, scales = map(np.stack, take_places([usable, scale], down, right, places))
    vectors, means, *amplitudes = take_places([normals, mean, cosine, sine], down, right, places)
    x, y, z = np.stack(vectors, axis=1, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        flat, amplitude = np.hypot(x, y), np.hypot(*map(np.stack, amplitudes))
        steep = (used > 0) & (flat > math.sin(_MIN_ZENITH * tilt))
        angle = np.where(steep, np.arctan2(flat, z), np.nan)
        ratio = amplitude / (scales * _expected(angle, tilt))
        # Of each place: zenith, its sine's direction and the ratio of the swing, NaN where it is not usable.
        middle, east, west, north, south = zip(angle, x / flat, y / flat, ratio, strict=True)
        apart = 2 * _REACH
        pairs = (east, west), (north, south)
        turning = np.sum(
            [((first[k] - second[k]) / apart) ** 2 for first, second in pairs for k in (1, 2)], axis=0
        )
        bending = ((east[0] - west[0]) * middle[1] + (north[0] - south[0]) * middle[2]) / apart
        zenith = (east[0] + west[0] + north[0] + south[0]) / 4  # without the error of this pixel
        rough = middle[3] - (east[3] + west[3] + north[3] + south[3]) / 4
        noise = math.sqrt(2) * noise_of_mean.at(means[0]) / (scales[0] * tilt)
    finite = np.isfinite(rough) & np.isfinite(turning) & np.isfinite(noise) & (noise > 0)
    if np.count_nonzero(finite) < MIN_PIXELS:
        return ModulationEffects()
    y, x = (
        np.broadcast_to(positions, finite.shape)[finite]
        for positions in np.ix_(1 - 2 * np.array(down) / (rows - 1), 2 * np.array(right) / (columns - 1) - 1)
    )
    noise, rough = noise[finite], rough[finite]
    gain = _gain(rough, noise)
    zenith = zenith[finite] - np.mean(zenith[finite])
    response = 1 - _steepness(middle[0][finite], tilt)
    swing = Swing(
        middle[3][finite], np.hypot(noise, gain), response, x, y, turning[finite], bending[finite], zenith
    )
    columns_of = np.stack([
        np.ones_like(x), swing.turning, swing.bending, zenith, x, y, x * x, x * y, y * y
    ], axis=1)  # fmt: skip
    given = swing.ratio, columns_of, swing.sigma
    area = _area(*given)
    blur = math.sqrt(max(area - PIXEL, 0.0))
    return ModulationEffects(gain, area, blur if blur > _MIN_BLUR else 0.0, _response(*given), swing)


def swing_of_wall(
    normals: AnyArray,
    mean: AnyArray,
    cosine: AnyArray,
    sine: AnyArray,
    usable: NDArray[Any],
    response: Response,
    tilt: float,
    noise_of_mean: CountNoise,
) -> Swing | None:
    """Return the swing of the brightness under a calibrated wall, relative to the expected one.

    Arguments as for `find_modulation_effects`; ``response`` replaces the gain. Pixels whose light leaves the
    range of the response are left out.
    """
    rows, columns = usable.shape
    thin = max(1, math.isqrt(int(np.count_nonzero(usable))) // GRID_LINES)
    if min(rows, columns) <= 2 * _REACH:
        return None
    down, right = range(_REACH, rows - _REACH, thin), range(_REACH, columns - _REACH, thin)
    places = (0, 0), (0, _REACH), (0, -_REACH), (-_REACH, 0), (_REACH, 0)
    vectors = np.stack(take_places([normals], down, right, places)[0], dtype=np.float64)
    ((used,), (level,), (along,), (across,)) = take_places(
        [usable, mean, cosine, sine], down, right, [(0, 0)]
    )
    scale = response.planes[:, down.start : down.stop : thin, right.start : right.stop : thin]
    finite = np.isfinite(vectors).all(axis=(0, 1)) & (used > 0) & np.isfinite(scale).all(axis=0)
    finite &= np.hypot(*vectors[0, :2]) > math.sin(_MIN_ZENITH * tilt)
    if np.count_nonzero(finite) < MIN_PIXELS:
        return None
    normal, planes = vectors[0][:, finite].T, scale[:, finite].astype(np.float64)
    light, swing, within = _wall_swing(normal, planes, response.wall, tilt)
    nearby, near_swing, _ = _wall_swing(_steeper(normal), planes, response.wall, tilt)
    with np.errstate(divide="ignore", invalid="ignore"):
        steepness = np.log(near_swing / swing) / np.log(nearby / light)
        amplitude = np.hypot(along, across)[finite] * np.abs(planes[1])
        ratio = np.where(within & (np.abs(steepness) < _MOST_STEEP), amplitude / swing, np.nan)
        sigma = math.sqrt(2) * noise_of_mean.at(level[finite]) * np.abs(planes[1]) / swing
        flat = np.hypot(vectors[:, 0], vectors[:, 1])
        zenith, x, y = np.arctan2(flat, vectors[:, 2]), vectors[:, 0] / flat, vectors[:, 1] / flat
    apart = 2 * _REACH
    turning = sum(
        ((each[first] - each[second]) / apart) ** 2 for each in (x, y) for first, second in ((1, 2), (3, 4))
    )
    bending = ((zenith[1] - zenith[2]) * x[0] + (zenith[3] - zenith[4]) * y[0]) / apart
    row, column = (
        np.broadcast_to(positions, finite.shape)[finite]
        for positions in np.ix_(1 - 2 * np.array(down) / (rows - 1), 2 * np.array(right) / (columns - 1) - 1)
    )
    mean_zenith = float(np.mean(zenith[0][finite]))
    return Swing(
        ratio, sigma, 1 - steepness, column, row, np.asarray(turning)[finite], bending[finite],
        zenith[0][finite] - mean_zenith,
    )  # fmt: skip


def _wall_swing(
    normal: Doubles, planes: Doubles, wall: Wall, tilt: float
) -> tuple[Doubles, Doubles, NDArray[np.bool_]]:
    """Return mean and amplitude of the light of normals, (n, 3), over a turn, and whether it is in range."""
    phase = np.arange(_PHASES) * 2 * math.pi / _PHASES
    light, within = light_of_turn(normal, phase, planes, wall, tilt)
    return light.mean(axis=0), np.abs(2 * np.exp(1j * phase) @ light) / _PHASES, np.all(within, axis=0)


def _steeper(normal: Doubles) -> Doubles:
    """Return normals, (n, 3), whose zenith is a little larger."""
    turned = normal.copy()
    turned[:, :2] *= 1 + _STEP
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def _expected(zenith: Doubles, tilt: float) -> Doubles:
    """Return the swing of the angle to the body's axis, radians."""
    return np.asarray(np.interp(zenith, *_swings(tilt)))


def _steepness(zenith: Doubles, tilt: float) -> Doubles:
    """Return the relative change of the swing for that of the zenith: 0 where surfaces are steep."""
    step = 0.01
    above, below = (np.log(_expected(factor * zenith, tilt)) for factor in (1 + step, 1 - step))
    return np.asarray((above - below) / (2 * step))


@functools.lru_cache(4)
def _swings(tilt: float) -> tuple[Doubles, Doubles]:
    """Return zeniths, and the swing of the angle to the body's axis at each."""
    zenith = np.linspace(0, math.pi / 2, 256)
    phase = np.arange(32) * 2 * math.pi / 32
    lean = np.multiply.outer(np.sin(zenith) * math.sin(tilt), np.cos(phase))
    angle = np.arccos(np.clip((np.cos(zenith) * math.cos(tilt))[:, np.newaxis] - lean, -1, 1))
    return zenith, np.abs(2 * np.mean(angle * np.cos(phase), axis=1))


def _gain(rough: Doubles, noise: Doubles) -> float:
    """Return the standard deviation of gains, from what differs from the mean of four neighbours."""
    ratio = rough / (noise * math.sqrt(1.25))
    # Neighbours are in several means, so that the error of the variance is larger than of independent values.
    excess = float(np.mean(ratio[np.abs(ratio) <= OUTLYING * mad_sigma(ratio)] ** 2)) - 1
    gain = math.sqrt(max(excess, 0)) * float(np.median(noise))
    return (
        gain
        if excess > _GAIN_Z_SCORE * _ERROR_RATIO * math.sqrt(2 / len(rough)) and gain > _MIN_GAIN
        else 0.0
    )


class _Fit:
    """Effects on the ratio of the swing to the expected one: factors of columns."""

    def __init__(self, ratio: Doubles, columns: Doubles, noise: Doubles) -> None:
        result = fit_clipped(columns, ratio, noise) if len(ratio) >= MIN_PIXELS else None
        self._covariance: Doubles | None = None
        if result is None:
            return
        self.factors, inverse, residual, kept = result
        self._covariance = inverse * max(1.0, float(np.mean(residual[kept] ** 2)))
        self.used = columns.compress(kept, axis=0)
        self._products = gram(self.used)

    def has(self, number: int) -> bool:
        """Return whether the effect of a column is significant, and not that of others."""
        if self._covariance is None:
            return False
        products, others = self._products, np.delete(np.arange(len(self.factors)), number)
        sums, count = products[0], products[0, 0]  # the first column is 1
        square, mixed = products[number, number], products[number, others]
        unexplained = square - float(mixed @ np.linalg.solve(products[np.ix_(others, others)], mixed))
        alone = unexplained > _MIN_UNEXPLAINED * (square - float(sums[number]) ** 2 / count)
        error = math.sqrt(self._covariance[number, number])
        return bool(alone and abs(float(self.factors[number])) > CLEAR_Z_SCORE * error)


def _area(ratio: Doubles, columns: Doubles, noise: Doubles) -> float:
    """Return the variance of the area that a pixel sees; 0 if azimuths turn at too few pixels to show it.

    The swing is proportional to the square of the turning only where an area is small compared with the
    distance over which azimuths turn: other pixels have a smaller weight.
    """
    area, turned = 0.0, columns[:, _TURNING]
    for _ in range(_AREA_ITERATIONS):
        fit = _Fit(ratio, columns, noise * (1 + (area * turned / _MOST_TURNED) ** 2))
        if not fit.has(_TURNING):
            break
        turning = fit.used[:, _TURNING]
        deciding = float(np.sum(turning**2)) ** 2 / float(np.sum(turning**4))  # pixels
        if deciding < _MIN_DECIDING_PIXELS or float(np.percentile(turning, 95)) < _MIN_TURNING:
            break
        area = max(-2 * float(fit.factors[_TURNING]), 0.0)
    return area


def _response(ratio: Doubles, columns: Doubles, noise: Doubles) -> float:
    """Return the range of the swing that changes with the zenith, where the surface is hardly bent."""
    mild = columns[:, _TURNING] < _MAX_TURNING
    fit = _Fit(ratio[mild], columns[mild], noise[mild])
    if not fit.has(_ZENITH):
        return 0.0
    low, high = np.percentile(fit.used[:, _ZENITH], (5, 95))
    extent = abs(float(fit.factors[_ZENITH])) * float(high - low)
    return extent if extent > _MIN_RANGE else 0.0
