"""The heights that fit the normals of a rotation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.frames import SAMPLES
from mirrorskin.engine.integration.integration import explain, integrate
from mirrorskin.engine.integration.surface import Surface
from mirrorskin.engine.integration.validation import LEAST, MOST
from mirrorskin.engine.rotation.normals import Normals
from mirrorskin.io import ProcessValue
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

Floats = NDArray[np.float32]

_STEEPEST = math.radians(80.0)  # zenith beyond which a slope would grow without bounds
_AROUND = 5  # pixels across, from which the meridian's direction is taken
_WIDEST = 0.5  # radians: standard deviation of an azimuth beyond which its mean cosine is no longer made good


@dataclass(frozen=True, slots=True)
class Slopes:
    """How much the surface rises along x, and along y, which runs up the picture.

    Attributes
    ----------
    dz_dx, dz_dy : ndarray, (H, W), float32
        Without unit; NaN where there is none.
    weights : ndarray, (2, H, W), float32
        Inverse variances of both; 0 where there is none.
    """

    dz_dx: Floats
    dz_dy: Floats
    weights: Floats

    @property
    def known(self) -> NDArray[np.bool_]:
        """Where there are slopes, (H, W)."""
        return np.asarray(self.weights[0] > 0)


def find_slopes(
    vectors: NDArray[np.float32],
    sigma: NDArray[np.float32],
    contact: NDArray[np.uint8],
    tilt: float | None,
    turns: int = 1,
    white: NDArray[np.float32] | None = None,
) -> Slopes:
    """Turn the normals of a rotation into slopes, -n_x / n_z and -n_y / n_z.

    *How sure they are.* Samples are distances from the axis, which goes round on a circle of radius d: they
    tell a zenith far better than an azimuth. Of the information of samples evenly round the circle the share
    that is across the meridian is ::

        q = 1/2 within the circle,  sin(d)^2 / (2 sin(zenith)^2) without

    so the variance sigma^2 of an angular error is sigma^2 q along the meridian, sigma^2 (1 - q) across. An
    error along it changes the slope by 1/cos(zenith)^2, one across it by 1/cos(zenith). Along x and y these
    two are mixed; that their errors go together is not told.

    *Bias.* An azimuth that is uncertain by s makes the mean of its vectors shorter by exp(-s^2 / 2), and
    a surface of them flatter. Slopes are made longer by as much.

    Parameters
    ----------
    vectors : ndarray, (H, W, 3), float32
        Unit normals; NaN where there is none.
    sigma : ndarray, (H, W), float32
        Their RMS angular error, radians.
    contact : ndarray, (H, W), uint8
        0 where they mean nothing.
    tilt : float or None
        Half-angle d of the precession, radians. None: errors are the same in all directions.
    turns : int
        Of how many turns the normals are the mean.
    white : ndarray, (H, W), float32, optional
        What to weigh slopes by instead of ``sigma``, where errors of neighbours are alike: those independent
        errors of which as much is left in a mean over many pixels.

    Returns
    -------
    Slopes
        Finite: a surface steeper than 80 degrees is taken to be as steep as that.
    """
    nx, ny, nz = np.moveaxis(vectors, -1, 0)
    white = sigma if white is None else white
    known = (contact != 0) & (nz > 0) & (sigma > 0) & (sigma < np.inf) & (white > 0) & (white < np.inf)
    nx, ny, nz, sigma, white = (np.where(known, one, np.float32(1)) for one in (nx, ny, nz, sigma, white))
    nz = np.maximum(nz, np.float32(math.cos(_STEEPEST)))
    longer = np.exp(0.5 * _turned(nx, ny, sigma, tilt, turns))
    nothing = np.float32(np.nan)
    variances = _variances(nx, ny, nz, white, tilt, known)
    return Slopes(
        dz_dx=np.where(known, -longer * nx / nz, nothing).astype(np.float32),
        dz_dy=np.where(known, -longer * ny / nz, nothing).astype(np.float32),
        weights=np.stack([np.where(known, 1 / one, 0) for one in variances]).astype(np.float32),
    )


def _share_along(nx: Floats, ny: Floats, tilt: float | None) -> Floats:
    """Return the share of an angular error's variance that is along the meridian."""
    if tilt is None:
        return np.full(nx.shape, 0.5, np.float32)
    least = math.sin(tilt) ** 2
    return np.asarray(0.5 * least / np.maximum(nx * nx + ny * ny, least), np.float32)


def _turned(nx: Floats, ny: Floats, sigma: Floats, tilt: float | None, turns: int = 1) -> Floats:
    """Return the variance of the azimuth in one turn, radians^2, within bounds; 0 without a tilt."""
    if tilt is None:
        return np.zeros(nx.shape, np.float32)
    outside = np.maximum(nx * nx + ny * ny, math.sin(tilt) ** 2)
    variance = turns * (1 - _share_along(nx, ny, tilt)) * sigma**2 / outside
    return np.asarray(np.minimum(variance, _WIDEST**2), np.float32)


