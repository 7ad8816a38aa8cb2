"""Heights of characteristic points, areas, and volumes between a surface and a plane."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.metrology.fitting import find_uncertain
from mirrorskin.engine.metrology.patch import Patch, patch_of
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.engine.metrology.sections import apex
from mirrorskin.io import Result
from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]

_REACH = 3  # pixels on either side of the highest one to which a paraboloid is fitted
_MIN_PIXELS = 20  # of these 49 pixels that must have a height
_NEAR = 3.0  # standard deviations above the lowest pixel, up to which others count as candidates
_OF_TOP = 0.5  # share of the noise's variance that a paraboloid leaves, and the choice of its place adds
_NEAR_MEDIAN = 1.5  # standard deviations from a median, up to which errors of heights change it
_OF_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
_COMMON_BORDER = 0.1  # share of the border's error with the same sign everywhere
_UNIFORM = 1 / math.sqrt(3)  # standard deviation of a uniform distribution between -1 and 1


@dataclass(frozen=True, slots=True)
class HighestPoint:
    """The highest measured point of a surface.

    Attributes
    ----------
    height : Quantity
        That of `measure`, mm.
    x, y : float
        Position of the highest pixel after a median filter, mm.
    """

    height: Quantity
    x: float
    y: float


def highest_point(result: Result) -> HighestPoint:
    """Return the highest measured point of a result with a pixel size."""
    patch, _ = patch_of(result)
    row, column = apex(patch.height)
    return HighestPoint(_highest(patch), float(patch.x[column]), float(patch.y[row]))


def heights(patch: Patch, outermost: Mask | None) -> dict[str, Quantity]:
    """Return the heights of the highest and the lowest point, the median, and that of the rim's pixels, mm.

    The *highest point* is the top of a paraboloid fitted to 7 x 7 pixels around the highest pixel after a
    median filter; the highest pixel itself would have the largest error. If the paraboloid has no top there,
    it is the mean of 3 x 3 pixels. The *lowest point* is the lowest level that two adjacent pixels reach,
    because it is often at the rim, where nothing can be fitted. Pixels that are far more uncertain than most
    (see `find_uncertain`) do not count. Its uncertainty increases with the number of candidates. If a filled
    point is higher than the highest point, values that depend on it are also returned "with filled".
    """
    highest, lowest = _highest(patch), _lowest(patch)
    base = None if outermost is None else rim(patch, outermost)
    median = Quantity(float(np.median(patch.height[patch.measured])), float(np.median(patch.sigmas())), "mm")
    measured = {
        "highest point": highest,
        "lowest point": lowest,
        "height range": _difference(highest, lowest),
    }
    measured["median height"] = median
    if base is not None:
        measured |= {"rim height": base, "height above rim": _difference(highest, base)}
    filled = patch.filled[np.isfinite(patch.filled)]
    if not filled.size or not filled.max() > np.max(patch.height[patch.measured]):
        return measured
    quantities: dict[str, Quantity] = {}
    for name, quantity in measured.items():
        quantities[name] = quantity
        if name in ("highest point", "height range", "height above rim"):
            value = quantity.value + float(filled.max()) - highest.value
            quantities[f"{name} with filled"] = Quantity(value, np.nan, "mm")
    return quantities


def _difference(upper: Quantity, lower: Quantity) -> Quantity:
    """Return the difference of two heights with independent errors."""
    return Quantity(upper.value - lower.value, math.hypot(upper.sigma, lower.sigma), upper.unit)


def rim_pixels(patch: Patch) -> Mask | None:
    """Return the outermost measured pixels of the largest connected area.

    Borders of holes and the picture's border are no rim. None if more than half of the area's outline is the
    picture's border.
    """
    import cv2

    area = patch.measured | np.isfinite(patch.filled)
    count, label = cv2.connectedComponents(area.view(np.uint8), connectivity=8)
    if count > 2:
        area = label == 1 + np.argmax(np.bincount(label.ravel())[1:])
    # Everything that is not connected to the outside of the picture, without diagonals: no holes.
    _, outside = cv2.connectedComponents(
        np.pad(~area, 1, constant_values=True).view(np.uint8), connectivity=4
    )
    area = outside[1:-1, 1:-1] != outside[0, 0]
    outermost = border(area)
    if 2 * np.count_nonzero(outermost) < np.count_nonzero(border(area, ends=True)):
        return None
    outermost &= patch.measured
    if not outermost.any():
        return None
    return outermost


def rim(patch: Patch, outermost: Mask) -> Quantity:
    """Return the median height of the rim's pixels, mm."""
    height, sigma = patch.height[outermost], _median_sigma(patch, outermost)
    middle, common = float(np.median(height)), patch.common_variance(outermost)
    # On slopes, only few pixels are as high as their median, whose errors change it.
    pixels = int(np.count_nonzero(abs(height - middle) <= _NEAR_MEDIAN * sigma))
    variance = common + (sigma**2 - common) * min(_OF_MEDIAN**2 / max(pixels, 1), 1.0)
    return Quantity(middle, math.sqrt(variance), "mm")


