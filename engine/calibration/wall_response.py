"""The response of all pixels from a fit of the wall, its errors, and the zenith of first light."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.calibration import wall_model as model
from mirrorskin.engine.calibration.ball import rotations
from mirrorskin.engine.calibration.sources import pixel_size_of
from mirrorskin.engine.calibration.wall_fit import WallFit
from mirrorskin.engine.rotation.response import shade
from mirrorskin.io import InputError, Source, WallResponse, pixel_axes
from mirrorskin.io.base.arguments import check_number, checked, in_unit
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.rotation.response import (
    follow,
    half_tangent,
    lamp_light,
    level,
    sight_of,
    sight_slopes,
)

_ZENITHS = 16  # number of zeniths at which the first light is searched for
_HALVINGS = 16  # number of bisections of the interval of the first light

_EXACT = 1e-4  # share of full light: maximum error of the polynomial
_TERMS = 12  # maximum number of terms of the polynomial
_PLACES = 400  # number of points of the curve to which the polynomial is fitted
_SMOOTH = 1e-3  # weight of the roughness of a curve, relative to its light
_HALF = 0.5  # share of full light: threshold of a uniform wall
_GRADED = 0.2  # minimum variation of a graded wall, as a share of its maximum light
_MIN_CURVE_SLOPE = 0.02  # minimum slope of the curve, relative to the slope in its middle
FEW = 2e-3
"""Share of the samples outside the reach, at either end."""


_SIDE = 5  # number of positions along a side at which errors are computed
_TURN = 8  # number of azimuths at each position
_LEAN = math.radians(2.5)  # tilt of a typical rotation; errors of the normals hardly depend on it
_FRAMES = 8  # number of frames of that rotation
_DERIVATIVE_STEP = 1e-4  # radians: step of numerical derivatives by angles
_SMALL = 1e-3  # step of numerical derivatives by a parameter, relative to its scale
_SCALES = np.append([model.SCALES[name] for name in model.SENSOR], np.ones(model.CURVE_COEFFICIENTS))
_SWING_ZENITHS = 0.25, 0.5, 0.75  # shares of the reach at which errors of the swing are computed
_CLIP_Z_SCORE = 3.0  # times the noise at which residuals are clipped
_RINGS, _OCTANTS = 6, 8  # cells of a press, in which residuals are averaged


@checked(x=in_unit("mm"), y=in_unit("mm"), azimuth=in_unit("rad"), threshold=check_number, z=in_unit("mm"))
def threshold_zenith(
    response: WallResponse,
    x: ArrayLike,
    y: ArrayLike,
    azimuth: ArrayLike,
    threshold: float = 0.5,
    *,
    z: ArrayLike = 0.0,
) -> Doubles:
    """Return the smallest zenith of bright mirrors, radians; NaN if there is none up to 45 degrees.

    Parameters
    ----------
    response : WallResponse
    x, y : array_like
        Positions of pixels on the rest plane, mm. These, ``azimuth`` and ``z`` broadcast.
    azimuth : array_like
        Azimuth of the mirrors' normals, radians.
    threshold : float
        Share of the pixels' full light.
    z : array_like
        Height of the mirrors, mm.
    """
    arrays = np.broadcast_arrays(*(np.asarray(value, np.float64) for value in (x, y, z, azimuth)))
    *place, turn = (value.ravel() for value in arrays)
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
    return np.asarray(((dark + light) / 2).reshape(arrays[0].shape))


def full_light(response: WallResponse, places: Doubles, zenith: Doubles, azimuth: Doubles) -> Doubles:
    """Return shares of the pixels' full light, (n,), including scattered rays that partly miss the wall.

    ``places`` are x and y on the rest plane and the mirror's height, (3, n), mm; zenith and azimuth are its
    normal's. Outside its reach the wall is as bright as at the end of the reach.
    """
    z, radius = places[2], response.radius
    from_axis = places[:2] - np.reshape(response.axis, (2, 1))
    slope = sight_slopes(from_axis, response.sight)
    mirror = from_axis + z * slope
    mirror = np.where((mirror**2).sum(axis=0) < radius**2, mirror, np.nan)
    ray = follow(np.stack([*mirror, z]), sight_of(slope), _normals(zenith, azimuth), radius)
    # Share of the ray, spread evenly over the scatter, that meets the wall.
    out = np.sqrt(ray.direction[0] ** 2 + ray.direction[1] ** 2)
    elevation, spread = np.arctan2(ray.direction[2], out), max(response.scatter, 1e-9)
    top = np.minimum(np.arctan2(response.rim - z, ray.distance * out), model.MAX_RAY_ELEVATION)
    bottom = np.arctan2(-z, ray.distance * out)
    lit = np.minimum(elevation + spread, top) - np.maximum(elevation - spread, bottom)
    q = np.clip(half_tangent(ray.height, radius), *response.reach)
    light = level(q, response.curve, response.reach)[0]
    light *= shade(response, *from_axis) * lamp_light(ray, response.lamps)
    return np.asarray(light * np.clip(lit / (2 * spread), 0, 1))


def _normals(zenith: Doubles, azimuth: Doubles) -> Doubles:
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)])


def make_response(
    fit: WallFit, samples: model.LightSamples, noise: Doubles, pattern: str, source: Source
) -> WallResponse:
    """Return a fit to samples with some noise as a response for the pixels of a source."""
    named, _, centres = model.split(fit.parameters)
    residual, largest = error_left(samples, fit, noise)
    shares = (0.0, 1.0)
    if pattern == "graded":
        wall = model.reach_wall(model.meet_balls(samples, named, centres), named)
        low, high = np.quantile((wall.low + wall.high) / 2, [FEW, 1 - FEW])
        shares = float(low), float(high)
    response = response_of(fit, shares, pattern, source)
    zenith_sigma = np.hypot(response.zenith_sigma, np.float32(residual))
    swing_sigma = response.swing_sigma
    if swing_sigma is not None:  # the swing is a difference of light whose zeniths are two tilts apart
        swing_sigma = math.hypot(swing_sigma, math.sqrt(2) * residual / _LEAN)
    return replace(response, zenith_sigma=zenith_sigma, swing_sigma=swing_sigma, error=largest)


def response_of(fit: WallFit, shares: tuple[float, float], pattern: str, source: Source) -> WallResponse:
    """Return a fit to samples between two shares of the wall's height as a response for a source's pixels.

    Its scatter is 5 % larger than the fitted one, so that its range is on the safe side. Its error is the
    median standard error of the zenith.
    """
    named, steps, _ = model.split(fit.parameters)
    coefficients = model.curve_from_steps(fit.rising) @ steps
    if pattern == "uniform":
        powers, reach = coefficients[:1], _reach(named)
    else:
        powers, reach = _polynomial(named, coefficients, _reach(named, shares))
    response = WallResponse(
        radius=named["radius"],
        rim=named["rim"],
        axis=(named["axis_x"], named["axis_y"]),
        sight=(named["sight_0"], named["sight_2"]),
        lamps=(named["lamp_x"], named["lamp_y"]),
        scatter=model.SCATTER_MARGIN * named["scatter"],
        curve=powers,
        reach=reach,
        shade=np.array([named[f"shade_{number}"] for number in range(5)]),
        pattern=pattern,
        zenith_sigma=np.full(source.shape[1:], np.nan, np.float32),
        azimuth_sigma=np.full(source.shape[1:], np.nan, np.float32),
        parameters=(*model.SENSOR, *model.STEP_NAMES),
        covariance=fit.covariance[: model.STEPS.stop, : model.STEPS.stop],
        error=math.nan,
    )
    zenith_sigma, azimuth_sigma = _error_maps(response, fit, source)
    swing_sigma = _swing_error(response, fit, source) if pattern == "graded" else None
    response = replace(response, zenith_sigma=zenith_sigma, azimuth_sigma=azimuth_sigma)
    return replace(response, swing_sigma=swing_sigma, error=float(np.nanmedian(zenith_sigma)))


def _reach(named: Mapping[str, float], shares: tuple[float, float] = (0.0, 1.0)) -> tuple[float, float]:
    """Return the range of q in which the whole scattered ray meets the wall, and there are samples."""
    whole, spread = math.atan2(named["rim"], named["radius"]), model.SCATTER_MARGIN * named["scatter"]
    low = max(spread, (1 - shares[1]) * whole)
    high = min(whole - spread, (1 - shares[0]) * whole)
    return math.tan(low / 2), math.tan(high / 2)


def _polynomial(
    named: Mapping[str, float], coefficients: Doubles, ends: tuple[float, float]
) -> tuple[Doubles, tuple[float, float]]:
    """Return the blurred curve at the centre as a polynomial in q with few terms, and its valid range."""
    q = np.linspace(*ends, _PLACES)
    light = _blurred(named, q) @ coefficients
    for terms in range(2, _TERMS + 1):
        fit = np.polynomial.Polynomial.fit(q, light, terms - 1)
        if np.max(np.abs(fit(q) - light)) <= _EXACT:
            break
    if np.ptp(light) < _GRADED * np.max(light):
        raise InputError(
            "the wall is equally bright at all heights: give --pattern uniform, or check that the print is in"
        )
    slope = fit.deriv()(q)
    middle = _PLACES // 2
    flat = np.flatnonzero(slope * np.sign(slope[middle]) < _MIN_CURVE_SLOPE * np.median(np.abs(slope)))
    first = flat[flat < middle].max(initial=-1) + 1
    last = flat[flat > middle].min(initial=_PLACES) - 1
    return np.asarray(fit.convert().coef), (float(q[first]), float(q[last]))


def _blurred(named: Mapping[str, float], q: Doubles) -> Doubles:
    """Return the matrix from coefficients to the light of the centre at q, blurred by the scatter."""
    whole = math.atan2(named["rim"], named["radius"])
    elevation, spread = 2 * np.arctan(q), named["scatter"]
    return model.curve_means(1 - (elevation + spread) / whole, 1 - (elevation - spread) / whole)


def steps_of(response: WallResponse) -> Doubles:
    """Return the steps of the smoothest rising curve whose light is that of a response, by least squares."""
    named = {
        "radius": response.radius,
        "rim": response.rim,
        "scatter": response.scatter / model.SCATTER_MARGIN,
    }
    q = np.linspace(*response.reach, _PLACES)
    matrix = _blurred(named, q) @ model.curve_from_steps(rising=True)
    rough = _SMOOTH * model.curve_roughness() @ model.curve_from_steps(rising=True)
    light = np.append(np.polynomial.polynomial.polyval(q, response.curve), np.zeros(len(rough)))
    return np.asarray(np.linalg.lstsq(np.concatenate([matrix, rough]), light, rcond=None)[0])


def _error_maps(
    response: WallResponse, fit: WallFit, source: Source
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the standard deviations of zenith, and of azimuth times the zenith's sine, (H, W), radians.

    The covariance of the parameters is propagated to the light of 8 frames, and from there to the normal by
    least squares. RMS over azimuths, in the middle of the reach, or at the threshold for a uniform wall; NaN
    where the wall is visible at no azimuth.
    """
    from scipy.ndimage import map_coordinates

    shape = source.shape[1:]
    places, azimuth = _mirrors(source)
    if response.pattern == "uniform":
        zenith = threshold_zenith(response, places[0], places[1], azimuth, _HALF * response.curve[0])
    else:
        middle = math.pi / 4 - math.atan(sum(response.reach) / 2)
        zenith = np.where(_on_body(response, places), middle, np.nan)
    valid = np.isfinite(zenith)
    slopes = np.full((2, len(zenith), model.STEPS.stop), np.nan)
    slopes[:, valid] = _normal_slopes(fit, places[:, valid], azimuth[valid], zenith[valid])
    covariance = fit.covariance[: model.STEPS.stop, : model.STEPS.stop]
    variance = np.einsum("inp,pq,inq->in", slopes, covariance, slopes).reshape(2, -1, _TURN)
    valid = np.isfinite(variance)
    count = np.where(valid.any(axis=-1), valid.sum(axis=-1), np.nan)
    coarse = np.sqrt(np.where(valid, variance, 0).sum(axis=-1) / count).reshape(2, _SIDE, _SIDE)
    # The rows of the coarse maps are in the order of the picture's: both follow the pixels' axes.
    positions = np.meshgrid(*(np.linspace(0, _SIDE - 1, size) for size in shape), indexing="ij")
    zenith_sigma, azimuth_sigma = (
        map_coordinates(sigma, positions, order=1, mode="nearest").astype(np.float32) for sigma in coarse
    )
    if response.pattern == "uniform":
        azimuth_sigma[:] = np.nan
    return zenith_sigma, azimuth_sigma


