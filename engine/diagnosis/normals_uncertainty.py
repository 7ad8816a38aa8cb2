"""Corrections and uncertainties of the normals of a rotation, which every run applies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, stored_map
from mirrorskin.engine.base.frames import QUANTUM, take_places, typical_value
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.diagnosis.curl import AzimuthBias, find_azimuth_bias
from mirrorskin.engine.diagnosis.registration import Registered
from mirrorskin.engine.diagnosis.residual_noise import CountNoise
from mirrorskin.engine.diagnosis.swing import ModulationEffects, find_modulation_effects
from mirrorskin.io import Result
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.io.watch.mirrored import MIRRORED
from mirrorskin.kernels.numerics.least_squares import CLEAR_Z_SCORE, mad_sigma
from mirrorskin.kernels.rotation.normals import azimuth_of

if TYPE_CHECKING:
    from mirrorskin.engine.rotation.normals import Normals

_PARTS, _POINTS = 8, 64  # of the extent of the normals: distance between slopes; slopes along a side
_GRID = 64  # points along a side that show this extent
_MIN_POINTS, _MIN_CORRELATION = 100, 0.1  # points, and their correlation, that decide
_REACH = 5  # pixels: size of the neighbourhood whose loss of contact affects a registered sample


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

    Gains of pixels and uneven light are added to the errors, and noted; a response that is not as stated and
    blur are warnings: see `mirrorskin.engine.diagnosis.swing`. A calibrated response is not judged.
    """

    needs = ("normals", "normals_sigma", "zenith", "mean", "modulation", "contact")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other ``normals_sigma``, or with a warning."""
        operation = cast("Normals", context.operation)
        fitted = result.fitted
        noise, slope, frames, tilt = fitted.noise, fitted.shot_noise, fitted.frames, fitted.tilt
        normals, mean = (stored_map(result, name) for name in ("normals", "mean"))
        if operation.response is not None or normals.ndim == 4:
            return result
        if noise is None or slope is None or frames is None or tilt is None:  # of a class with its own result
            return result
        cosine, sine = (stored_map(context.computed, name) for name in ("cosine", "sine"))
        base = noise**2 - (slope * typical_value(mean) if slope > 0 else 0.0)
        modulation = find_modulation_effects(
            normals,
            mean,
            cosine,
            sine,
            result.contact,
            cast("ArrayLike", operation.zenith_gain),
            tilt,
            CountNoise(base / frames, slope / frames, QUANTUM**2 / frames),
        )
        if modulation.gain > 0:
            result = _with_share_of_zenith(result, modulation.gain).with_fitted(
                pixel_gain_sigma=modulation.gain
            )
        if (fraction := max(modulation.response, modulation.light)) > 0:
            result = result.with_fitted(swing_range=fraction)
        return with_findings(result, *_uneven(modulation))


class SystematicUncertainty(Step):
    """Add errors of the response, which are common to neighbours, to those of normals.

    They are the standard errors of a calibrated response, or the range of the swing of a linear one that does
    not fit to it, as a share of zeniths.
    """

    needs = ("normals_sigma", "zenith")

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other ``normals_sigma``, if the response has errors."""
        response, fraction = cast("Normals", context.operation).response, result.fitted.swing_range
        if response is not None:
            return result.assign(normals_sigma=np.hypot(result.normals_sigma, response.sigma))
        return result if fraction is None else _with_share_of_zenith(result, fraction)


def _with_share_of_zenith(result: Result, fraction: float) -> Result:
    """Return a result with a share of zeniths added to the errors of normals, when these are used."""
    return result.assign(
        normals_sigma=lambda: np.hypot(result.normals_sigma, np.float32(fraction) * result.zenith)
    )


def _uneven(modulation: ModulationEffects) -> Iterator[Finding]:
    if modulation.gain > 0:
        text = f"the gains of pixels differ by {100 * modulation.gain:.2g} %, which is part of the errors"
        yield Finding("pixel gains", text, False)
    causes = []
    if modulation.response > 0:
        causes.append(f"differs by {100 * modulation.response:.2g} % from zenith to zenith, as with gamma")
    if modulation.light > 0:
        light = f"differs by {100 * modulation.light:.2g} % from place to place, as in uneven light"
        if modulation.response > 0 or modulation.blur > 0:
            causes.append(light)
        else:
            text = (
                f"the swing of the brightness {light} (or points move in the picture); the errors include it"
            )
            yield Finding("swing", text, False)
    if modulation.blur > 0:
        causes.append(f"is weak at tops and edges, as if a lens blurs by {modulation.blur:.2g} pixels")
    if causes:
        yield Finding(
            "swing",
            f"the brightness does not swing as tilt and gain predict: its swing {' and '.join(causes)} (or"
            " points move in the picture), so normals and heights may be wrong by more than their sigma."
            " Calibrate the zenith, focus, or register (--heights)",
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
    reach, thin = max(1, extent // _PARTS), max(1, extent // _POINTS)
    rows, columns = (range(0, length - reach, thin) for length in shape)
    if not (rows and columns):
        return False
    ((here, across, down),) = take_places([normals], rows, columns, ((0, 0), (0, reach), (reach, 0)))
    here, across, down = (values.astype(np.float64) for values in (here, across, down))
    with np.errstate(divide="ignore", invalid="ignore"):
        dp_dy = down[0] / down[2] - here[0] / here[2]  # y points up
        dq_dx = here[1] / here[2] - across[1] / across[2]
    defined = np.isfinite(dp_dy) & np.isfinite(dq_dx)
    if np.count_nonzero(defined) < _MIN_POINTS:
        return False
    dp_dy, dq_dx = (_clip_outliers(values[defined]) for values in (dp_dy, dq_dx))
    product = dp_dy * dq_dx
    clear = -float(np.mean(product)) > CLEAR_Z_SCORE * float(np.std(product)) / math.sqrt(len(product))
    return clear and bool(
        -np.sum(product) >= _MIN_CORRELATION * math.sqrt(np.sum(dp_dy**2) * np.sum(dq_dx**2))
    )


def _clip_outliers(values: NDArray[np.float64]) -> NDArray[np.float64]:
    limit = 3 * mad_sigma(values)
    return np.clip(values, -limit, limit)
