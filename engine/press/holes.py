"""Filling of holes in a height map: flat tops and vertices, which never turn light."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.press.membrane import stretch
from mirrorskin.engine.press.spline import Spline, fit_within
from mirrorskin.io import InputError
from mirrorskin.io.base.arguments import check_number, check_pixel_size, checked, in_unit
from mirrorskin.kernels.array_types import Doubles

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Box = tuple[slice, slice]

_SQUARE = np.ones((3, 3), np.uint8)
_LINES: tuple[Any, ...] = np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1]  # a map's four sides
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
_LEAST_AREA, _LEAST_SIDE = 9, 3  # pixels: smaller or narrower holes are filled with a membrane
_SMALL = 2.0  # pixels: minimum radius of the largest circle in a hole that is not filled with a membrane
_RING = 1.1  # width of the ring that determines the fill, in radii of the hole
_NARROW = 0.6  # width of the second ring to try, in radii
_LEAST_RING = 3.0  # pixels
_TERRACES = 1.9  # steps of height that a ring must span to show curvature: 2, less rounding
_WIDEST, _WIDER = 3.0, 1.3  # radii up to which a ring is widened, and the factor
_SAMPLES = 12  # samples of the ring per radius of the hole
_MOST_SAMPLES = 120  # approximate number of samples along a side of the hole's box
_MOST_CELLS = 20  # maximum number of spline cells, of the length of a radius, along an axis
_STIFFNESS = 2e-4  # see `fit_within`; for a hole of radius 1 and intervals of half-width _DEPTH
_MISFIT = 0.5  # half-widths: RMS excess above which the ring is not one smooth surface
_STEEP_SHARE = 0.05  # maximum share of a hole's pixels that are steeper than `steepest`
_DEPTH = 0.1  # depth of a spherical cap that is dark up to 11.8 degrees, in radii of its hole
_CUT = 0.2  # maximum share of a hole's outline on the picture's border
_HEAVY = 250  # splines of a surface that takes twice as long as a small one
_WORK = 40.0  # limit of the work, in small surfaces; further holes are filled with membranes
_EXACT = 0.01  # pixel sizes: minimum half-width of an interval


@checked(
    height=in_unit("mm"),
    sigma=in_unit("mm"),
    pixel_size=in_unit("mm"),
    above=in_unit("mm"),
    steepest=check_number,
    deepest=in_unit("mm", check_number),
)
def fill_holes(
    height: ArrayLike,
    sigma: ArrayLike,
    pixel_size: ArrayLike,
    *,
    above: ArrayLike | None = None,
    steepest: float = 0.32,
    deepest: float | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Fill the holes of a height map with smooth surfaces.

    Surfaces flatter than about 12 degrees never turn light, so the tops of a press are missing. A hole is a
    group of pixels without height that is surrounded by pixels with heights, except for gaps of up to two
    pixels. It may touch the picture's border within the convex hull of the heights.

    *Smooth surface.* Each height in a ring around the hole, about as wide as the hole's radius, is an
    interval of +- sqrt(3) sigma. Of all surfaces within these intervals, the one with the smallest squared
    third derivatives fills the hole. They vanish for a paraboloid, so a cap is continued as a cap. Terraces
    fix the surface at their borders and leave it free within the intervals elsewhere.

    *Membrane.* If that surface would be light in the hole (steeper than `steepest`), there is a crease at the
    rim; if no surface stays within the intervals, there is a crease in the ring. These holes, and small or
    long thin ones, are filled with the solution of Laplace's equation for the heights at their rim, so flat
    tops are filled flat. Such holes are not filled if the picture's border cuts off more than a corner.

    Parameters
    ----------
    height : array_like, (H, W)
        Millimetres; NaN where there is none.
    sigma : array_like, scalar or (H, W)
        Standard deviations of the heights, mm: half-widths over sqrt(3), as returned by ``find_onset``.
    pixel_size : float or (float, float)
        Millimetres, along x and y.
    above : array_like, scalar or (H, W), optional
        Lower bounds of the heights, mm; NaN without a bound. For a pixel that was light at the start, it is
        minus the first travel.
    steepest : float
        Slope above which a pressed sheet is light. The default is for the paper's sensor up to 10 mm off its
        centre, with a margin; a sensor with an air gap needs 0.45.
    deepest : float, optional
        Height of the untouched sheet in the last frame, mm: minus the last travel. Pixels whose fill is less
        than a step above it may be untouched, and are not filled.

    Returns
    -------
    height : ndarray, (H, W), float32
        The heights, with the holes filled.
    filled : ndarray, (H, W), uint8
        1 where a hole was filled.

    Raises
    ------
    mirrorskin.io.InputError
        Maps, sizes or limits that cannot be used.

    Notes
    -----
    A fill is a guess without a meaningful standard deviation: a ball's cap, a worn cone and a top cut off
    within the hole look the same. On balls of 3 to 10 mm radius the apex was accurate to 0.005 mm at steps of
    0.01 mm, and to 0.020 mm at 0.1 and 0.2 mm. A flat top is accurate to half a step and the drop of its
    flank over a pixel. The tip of a cone is cut off at its hole. Pixels that are light at the start make
    holes larger: start a press well above the object. An untouched pit with vertical walls looks like a flat
    top, and is filled.

    Examples
    --------
    >>> height = np.zeros((9, 9))
    >>> height[3:6, 3:6] = np.nan
    >>> height, filled = fill_holes(height, sigma=0.01, pixel_size=0.1)
    >>> float(height[4, 4]), int(filled.sum())
    (0.0, 9)
    """
    heights = np.asarray(height, np.float32)
    if heights.ndim != 2 or 0 in heights.shape:
        raise InputError(f"heights have shape {heights.shape}: one map (H, W) is needed")
    sigmas = _like("sigma", sigma, heights)
    bounds = _like("above", np.nan if above is None else above, heights)
    if np.any(sigmas < 0):
        raise InputError("sigma is negative somewhere: standard deviations in mm are needed")
    field = _Field(heights, sigmas, bounds, check_pixel_size(pixel_size)[::-1])
    if not 0 < steepest < math.inf:
        raise InputError(f"steepest {steepest}: a slope above 0 is needed, such as 0.32")
    if deepest is not None and not math.isfinite(deepest):
        raise InputError(f"deepest {deepest}: a height in mm is needed, such as -3.0")
    result, filled = heights.copy(), np.zeros(heights.shape, np.uint8)
    left, top, across, down = cv2.boundingRect(np.isfinite(result).view(np.uint8))
    if across:
        part = slice(top, top + down), slice(left, left + across)
        sides = top == 0, top + down == len(result), left == 0, left + across == len(result[0])
        _fill(field.part(part), sides, steepest, deepest, result[part], filled[part])
    return result, filled


