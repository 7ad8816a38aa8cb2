"""Corrections and uncertainties of the normals of a rotation, which every run applies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, on_host, stored_map
from mirrorskin.engine.base.frames import QUANTUM, take_places, typical_value
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.diagnosis.amplitude_blur import BEND_NOISE, with_bend
from mirrorskin.engine.diagnosis.curl import AzimuthBias, find_azimuth_bias
from mirrorskin.engine.diagnosis.registration import Registered
from mirrorskin.engine.diagnosis.residual_noise import CountNoise
from mirrorskin.engine.diagnosis.sensor_health import (
    CALIBRATION,
    change_of_swing,
    reference_of,
    with_light_change,
)
from mirrorskin.engine.diagnosis.swing import ModulationEffects, find_modulation_effects, swing_of_wall
from mirrorskin.engine.diagnosis.turn_nuisances import TurnNuisances, shift_of
from mirrorskin.io import Calibrated, Result, Source
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.io.watch.mirrored import MIRRORED
from mirrorskin.kernels.numerics.least_squares import CLEAR_Z_SCORE, mad_sigma
from mirrorskin.kernels.rotation.normals import azimuth_of

if TYPE_CHECKING:
    from mirrorskin.engine.rotation.normals import Normals, NormalsOperation

_PARTS, _POINTS = 8, 64  # of the extent of the normals: distance between slopes; slopes along a side
_GRID = 64  # points along a side that show this extent
_MIN_POINTS, _MIN_CORRELATION = 100, 0.1  # points, and their correlation, that decide
_MAX_CORRELATION = 0.05  # of neighbours: greatest one of a mirrored surface
_REACH = 5  # pixels: size of the neighbourhood whose loss of contact affects a registered sample
_STILL = 0.2  # pixels by which points may move, where the swing of brightness is still that of their normals


class RegistrationUncertainty(Step):
    """Correct the errors of normals for the interpolation of registered frames.

    A given noise of samples is corrected; noise that was estimated from the registered frames includes the
    interpolation. A sample is interpolated from 4 x 4 pixels, which must all be in contact.
    """

    needs = ("normals_sigma", "contact")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other ``normals_sigma`` and ``contact``, if frames were registered."""
        if not isinstance(context.stream, Registered):
            return result
        import cv2

        sigma, contact = result.normals_sigma, result.contact
        reach = np.ones((_REACH, _REACH), np.uint8)
        lost = np.isfinite(sigma) & (contact == 0)
        near = [cv2.dilate(lost_map.view(np.uint8), reach) for lost_map in lost.reshape(-1, *lost.shape[-2:])]
        inside = contact * (np.reshape(near, lost.shape) == 0)
        if context.operation.option_values()["noise"] is not None:
            sigma = sigma * context.stream.noise_gain
        fitted = replace(result.fitted, registered=True)
        return result.assign(normals_sigma=sigma, contact=inside, fitted=fitted)