def _median_sigma(patch: Patch, chosen: Mask) -> float:
    return np.nan if patch.sigma is None else float(np.median(patch.sigma[chosen]))


def border(mask: Mask, *, ends: bool = False) -> Mask:
    """Return the pixels of a mask with a neighbour outside of it; with ``ends`` also the picture's border."""
    import cv2

    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    inside = cv2.erode(
        mask.astype(np.uint8), cross, borderType=cv2.BORDER_CONSTANT, borderValue=int(not ends)
    )
    return np.asarray(mask & (inside == 0))


def _highest(patch: Patch) -> Quantity:
    row, column = apex(patch.height)
    rows, columns = (slice(max(at - _REACH, 0), at + _REACH + 1) for at in (row, column))
    measured = patch.measured[rows, columns]
    y, x = np.nonzero(measured)
    y, x, z = y + rows.start - row, x + columns.start - column, patch.height[rows, columns][measured]
    top = _top(x, y, z)
    if top is None:
        middle = z[(abs(y) <= 1) & (abs(x) <= 1)]
        top = float(np.mean(middle)), float(np.std(middle))
    value, misfit = top
    if patch.sigma is None:
        return Quantity(value, np.nan, "mm")
    sigma = float(np.median(patch.sigma[rows, columns][measured]))
    near = np.zeros(patch.measured.shape, bool)
    near[rows, columns] = measured
    noise = sigma**2 - patch.common_variance(near)
    variance = sigma**2 - (1 - _OF_TOP) * noise + max(misfit**2 - noise, 0.0)
    return Quantity(value, math.sqrt(variance), "mm")


def _top(x: NDArray[np.intp], y: NDArray[np.intp], z: Doubles) -> tuple[float, float] | None:
    """Return the top of a paraboloid fitted to pixels, and the RMS residual; None if it has no top."""
    if z.size < _MIN_PIXELS:
        return None
    rows = np.stack([np.ones(z.size), x, y, x * x, x * y, y * y]).astype(np.float64)
    c, *_ = np.linalg.lstsq(rows.T, z, rcond=None)
    hessian = np.array([[2 * c[3], c[4]], [c[4], 2 * c[5]]])
    if np.linalg.eigvalsh(hessian)[1] >= 0:
        return None
    position = np.linalg.solve(hessian, -c[1:3])
    if np.abs(position).max() > _REACH:
        return None
    misfit = float(np.sqrt(np.mean((z - c @ rows) ** 2)))
    return float(c[0] + c[1:3] @ position / 2), misfit


def _lowest(patch: Patch) -> Quantity:
    import cv2

    counts = patch.measured
    if patch.sigma is not None:
        counts = counts & ~find_uncertain(patch.sigma, counts)
    height = np.where(counts, patch.height, np.inf)
    # A low pixel counts only if an adjacent pixel is as low.
    neighbours = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
    adjacent = cv2.erode(height, neighbours, borderType=cv2.BORDER_CONSTANT, borderValue=math.inf)
    pair = np.where(height >= adjacent, height, np.inf)
    place = np.unravel_index(int(np.argmin(pair if np.isfinite(pair).any() else height)), height.shape)
    value = float(height[place])
    if patch.sigma is None:
        return Quantity(value, np.nan, "mm")
    # The least of n normal variates is about sqrt(2 ln n) standard deviations below their mean, and the least
    # that two neighbours reach sqrt(ln n).
    candidates = height <= value + _NEAR * patch.sigma[place]
    sigma, number = float(np.median(patch.sigma[candidates])), int(np.count_nonzero(candidates))
    common = 0.0 if math.isinf(patch.noise_length) else patch.common_variance(candidates)
    noise = sigma**2 - common
    return Quantity(value, math.sqrt(sigma**2 + noise * max(0.0, math.log(number) - 1)), "mm")


