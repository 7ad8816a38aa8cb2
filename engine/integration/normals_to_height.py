"""Heights from the normals of a rotation: slopes, their variances, and integration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.diagnosis.footprint import with_curvature
from mirrorskin.engine.diagnosis.turn_nuisances import light_sigma, picture_axes
from mirrorskin.engine.integration.arrays import integrate_arrays
from mirrorskin.engine.integration.common_errors import common_variance, mode_slopes, normals_of_slopes
from mirrorskin.engine.integration.device_inputs import sample_evenly
from mirrorskin.engine.integration.surface import explain
from mirrorskin.engine.integration.validation import LEAST, MOST
from mirrorskin.io import Fitted, Result
from mirrorskin.io.base.findings import findings_of, in_process
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.integration.slopes import find, weigh
from mirrorskin.kernels.rotation.registration import MEAN_NOISE_GAIN

Floats = NDArray[np.float32]

# Accepted relative residual if many small facets prevent convergence; the errors of normals are larger.
_TOLERANCE = 1e-4
_NO_LIMIT = 1e9  # seconds: with a budget, `integrate` returns an unconverged surface
_CHUNK, _STRIP = 256, 16  # columns and rows of a work-item on a CPU; see slopes.cl


@dataclass(frozen=True, slots=True)
class Slopes:
    """Slopes of the surface along x, and along y, which points up the picture."""

    dz_dx: Floats  # (H, W); NaN where undefined
    dz_dy: Floats
    weights: Floats  # (2, H, W): inverse variances of both; 0 where undefined

    @property
    def defined(self) -> NDArray[np.bool_]:
        """Where there are slopes, (H, W)."""
        return np.asarray(self.weights[0] > 0)

    def without(self, mode: Doubles) -> Slopes:
        """Return slopes without an error of normals; see `find_common_errors`."""
        wrong, dz_dx, dz_dy = self.defined, self.dz_dx.copy(), self.dz_dy.copy()
        normals = normals_of_slopes(dz_dx[wrong], dz_dy[wrong])
        x, y = np.meshgrid(*picture_axes((wrong.shape[0], wrong.shape[1])))
        errors = mode_slopes(mode[np.newaxis], normals, x[wrong], y[wrong])
        for slope, (error,) in zip((dz_dx, dz_dy), errors, strict=True):
            slope[wrong] -= error
        return replace(self, dz_dx=dz_dx, dz_dy=dz_dy)


def integrate_result(
    result: Result,
    pixel_size: tuple[float, float],
    *,
    robust: bool,
    device: Device,
    noise_gain: Floats | None = None,
) -> Result:
    """Return the heights that fit the normals of a result, with the errors that all have in common.

    These are the modes of `mirrorskin.engine.diagnosis.turn_nuisances`. For ``noise_gain`` see
    `separate_errors`.
    """
    separate, independent_sigma = separate_errors(result, noise_gain)
    surface = integrate_normals(separate, independent_sigma, pixel_size, robust=robust, device=device)
    fitted = result.fitted
    if fitted.common_errors is None and fitted.footprint is None:
        return surface
    sigma, modes = np.array(surface.height_sigma), fitted.common_errors
    turns = [()] if sigma.ndim == 2 else [(number,) for number in range(len(sigma))]
    for turn in turns:
        if modes:
            variance = common_variance(result.normals[turn], surface.component[turn], modes, pixel_size)
            sigma[turn] = np.sqrt(sigma[turn] ** 2 + variance)
        if fitted.footprint is not None:
            sigma[turn] = with_curvature(surface.height[turn], sigma[turn], fitted.footprint)
    return surface.assign(height_sigma=sigma)


def separate_errors(result: Result, noise_gain: Floats | None = None) -> tuple[Result, Floats]:
    """Return a result without errors of the response, and the errors that differ from pixel to pixel.

    Those of pixels are without registration: it reduces errors but correlates those of neighbours, so that
    means over many pixels are not better. ``noise_gain``, (H, W), is the factor of the noise of registered
    samples; by default the mean one, if frames were registered.
    """
    fitted, sigma = result.fitted, np.asarray(result.normals_sigma, np.float32)
    independent = sigma
    if fitted.light_variance is not None:
        independent = _without(sigma, light_sigma(result.normals, fitted.light_variance))
    if noise_gain is not None:
        independent = independent / noise_gain
    elif fitted.registered:
        independent = independent / np.float32(MEAN_NOISE_GAIN)
    return result.assign(normals_sigma=sigma), independent


def slopes_of(
    result: Result, independent_sigma: Floats | None = None, contact: NDArray[Any] | None = None
) -> Slopes:
    """Return the slopes of a result's normals; see `find_slopes`.

    ``contact``, (H, W), replaces that of the result; without either, all normals are used. The half-angle of
    the precession and the number of turns are ``tilt`` and ``turns`` of the result's ``fitted``, if known.
    """
    normals, fitted = result.normals, result.fitted
    if contact is None:
        contact = result.contact
    sigma, gain = result.normals_sigma, fitted.pixel_gain_sigma
    along = None if gain is None else np.float32(gain) * result.zenith
    if along is not None:  # it is part of the standard deviation of normals
        sigma = _without(sigma, along)
        independent_sigma = None if independent_sigma is None else _without(independent_sigma, along)
    slopes = find_slopes(
        normals,
        sigma,
        np.ones(normals.shape[:-1], np.uint8) if contact is None else contact,
        fitted.tilt,
        fitted.turns or 1,
        independent_sigma,
    )
    return slopes if along is None else _with_zenith_errors(slopes, along)


def _without(sigma: Floats, part: Floats) -> Floats:
    """Return a standard deviation without an independent part of it."""
    return np.asarray(np.sqrt(np.maximum(sigma**2 - part**2, np.float32(1e-6) * sigma**2)))


def _with_zenith_errors(slopes: Slopes, sigma: Floats) -> Slopes:
    """Return slopes with weights for additional errors of the zenith, radians: they are along the slope."""
    square = slopes.dz_dx**2 + slopes.dz_dy**2
    factor = ((1 + square) * sigma) ** 2 / np.maximum(square, np.float32(1e-12))
    parts = np.stack([slopes.dz_dx**2 * factor, slopes.dz_dy**2 * factor])
    weights = np.where(slopes.defined, slopes.weights / (1 + slopes.weights * np.nan_to_num(parts)), 0)
    return replace(slopes, weights=weights.astype(np.float32))


def find_slopes(
    normals: Floats,
    sigma: Floats,
    contact: NDArray[np.uint8],
    tilt: float | None,
    turns: int = 1,
    independent_sigma: Floats | None = None,
) -> Slopes:
    """Return the slopes -n_x / n_z and -n_y / n_z of the normals of a rotation.

    *Variances.* Samples measure the angle to the axis, which moves on a circle of radius d: they determine
    the zenith far better than the azimuth. For samples evenly spaced on the circle, the share of information
    across the meridian is ::

        q = 1/2 inside the circle,  sin(d)^2 / (2 sin(zenith)^2) outside

    so an angular error of variance sigma^2 has the variances sigma^2 q along the meridian and
    sigma^2 (1 - q) across it. An error along the meridian changes the slope by 1/cos(zenith)^2, an error
    across it by 1/cos(zenith). The slopes along x and y mix both; their covariance is neglected.

    *Bias.* An azimuth with the standard deviation s shortens the mean vector by exp(-s^2 / 2), which flattens
    the surface. Slopes are multiplied by the inverse factor.

    ``normals``, (H, W, 3) unit vectors, are used if their RMS angular error ``sigma``, (H, W) radians, is
    finite and ``contact`` is not 0. ``tilt`` is the half-angle d of the precession, radians; without it,
    errors are isotropic. The normals are the mean of ``turns`` turns. If errors of neighbours are correlated,
    ``independent_sigma`` replaces sigma in the weights: independent errors with the same mean over many
    pixels. The zenith is limited to 80 degrees.
    """
    floor = math.inf if tilt is None else math.sin(tilt) ** 2
    white = sigma if independent_sigma is None else independent_sigma
    usable = (contact != 0) & (white > 0) & (white < np.inf)
    dz_dx, dz_dy, *squares = find(floor, normals, np.float32(math.sqrt(turns)) * sigma, usable)
    weights = weigh(floor, (0.0, math.inf), white, dz_dx, *squares)
    return Slopes(dz_dx, dz_dy, np.stack(weights))


def integrate_normals(
    result: Result,
    independent_sigma: Floats,
    pixel_size: tuple[float, float],
    *,
    robust: bool = False,
    device: Device,
) -> Result:
    """Integrate the normals of pixels in contact, of one picture or of each turn, or raise NotConverged.

    ``independent_sigma``, (H, W) or (turns, H, W), is that of `find_slopes`. The mean height of each
    component is 0; components are numbered over all turns. With ``robust``, edges are breaks of the surface,
    and the mean of components that breaks separate is 0 together.
    """
    per_turn = result.normals.ndim == 4
    each, sigmas = [result], [independent_sigma]
    if per_turn:
        once = replace(result.fitted, turns=1)
        names = [name for name in ("normals", "normals_sigma", "contact") if result.name_of(name)]
        maps = zip(*(getattr(result, name) for name in names), strict=True)
        each = [Result(dict(zip(names, turn, strict=True)), fitted=once) for turn in maps]
        sigmas = list(independent_sigma)
    surfaces = [
        _integrate(slopes_of(turn, sigma), pixel_size, robust, device)
        for turn, sigma in zip(each, sigmas, strict=True)
    ]
    before = np.cumsum([0, *(len(surface.offset_unknown) for surface in surfaces)])
    components: list[NDArray[Any] | None] = [
        np.where(surface.component >= 0, surface.component + np.int32(shift), np.int32(-1))
        for surface, shift in zip(surfaces, before, strict=False)
    ]
    stacked = {
        name: _stack([getattr(surface, name) for surface in surfaces], per_turn)
        for name in ("height", "height_sigma", "edges")
    }
    return Result(
        stacked,
        component=_stack(components, per_turn),
        offset_unknown=np.ones(before[-1], np.uint8),
    ).with_process(describe_integration(surfaces))


def describe_integration(surfaces: Sequence[Result]) -> dict[str, ProcessValue]:
    """Return the method and convergence of surfaces, for a result's process."""
    if not surfaces:
        return {}
    each = [surface.fitted for surface in surfaces]
    found = [finding for surface in surfaces for finding in findings_of("heights", surface.process)]
    notes = in_process([replace(finding, warning=False) for finding in found], {})
    return {
        **notes,
        "integration": each[0].integration or "",
        "integration_iterations": max(surface.integration_iterations or 0 for surface in each),
        "integration_residual": max(surface.integration_residual or 0.0 for surface in each),
    }