class _Field(NamedTuple):
    """Heights, (H, W), NaN where unknown; their standard deviations and lower bounds (NaN without).

    ``spacing`` is the distance of rows and of columns. All lengths are in mm.
    """

    height: Floats
    sigma: NDArray[Any]
    above: NDArray[Any]
    spacing: tuple[float, float]

    def part(self, box: Box) -> _Field:
        """Return a part of the map."""
        return _Field(self.height[box], self.sigma[box], self.above[box], self.spacing)

    def intervals(self, holes: Mask) -> tuple[Doubles, Doubles]:
        """Return the ends of intervals: NaN without a height; in holes, ``above`` and infinity."""
        height = self.height.astype(np.float64)
        half = np.maximum(math.sqrt(3) * self.sigma, _EXACT * min(self.spacing))
        valid = np.isfinite(height)
        low = np.where(valid, height - half, np.where(holes, self.above, np.nan))
        return low, np.where(valid, height + half, np.inf)


def _like(name: str, values: ArrayLike, heights: Floats) -> NDArray[Any]:
    """Return one number per pixel."""
    array = np.asarray(values)
    if array.shape not in ((), heights.shape):
        raise InputError(
            f"{name} has shape {array.shape}, the heights {heights.shape}: give one a pixel, or one"
        )
    return np.broadcast_to(array, heights.shape)