class PhaseUncertainty(Step):
    """Correct slopes that are rotated, and warn if phases seem to run the wrong way round.

    The curl of the slopes shows by how much they are rotated, as by a wrong phase of the first frame or by a
    rolling shutter: see `mirrorskin.engine.diagnosis.curl`. With phases reversed, the surface is mirrored.
    """

    needs = ("normals", "normals_sigma", "contact")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other normals, or with a warning, if the slopes contradict the phases."""
        normals = stored_map(result, "normals")
        several = normals.ndim == 4
        if _mirrored(normals[0] if several else normals):
            return with_findings(result, MIRRORED)
        if several:
            return result
        size = context.source.header.pixel_size or (1.0, 1.0)
        error = find_azimuth_bias(normals, result.contact, size)
        if error is None:
            return result
        normals = error.remove(result.normals)
        sine = np.hypot(normals[..., 0], normals[..., 1])
        sigma = np.hypot(result.normals_sigma, np.float32(error.sigma) * sine)
        result = result.assign(normals=normals, azimuth=partial(azimuth_of, normals), normals_sigma=sigma)
        return with_findings(result, _rotated(error))


class ResponseUncertainty(Step):
    """Compare the swing of the brightness with what tilt and gain predict.

    Gains of pixels are added to the errors, and noted; the area that a pixel sees is used. Blur, and a
    response that is not linear, are warnings: see `mirrorskin.engine.diagnosis.swing`, and so is brightness
    that has changed since the calibration, or that contradicts the stated gain: see
    `mirrorskin.engine.diagnosis.sensor_health`. Of a calibrated response, only the latter is judged, and only
    if points of the surface stay at their pixels: frames of a stream are not registered.
    """

    needs = ("normals", "normals_sigma", "zenith", "mean", "modulation", "contact")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other ``normals_sigma``, or with a warning."""
        operation = cast("Normals", context.operation)
        fitted = result.fitted
        noise, slope, frames, tilt = fitted.noise, fitted.shot_noise, fitted.frames, fitted.tilt
        normals, mean = (stored_map(result, name) for name in ("normals", "mean"))
        if normals.ndim == 4:
            return result
        if noise is None or slope is None or frames is None or tilt is None:  # of a class with its own result
            return result
        cosine, sine = (stored_map(context.computed, name) for name in ("cosine", "sine"))
        base = noise**2 - (slope * typical_value(mean) if slope > 0 else 0.0)
        maps = normals, mean, cosine, sine, result.contact
        noise_of_mean = CountNoise(base / frames, slope / frames, QUANTUM**2 / frames)
        header, response = context.source.header, operation.response
        if response is not None:
            if not isinstance(context.stream, Registered) and shift_of(header, tilt) > _STILL:
                return result
            swing = swing_of_wall(*maps, response, tilt, noise_of_mean)
            sigma = response.swing_sigma
            if sigma is None:  # the swing is a difference of light whose zeniths are two tilts apart
                sigma = math.sqrt(2) * float(np.nanmedian(response.sigma)) / tilt
            tilt_sigma = _calibrated_tilt_sigma(context.source, tilt)
            change = change_of_swing(swing, header, tilt, sigma, tilt_sigma)
            return with_light_change(result, change, CALIBRATION)
        gain = cast("ArrayLike", operation.zenith_gain)
        modulation = find_modulation_effects(*maps, gain, tilt, noise_of_mean)
        if modulation.gain > 0:
            result = _with_share_of_zenith(result, modulation.gain).with_fitted(
                pixel_gain_sigma=modulation.gain
            )
        if modulation.area > 0 and operation.blur is None:
            result = result.assign(fitted=replace(result.fitted, footprint=modulation.area))
        result = with_findings(result, *_of_swing(modulation))
        doubtful = modulation.blur > 0 or modulation.response > 0
        change = None if doubtful else change_of_swing(modulation.swing, header, tilt)
        return with_light_change(result, change, reference_of(context.source, gain))


def _calibrated_tilt_sigma(source: Source, tilt: float) -> float | None:
    """Return the relative standard error of a tilt if it is that of the calibration."""
    precession = source.calibration.precession if isinstance(source, Calibrated) else None
    if precession is None or not math.isclose(tilt, precession.tilt):
        return None
    sigma = precession.sigma.get("tilt", math.nan) / tilt
    return sigma if math.isfinite(sigma) else None


class NuisanceUncertainty(Step):
    """Add to the errors of normals what is uncertain of camera, light and stage.

    Where the surface is bent, the area that a pixel sees does not show the normal in its middle. What is
    wrong with the brightness of all pixels together, as far as the frames do not show it, is as uncertain as
    the header states, or as that of a camera and a stage that nobody characterised: see
    `mirrorskin.engine.diagnosis.turn_nuisances`. A note names it.
    """

    needs = ("normals", "normals_sigma")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other ``normals_sigma``, and with the errors that all have in common."""
        operation = cast("NormalsOperation", context.operation)
        footprint = max(operation.footprint, result.fitted.footprint or 0.0)
        found = operation.nuisances_of(context.samples)
        if not footprint and found is None:
            return result
        common = (0.0, 0.0) if found is None else found.variance

        def changed() -> AnyArray:
            normals, sigma = (stored_map(result, name) for name in ("normals", "normals_sigma"))
            several = normals.ndim == 4
            turns = zip(normals, sigma, strict=True) if several else [(normals, sigma)]
            maps = [with_bend(*turn, footprint, BEND_NOISE, common, operation.device) for turn in turns]
            return np.stack(list(map(on_host, maps))) if several else maps[0]

        fitted = replace(result.fitted, footprint=footprint or None)
        if found is not None:
            modes = tuple(found.modes.ravel().tolist())
            fitted = replace(fitted, light_variance=found.variance, common_errors=modes)
        on_device = result.on_device("normals_sigma") is not None
        with_errors = result.assign(normals_sigma=changed() if on_device else changed, fitted=fitted)
        return with_errors if found is None else with_findings(with_errors, *_common(found))


class SystematicUncertainty(Step):
    """Add the standard errors of a calibrated response, which neighbours have in common."""

    needs = ("normals_sigma",)

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other ``normals_sigma``, if the response has errors."""
        response = cast("Normals", context.operation).response
        if response is None:
            return result
        return result.assign(normals_sigma=np.hypot(result.normals_sigma, response.sigma))


