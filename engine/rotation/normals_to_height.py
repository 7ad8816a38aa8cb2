"""Heights from the normals of a rotation: slopes, their variances, and integration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.frames import SAMPLES
from mirrorskin.engine.integration.integration import integrate
from mirrorskin.engine.integration.surface import explain
from mirrorskin.engine.integration.validation import LEAST, MOST
from mirrorskin.io import Result
from mirrorskin.io.types import ProcessValue
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

Floats = NDArray[np.float32]

_STEEPEST = math.radians(80.0)  # largest zenith whose slope is used
_AROUND = 5  # pixels: side of the window for the direction of the meridian
_WIDEST = 0.5  # radians: limit of the standard deviation of an azimuth in the correction of bias
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
    def known(self) -> NDArray[np.bool_]:
        """Where there are slopes, (H, W)."""
        return np.asarray(self.weights[0] > 0)


def slopes_of(
    result: Result, independent_sigma: Floats | None = None, contact: NDArray[Any] | None = None
) -> Slopes:
    """Return the slopes of a result's normals; see `find_slopes`.

    ``contact``, (H, W), replaces that of the result; without either, all normals are used. The half-angle of
    the precession and the number of turns are ``tilt`` and ``turns`` in the result's process, if available.
    """
    normals, process = result.normals, result.process
    if contact is None:
        contact = result.contact
    tilt, turns = process.get("tilt"), process.get("turns", 1)
    return find_slopes(
        normals,
        result.normals_sigma,
        np.ones(normals.shape[:-1], np.uint8) if contact is None else contact,
        float(tilt) if isinstance(tilt, int | float) else None,
        int(turns) if isinstance(turns, int | float) else 1,
        independent_sigma,
    )


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
    nx, ny, nz = np.moveaxis(normals, -1, 0)
    white = sigma if independent_sigma is None else independent_sigma
    valid = (contact != 0) & (nz > 0) & (sigma > 0) & (sigma < np.inf) & (white > 0) & (white < np.inf)
    nx, ny, nz, sigma, white = (np.where(valid, part, np.float32(1)) for part in (nx, ny, nz, sigma, white))
    nz = np.maximum(nz, np.float32(math.cos(_STEEPEST)))
    factor = np.exp(0.5 * _azimuth_variance(nx, ny, sigma, tilt, turns))
    nan = np.float32(np.nan)
    variances = _variances(nx, ny, nz, white, tilt, valid)
    return Slopes(
        dz_dx=np.where(valid, -factor * nx / nz, nan).astype(np.float32),
        dz_dy=np.where(valid, -factor * ny / nz, nan).astype(np.float32),
        weights=np.stack([np.where(valid, 1 / variance, 0) for variance in variances]).astype(np.float32),
    )


def _share_along(nx: Floats, ny: Floats, tilt: float | None) -> Floats:
    """Return the share of an angular error's variance that is along the meridian."""
    if tilt is None:
        return np.full(nx.shape, 0.5, np.float32)
    least = math.sin(tilt) ** 2
    return np.asarray(0.5 * least / np.maximum(nx * nx + ny * ny, least), np.float32)


def _azimuth_variance(nx: Floats, ny: Floats, sigma: Floats, tilt: float | None, turns: int = 1) -> Floats:
    """Return the variance of the azimuth in one turn, radians^2, within bounds; 0 without a tilt."""
    if tilt is None:
        return np.zeros(nx.shape, np.float32)
    outside = np.maximum(nx * nx + ny * ny, math.sin(tilt) ** 2)
    variance = turns * (1 - _share_along(nx, ny, tilt)) * sigma**2 / outside
    return np.asarray(np.minimum(variance, _WIDEST**2), np.float32)