def _fill(
    field: _Field,
    sides: tuple[bool, ...],
    steepest: float,
    deepest: float | None,
    result: Floats,
    filled: Bytes,
) -> None:
    """Fill the holes of a map; ``sides``: whether its top, bottom, left and right are the picture's."""
    valid = np.isfinite(field.height)
    unfilled = _find_holes(valid.view(np.uint8), sides)
    labels, boxes = map(np.asarray, cv2.connectedComponentsWithStats(unfilled, connectivity=4)[1:3])
    _remove_cut_holes(unfilled, labels, boxes, valid.view(np.uint8), sides)
    for number, box, smooth in _smooth_surfaces(field, labels, boxes, steepest):
        hole = labels[box] == number
        result[box][hole] = smooth[hole]
        filled[box] |= hole
        unfilled[box][hole] = 0
    del labels  # a map that the membranes need no more
    _fill_with_membranes(field, valid, unfilled, result)
    filled |= unfilled
    holes = filled > 0
    np.fmax(result, field.above, out=result, where=holes)
    if deepest is not None and holes.any():
        rim = (cv2.dilate(filled, _CROSS) > 0) & valid
        step = np.median(2 * np.maximum(math.sqrt(3) * field.sigma[rim], _EXACT * min(field.spacing)))
        filled[result <= deepest + step] = 0
        np.copyto(result, field.height, where=holes & (filled == 0))


def _find_holes(valid: Bytes, sides: tuple[bool, ...]) -> Bytes:
    """Return the invalid pixels that are not connected to the outside.

    Small gaps are closed first. The picture's border is closed within the convex hull of the heights.
    """
    wall = _padded(np.zeros_like(valid), 1)
    if any(sides):
        rows = np.flatnonzero(valid.any(axis=1))
        first, last = valid.argmax(axis=1), valid.shape[1] - 1 - valid[:, ::-1].argmax(axis=1)
        ends = np.concatenate([np.stack([column[rows], rows], axis=1) for column in (first, last)])
        corners = cv2.convexHull(ends.astype(np.int32))
        hull = np.asarray(cv2.fillConvexPoly(np.zeros(valid.shape, np.uint8), corners, 1), np.uint8)
        hull = _padded(hull, 1, cv2.BORDER_REPLICATE)
        for side, line in zip(sides, _LINES, strict=True):
            wall[line] = hull[line] if side else 0
    closed = cv2.morphologyEx(_padded(valid, 2), cv2.MORPH_CLOSE, _SQUARE)[2:-2, 2:-2]
    core = np.asarray(cv2.dilate(_enclosed(closed, wall), _SQUARE), np.uint8)  # closing hid the rim
    return np.asarray((core | _enclosed(valid, wall)) & (1 - valid))


def _padded(values: Bytes, count: int, kind: int = cv2.BORDER_CONSTANT) -> Bytes:
    return np.asarray(cv2.copyMakeBorder(values, count, count, count, count, kind), np.uint8)


def _enclosed(valid: NDArray[Any], wall: Bytes) -> Bytes:
    """Return the invalid pixels that are not connected to the outside of a wall around the picture."""
    walled = wall.copy()
    walled[1:-1, 1:-1] = valid
    walled = _padded(walled, 1)
    cv2.floodFill(walled, None, (0, 0), 1)
    return np.asarray(1 - walled[2:-2, 2:-2], np.uint8)


def _remove_cut_holes(
    holes: Bytes, labels: NDArray[Any], boxes: NDArray[Any], valid: Bytes, sides: tuple[bool, ...]
) -> None:
    """Remove the holes that the picture's border cuts off, unless it is only a corner."""
    border = np.zeros_like(holes)
    for side, line in zip(sides, _LINES, strict=True):
        border[line] |= side
    for number in np.unique(labels[(border > 0) & (labels > 0)]):
        left, top, across, down, _ = boxes[number]
        box = slice(top, top + down), slice(left, left + across)
        hole = labels[box] == number
        edge = np.count_nonzero(hole & (border[box] > 0))
        rim = np.count_nonzero(hole & (cv2.dilate(valid, _CROSS)[box] > 0))
        if edge > _CUT * (edge + rim):
            holes[box][hole] = 0