def _east(nx: Floats, ny: Floats, known: NDArray[np.bool_], turned: Floats) -> Floats:
    """Return the square of the azimuth's cosine, from the normals around.

    By its own azimuth, a slope that noise has made shorter would be given another weight than one that it has
    made longer, and the weighted mean would be wrong. Squares do not mind which way a ridge faces. Noise of
    the azimuth, of the variance ``turned``, makes their means more alike, by exp(-2 turned).
    """
    x, y = (ndimage.uniform_filter(np.where(known, n * n, 0), _AROUND, mode="constant") for n in (nx, ny))
    least = np.finfo(np.float32).tiny
    east = (x + least) / (x + y + 2 * least)
    return np.asarray(np.clip(0.5 + (east - 0.5) * np.exp(2 * turned), 0, 1), np.float32)


def _variances(
    nx: Floats, ny: Floats, nz: Floats, sigma: Floats, tilt: float | None, known: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Return the variances of the slopes along x and y."""
    share, turned = _share_along(nx, ny, tilt), _turned(nx, ny, sigma, tilt)
    # An azimuth that is off by e makes a slope shorter by e^2 / 2 of it, besides what it does across.
    along = share * (sigma / nz**2) ** 2 + (nx * nx + ny * ny) / nz**2 * turned**2 / 2
    across = (1 - share) * (sigma / nz) ** 2
    east = _east(nx, ny, known, turned)
    along_x, along_y = east * along + (1 - east) * across, (1 - east) * along + east * across
    return along_x.astype(np.float32), along_y.astype(np.float32)


_ENOUGH = 1e-4  # residual that will do where that is not met, of many small facets: normals err far more
_FOREVER = 1e9  # seconds: with a budget, what was reached is returned


@dataclass(frozen=True, slots=True)
class RelativeHeights:
    """Heights that are relative, of one picture or of one for each turn, and which of them hang together.

    Attributes
    ----------
    height, sigma : ndarray, (H, W) or (turns, H, W), float32
        Millimetres; see ``mirrorskin.engine.Surface``. ``sigma`` may be None.
    component : ndarray, the same, int32
        Numbered through all turns.
    offset_unknown : ndarray, (components,), uint8
        Ones.
    edges : ndarray, (H, W) or (turns, H, W), uint8, or None
        Where the surface breaks, if that was asked.
    process : dict
        How they were found.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32] | None
    component: NDArray[np.int32]
    offset_unknown: NDArray[np.uint8]
    edges: NDArray[np.uint8] | None
    process: dict[str, ProcessValue]


def integrate_normals(
    normals: Normals,
    white: NDArray[np.float32],
    pixel_size: tuple[float, float],
    *,
    robust: bool = False,
    device: Device,
) -> RelativeHeights:
    """Integrate the normals of pixels in contact.

    Parameters
    ----------
    normals : Normals
        Of one picture, or of one for each turn.
    white : ndarray, (H, W) or (turns, H, W), float32
        Independent errors that amount to theirs, radians; see ``find_slopes``.
    pixel_size : (float, float)
        Millimetres along x and y.
    robust, device
        As for ``mirrorskin.engine.integrate``.

    Returns
    -------
    RelativeHeights

    Raises
    ------
    mirrorskin.engine.NotConverged
        No heights were found that fit.
    """
    each = normals.contact.ndim == 3
    maps: list[NDArray[Any]] = [normals.vectors, normals.sigma, normals.contact, white]
    turns = [np.index_exp[turn] for turn in range(len(white))] if each else [np.index_exp[:]]
    surfaces = []
    for turn in turns:
        vectors, sigma, contact, weighed = (one[turn] for one in maps)
        slopes = find_slopes(vectors, sigma, contact, normals.tilt, 1 if each else normals.turns, weighed)
        surfaces.append(_integrate(slopes, pixel_size, robust, device))
    relief = _stack(surfaces)
    return relief if each else _only(relief)


def describe_integration(surfaces: Sequence[Surface]) -> dict[str, ProcessValue]:
    """Say how surfaces were found, for a result's process."""
    if not surfaces:
        return {}
    return {
        "integration": surfaces[0].method,
        "integration_iterations": max(surface.iterations for surface in surfaces),
        "integration_residual": max(surface.residual for surface in surfaces),
    }


def _integrate(slopes: Slopes, pixel_size: tuple[float, float], robust: bool, device: Device) -> Surface:
    """Return the surface of one picture; one of no pixels, where there is no normal to begin with."""
    if not slopes.known.any():
        return _nothing(slopes.known.shape)
    surface = integrate(
        slopes.dz_dx,
        slopes.dz_dy,
        pixel_size,
        mask=slopes.known,
        slope_weights=slopes.weights,
        robust=robust,
        budget=_FOREVER,
        device=device,
    )
    if not (surface.converged or surface.residual <= _ENOUGH):
        raise NotConverged(explain(surface.iterations, surface.residual, _ENOUGH))
    return surface