def _integrate(slopes: Slopes, pixel_size: tuple[float, float], robust: bool, device: Device) -> Result:
    """Return the surface of one picture; it has no pixels if there are no normals."""
    if not slopes.defined.any():
        nan, shape = np.full(slopes.defined.shape, np.nan, np.float32), slopes.defined.shape
        return Result(
            height=nan,
            height_sigma=nan.copy(),
            component=np.full(shape, -1, np.int32),
            offset_unknown=np.zeros(0, np.uint8),
            fitted=Fitted(integration="multigrid", integration_iterations=0, integration_residual=0.0),
        )
    surface = integrate_arrays(
        slopes.dz_dx,
        slopes.dz_dy,
        pixel_size,
        mask=slopes.defined,
        slope_weights=slopes.weights,
        robust=robust,
        budget=_NO_LIMIT,
        device=device,
    )
    fitted = surface.fitted
    residual = fitted.integration_residual or 0.0
    if not (fitted.integration_converged or residual <= _TOLERANCE):
        raise NotConverged(explain(fitted.integration_iterations or 0, residual, _TOLERANCE))
    return surface


def _stack(maps: list[NDArray[Any] | None], per_turn: bool) -> NDArray[Any] | None:
    """Return the stacked maps of all turns, or the map of the only picture; None if one is missing."""
    available = [values for values in maps if values is not None]
    if len(available) < len(maps):
        return None
    return np.stack(available) if per_turn else available[0]