def _smooth_surfaces(
    field: _Field, labels: NDArray[Any], boxes: NDArray[Any], steepest: float
) -> Iterator[tuple[int, Box, Doubles]]:
    """Yield the holes that a smooth surface fits, and the surface over their box; the largest holes first."""
    work = 0.0
    for number in 1 + np.argsort(-boxes[1:, cv2.CC_STAT_AREA], kind="stable"):
        _, _, across, down, area = boxes[number]
        if area < _LEAST_AREA or work > _WORK:
            return
        if min(across, down) < _LEAST_SIDE:
            continue
        hole = _Hole(labels, int(number), boxes[number], field.spacing)
        for width in (_RING, _NARROW) if hole.radius >= _SMALL * max(field.spacing) else ():
            ring = _ring(field, hole, width)
            shape = None if ring is None else _size(ring.box)
            spans = zip(shape or (), field.spacing, strict=False)
            cells = tuple(math.ceil((count - 1) * step / hole.radius) for count, step in spans)
            # There is no ring, the box is a single row or column, or the hole is too long and thin.
            if ring is None or min(cells) < 1 or max(cells) > _MOST_CELLS:
                break
            work += 1 + ((cells[0] + 3) * (cells[1] + 3) / _HEAVY) ** 3
            smooth = _smooth_surface(field, hole, ring, cells, steepest)
            if smooth is not None:
                yield hole.number, hole.box, smooth
                break


