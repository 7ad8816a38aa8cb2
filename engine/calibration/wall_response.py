"""What a fit of the wall says of every pixel, how sure that is, and from which zenith mirrors are light."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.calibration.ball import pixel_size_of, rotations
from mirrorskin.engine.calibration.wall_fit import WallFit
from mirrorskin.engine.calibration.wall_model import (
    CURVE_COEFFICIENTS,
    SCALES,
    SENSOR,
    STEPS,
    LightSamples,
    SheetPoints,
    curve_from_steps,
    curve_means,
    down,
    light_of,
    look,
    meet_balls,
    reach_wall,
    split,
)
from mirrorskin.io import InputError, Source, WallResponse, pixel_axes
from mirrorskin.kernels.response import reflect, way_to_wall

Doubles = NDArray[np.float64]

_ZENITHS = 16  # at which the first light is looked for
_HALVINGS = 16
_STEEPEST = math.radians(89.0)  # elevation up to which rays are followed

_MARGIN = 1.05  # of the scatter: its edges are not sharp, and off the centre it is a little wider
_EXACT = 1e-4  # of full light by which the polynomial may miss the curve
_TERMS = 12
_PLACES = 400  # of the curve, at which the polynomial is fitted
_HALF = 0.5  # of the light of a uniform wall
_GRADED = 0.2  # of its greatest light by which a graded wall's changes at least
_FLAT = 0.02  # of its middle's steepness that a curve must have to be read
_FEW = 2e-3  # of the samples that may lie beyond the reach at either end

_SIDE = 5  # places along a side at which errors are computed
_TURN = 8  # azimuths there
_LEAN = math.radians(2.5)  # of a usual rotation; errors of the normals hardly depend on it
_FRAMES = 8
_STEP = 1e-4  # radians, of differences
_SMALL = 1e-3  # step of a parameter, as a share of its scale
_OUTLIER = 3.0  # times the noise at which residuals are clipped
_RINGS, _OCTANTS = 6, 8  # cells of a press, whose mean residual is compared with noise


def threshold_zenith(
    response: WallResponse,
    x: ArrayLike,
    y: ArrayLike,
    azimuth: ArrayLike,
    threshold: float = 0.5,
    *,
    z: ArrayLike = 0.0,
) -> Doubles:
    """Return the least zenith at which pixels get so much light, radians; NaN where none up to 45 deg does.

    Pixels look at ``x`` and ``y`` on the rest plane, mm, at mirrors of this height ``z``, mm, whose normals
    have this ``azimuth``; ``threshold`` is a share of their own full light. All arguments broadcast.
    """
    given = np.broadcast_arrays(*(np.asarray(value, np.float64) for value in (x, y, z, azimuth)))
    *place, turn = (value.ravel() for value in given)
    places = np.stack(place)
    dark, light = np.zeros(turn.shape), np.full(turn.shape, np.nan)
    for zenith in np.linspace(0, math.pi / 4, _ZENITHS + 1)[1:]:
        lit = full_light(response, places, np.full(turn.shape, zenith), turn) >= threshold
        light = np.where(np.isnan(light) & lit, zenith, light)
        dark = np.where(np.isnan(light), zenith, dark)
    for _ in range(_HALVINGS):
        middle = (dark + light) / 2
        lit = full_light(response, places, middle, turn) >= threshold
        dark, light = np.where(lit, dark, middle), np.where(lit, middle, light)
    return np.asarray(((dark + light) / 2).reshape(given[0].shape))


def full_light(response: WallResponse, places: Doubles, zenith: Doubles, azimuth: Doubles) -> Doubles:
    """Return shares of the pixels' own full light, (n,), also where part of a ray misses the wall.

    ``places`` are x and y on the rest plane and the mirror's height, (3, n), mm; zenith and azimuth are those
    of its normal. Beyond what is known of the wall it is as bright as at the end of that.
    """
    z, radius = places[2], response.radius
    from_axis = places[:2] - np.reshape(response.axis, (2, 1))
    lean = response.sight_slopes(from_axis)
    ray = reflect(down(lean), _normals(zenith, azimuth))
    at = from_axis + z * lean
    out = np.sqrt(ray[0] ** 2 + ray[1] ** 2) + 1e-12
    with np.errstate(invalid="ignore"):
        room = radius**2 - (at**2).sum(axis=0)
        room = np.where(room > 0, room, np.nan)
        way, _ = way_to_wall((at * ray[:2]).sum(axis=0), out**2, room)
        # The share of the ray, spread evenly over its scatter, that meets the wall.
        elevation, spread = np.arctan2(ray[2], out), max(response.scatter, 1e-9)
        top = np.minimum(np.arctan2(response.rim - z, way * out), _STEEPEST)
        bottom = np.arctan2(-z, way * out)
        lit = np.minimum(elevation + spread, top) - np.maximum(elevation - spread, bottom)
        height = z + way * ray[2]
        q = np.clip(height / (radius + np.hypot(height, radius)), *response.reach)
        lamp = 1 + np.array(response.lamps) @ (at + way * ray[:2]) / radius
    u, v = from_axis / radius
    shade = 1 + response.shade @ np.stack([u, v, u * u, u * v, v * v])
    level = np.polynomial.polynomial.polyval(q, response.curve)
    return np.asarray(shade * lamp * np.clip(lit / (2 * spread), 0, 1) * level)


def _normals(zenith: Doubles, azimuth: Doubles) -> Doubles:
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)])


def make_response(
    fit: WallFit, samples: LightSamples, noise: Doubles, pattern: str, source: Source
) -> WallResponse:
    """Return a fit, to samples of so much noise, as a response for the pixels of a source.

    Its scatter is 5 % above the fitted one, so that what is within its range is so safely.
    """
    named, steps, centres = split(fit.parameters)
    residual, most = error_left(samples, fit, noise)
    coefficients = curve_from_steps(fit.rising) @ steps
    if pattern == "uniform":
        powers, reach = coefficients[:1], _reach(named)
    else:
        wall = reach_wall(meet_balls(samples, named, centres), named)
        low, high = np.quantile((wall.low + wall.high) / 2, [_FEW, 1 - _FEW])
        powers, reach = _polynomial(named, coefficients, _reach(named, (float(low), float(high))))
    response = WallResponse(
        radius=named["radius"],
        rim=named["rim"],
        axis=(named["axis_x"], named["axis_y"]),
        sight=(named["sight_0"], named["sight_2"]),
        lamps=(named["lamp_x"], named["lamp_y"]),
        scatter=_MARGIN * named["scatter"],
        curve=powers,
        reach=reach,
        shade=np.array([named[f"shade_{number}"] for number in range(5)]),
        pattern=pattern,
        zenith_sigma=np.full(source.shape[1:], np.nan, np.float32),
        azimuth_sigma=np.full(source.shape[1:], np.nan, np.float32),
        parameters=(*SENSOR, *(f"step_{number}" for number in range(CURVE_COEFFICIENTS))),
        covariance=fit.covariance[: STEPS.stop, : STEPS.stop],
        error=most,
    )
    zenith_sigma, azimuth_sigma = _error_maps(response, fit, source)
    zenith_sigma = np.hypot(zenith_sigma, np.float32(residual))
    return replace(response, zenith_sigma=zenith_sigma, azimuth_sigma=azimuth_sigma)


def _reach(named: Mapping[str, float], shares: tuple[float, float] = (0.0, 1.0)) -> tuple[float, float]:
    """Return the q between which the whole scattered ray meets the wall, and there are samples."""
    whole, turn = math.atan2(named["rim"], named["radius"]), _MARGIN * named["scatter"]
    low = max(turn, (1 - shares[1]) * whole)
    high = min(whole - turn, (1 - shares[0]) * whole)
    return math.tan(low / 2), math.tan(high / 2)


def _polynomial(
    named: Mapping[str, float], coefficients: Doubles, ends: tuple[float, float]
) -> tuple[Doubles, tuple[float, float]]:
    """Return the scattered curve at the centre as a polynomial in q, of few terms, and where it is valid."""
    q = np.linspace(*ends, _PLACES)
    whole = math.atan2(named["rim"], named["radius"])
    elevation, turn = 2 * np.arctan(q), named["scatter"]
    light = curve_means(1 - (elevation + turn) / whole, 1 - (elevation - turn) / whole) @ coefficients
    for terms in range(2, _TERMS + 1):
        fit = np.polynomial.Polynomial.fit(q, light, terms - 1)
        if np.max(np.abs(fit(q) - light)) <= _EXACT:
            break
    if np.ptp(light) < _GRADED * np.max(light):
        raise InputError(
            "the wall is equally bright at all heights: give --pattern uniform, or check that the print is in"
        )
    steepness = fit.deriv()(q)
    middle = _PLACES // 2
    flat = np.flatnonzero(steepness * np.sign(steepness[middle]) < _FLAT * np.median(np.abs(steepness)))
    first = flat[flat < middle].max(initial=-1) + 1
    last = flat[flat > middle].min(initial=_PLACES) - 1
    return np.asarray(fit.convert().coef), (float(q[first]), float(q[last]))


def _error_maps(
    response: WallResponse, fit: WallFit, source: Source
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the standard deviations of zenith, and of azimuth times the zenith's sine, (H, W), radians.

    What a fit says of the light of 8 frames is off by its slopes times the parameters' errors, and the normal
    of least squares by what comes of that. Root mean square over azimuths, in the middle of the reach, or
    where light begins under a uniform wall; NaN where no azimuth shows the wall.
    """
    from scipy.ndimage import map_coordinates

    pixel_size, shape = pixel_size_of(source), source.shape[1:]
    axes = (np.linspace(axis[0], axis[-1], _SIDE) for axis in pixel_axes(shape, pixel_size))
    places = np.repeat(np.stack([axis.ravel() for axis in np.meshgrid(*axes)]), _TURN, axis=1)
    azimuth = np.tile(np.arange(_TURN) * 2 * np.pi / _TURN, _SIDE * _SIDE)
    if response.pattern == "uniform":
        zenith = threshold_zenith(response, places[0], places[1], azimuth, _HALF * response.curve[0])
    else:
        middle = math.pi / 4 - math.atan(sum(response.reach) / 2)
        outside = np.hypot(places[0] - response.axis[0], places[1] - response.axis[1]) >= response.radius
        zenith = np.where(outside, np.nan, middle)
    seen = np.isfinite(zenith)
    slopes = np.full((2, len(zenith), STEPS.stop), np.nan)
    slopes[:, seen] = _normal_slopes(fit, places[:, seen], azimuth[seen], zenith[seen])
    covariance = fit.covariance[: STEPS.stop, : STEPS.stop]
    variance = np.einsum("inp,pq,inq->in", slopes, covariance, slopes).reshape(2, -1, _TURN)
    known = np.isfinite(variance)
    count = np.where(known.any(axis=-1), known.sum(axis=-1), np.nan)
    coarse = np.sqrt(np.where(known, variance, 0).sum(axis=-1) / count).reshape(2, _SIDE, _SIDE)
    # Rows go down the picture as the coarse ones do: both follow the pixels' axes.
    where = np.meshgrid(*(np.linspace(0, _SIDE - 1, size) for size in shape), indexing="ij")
    zenith_sigma, azimuth_sigma = (
        map_coordinates(one, where, order=1, mode="nearest").astype(np.float32) for one in coarse
    )
    if response.pattern == "uniform":
        azimuth_sigma[:] = np.nan
    return zenith_sigma, azimuth_sigma