def _mirrors(source: Source) -> tuple[Doubles, Doubles]:
    """Return places on the rest plane, (2, n), mm, and azimuths at which errors are computed, (n,)."""
    axes = (
        np.linspace(axis[0], axis[-1], _SIDE) for axis in pixel_axes(source.shape[1:], pixel_size_of(source))
    )
    places = np.repeat(np.stack([axis.ravel() for axis in np.meshgrid(*axes)]), _TURN, axis=1)
    return places, np.tile(np.arange(_TURN) * 2 * np.pi / _TURN, _SIDE * _SIDE)


def _on_body(response: WallResponse, places: Doubles) -> NDArray[np.bool_]:
    """Return whether places are within the wall."""
    away = np.hypot(places[0] - response.axis[0], places[1] - response.axis[1])
    return np.asarray(away < response.radius)


def _swing_error(response: WallResponse, fit: WallFit, source: Source) -> float:
    """Return the relative standard error of the swing of the brightness over a turn, at a given mean.

    The mean m and the amplitude a of the light of a mirror change with its zenith and with the parameters p
    of the fit; at a given mean, the amplitude changes by ::

        d ln a = (a_p - a_z m_p / m_z) dp / a

    It is averaged over the picture and azimuths; RMS over zeniths.
    """
    places, azimuth = _mirrors(source)
    inside = _on_body(response, places)
    places, azimuth = places[:, inside], azimuth[inside]
    parameters = fit.parameters[: model.STEPS.stop]
    covariance = fit.covariance[: model.STEPS.stop, : model.STEPS.stop]
    first = np.exp(2j * np.pi * np.arange(_FRAMES) / _FRAMES) * 2 / _FRAMES
    low, high = (math.pi / 4 - math.atan(q) for q in reversed(response.reach))
    variances = []
    for share in _SWING_ZENITHS:
        zenith = np.full(len(azimuth), low + share * (high - low))

        def wave(values: Doubles, by: float = 0.0, at: Doubles = zenith) -> Doubles:
            light = _light_of_turn(values, fit.rising, places, at + by, azimuth)
            return np.stack([np.mean(light, axis=1), np.abs(light @ first)])

        steeper = wave(parameters, _DERIVATIVE_STEP) - wave(parameters, -_DERIVATIVE_STEP)
        mean_slope, slope = steeper / (2 * _DERIVATIVE_STEP)
        mean, amplitude = _by_parameters(wave, parameters)
        changes = amplitude - (slope / mean_slope)[:, np.newaxis] * mean
        by_parameter = np.nanmean(changes / wave(parameters)[1][:, np.newaxis], axis=0)
        variances.append(by_parameter @ covariance @ by_parameter)
    return math.sqrt(float(np.mean(variances)))