def areas(patch: Patch) -> dict[str, Quantity]:
    """Return the projected areas with a height and in contact, and the area of the surface in contact, mm2.

    The end of contact is known within half a pixel, independently in each pixel of the border, but for a
    tenth of that which has the same sign everywhere; it is unknown if all of it is the picture's border.
    Without a map of contact, a press is in contact where it has a height, and the name says so if part of
    it was filled; other heights have no contact. The surface area of a pixel is its area over the
    normal's z.
    """
    filled = np.isfinite(patch.filled)
    quantities = {"measured area": _area(patch, patch.measured)}
    if filled.any():
        quantities["measured area with filled"] = _area(patch, patch.measured | filled)
    in_contact = patch.contact_given or patch.of_press
    if in_contact:
        guessed = filled.any() and not patch.contact_given
        contact = _area(patch, patch.contact)
        if contact.sigma == 0 and contact.value > 0:  # all of its border is that of the picture
            contact = replace(contact, sigma=math.nan)
        quantities["contact area with filled" if guessed else "contact area"] = contact
    if patch.secant is not None:
        measured = patch.contact & np.isfinite(patch.secant)
        if measured.any():
            name = "contact surface area" if in_contact else "measured surface area"
            quantities[name] = _surface(patch, measured, patch.secant)
    return quantities


def volume(
    patch: Patch, level: float, name: str, *, level_sigma: float = 0.0, level_pixels: Mask | None = None
) -> dict[str, Quantity]:
    """Return the volume between the surface and a plane at a level, mm, in mm3; negative below the plane.

    Errors of heights are partly independent, and partly common: see `Patch.error_of_sum`. An error of the
    pixels whose median is the level changes the level as well.
    """
    above, pixels = patch.height - level, np.count_nonzero(patch.measured)
    value = patch.pixel_area * float(np.nansum(above))
    weights: Doubles | float = 1.0
    if level_pixels is not None and math.isfinite(patch.noise_length):
        share = level_pixels / np.count_nonzero(level_pixels)
        weights = 1 - pixels * share
        # The error of a median is that at its height; on slopes it exceeds that of the mean.
        level_sigma = math.sqrt(max(level_sigma**2 - patch.error_of_sum(share) ** 2, 0.0))
    errors = math.hypot(patch.error_of_sum(weights), pixels * level_sigma)
    edge = _error_of_border(above[border(patch.measured)])
    quantities = {name: Quantity(value, patch.pixel_area * math.hypot(errors, edge), "mm3")}
    if np.isfinite(patch.filled).any():
        filled = patch.pixel_area * float(np.nansum(patch.filled - level))
        quantities[f"{name} with filled"] = Quantity(value + filled, np.nan, "mm3")
    return quantities


def _error_of_border(values: Doubles) -> float:
    """Return the standard deviation of a sum because its border, with values (n,), is known to a pixel."""
    independent = math.sqrt(float(np.sum(values**2)))
    return 0.5 * _UNIFORM * math.hypot(independent, _COMMON_BORDER * float(np.sum(np.abs(values))))


def _area(patch: Patch, mask: Mask) -> Quantity:
    edge = _error_of_border(np.ones(np.count_nonzero(border(mask))))
    return Quantity(patch.pixel_area * int(np.count_nonzero(mask)), patch.pixel_area * edge, "mm2")


def _surface(patch: Patch, measured: Mask, secant: Doubles) -> Quantity:
    """Return the sum of secants. Errors of the zenith change them by the tangent, fully correlated."""
    value = float(np.sum(secant[measured]))
    edge = _error_of_border(secant[border(measured)])
    errors = np.nan
    if patch.normals_sigma is not None:
        tangent = np.sqrt(np.maximum(secant**2 - 1, 0))
        errors = float(np.nansum((secant * tangent * patch.normals_sigma)[measured]))
    return Quantity(patch.pixel_area * value, patch.pixel_area * math.hypot(edge, errors), "mm2")