def _common(found: TurnNuisances) -> Iterator[Finding]:
    """Yield what is said of errors that all pixels have in common."""
    if found.is_odd:
        side = "below" if found.gamma < 0 else "above"
        yield Finding(
            "gamma",
            f"the brightness is not proportional to the light, as with a gamma {side} 1: normals and heights"
            " may be wrong by more than their sigma. Set the camera's gamma to 1, or calibrate the zenith",
        )
    if found.unknown:
        names = ", ".join(found.unknown)
        text = f"not identifiable on this object: {names}; the errors include it"
        yield Finding("not identifiable", text, False)


def _with_share_of_zenith(result: Result, fraction: float) -> Result:
    """Return a result with a share of zeniths added to the errors of normals, when these are used."""
    return result.assign(
        normals_sigma=lambda: np.hypot(result.normals_sigma, np.float32(fraction) * result.zenith)
    )


def _of_swing(modulation: ModulationEffects) -> Iterator[Finding]:
    if modulation.gain > 0:
        text = f"the gains of pixels differ by {100 * modulation.gain:.2g} %, which is part of the errors"
        yield Finding("pixel gains", text, False)
    if modulation.blur > 0:
        yield Finding(
            "swing",
            "the brightness does not swing as tilt and gain predict: its swing is weak at tops and edges,"
            f" as if a lens blurs by {modulation.blur:.2g} pixels (or points move in the picture), so normals"
            " and heights may be wrong by more than their sigma. Focus, or register (--heights)",
        )
    if modulation.response > 0:
        yield Finding(
            "swing",
            f"the swing of the brightness differs by {100 * modulation.response:.2g} % from zenith to zenith,"
            " as with a gamma other than 1, so normals and heights may be wrong by more than their sigma:"
            " calibrate the zenith",
        )


def _rotated(error: AzimuthBias) -> Finding:
    first, last = math.degrees(error.first), math.degrees(error.last)
    if error.first == error.last:
        text = f"by {first:+.1f} degrees, which is corrected: calibrate the phases (calibrate tilt)"
    else:
        text = (
            f"by {first:+.1f} degrees in the first row and {last:+.1f} in the last, as by a rolling shutter,"
            " which is corrected: use a global shutter, or stop the body for each frame"
        )
    return Finding("rotated slopes", f"the curl of the slopes shows that azimuths are wrong {text}")


def _mirrored(normals: AnyArray) -> bool:
    """Return whether the slopes are those of a surface if one of them has the other sign.

    Slopes p and q of a surface satisfy dp/dy = dq/dx; with the phases reversed, q has the other sign. So the
    mean of their product is positive for a surface, and negative for a mirrored one.
    """
    shape = normals.shape[:2]
    step = max(1, math.isqrt(math.prod(shape)) // _GRID)
    rows, columns = (range(0, length, step) for length in shape)
    [[(*_, z)]] = take_places([normals], rows, columns, [(0, 0)])
    extent = step * math.isqrt(int(np.count_nonzero(np.isfinite(z))))
    thin = max(1, extent // _POINTS)
    far, near = (_correlation(normals, reach, thin) for reach in (max(2, extent // _PARTS), 2))
    # Relief finer than the distance of far points has any correlation there.
    return far < -_MIN_CORRELATION and near < _MAX_CORRELATION


def _correlation(normals: AnyArray, reach: int, thin: int) -> float:
    """Return the correlation of dp/dy and dq/dx over a distance; 0 if it is not clear.

    They are from different pixels around one place, because the noise of a pixel's slopes is correlated.
    """
    rows, columns = (range(0, length - reach, thin) for length in normals.shape[:2])
    if not (rows and columns):
        return 0.0
    half = reach // 2
    (points,) = take_places([normals], rows, columns, [(0, half), (reach, half), (half, 0), (half, reach)])
    above, below, left, right = (values.astype(np.float64) for values in points)
    with np.errstate(divide="ignore", invalid="ignore"):
        dp_dy = below[0] / below[2] - above[0] / above[2]  # y points up
        dq_dx = left[1] / left[2] - right[1] / right[2]
    defined = np.isfinite(dp_dy) & np.isfinite(dq_dx)
    if np.count_nonzero(defined) < _MIN_POINTS:
        return 0.0
    dp_dy, dq_dx = (_clip_outliers(values[defined]) for values in (dp_dy, dq_dx))
    product = dp_dy * dq_dx
    if abs(float(np.mean(product))) <= CLEAR_Z_SCORE * float(np.std(product)) / math.sqrt(len(product)):
        return 0.0
    return float(np.sum(product) / math.sqrt(np.sum(dp_dy**2) * np.sum(dq_dx**2)))


def _clip_outliers(values: NDArray[np.float64]) -> NDArray[np.float64]:
    limit = 3 * mad_sigma(values)
    return np.clip(values, -limit, limit)
