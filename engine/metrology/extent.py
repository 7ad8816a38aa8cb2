"""How high and how large: heights of single points, areas, and volumes between a surface and a plane."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.metrology.fitting import find_uncertain
from mirrorskin.engine.metrology.patch import Patch
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.engine.metrology.sections import apex

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_REACH = 3  # pixels to either side of the highest one, over which its top is fitted
_ENOUGH = 20  # of these 49 pixels that must be known
_NEAR = 3.0  # standard deviations above the lowest pixel, within which others might have been it
_UNIFORM = 1 / math.sqrt(3)  # standard deviation of what lies anywhere within 1 of its middle


def heights(patch: Patch) -> dict[str, Quantity]:
    """Return the heights of the highest and the lowest point, of the middle and of the rim, mm.

    The *highest* is that of a paraboloid fitted to 7 x 7 pixels around the highest one after a median: the
    highest pixel itself would be that with the largest error. Where no paraboloid has its top there, it is
    the mean of the nine pixels around. The *lowest* is the lowest level that two neighbouring pixels
    reach, as it often lies at the rim where nothing can be fitted; a few far more uncertain than others (see
    `find_uncertain`) do not count. Its uncertainty grows with the number of pixels of which it is the
    lowest by chance. Where a filled point is above the highest, values that reach up to it are also given
    "with filled".
    """
    highest, lowest, base = _highest(patch), _lowest(patch), rim(patch)
    median = Quantity(float(np.median(patch.height[patch.measured])), float(np.median(patch.sigmas())), "mm")
    found = {"highest point": highest, "lowest point": lowest, "height range": _difference(highest, lowest)}
    up_to_top = {"highest point", "height range", "height above rim"}
    found["median height"] = median
    if base is not None:
        found |= {"rim height": base, "height above rim": _difference(highest, base)}
    filled = patch.filled[np.isfinite(patch.filled)]
    if not filled.size or not filled.max() > np.max(patch.height[patch.measured]):
        return found
    quantities: dict[str, Quantity] = {}
    for name, quantity in found.items():
        quantities[name] = quantity
        if name in up_to_top:
            value = quantity.value + float(filled.max()) - highest.value
            quantities[f"{name} with filled"] = Quantity(value, np.nan, "mm")
    return quantities


def _difference(upper: Quantity, lower: Quantity) -> Quantity:
    """Return the distance of two points; their errors are taken to be independent."""
    return Quantity(upper.value - lower.value, math.hypot(upper.sigma, lower.sigma), upper.unit)


def rim(patch: Patch) -> Quantity | None:
    """Return the median height of the outermost measured pixels of the largest connected area, mm.

    Holes have no rim of their own, and the picture's border is none. None where more than half of the area's
    outline is the picture's border.
    """
    area = _largest(patch.measured | np.isfinite(patch.filled))
    outermost = border(area)
    if 2 * np.count_nonzero(outermost) < np.count_nonzero(border(area, ends=True)):
        return None
    outermost &= patch.measured
    if not outermost.any():
        return None
    sigma = np.nan if patch.sigma is None else float(np.median(patch.sigma[outermost]))
    return Quantity(float(np.median(patch.height[outermost])), sigma, "mm")


def border(mask: Mask, *, ends: bool = False) -> Mask:
    """Return the pixels of a mask next to one outside of it, or with ``ends`` at the picture's end."""
    from scipy import ndimage

    return np.asarray(mask & ~ndimage.binary_erosion(mask, border_value=not ends))


