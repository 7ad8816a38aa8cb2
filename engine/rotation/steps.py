"""Steps that follow the normals of a rotation: registration, edges, heights, errors of the calibration."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.frames import QUANTUM, thin_out
from mirrorskin.engine.method import Context, Step
from mirrorskin.engine.options import option
from mirrorskin.engine.rotation.curl import AzimuthError, find_azimuth_error
from mirrorskin.engine.rotation.edges import find_edges
from mirrorskin.engine.rotation.normals import Normals, azimuth_of
from mirrorskin.engine.rotation.normals_to_height import Slopes, integrate_normals, slopes_of
from mirrorskin.engine.rotation.registration import Registered
from mirrorskin.engine.rotation.residual_noise import CountNoise
from mirrorskin.engine.rotation.swing import Swing, find_swing
from mirrorskin.io import Result
from mirrorskin.io.findings import Finding, with_findings
from mirrorskin.kernels.least_squares import mad_sigma

_NO_PIXEL_SIZE = "none: the recording has no pixel size"
_PARTS, _POINTS = (
    8,
    128,
)  # of the extent of the normals: distance between slopes, and number of them, along a side
_FEWEST, _CLEAR, _ALIKE = 100, 6.0, 0.1  # points, standard errors, and correlation that decide
_REACH = 5  # pixels: size of the neighbourhood whose loss of contact affects a registered sample


class Edges(Step):
    """Draw edges where the normal jumps and where contact ends; see `mirrorskin.engine.find_edges`."""

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with ``edges``, if it has normals."""
        if result.normals is None:
            return result
        device = context.operation.device
        maps = result.normals, result.normals_sigma, result.contact
        if result.contact.ndim == 2:
            return result.assign(edges=find_edges(*maps, device=device))
        turns = [find_edges(*turn, device=device) for turn in zip(*maps, strict=True)]
        return result.assign(edges=np.stack(turns))


class RegistrationErrors(Step):
    """Correct the errors of normals for the interpolation of registered frames.

    A given noise of samples is corrected; noise that was estimated from the registered frames includes the
    interpolation. A sample is interpolated from 4 x 4 pixels, which must all be in contact.
    """

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other ``normals_sigma`` and ``contact``, if frames were registered."""
        if not isinstance(context.stream, Registered):
            return result
        import cv2

        sigma, contact = result.normals_sigma, result.contact
        reach = np.ones((_REACH, _REACH), np.uint8)
        lost = np.isfinite(sigma) & (contact == 0)
        near = [cv2.dilate(one.view(np.uint8), reach) for one in lost.reshape(-1, *lost.shape[-2:])]
        inside = contact * (np.reshape(near, lost.shape) == 0)
        if context.operation.chosen()["noise"] is not None:
            sigma = sigma * context.stream.noise_gain
        return result.assign(normals_sigma=sigma, contact=inside)


class Integration(Step):
    """Find the heights that fit the normals; the mean height of each connected component is 0.

    Needs the pixel size.
    """

    robust: bool = option(
        default=False,
        help="let the surface break at discontinuities that are found in it; they are drawn as edges, too",
    )

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with ``height``, ``component`` and ``offset_unknown``, if it has normals."""
        pixel_size = context.source.header.pixel_size
        if result.normals is None:
            return result
        if pixel_size is None:
            return result.assign(process={**result.process, "height": _NO_PIXEL_SIZE})
        surface = integrate_normals(
            result,
            _independent_sigma(result, context),
            pixel_size,
            robust=self.robust,
            device=context.operation.device,
        )
        if surface.edges is not None and result.edges is not None:
            surface = surface.assign(edges=result.edges | surface.edges)
        surface = _with_common_errors(surface, result, context)
        return result.assign(surface, process={**result.process, **surface.process})

    def slopes(self, result: Result, context: Context) -> Slopes:
        """Return the slopes that `apply` integrates, for the mean of all turns."""
        return slopes_of(result, _independent_sigma(result, context))