def error_left(samples: LightSamples, fit: WallFit, noise: Doubles) -> tuple[float, float]:
    """Return the RMS error of the zenith that the fit leaves on the balls, and its upper bound, radians.

    Estimated by the mean residuals of cells, octants of some rings of each ball, whose noise averages out.
    The first is what is left beyond noise, 0 where that is none; the upper bound is one standard error of its
    square more, which noise never lets be 0.
    """
    named, steps, centres = split(fit.parameters)
    met = meet_balls(samples, named, centres)
    coefficients = curve_from_steps(fit.rising) @ steps
    flat = np.hypot(met.normal[0], met.normal[1])
    steeper = np.cos(_STEP) * met.normal + np.sin(_STEP) * np.stack(
        [*(met.normal[:2] * met.normal[2] / np.maximum(flat, _STEP)), -flat]
    )
    light = light_of(met, named, coefficients)
    slope = (light_of(met._replace(normal=steeper), named, coefficients) - light) / _STEP
    turn = np.arctan2(met.normal[1], met.normal[0]) / (2 * np.pi) + 0.5
    octant = np.minimum((turn * _OCTANTS).astype(np.intp), _OCTANTS - 1)
    ring = np.minimum((flat / flat.max() * _RINGS).astype(np.intp), _RINGS - 1)
    cell = (samples.press[samples.pose] * _RINGS + ring) * _OCTANTS + octant
    residual = np.clip(samples.light - light, -_OUTLIER * noise, _OUTLIER * noise)
    summed = np.ones_like(light), residual, noise**2, slope**2
    count, total, expected, steep = (np.bincount(cell, values) for values in summed)
    # A mean's square less what noise makes of it, summed over samples.
    known = count > 0
    share = expected[known] / count[known]
    excess = max(0.0, float(np.sum(total[known] ** 2 / count[known] - share)))
    # The square of a normal number of variance v has variance 2 v^2.
    chance = math.sqrt(2 * float(np.sum(share**2)))
    over = max(float(np.sum(steep)), 1e-12)
    return math.sqrt(excess / over), math.sqrt((excess + chance) / over)