def error_left(samples: model.LightSamples, fit: WallFit, noise: Doubles) -> tuple[float, float]:
    """Return the RMS error of the zenith that remains on the balls, and its upper bound, radians.

    The error is estimated from mean residuals over cells (octants of rings of each ball), in which noise is
    averaged: it is the excess over the noise, or 0. The bound adds one standard error of its square, so it is
    never 0.
    """
    named, steps, centres = model.split(fit.parameters)
    met = model.meet_balls(samples, named, centres)
    coefficients = model.curve_from_steps(fit.rising) @ steps
    flat = np.hypot(met.normal[0], met.normal[1])
    steeper = np.cos(_DERIVATIVE_STEP) * met.normal + np.sin(_DERIVATIVE_STEP) * np.stack(
        [*(met.normal[:2] * met.normal[2] / np.maximum(flat, _DERIVATIVE_STEP)), -flat]
    )
    light = model.light_of(met, named, coefficients)
    slope = (model.light_of(met._replace(normal=steeper), named, coefficients) - light) / _DERIVATIVE_STEP
    turn = np.arctan2(met.normal[1], met.normal[0]) / (2 * np.pi) + 0.5
    octant = np.minimum((turn * _OCTANTS).astype(np.intp), _OCTANTS - 1)
    ring = np.minimum((flat / flat.max() * _RINGS).astype(np.intp), _RINGS - 1)
    cell = (samples.press[samples.pose] * _RINGS + ring) * _OCTANTS + octant
    residual = np.clip(samples.light - light, -_CLIP_Z_SCORE * noise, _CLIP_Z_SCORE * noise)
    terms = np.ones_like(light), residual, noise**2, slope**2
    count, total, expected, steep = (np.bincount(cell, values) for values in terms)
    # Square of each cell's mean minus its expectation from noise, summed over samples.
    filled = count > 0
    mean_error = expected[filled] / count[filled]
    excess = max(0.0, float(np.sum(total[filled] ** 2 / count[filled] - mean_error)))
    # The square of a normal variate of variance v has the variance 2 v^2.
    chance = math.sqrt(2 * float(np.sum(mean_error**2)))
    over = max(float(np.sum(steep)), 1e-12)
    return math.sqrt(excess / over), math.sqrt((excess + chance) / over)