class CalibrationErrors(Step):
    """Add errors of the response, which are common to neighbours, to those of normals and heights.

    They are the standard errors of a calibrated response, or the range of the swing of a linear one that does
    not fit to it, as a share of zeniths and, about, of heights.
    """

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other ``normals_sigma`` and ``height_sigma``, if the response has errors."""
        operation, share = context.operation, result.process.get("swing_range")
        if isinstance(operation, Normals) and operation.response is not None:
            return result.assign(normals_sigma=np.hypot(result.normals_sigma, operation.response.sigma))
        if not isinstance(share, float):
            return result
        sigma = np.hypot(result.normals_sigma, np.float32(share) * result.zenith)
        result = result.assign(normals_sigma=sigma)
        if result.height is None:
            return result
        return result.assign(height_sigma=np.hypot(result.height_sigma, np.float32(share) * result.height))


class PhaseErrors(Step):
    """Correct slopes that are rotated, and warn if phases seem to run the wrong way round.

    The curl of the slopes shows by how much they are rotated, as by a wrong phase of the first frame or by a
    rolling shutter: see `mirrorskin.engine.rotation.curl`. With phases reversed, the surface is mirrored.
    """

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other normals, or with a warning, if the slopes contradict the phases."""
        if result.normals is None:
            return result
        if _mirrored(result.normals if result.normals.ndim == 3 else result.normals[0]):
            found = Finding(
                "mirrored",
                "the slopes fit together better with the phases reversed: do phases count counter-clockwise"
                " in the picture?",
            )
            return with_findings(result, found)
        if result.normals.ndim == 4:
            return result
        size = context.source.header.pixel_size or (1.0, 1.0)
        error = find_azimuth_error(result.normals, result.contact, size)
        if error is None:
            return result
        normals = error.remove(result.normals)
        sine = np.hypot(normals[..., 0], normals[..., 1])
        sigma = np.hypot(result.normals_sigma, np.float32(error.sigma) * sine)
        result = result.assign(normals=normals, azimuth=partial(azimuth_of, normals), normals_sigma=sigma)
        return with_findings(result, _rotated(error))


