"""The heights that fit the normals of a rotation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.integration.integrate import integrate
from mirrorskin.engine.integration.solver import explain
from mirrorskin.engine.integration.surface import Surface
from mirrorskin.engine.rotation.normals import Normals
from mirrorskin.engine.rotation.slopes import Slopes, find_slopes
from mirrorskin.io import ProcessValue
from mirrorskin.kernels.device import Device

_ENOUGH = 1e-4  # residual that will do where that is not met, of many small facets: normals err far more
_FOREVER = 1e9  # seconds: with a budget, what was reached is returned


@dataclass(frozen=True, slots=True)
class Relief:
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


def find_relief(
    normals: Normals,
    white: NDArray[np.float32],
    pixel_size: tuple[float, float],
    *,
    robust: bool = False,
    device: Device,
) -> Relief:
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
    Relief

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


def tell_integration(surfaces: Sequence[Surface]) -> dict[str, ProcessValue]:
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
        weights=slopes.weights,
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


def _stack(surfaces: list[Surface]) -> Relief:
    """Put the surfaces of turns together."""
    before = np.cumsum([0, *(len(surface.offset_unknown) for surface in surfaces)])
    components = [
        np.where(surface.component >= 0, surface.component + np.int32(shift), np.int32(-1))
        for surface, shift in zip(surfaces, before, strict=False)
    ]
    return Relief(
        height=np.stack([surface.height for surface in surfaces]),
        sigma=_stack_known([surface.sigma for surface in surfaces]),
        component=np.stack(components),
        offset_unknown=np.ones(before[-1], np.uint8),
        edges=_stack_known([surface.edges for surface in surfaces]),
        process=tell_integration(surfaces),
    )


def _stack_known(maps: list[NDArray[Any] | None]) -> NDArray[Any] | None:
    """Stack maps, if there are all of them."""
    known = [one for one in maps if one is not None]
    return np.stack(known) if len(known) == len(maps) else None


def _only(relief: Relief) -> Relief:
    """Return what is told of the only picture without a leading axis."""
    return replace(
        relief,
        height=relief.height[0],
        sigma=None if relief.sigma is None else relief.sigma[0],
        component=relief.component[0],
        edges=None if relief.edges is None else relief.edges[0],
    )