def _normal_slopes(fit: WallFit, places: Doubles, azimuth: Doubles, zenith: Doubles) -> Doubles:
    """Return the derivatives of zenith, and azimuth times its sine, by the parameters, (2, n, P)."""
    parameters = fit.parameters[: model.STEPS.stop]

    def light(values: Doubles, theta: Doubles, phi: Doubles) -> Doubles:
        return _light_of_turn(values, fit.rising, places, theta, phi)

    across = _DERIVATIVE_STEP / np.sin(zenith)
    design = np.stack(
        [
            light(parameters, zenith + _DERIVATIVE_STEP, azimuth)
            - light(parameters, zenith - _DERIVATIVE_STEP, azimuth),
            light(parameters, zenith, azimuth + across) - light(parameters, zenith, azimuth - across),
        ],
        axis=-1,
    ) / (2 * _DERIVATIVE_STEP)
    by_parameter = _by_parameters(lambda values: light(values, zenith, azimuth), parameters)
    return np.asarray(np.moveaxis(-np.linalg.pinv(design, rcond=1e-6) @ by_parameter, 1, 0), np.float64)


def _by_parameters(of: Callable[[Doubles], Doubles], parameters: Doubles) -> Doubles:
    """Return the derivatives of a function by the parameters, along a last axis."""
    derivatives = []
    for number, step in enumerate(_SMALL * _SCALES):
        more, less = parameters.copy(), parameters.copy()
        more[number] += step
        less[number] -= step
        derivatives.append((of(more) - of(less)) / (2 * step))
    return np.stack(derivatives, axis=-1)


def _light_of_turn(
    parameters: Doubles, rising: bool, places: Doubles, zenith: Doubles, azimuth: Doubles
) -> Doubles:
    """Return the light, (n, frames), of normals at places on the rest plane in the frames of a rotation."""
    named, steps, _ = model.split(parameters)
    phase = np.arange(_FRAMES) * 2 * np.pi / _FRAMES
    turns = rotations(_LEAN * np.stack([np.cos(phase), np.sin(phase)], axis=1))
    normal = np.moveaxis(turns @ _normals(zenith, azimuth), 0, -1).reshape(3, -1)
    (x, y), slope = model.look(np.repeat(places, _FRAMES, axis=1), named)
    met = model.SheetPoints(x, y, np.zeros_like(x), sight_of(slope), normal)
    return model.light_of(met, named, model.curve_from_steps(rising) @ steps).reshape(-1, _FRAMES)
