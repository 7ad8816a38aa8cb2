"""How high and how large: heights of single points, areas, and volumes between a surface and a plane."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mirrorskin.engine.metrology.fitting import far_less_sure
from mirrorskin.engine.metrology.patch import Patch
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.engine.metrology.sections import apex

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_REACH = 3  # pixels to either side of the highest one, over which its top is fitted
_ENOUGH = 20  # of these 49 pixels that must be known
_NEAR = 3.0  # standard deviations above the lowest pixel, within which others might have been it
_UP_TO_TOP = ("highest point", "height range", "height above rim")
_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)


def levels(patch: Patch) -> dict[str, Quantity]:
    """Return the heights of the highest and the lowest point, of the middle and of the rim, mm.

    The *highest* is that of a paraboloid fitted to 7 x 7 pixels around the highest one after a median: the
    highest pixel itself would be that with the largest error. Where no paraboloid has its top there, it is
    the mean of the nine pixels around. The *lowest* is the lowest level that two neighbouring pixels
    reach, as it often lies at the rim where nothing can be fitted; a few far less sure than others (see
    `far_less_sure`) do not count. Its uncertainty grows with the number of pixels of which it is the
    lowest by chance.
    """
    highest, lowest = _highest(patch), _lowest(patch)
    sigma = patch.sigmas()
    middle = Quantity(float(np.median(patch.height[patch.measured])), float(np.median(sigma)), "mm")
    base = rim(patch)
    told = {
        "highest point": highest,
        "lowest point": lowest,
        "height range": _difference(highest, lowest),
        "median height": middle,
    }
    if base is not None:
        told |= {"rim height": base, "height above rim": _difference(highest, base)}
    return _with_filled(told, _highest_filled(patch))


def _with_filled(told: dict[str, Quantity], top: float | None) -> dict[str, Quantity]:
    """Add to what goes up to the highest point what it is with a higher filled one."""
    every: dict[str, Quantity] = {}
    for name, quantity in told.items():
        every[name] = quantity
        if top is not None and name in _UP_TO_TOP:
            value = quantity.value + top - told["highest point"].value
            every[f"{name} with filled"] = Quantity(value, np.nan, "mm")
    return every


def _difference(upper: Quantity, lower: Quantity) -> Quantity:
    """Return how far two points are apart; their errors are taken to be independent."""
    return Quantity(upper.value - lower.value, math.hypot(upper.sigma, lower.sigma), upper.unit)


def rim(patch: Patch) -> Quantity | None:
    """Return the median height of the outermost measured pixels of the largest connected area, mm.

    Holes have no rim of their own, and the picture's border is none.

    Returns
    -------
    Quantity or None
        None where more than half of the area's outline is the picture's border.
    """
    whole = _largest(patch.measured | np.isfinite(patch.filled))
    outermost = border(whole)
    if 2 * np.count_nonzero(outermost) < np.count_nonzero(border(whole, ends=True)):
        return None
    outermost &= patch.measured
    if not outermost.any():
        return None
    sigma = np.nan if patch.sigma is None else float(np.median(patch.sigma[outermost]))
    return Quantity(float(np.median(patch.height[outermost])), sigma, "mm")


def border(mask: Mask, *, ends: bool = False) -> Mask:
    """Return the pixels of a mask beside one outside of it, or with ``ends`` beside the picture's end."""
    return np.asarray(mask & ~ndimage.binary_erosion(mask, border_value=not ends))


def _largest(mask: Mask) -> Mask:
    """Return the largest connected area of a mask, with its holes."""
    label, count = ndimage.label(mask, np.ones((3, 3)))
    if count > 1:
        mask = label == 1 + np.argmax(np.bincount(label.ravel())[1:])
    return np.asarray(ndimage.binary_fill_holes(mask))


def _highest_filled(patch: Patch) -> float | None:
    """Return the height of the highest filled point, mm, if it is above all that was measured."""
    filled = patch.filled[np.isfinite(patch.filled)]
    if not filled.size or not filled.max() > np.max(patch.height[patch.measured]):
        return None
    return float(filled.max())


def _highest(patch: Patch) -> Quantity:
    row, column = apex(patch.height)
    rows, columns = (slice(max(at - _REACH, 0), at + _REACH + 1) for at in (row, column))
    known = patch.measured[rows, columns]
    y, x = np.nonzero(known)
    y, x, z = y + rows.start - row, x + columns.start - column, patch.height[rows, columns][known]
    sigma = np.nan if patch.sigma is None else float(np.median(patch.sigma[rows, columns][known]))
    top = _top(x, y, z)
    if top is None:
        near = z[(abs(y) <= 1) & (abs(x) <= 1)]
        top = float(np.mean(near)), float(np.std(near))
    value, misfit = top
    return Quantity(value, math.hypot(sigma, misfit), "mm")


def _top(x: NDArray[np.intp], y: NDArray[np.intp], z: Doubles) -> tuple[float, float] | None:
    """Return the top of a paraboloid through pixels, and the RMS of what it leaves; None if it has none."""
    if z.size < _ENOUGH:
        return None
    rows = np.stack([np.ones(z.size), x, y, x * x, x * y, y * y]).astype(np.float64)
    found, *_ = np.linalg.lstsq(rows.T, z, rcond=None)
    bend = np.array([[2 * found[3], found[4]], [found[4], 2 * found[5]]])
    if np.linalg.eigvalsh(bend)[1] >= 0:
        return None
    place = np.linalg.solve(bend, -found[1:3])
    if np.abs(place).max() > _REACH:
        return None
    misfit = float(np.sqrt(np.mean((z - found @ rows) ** 2)))
    return float(found[0] + found[1:3] @ place / 2), misfit


def _lowest(patch: Patch) -> Quantity:
    counts = patch.measured
    if patch.sigma is not None:
        counts = counts & ~far_less_sure(patch.sigma, counts)
    height = np.where(counts, patch.height, np.inf)
    # Only pixels with one beside them that is as low: a single low pixel does not count.
    beside = cv2.erode(height, _AROUND, borderType=cv2.BORDER_CONSTANT, borderValue=math.inf)
    pair = np.where(height >= beside, height, np.inf)
    place = np.unravel_index(int(np.argmin(pair if np.isfinite(pair).any() else height)), height.shape)
    value = float(height[place])
    sigma = np.nan if patch.sigma is None else float(patch.sigma[place])
    if np.isfinite(sigma):
        # The least of n normal variates lies about sqrt(2 ln n) standard deviations below their mean.
        rivals = int(np.count_nonzero(height <= value + _NEAR * sigma))
        sigma *= max(1.0, math.sqrt(2 * math.log(max(rivals, 1))))
    return Quantity(value, sigma, "mm")


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