def _normal_slopes(fit: WallFit, places: Doubles, azimuth: Doubles, zenith: Doubles) -> Doubles:
    """Return how zenith, and azimuth times its sine, change with the parameters, (2, n, STEPS.stop)."""
    parameters = fit.parameters[: STEPS.stop]

    def light(values: Doubles, theta: Doubles, phi: Doubles) -> Doubles:
        return _light_of_turn(values, fit.rising, places, theta, phi)

    across = _STEP / np.sin(zenith)
    design = np.stack(
        [
            light(parameters, zenith + _STEP, azimuth) - light(parameters, zenith - _STEP, azimuth),
            light(parameters, zenith, azimuth + across) - light(parameters, zenith, azimuth - across),
        ],
        axis=-1,
    ) / (2 * _STEP)
    by_parameter = np.zeros((*design.shape[:2], len(parameters)))
    scales = [*(SCALES[name] for name in SENSOR), *([1.0] * (STEPS.stop - STEPS.start))]
    for number, step in enumerate(_SMALL * np.array(scales)):
        moved = np.repeat(parameters[np.newaxis], 2, axis=0)
        moved[:, number] += step, -step
        change = light(moved[0], zenith, azimuth) - light(moved[1], zenith, azimuth)
        by_parameter[..., number] = change / (2 * step)
    return np.asarray(np.moveaxis(-np.linalg.pinv(design, rcond=1e-6) @ by_parameter, 1, 0), np.float64)


def _light_of_turn(
    parameters: Doubles, rising: bool, places: Doubles, zenith: Doubles, azimuth: Doubles
) -> Doubles:
    """Return the light of normals at places on the rest plane in the frames of a rotation, (n, frames)."""
    named, steps, _ = split(parameters)
    phase = np.arange(_FRAMES) * 2 * np.pi / _FRAMES
    turns = rotations(_LEAN * np.stack([np.cos(phase), np.sin(phase)], axis=1))
    normal = np.moveaxis(turns @ _normals(zenith, azimuth), 0, -1).reshape(3, -1)
    from_axis, lean = look(np.repeat(places, _FRAMES, axis=1), named)
    met = SheetPoints(from_axis[0], from_axis[1], np.zeros(from_axis.shape[1]), down(lean), normal)
    return light_of(met, named, curve_from_steps(rising) @ steps).reshape(-1, _FRAMES)