class _Hole:
    """A hole: its number in a map of labels, its box, and the radius of the largest circle in it, mm."""

    def __init__(
        self, labels: NDArray[Any], number: int, box: NDArray[Any], spacing: tuple[float, float]
    ) -> None:
        left, top, across, down, _ = map(int, box)
        self.number, self._labels = number, labels
        self.box = slice(top, top + down), slice(left, left + across)
        stride = max(1, min(down, across) // (4 * _SAMPLES))
        # The picture's border is not a rim.
        ends = zip(self.box, labels.shape, strict=True)
        rims = [(int(part.start > 0), int(part.stop < size)) for part, size in ends]
        inside = np.pad(self.within(_thinned(self.box, (stride, stride))), rims)
        depth = _distance(inside, (spacing[0] * stride, spacing[1] * stride))
        self.radius = min(float(depth.max()), max(down * spacing[0], across * spacing[1]))

    def within(self, box: Box) -> Mask:
        """Return the hole's pixels in a part of the map, or in every n-th row and column of it."""
        return np.asarray(self._labels[box] == self.number)

    def around(self, reach: float, spacing: tuple[float, float]) -> Box:
        """Return the part of the map within a distance of the hole, mm."""
        down, across = (
            slice(
                max(part.start - math.ceil(reach / step), 0), min(part.stop + math.ceil(reach / step), size)
            )
            for part, step, size in zip(self.box, spacing, self._labels.shape, strict=True)
        )
        return down, across


class _Ring(NamedTuple):
    """Surroundings of a hole: a box, and every n-th sample with the ends of its interval."""

    box: Box
    strides: tuple[int, int]
    hole: Mask
    low: Doubles
    high: Doubles


def _distance(inside: Mask, spacing: tuple[float, float]) -> Doubles:
    """Return the distance of each pixel in a region to the nearest pixel outside."""
    finest = min(spacing)
    down, across = (round(length * step / finest) for length, step in zip(inside.shape, spacing, strict=True))
    even = cv2.resize(inside.view(np.uint8), (across, down), interpolation=cv2.INTER_NEAREST)
    distance = cv2.distanceTransform(even, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    back = np.asarray(cv2.resize(distance, inside.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float64)
    # OpenCV's square roots depend on where arrays are in memory; squared distances are whole numbers.
    return np.sqrt(np.rint(back * back)) * finest


def _thinned(box: Box, strides: tuple[int, int]) -> Box:
    """Return a box of every n-th row and column."""
    rows, columns = box
    return slice(rows.start, rows.stop, strides[0]), slice(columns.start, columns.stop, strides[1])


def _ring(field: _Field, hole: _Hole, width: float) -> _Ring | None:
    """Return the valid pixels around a hole; the ring is widened until it spans enough terraces."""
    down, across = (
        max(1, int(hole.radius / (_SAMPLES * step)), length // _MOST_SAMPLES)
        for step, length in zip(field.spacing, _size(hole.box), strict=True)
    )
    apart = field.spacing[0] * down, field.spacing[1] * across
    while True:
        reach = max(width * hole.radius, _LEAST_RING * max(field.spacing))
        box = hole.around(reach, field.spacing)
        thin = _thinned(box, (down, across))
        inside = hole.within(thin)
        low, high = field.part(thin).intervals(inside)
        bounded = np.isfinite(low) & np.isfinite(high)
        count, groups = cv2.connectedComponents(bounded.view(np.uint8), connectivity=8)
        adjacent = np.zeros(count, bool)
        adjacent[groups[cv2.dilate(inside.view(np.uint8), _SQUARE) > 0]] = True
        adjacent[0] = False
        ring = adjacent[groups] & (_distance(~inside, apart) <= reach)
        if not ring.any():
            return None
        terrace = np.median((high - low)[ring])
        if np.ptp(low[ring]) >= _TERRACES * terrace or width >= _WIDEST:
            return _Ring(box, (down, across), inside, np.where(ring | inside, low, np.nan), high)
        width *= _WIDER


def _size(box: Box) -> tuple[int, int]:
    return box[0].stop - box[0].start, box[1].stop - box[1].start


def _smooth_surface(
    field: _Field, hole: _Hole, ring: _Ring, cells: tuple[int, ...], steepest: float
) -> Doubles | None:
    """Return the smoothest surface within a ring's intervals, over the hole's box, if it would be dark."""
    spacing = field.spacing[0] / hole.radius, field.spacing[1] / hole.radius
    spline = Spline(_size(ring.box), spacing, (cells[0], cells[1]), ring.strides)
    bounded = np.isfinite(ring.low) & np.isfinite(ring.high)
    resolution = np.median((ring.high - ring.low)[bounded]) / 2 / (_DEPTH * hole.radius)
    fit = fit_within(spline, ring.low, ring.high, _STIFFNESS * float(resolution) ** 2)
    apart = (step * stride for step, stride in zip(field.spacing, ring.strides, strict=True))
    slopes = np.hypot(*np.gradient(fit.height, *apart))
    if fit.misfit > _MISFIT or np.mean(slopes[ring.hole] > steepest) > _STEEP_SHARE:
        return None
    rows, columns = (
        slice(part.start - box.start, part.stop - box.start)
        for part, box in zip(hole.box, ring.box, strict=True)
    )
    return spline.over(fit.factors, (rows, columns))


def _fill_with_membranes(field: _Field, valid: Mask, holes: Bytes, result: Floats) -> None:
    """Fill holes with membranes that respect the lower bounds."""
    # Only rows and columns with a hole or its rim are needed.
    rows, columns = (np.flatnonzero(np.convolve(holes.any(axis=axis), np.ones(3), "same")) for axis in (1, 0))
    if not rows.size:
        return
    part = np.ix_(rows, columns)
    fixed, free, above, height = valid[part], holes[part] > 0, field.above[part], field.height[part]
    membrane = stretch(height, fixed, free, field.spacing)
    deeper = free & (membrane < above)
    if deeper.any():
        height = np.where(deeper, above, height)
        membrane = stretch(height, fixed | deeper, free & ~deeper, field.spacing)
    result[holes > 0] = membrane[free]