def _largest(mask: Mask) -> Mask:
    """Return the largest connected area of a mask, with its holes."""
    from scipy import ndimage

    label, count = ndimage.label(mask, np.ones((3, 3)))
    if count > 1:
        mask = label == 1 + np.argmax(np.bincount(label.ravel())[1:])
    return np.asarray(ndimage.binary_fill_holes(mask))


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
    """Return the top of a paraboloid through pixels, and the RMS of its residual; None if it has none."""
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
    import cv2

    counts = patch.measured
    if patch.sigma is not None:
        counts = counts & ~find_uncertain(patch.sigma, counts)
    height = np.where(counts, patch.height, np.inf)
    # Only pixels with an adjacent one that is as low: a single low pixel does not count.
    around = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
    adjacent = cv2.erode(height, around, borderType=cv2.BORDER_CONSTANT, borderValue=math.inf)
    pair = np.where(height >= adjacent, height, np.inf)
    place = np.unravel_index(int(np.argmin(pair if np.isfinite(pair).any() else height)), height.shape)
    value = float(height[place])
    sigma = np.nan if patch.sigma is None else float(patch.sigma[place])
    if np.isfinite(sigma):
        # The least of n normal variates lies about sqrt(2 ln n) standard deviations below their mean.
        rivals = int(np.count_nonzero(height <= value + _NEAR * sigma))
        sigma *= max(1.0, math.sqrt(2 * math.log(max(rivals, 1))))
    return Quantity(value, sigma, "mm")


def areas(patch: Patch) -> dict[str, Quantity]:
    """Return the areas with a height and in contact, as the camera sees them, and of the surface there, mm2.

    Where contact ends is known within half a pixel, everywhere to the same side: so the whole border of
    half a pixel's width is uncertain. Where the result has no map of contact, the area with a height is
    taken for it, and named so if part of that was filled. The surface is that of the normals: a pixel's
    area over the normal's z.
    """
    filled = np.isfinite(patch.filled)
    found = {"measured area": _area(patch, patch.measured)}
    if filled.any():
        found["measured area with filled"] = _area(patch, patch.measured | filled)
    guessed = filled.any() and not patch.contact_given
    found["contact area with filled" if guessed else "contact area"] = _area(patch, patch.contact)
    if patch.secant is not None:
        known = patch.contact & np.isfinite(patch.secant)
        if known.any():
            found["contact surface area"] = _surface(patch, known, patch.secant)
    return found


def volume(patch: Patch, level: float, level_sigma: float, name: str) -> dict[str, Quantity]:
    """Return the volume between the surface and a plane at a level, mm, in mm3; negative where it lies below.

    Errors of heights are taken to be fully correlated, so their standard deviations add up: no correlation
    makes the volume less certain than that.
    """
    above = patch.height - level
    value = patch.pixel_area * float(np.nansum(above))
    errors = float(np.sum(patch.sigmas())) + level_sigma * np.count_nonzero(patch.measured)
    edge = 0.5 * _UNIFORM * float(np.sum(abs(above[border(patch.measured)])))
    found = {name: Quantity(value, patch.pixel_area * math.hypot(errors, edge), "mm3")}
    if np.isfinite(patch.filled).any():
        filled = patch.pixel_area * float(np.nansum(patch.filled - level))
        found[f"{name} with filled"] = Quantity(value + filled, np.nan, "mm3")
    return found


def _area(patch: Patch, mask: Mask) -> Quantity:
    edge = 0.5 * _UNIFORM * int(np.count_nonzero(border(mask)))
    return Quantity(patch.pixel_area * int(np.count_nonzero(mask)), patch.pixel_area * edge, "mm2")


def _surface(patch: Patch, known: Mask, secant: Doubles) -> Quantity:
    """Add up secants; errors of the zenith change them by the tangent, and are taken as fully correlated."""
    value = float(np.sum(secant[known]))
    edge = 0.5 * _UNIFORM * float(np.sum(secant[border(known)]))
    errors = np.nan
    if patch.normals_sigma is not None:
        tangent = np.sqrt(np.maximum(secant**2 - 1, 0))
        errors = float(np.nansum((secant * tangent * patch.normals_sigma)[known]))
    return Quantity(patch.pixel_area * value, patch.pixel_area * math.hypot(edge, errors), "mm2")