class ResponseErrors(Step):
    """Compare the swing of the brightness with what tilt and gain predict.

    Gains of pixels and uneven light are added to the errors, and noted; a response that is not as stated and
    blur are warnings: see `mirrorskin.engine.rotation.swing`. A calibrated response is not judged.
    """

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with other ``normals_sigma``, or with a warning."""
        operation = context.operation
        if not isinstance(operation, Normals) or operation.response is not None or result.normals.ndim == 4:
            return result
        process = result.process
        frames, slope = int(process["frames"]), float(process["shot_noise"])
        base = float(process["noise"]) ** 2 - slope * _median(result.mean)
        swing = find_swing(
            result.normals,
            result.mean,
            result.modulation,
            result.contact,
            cast("ArrayLike", operation.zenith_gain),
            float(process["tilt"]),
            CountNoise(base / frames, slope / frames, QUANTUM**2 / frames),
        )
        if swing.gain > 0:
            sigma = np.hypot(result.normals_sigma, np.float32(swing.gain) * result.zenith)
            process = {**process, "pixel_gain_sigma": swing.gain}
            result = result.assign(normals_sigma=sigma, process=process)
        if (share := max(swing.response, swing.light)) > 0:
            result = result.assign(process={**process, "swing_range": share})
        return with_findings(result, *_uneven(swing))


def _median(values: NDArray[np.floating]) -> float:
    """Return the median of some of the values that are numbers; 0 if none is."""
    some = thin_out(values)
    some = some[np.isfinite(some)]
    return float(np.median(some)) if some.size else 0.0


def _uneven(swing: Swing) -> Iterator[Finding]:
    if swing.gain > 0:
        text = f"the gains of pixels differ by {100 * swing.gain:.2g} %, which is part of the errors"
        yield Finding("pixel gains", text, False)
    causes = []
    if swing.response > 0:
        causes.append(f"differs by {100 * swing.response:.2g} % from zenith to zenith, as with gamma")
    if swing.light > 0:
        light = f"differs by {100 * swing.light:.2g} % from place to place, as in uneven light"
        if swing.response > 0 or swing.blur > 0:
            causes.append(light)
        else:
            text = (
                f"the swing of the brightness {light} (or points move in the picture); the errors include it"
            )
            yield Finding("swing", text, False)
    if swing.blur > 0:
        causes.append(f"is weak at tops and edges, as if a lens blurs by {swing.blur:.2g} pixels")
    if causes:
        yield Finding(
            "swing",
            f"the brightness does not swing as tilt and gain predict: its swing {' and '.join(causes)} (or"
            " points move in the picture), so normals and heights may be wrong by more than their sigma."
            " Calibrate the zenith, focus, or register (--heights)",
        )


def _rotated(error: AzimuthError) -> Finding:
    first, last = math.degrees(error.first), math.degrees(error.last)
    if error.first == error.last:
        text = f"by {first:+.1f} degrees, which is corrected: calibrate the phases (calibrate tilt)"
    else:
        text = (
            f"by {first:+.1f} degrees in the first row and {last:+.1f} in the last, as by a rolling shutter,"
            " which is corrected: use a global shutter, or stop the body for each frame"
        )
    return Finding("rotated slopes", f"the curl of the slopes shows that azimuths are wrong {text}")


def _mirrored(normals: NDArray[np.floating]) -> bool:
    """Return whether the slopes are those of a surface if one of them has the other sign.

    Slopes p and q of a surface satisfy dp/dy = dq/dx; with the phases reversed, q has the other sign. So the
    mean of their product is positive for a surface, and negative for a mirrored one.
    """
    known = int(np.count_nonzero(np.isfinite(normals[..., 2])))
    reach, thin = max(1, math.isqrt(known) // _PARTS), max(1, math.isqrt(known) // _POINTS)
    here, across, down = (
        normals[rows, columns][::thin, ::thin].astype(np.float64)
        for rows, columns in (
            (slice(None, -reach), slice(None, -reach)),
            (slice(None, -reach), slice(reach, None)),
            (slice(reach, None), slice(None, -reach)),
        )
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        dp_dy = down[..., 0] / down[..., 2] - here[..., 0] / here[..., 2]  # y points up
        dq_dx = here[..., 1] / here[..., 2] - across[..., 1] / across[..., 2]
    defined = np.isfinite(dp_dy) & np.isfinite(dq_dx)
    if np.count_nonzero(defined) < _FEWEST:
        return False
    dp_dy, dq_dx = (_clip_outliers(one[defined]) for one in (dp_dy, dq_dx))
    product = dp_dy * dq_dx
    clear = -float(np.mean(product)) > _CLEAR * float(np.std(product)) / math.sqrt(len(product))
    return clear and bool(-np.sum(product) >= _ALIKE * math.sqrt(np.sum(dp_dy**2) * np.sum(dq_dx**2)))


def _clip_outliers(values: NDArray[np.float64]) -> NDArray[np.float64]:
    limit = 3 * mad_sigma(values)
    return np.clip(values, -limit, limit)


def _with_common_errors(surface: Result, result: Result, context: Context) -> Result:
    """Add errors of slopes that are common to all pixels, such as those of the light of a frame, to sigma.

    They change slopes, and with them heights, by about the same share everywhere.
    """
    operation = context.operation
    if not isinstance(operation, Normals) or not operation.corrects:
        return surface
    cosine = result.normals[..., 2].astype(np.float64)
    error = operation.common_sigma(result.normals) / cosine**2
    known = np.isfinite(error) & (result.contact > 0)
    steepness = np.sqrt(1 / cosine[known] ** 2 - 1)
    share = math.sqrt(float(np.mean(error[known] ** 2) / np.mean(steepness**2)))
    sigma = np.hypot(surface.height_sigma, np.float32(share) * surface.height)
    return surface.assign(height_sigma=sigma)


def _independent_sigma(result: Result, context: Context) -> NDArray[np.float32]:
    """Return the errors of normals that differ from pixel to pixel, without registration.

    Registration reduces errors but correlates those of neighbours: means over many pixels are not better.
    """
    sigma: NDArray[np.float32] = result.normals_sigma
    if isinstance(context.operation, Normals) and context.operation.corrects:
        common = context.operation.common_sigma(result.normals)
        sigma = np.sqrt(np.maximum(sigma**2 - common**2, 0))
    return sigma / context.stream.noise_gain if isinstance(context.stream, Registered) else sigma