def _nothing(shape: tuple[int, ...]) -> Surface:
    """Return a surface without an answer."""
    unknown = np.full(shape, np.nan, np.float32)
    return Surface(
        height=unknown,
        sigma=unknown.copy(),
        component=np.full(shape, -1, np.int32),
        offset_unknown=np.zeros(0, bool),
        filled=np.zeros(shape, np.uint8),
        edges=None,
        iterations=0,
        residual=0.0,
        converged=True,
        method="multigrid",
        invalid=0,
    )


def _stack(surfaces: list[Surface]) -> RelativeHeights:
    """Put the surfaces of turns together."""
    before = np.cumsum([0, *(len(surface.offset_unknown) for surface in surfaces)])
    components = [
        np.where(surface.component >= 0, surface.component + np.int32(shift), np.int32(-1))
        for surface, shift in zip(surfaces, before, strict=False)
    ]
    return RelativeHeights(
        height=np.stack([surface.height for surface in surfaces]),
        sigma=_stack_known([surface.sigma for surface in surfaces]),
        component=np.stack(components),
        offset_unknown=np.ones(before[-1], np.uint8),
        edges=_stack_known([surface.edges for surface in surfaces]),
        process=describe_integration(surfaces),
    )


def _stack_known(maps: list[NDArray[Any] | None]) -> NDArray[Any] | None:
    """Stack maps, if there are all of them."""
    known = [one for one in maps if one is not None]
    return np.stack(known) if len(known) == len(maps) else None


def _only(relief: RelativeHeights) -> RelativeHeights:
    """Return what is told of the only picture without a leading axis."""
    return replace(
        relief,
        height=relief.height[0],
        sigma=None if relief.sigma is None else relief.sigma[0],
        component=relief.component[0],
        edges=None if relief.edges is None else relief.edges[0],
    )


_CHUNK, _STRIP = 256, 16  # columns and rows of a work-item that is a core's loop; see slopes.cl
_PARTS = "squares_x", "squares_y"


class SlopeKernels:
    """Turns normals into slopes and weights, as ``find_slopes`` does of one turn, on the device.

    Parameters
    ----------
    device : Device
    shape : (int, int)
        Rows and columns.
    """

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self._device, self._shape = device, shape
        self._parts = [device.array(name, shape, np.float32) for name in _PARTS]
        for array in self._parts:
            array.upload()
        self.typical = math.nan

    def find(self, tilt: float, normals: Mapping[str, Array], to: Mapping[str, Array]) -> None:
        """Put the work on the device's queue.

        The first time, a weight as there are many is waited for, ``typical``: it bounds weights.

        Parameters
        ----------
        tilt : float
            Half-angle of the precession, radians.
        normals : mapping of str to Array
            ``vectors`` (H, W, 3), ``sigma`` and ``contact`` (H, W), and padding.
        to : mapping of str to Array
            ``dz_dx``, ``dz_dy``, ``weight_x`` and ``weight_y``, (H, W), float32.
        """
        device, (rows, columns) = self._device, self._shape
        pixels = rows * columns
        given = normals["vectors"], normals["sigma"], normals["contact"]
        slopes, weights = (to["dz_dx"], to["dz_dy"]), (to["weight_x"], to["weight_y"])
        width = 8 if device.layout.tile > 1 else 1
        find, weigh = (device.kernel("slopes", f"slopes_{name}", WIDTH=width) for name in ("find", "weigh"))
        least = np.float32(math.sin(tilt) ** 2)
        items = -(-pixels // device.layout.tile)
        find(items, np.int32(pixels), least, *given, *slopes, *self._parts, moved=33 * pixels)
        tile = device.layout.tile
        strip = _STRIP if tile >= _CHUNK else 1
        items = -(-rows // strip) * -(-columns // min(tile, _CHUNK))
        for _ in range(2 if math.isnan(self.typical) else 1):
            typical = 1.0 if math.isnan(self.typical) else self.typical
            free = math.isnan(self.typical)
            bounds = (0.0, math.inf) if free else (LEAST * typical, MOST * typical)
            sizes = np.int32(rows), np.int32(columns), least, *map(np.float32, bounds)
            weigh(items, *sizes, given[1], slopes[0], *self._parts, *weights, moved=24 * pixels)
            if free:
                self.typical = _typical(weights)


def _typical(weights: tuple[Array, Array]) -> float:
    """Return the median of weights above 0, of evenly spread pixels, or NaN where there is none."""
    some = []
    for array in weights:
        step = max(1, math.isqrt(array.host.size // SAMPLES))
        some.append(array.download()[step // 2 :: step, step // 2 :: step].ravel())
    known = np.concatenate(some)
    known = known[known > 0]
    return float(np.median(known)) if known.size else math.nan
