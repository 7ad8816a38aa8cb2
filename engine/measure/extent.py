"""How large: areas, and volumes between a surface and a plane."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.measure.levels import border
from mirrorskin.engine.measure.patch import Patch
from mirrorskin.engine.measure.quantity import Quantity

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_UNIFORM = 1 / math.sqrt(3)  # standard deviation of what lies anywhere within 1 of its middle


def areas(patch: Patch) -> dict[str, Quantity]:
    """Return the areas with a height and in contact, as the camera sees them, and of the surface there, mm2.

    Where contact ends is known within half a pixel, everywhere to the same side: so the whole border of
    half a pixel's width is uncertain. Where the result does not tell the contact, the area with a height is
    taken for it, and says so if part of that was filled. The surface is told by normals: a pixel's
    area over the normal's z.
    """
    filled = np.isfinite(patch.filled)
    told = {"measured area": _area(patch, patch.measured)}
    if filled.any():
        told["measured area with filled"] = _area(patch, patch.measured | filled)
    guessed = filled.any() and not patch.contact_told
    told["contact area with filled" if guessed else "contact area"] = _area(patch, patch.contact)
    if patch.secant is not None:
        known = patch.contact & np.isfinite(patch.secant)
        if known.any():
            told["contact surface area"] = _surface(patch, known, patch.secant)
    return told


def volume(patch: Patch, level: float, level_sigma: float, name: str) -> dict[str, Quantity]:
    """Return the volume between the surface and a plane of some height, mm3; negative where it lies below.

    Errors of heights are taken to go together wholly, so their standard deviations add up: no correlation
    makes the volume less sure than that.

    Parameters
    ----------
    patch : Patch
    level, level_sigma : float
        Of the plane, mm.
    name : str
        What to call it.
    """
    above = patch.height - level
    value = patch.pixel_area * float(np.nansum(above))
    errors = float(np.sum(patch.sigmas())) + level_sigma * np.count_nonzero(patch.measured)
    ends = border(patch.measured)
    edge = 0.5 * _UNIFORM * float(np.sum(abs(above[ends])))
    told = {name: Quantity(value, patch.pixel_area * math.hypot(errors, edge), "mm3")}
    if np.isfinite(patch.filled).any():
        filled = patch.pixel_area * float(np.nansum(patch.filled - level))
        told[f"{name} with filled"] = Quantity(value + filled, np.nan, "mm3")
    return told


def _area(patch: Patch, mask: Mask) -> Quantity:
    edge = 0.5 * _UNIFORM * int(np.count_nonzero(border(mask)))
    return Quantity(patch.pixel_area * int(np.count_nonzero(mask)), patch.pixel_area * edge, "mm2")


def _surface(patch: Patch, known: Mask, secant: Doubles) -> Quantity:
    """Add up secants; errors of the zenith change them by the tangent, and are taken to go together."""
    value = float(np.sum(secant[known]))
    edge = 0.5 * _UNIFORM * float(np.sum(secant[border(known)]))
    errors = np.nan
    if patch.normal_sigma is not None:
        tangent = np.sqrt(np.maximum(secant**2 - 1, 0))
        errors = float(np.nansum((secant * tangent * patch.normal_sigma)[known]))
    return Quantity(patch.pixel_area * value, patch.pixel_area * math.hypot(edge, errors), "mm2")
