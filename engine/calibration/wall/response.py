"""What a fit of the wall says of every pixel, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.wall import curve
from mirrorskin.engine.calibration.wall.errors import error_left, error_maps, error_places
from mirrorskin.engine.calibration.wall.fit import WallFit
from mirrorskin.engine.calibration.wall.model import SENSOR, STEPS, Samples, meet_balls, reach_wall, split
from mirrorskin.engine.calibration.wall.window import threshold_zenith
from mirrorskin.io import InputError, Source, WallResponse

Doubles = NDArray[np.float64]

_MARGIN = 1.05  # of the scatter: its edges are not sharp, and off the centre it is a little wider
_EXACT = 1e-4  # of full light by which the polynomial may miss the curve
_TERMS = 12
_PLACES = 400  # of the curve, at which the polynomial is fitted
_HALF = 0.5  # of the light of a uniform wall
_GRADED = 0.2  # of its greatest light by which a graded wall's changes at least
_FLAT = 0.02  # of its middle's steepness that a curve must have to be read
_FEW = 2e-3  # of the samples that may lie beyond the reach at either end


def make_response(
    fit: WallFit, samples: Samples, noise: Doubles, pattern: str, source: Source
) -> WallResponse:
    """Tell a fit as a response.

    Its scatter is 5 % above the fitted one, so that what is within its range is so safely.

    Parameters
    ----------
    fit : WallFit
    samples : Samples
        That went into it.
    noise : ndarray, (N,), float64
        Of their light.
    pattern : {"graded", "uniform"}
    source : Source
        One of the recordings, which tells how many pixels there are, and how large.
    """
    named, steps, _ = split(fit.parameters)
    left, most = error_left(samples, fit, noise)
    coefficients = curve.from_steps(fit.rising) @ steps
    if pattern == "uniform":
        powers, reach = coefficients[:1], _ends(named)
    else:
        powers, reach = _polynomial(named, coefficients, _ends(named, _shares(samples, fit)))
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
        parameters=(*SENSOR, *(f"step_{number}" for number in range(curve.COEFFICIENTS))),
        covariance=fit.covariance[: STEPS.stop, : STEPS.stop],
        error=most,
    )
    return _with_errors(response, fit, source, left)


def _with_errors(response: WallResponse, fit: WallFit, source: Source, left: float) -> WallResponse:
    """Add how far zenith and azimuth are off: in the middle of the reach, or where light begins.

    ``left`` is what the fit leaves of the zenith beyond noise, radians.
    """
    places, azimuth = error_places(source)
    if response.pattern == "uniform":
        zenith = threshold_zenith(response, places[0], places[1], azimuth, _HALF * response.curve[0])
    else:
        middle = math.pi / 4 - math.atan(sum(response.reach) / 2)
        outside = np.hypot(places[0] - response.axis[0], places[1] - response.axis[1]) >= response.radius
        zenith = np.where(outside, np.nan, middle)
    zenith_sigma, azimuth_sigma = error_maps(fit, source.shape[1:], places, azimuth, zenith)
    if response.pattern == "uniform":
        azimuth_sigma[:] = np.nan
    zenith_sigma = np.hypot(zenith_sigma, np.float32(left))
    return replace(response, zenith_sigma=zenith_sigma, azimuth_sigma=azimuth_sigma)


def _shares(samples: Samples, fit: WallFit) -> tuple[float, float]:
    """Return the places on the wall, as shares, between which the samples see it."""
    named, _, centres = split(fit.parameters)
    wall = reach_wall(meet_balls(samples, named, centres), named)
    low, high = np.quantile((wall.low + wall.high) / 2, [_FEW, 1 - _FEW])
    return float(low), float(high)


def _ends(named: Mapping[str, float], shares: tuple[float, float] = (0.0, 1.0)) -> tuple[float, float]:
    """Return the q between which the whole scattered ray meets the wall, and the samples tell of it."""
    whole, turn = math.atan2(named["rim"], named["radius"]), _MARGIN * named["scatter"]
    low = max(turn, (1 - shares[1]) * whole)
    high = min(whole - turn, (1 - shares[0]) * whole)
    return math.tan(low / 2), math.tan(high / 2)


def _polynomial(
    named: Mapping[str, float], coefficients: Doubles, ends: tuple[float, float]
) -> tuple[Doubles, tuple[float, float]]:
    """Return the scattered curve at the centre as a polynomial in q, and where it can be read.

    It has as few terms as meet the curve.
    """
    q = np.linspace(*ends, _PLACES)
    whole = math.atan2(named["rim"], named["radius"])
    elevation, turn = 2 * np.arctan(q), named["scatter"]
    light = curve.means(1 - (elevation + turn) / whole, 1 - (elevation - turn) / whole) @ coefficients
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