class SlopeKernels:
    """Slopes and weights from normals on the device; as `find_slopes` for one turn of a known tilt.

    They are those of a part of a picture of a number of columns. If it is narrower, its width is a multiple
    of 8. ``typical`` is the median weight, which determines the limits of weights; it is computed if it is
    NaN.
    """

    def __init__(
        self, device: Device, part: tuple[slice, slice], columns: int, typical: float = math.nan
    ) -> None:
        rows, across = part
        self._device, self._shape = device, (rows.stop - rows.start, across.stop - across.start)
        self._place = {"start": rows.start * columns + across.start, "stride": columns}
        names = "squares_x", "squares_y"
        self._squares: dict[str, Any] = {name: device.array(name, self._shape, np.float32) for name in names}
        self.typical: float = typical

    def find(self, tilt: float, normals: Mapping[str, Array], to: Mapping[str, Array]) -> None:
        """Enqueue the kernels; the first time, wait for `typical`.

        The input ``vectors``, ``sigma`` and ``contact`` are maps of the picture, which may have padding; the
        output is ``dz_dx``, ``dz_dy``, ``weight_x`` and ``weight_y`` of the part.
        """
        rows, columns = self._shape
        pixels, tile = rows * columns, self._device.layout.tile
        width, floor = 8 if tile > 1 else 1, math.sin(tilt) ** 2
        find = self._device.kernel("slopes", "slopes_find", WIDTH=width)
        find(
            -(-pixels // tile),
            pixels=pixels,
            columns=columns,
            **self._place,
            flat_limit=floor,
            vectors=normals["vectors"],
            sigma=normals["sigma"],
            contact=normals["contact"],
            dz_dx=to["dz_dx"],
            dz_dy=to["dz_dy"],
            **self._squares,
            moved=33 * pixels,
        )
        if math.isnan(self.typical):
            self._weigh(floor, width, (0.0, math.inf), normals["sigma"], to)
            self.typical = _typical(to["weight_x"], to["weight_y"])
        typical = 1.0 if math.isnan(self.typical) else self.typical
        self._weigh(floor, width, (LEAST * typical, MOST * typical), normals["sigma"], to)

    def _weigh(
        self, floor: float, width: int, bounds: tuple[float, float], sigma: Array, to: Mapping[str, Array]
    ) -> None:
        rows, columns = self._shape
        tile = self._device.layout.tile
        strip = _STRIP if tile >= _CHUNK else 1
        weigh = self._device.kernel("slopes", "slopes_weigh", WIDTH=width)
        weigh(
            -(-rows // strip) * -(-columns // min(tile, _CHUNK)),
            rows=rows,
            columns=columns,
            **self._place,
            flat_limit=floor,
            lowest=bounds[0],
            highest=bounds[1],
            sigma=sigma,
            dz_dx=to["dz_dx"],
            weight_x=to["weight_x"],
            weight_y=to["weight_y"],
            **self._squares,
            moved=24 * rows * columns,
        )


def _typical(*weights: Array) -> float:
    """Return the median of the weights above 0 of evenly spread pixels, or NaN."""
    samples = np.concatenate([sample_evenly(array).ravel() for array in weights])
    samples = samples[samples > 0]
    return float(np.median(samples)) if samples.size else math.nan