def _mean_around(values: Floats) -> Floats:
    """Return the mean of a window around each pixel, (H, W), with zeros outside the picture."""
    height, width = values.shape
    padded = np.pad(values, _AROUND // 2)
    rows = sum(padded[row : row + height] for row in range(1, _AROUND)) + padded[:height]
    columns = sum(rows[:, column : column + width] for column in range(1, _AROUND)) + rows[:, :width]
    return np.asarray(columns / np.float32(_AROUND**2), np.float32)


def _variances(
    nx: Floats, ny: Floats, nz: Floats, sigma: Floats, tilt: float | None, valid: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Return the variances of the slopes along x and y.

    The direction of the meridian is that of the surroundings: with a pixel's own azimuth, slopes that noise
    shortened would get other weights than those that it lengthened, and their weighted mean would be biased.
    Squares of components are equal on both sides of a ridge; noise of the azimuth reduces the contrast of
    their means by exp(-2 variance).
    """
    share, turned = _share_along(nx, ny, tilt), _azimuth_variance(nx, ny, sigma, tilt)
    # An error e of the azimuth also shortens the slope by e^2 / 2.
    along = share * (sigma / nz**2) ** 2 + (nx * nx + ny * ny) / nz**2 * turned**2 / 2
    across = (1 - share) * (sigma / nz) ** 2
    x, y = (_mean_around(np.where(valid, n * n, 0)) for n in (nx, ny))
    least = np.finfo(np.float32).tiny
    square = (x + least) / (x + y + 2 * least)
    square = np.asarray(np.clip(0.5 + (square - 0.5) * np.exp(2 * turned), 0, 1), np.float32)
    along_x, along_y = square * along + (1 - square) * across, (1 - square) * along + square * across
    return along_x.astype(np.float32), along_y.astype(np.float32)


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
    component is 0; components are numbered over all turns. With ``robust``, edges are breaks of the surface.
    """
    per_turn = result.contact.ndim == 3
    each, sigmas = [result], [independent_sigma]
    if per_turn:
        once = {**result.process, "turns": 1}
        names = "normals", "normals_sigma", "contact"
        maps = zip(*(result[name] for name in names), strict=True)
        each = [Result(dict(zip(names, turn, strict=True)), process=once) for turn in maps]
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
    names = ("height", "height_sigma", "edges")
    stacked = {name: _stack([getattr(surface, name) for surface in surfaces], per_turn) for name in names}
    return Result(
        stacked,
        component=_stack(components, per_turn),
        offset_unknown=np.ones(before[-1], np.uint8),
        process=describe_integration(surfaces),
    )


def describe_integration(surfaces: Sequence[Result]) -> dict[str, ProcessValue]:
    """Return the method and convergence of surfaces, for a result's process."""
    if not surfaces:
        return {}
    processes = [surface.process for surface in surfaces]
    return {
        "integration": processes[0]["integration"],
        "integration_iterations": max(process["integration_iterations"] for process in processes),
        "integration_residual": max(process["integration_residual"] for process in processes),
    }


def _integrate(slopes: Slopes, pixel_size: tuple[float, float], robust: bool, device: Device) -> Result:
    """Return the surface of one picture; it has no pixels if there are no normals."""
    if not slopes.known.any():
        nan, shape = np.full(slopes.known.shape, np.nan, np.float32), slopes.known.shape
        return Result(
            height=nan,
            height_sigma=nan.copy(),
            component=np.full(shape, -1, np.int32),
            offset_unknown=np.zeros(0, np.uint8),
            process={"integration": "multigrid", "integration_iterations": 0, "integration_residual": 0.0},
        )
    surface = integrate(
        slopes.dz_dx,
        slopes.dz_dy,
        pixel_size,
        mask=slopes.known,
        slope_weights=slopes.weights,
        robust=robust,
        budget=_NO_LIMIT,
        device=device,
    )
    residual = float(surface.process["integration_residual"])
    if not (surface.process["integration_converged"] or residual <= _TOLERANCE):
        raise NotConverged(explain(int(surface.process["integration_iterations"]), residual, _TOLERANCE))
    return surface


def _stack(maps: list[NDArray[Any] | None], per_turn: bool) -> NDArray[Any] | None:
    """Return the stacked maps of all turns, or the map of the only picture; None if one is missing."""
    available = [values for values in maps if values is not None]
    if len(available) < len(maps):
        return None
    return np.stack(available) if per_turn else available[0]


class SlopeKernels:
    """Slopes and weights from normals on the device; equivalent to `find_slopes` for one turn.

    ``typical`` is the median weight, which determines the limits of weights; it is computed if it is NaN.
    """

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self._device, self._shape = device, shape
        names = "squares_x", "squares_y"
        self._squares: dict[str, Any] = {name: device.array(name, shape, np.float32) for name in names}
        for array in self._squares.values():
            array.upload()
        self.typical: float = math.nan

    def find(self, tilt: float, normals: Mapping[str, Array], to: Mapping[str, Array]) -> None:
        """Enqueue the kernels; the first time, wait for `typical`.

        The input ``vectors``, ``sigma`` and ``contact`` may have padding; the output is ``dz_dx``, ``dz_dy``,
        ``weight_x`` and ``weight_y``, (H, W).
        """
        rows, columns = self._shape
        pixels, tile = rows * columns, self._device.layout.tile
        width, least = 8 if tile > 1 else 1, math.sin(tilt) ** 2
        find = self._device.kernel("slopes", "slopes_find", WIDTH=width)
        find(
            -(-pixels // tile),
            pixels=pixels,
            least=least,
            vectors=normals["vectors"],
            sigma=normals["sigma"],
            contact=normals["contact"],
            dz_dx=to["dz_dx"],
            dz_dy=to["dz_dy"],
            **self._squares,
            moved=33 * pixels,
        )
        if math.isnan(self.typical):
            self._weigh(least, width, (0.0, math.inf), normals["sigma"], to)
            self.typical = _typical(to["weight_x"], to["weight_y"])
        typical = 1.0 if math.isnan(self.typical) else self.typical
        self._weigh(least, width, (LEAST * typical, MOST * typical), normals["sigma"], to)

    def _weigh(
        self, least: float, width: int, bounds: tuple[float, float], sigma: Array, to: Mapping[str, Array]
    ) -> None:
        rows, columns = self._shape
        tile = self._device.layout.tile
        strip = _STRIP if tile >= _CHUNK else 1
        weigh = self._device.kernel("slopes", "slopes_weigh", WIDTH=width)
        weigh(
            -(-rows // strip) * -(-columns // min(tile, _CHUNK)),
            rows=rows,
            columns=columns,
            least=least,
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
    parts = []
    for array in weights:
        step = max(1, math.isqrt(array.host.size // SAMPLES))
        parts.append(array.download()[step // 2 :: step, step // 2 :: step].ravel())
    samples = np.concatenate(parts)
    samples = samples[samples > 0]
    return float(np.median(samples)) if samples.size else math.nan
