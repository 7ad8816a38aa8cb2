"""Holes in a height map: flat tops and vertices, which never turn light, filled from what is around them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.integration.validation import check_pixel_size
from mirrorskin.engine.press.membrane import stretch
from mirrorskin.engine.press.spline import Spline, fit_within
from mirrorskin.io import InputError
from mirrorskin.io.arguments import checked

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Box = tuple[slice, slice]

_SQUARE = np.ones((3, 3), np.uint8)
_LINES: tuple[Any, ...] = np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1]  # a map's sides
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
_LEAST_AREA, _LEAST_SIDE = 9, 3  # pixels of a hole that is worth a smooth surface, and
_SMALL = 2.0  # how many it must reach from its rim
_RING = 1.1  # width of the ring that determines the fill, in radii of the hole
_NARROW = 0.6  # of one tried where the surface beyond is another one
_LEAST_RING = 3.0  # pixels
_TERRACES = 1.9  # that a ring's heights must span: two steps, but for rounding, show how the slope changes
_WIDEST, _WIDER = 3.0, 1.3  # radii, and by how much to widen
_SAMPLES = 12  # of the ring in a hole's radius: more would say no more
_MOST_SAMPLES = 120  # along a side of its box, about
_MOST_CELLS = 20  # of the splines, a hole's radius long, along the picture's axes; longer holes are too thin
_STIFFNESS = 2e-4  # of a surface over a hole of radius 1, with intervals of half-width _DEPTH
_MISFIT = 0.5  # RMS excess, in half-widths, beyond which the ring is not one smooth surface
_STEEP_SHARE = 0.05  # of a hole's pixels that may be steeper than dark ones are
_DEPTH = 0.1  # of a round cap that is dark up to 11.8 degrees, in radii of its hole
_CUT = 0.2  # of a hole's outline along the picture's border, up to which it is still surrounded
_HEAVY = 250  # splines of a surface that takes twice as long as a small one
_WORK = 40.0  # small surfaces in all: the smallest of very many holes get membranes
_EXACT = 0.01  # pixel sizes: half-width of a height that claims to be exact


@checked
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

    What is flatter than about 12 degrees never turns light, so the tops of a press are missing. A hole is a
    group of pixels without height that is surrounded by others with one; gaps of up to two pixels do not open
    it. It may reach the picture's border if it lies in the convex hull of what is around it. Nothing is
    filled outside.

    *Smooth surface.* In a ring around the hole, about as wide as the hole's radius, each height is an
    interval of sqrt(3) sigma to either side. Of all surfaces that stay within these intervals the hole gets
    that with the least squared third derivatives: they vanish for a paraboloid, so a cap goes on as a cap.
    Terraces tie the surface at their borders, and leave it free within the interval elsewhere.

    *Membrane.* If that surface were light in the hole (steeper than `steepest`), there must be a crease at
    the rim; if it cannot stay in its intervals, there is one in the ring. Such holes, small ones and long
    thin ones get the solution of Laplace's equation from the heights at their rim: flat tops become flat. A
    hole of which the border cuts off more than a corner is then left open.

    Parameters
    ----------
    height : array_like, (H, W)
        Millimetres; NaN where there is none.
    sigma : array_like, scalar or (H, W)
        Standard deviations of the heights, mm: half-widths over sqrt(3), as ``find_onset`` gives them.
    pixel_size : float or (float, float)
        Millimetres, along x and y.
    above : array_like, scalar or (H, W), optional
        Heights, mm, above which pixels are known to be, NaN where nothing is: minus the first travel, where a
        pixel was light from the start.
    steepest : float
        Slope above which a pressed sheet is light. The default fits the paper's sensor up to 10 mm off its
        centre, with a margin; a sensor with a gap of air needs 0.45.
    deepest : float, optional
        Height of the untouched sheet in the last frame, mm: minus the last travel. What would be filled no
        more than a step above it was perhaps never touched, and stays open.

    Returns
    -------
    height : ndarray, (H, W), float32
        As given, with the holes filled.
    filled : ndarray, (H, W), uint8
        1 where it was filled.

    Raises
    ------
    mirrorskin.io.InputError
        Maps, sizes or limits that cannot be used.

    Notes
    -----
    A fill is a guess. No honest standard deviation of it can be given: a ball's cap, a worn cone and a top
    cut off within the hole give the same light. On balls of 3 to 10 mm radius the apex was right within
    0.005 mm at steps of 0.01 mm, and within 0.020 mm at 0.1 and 0.2 mm. A flat top is right within half a
    step and the fall of its flank over a pixel. The tip of a cone is cut off at its hole. What was light from
    the start makes holes larger: begin to press well above the object. A pit with upright walls that nothing
    touched looks like a flat top, and is filled.

    Examples
    --------
    >>> height = np.zeros((9, 9))
    >>> height[3:6, 3:6] = np.nan
    >>> height, filled = fill_holes(height, sigma=0.01, pixel_size=0.1)
    >>> float(height[4, 4]), int(filled.sum())
    (0.0, 9)
    """
    field = _field_of(height, sigma, pixel_size, above)
    _check_limits(steepest, deepest)
    result, filled = field.height.copy(), np.zeros(field.height.shape, np.uint8)
    left, top, across, down = cv2.boundingRect(np.isfinite(result).view(np.uint8))
    if across:
        part = slice(top, top + down), slice(left, left + across)
        sides = top == 0, top + down == len(result), left == 0, left + across == len(result[0])
        _fill(field.part(part), sides, steepest, deepest, result[part], filled[part])
    return result, filled


class _Field(NamedTuple):
    """Heights, (H, W), NaN where there are none, and what else is known of them.

    Standard deviations, and heights that pixels lie above, NaN where nothing is known: one a pixel, or one.
    The distances of rows and of columns. Lengths are in mm.
    """

    height: Floats
    sigma: NDArray[Any]
    above: NDArray[Any]
    spacing: tuple[float, float]

    def part(self, box: Box) -> _Field:
        """Return a part of the map."""
        return _Field(self.height[box], self.sigma[box], self.above[box], self.spacing)

    def intervals(self, holes: Mask) -> tuple[Doubles, Doubles]:
        """Return the intervals' ends: NaN where nothing is known, the upper infinite where only one is."""
        height = self.height.astype(np.float64)
        half = np.maximum(math.sqrt(3) * self.sigma, _EXACT * min(self.spacing))
        answered = np.isfinite(height)
        low = np.where(answered, height - half, np.where(holes, self.above, np.nan))
        return low, np.where(answered, height + half, np.inf)


def _field_of(height: ArrayLike, sigma: ArrayLike, pixel_size: ArrayLike, above: ArrayLike | None) -> _Field:
    heights = np.asarray(height, np.float32)
    if heights.ndim != 2 or 0 in heights.shape:
        raise InputError(f"heights have shape {heights.shape}: one map (H, W) is needed")
    sigmas = _like("sigma", sigma, heights)
    least = _like("above", np.nan if above is None else above, heights)
    if np.any(sigmas < 0):
        raise InputError("sigma is negative somewhere: standard deviations in mm are needed")
    width, tall = check_pixel_size(pixel_size)
    return _Field(heights, sigmas, least, (tall, width))


def _like(name: str, values: ArrayLike, heights: Floats) -> NDArray[Any]:
    """Return one number a pixel."""
    given = np.asarray(values)
    if given.shape not in ((), heights.shape):
        raise InputError(
            f"{name} has shape {given.shape}, the heights {heights.shape}: give one a pixel, or one"
        )
    return np.broadcast_to(given, heights.shape)


def _check_limits(steepest: float, deepest: float | None) -> None:
    if not 0 < steepest < math.inf:
        raise InputError(f"steepest {steepest}: a slope above 0 is needed, such as 0.32")
    if deepest is not None and not math.isfinite(deepest):
        raise InputError(f"deepest {deepest}: a height in mm is needed, such as -3.0")


def _fill(
    field: _Field,
    sides: tuple[bool, ...],
    steepest: float,
    deepest: float | None,
    result: Floats,
    filled: Bytes,
) -> None:
    """Fill the holes of a map, of which some sides are the picture's: top, bottom, left, right."""
    answered = np.isfinite(field.height)
    left = _find_holes(answered.view(np.uint8), sides)
    labels, boxes = map(np.asarray, cv2.connectedComponentsWithStats(left, connectivity=4)[1:3])
    _open_cut_holes(left, labels, boxes, answered.view(np.uint8), sides)
    for number, box, smooth in _smooth_surfaces(field, labels, boxes, steepest):
        own = labels[box] == number
        result[box][own] = smooth[own]
        filled[box] |= own
        left[box][own] = 0
    _stretch_over(field, answered, left, result)
    filled |= left
    holes = filled > 0
    np.fmax(result, field.above, out=result, where=holes)
    if deepest is not None and holes.any():
        rim = (cv2.dilate(filled, _CROSS) > 0) & answered
        step = np.median(2 * np.maximum(math.sqrt(3) * field.sigma[rim], _EXACT * min(field.spacing)))
        filled[result <= deepest + step] = 0
        np.copyto(result, field.height, where=holes & (filled == 0))


def _find_holes(answered: Bytes, sides: tuple[bool, ...]) -> Bytes:
    """Return the holes.

    What is dark is a hole if it cannot be reached from outside, where the picture's border is closed within
    the convex hull of what is answered; small gaps are closed before, and what that hides of a hole is added
    again.
    """
    wall = _beside(np.zeros_like(answered), 1)
    if any(sides):
        hull = _beside(_hull(answered), 1, cv2.BORDER_REPLICATE)
        for side, line in zip(sides, _LINES, strict=True):
            wall[line] = hull[line] if side else 0
    closed = cv2.morphologyEx(_beside(answered, 2), cv2.MORPH_CLOSE, _SQUARE)[2:-2, 2:-2]
    core = np.asarray(cv2.dilate(_enclosed(closed, wall), _SQUARE), np.uint8)
    return np.asarray((core | _enclosed(answered, wall)) & (1 - answered))


def _beside(values: Bytes, count: int, kind: int = cv2.BORDER_CONSTANT) -> Bytes:
    """Return a map with rows and columns beside it, of zeros or of what is next to them."""
    return np.asarray(cv2.copyMakeBorder(values, count, count, count, count, kind), np.uint8)


def _hull(answered: Bytes) -> Bytes:
    rows = np.flatnonzero(answered.any(axis=1))
    first, last = answered.argmax(axis=1), answered.shape[1] - 1 - answered[:, ::-1].argmax(axis=1)
    ends = np.concatenate([np.stack([column[rows], rows], axis=1) for column in (first, last)])
    corners = cv2.convexHull(ends.astype(np.int32))
    return np.asarray(cv2.fillConvexPoly(np.zeros(answered.shape, np.uint8), corners, 1), np.uint8)


def _enclosed(answered: NDArray[Any], wall: Bytes) -> Bytes:
    """Return the dark pixels that cannot be reached from outside of a wall around the picture."""
    room = wall.copy()
    room[1:-1, 1:-1] = answered
    room = _beside(room, 1)
    cv2.floodFill(room, None, (0, 0), 1)
    return np.asarray(1 - room[2:-2, 2:-2], np.uint8)


def _open_cut_holes(
    holes: Bytes,
    labels: NDArray[Any],
    boxes: NDArray[Any],
    answered: Bytes,
    sides: tuple[bool, ...],
) -> None:
    """Take away the holes of which the picture's border cuts off more than a corner."""
    border = np.zeros_like(holes)
    for side, line in zip(sides, _LINES, strict=True):
        border[line] |= side
    for number in np.unique(labels[(border > 0) & (labels > 0)]):
        left, top, across, down, _ = boxes[number]
        box = slice(top, top + down), slice(left, left + across)
        own = labels[box] == number
        edge = np.count_nonzero(own & (border[box] > 0))
        rim = np.count_nonzero(own & (cv2.dilate(answered, _CROSS)[box] > 0))
        if edge > _CUT * (edge + rim):
            holes[box][own] = 0


def _smooth_surfaces(
    field: _Field, labels: NDArray[Any], boxes: NDArray[Any], steepest: float
) -> Iterator[tuple[int, Box, Doubles]]:
    """Yield holes that a smooth surface fits, with these surfaces over boxes; the largest holes first."""
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
            cells = None if ring is None else _cells(_size(ring.box), field.spacing, hole.radius)
            if ring is None or cells is None:
                break
            work += 1 + ((cells[0] + 3) * (cells[1] + 3) / _HEAVY) ** 3
            smooth = _span(field, hole, ring, cells, steepest)
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
        # The picture's border is no rim.
        ends = zip(self.box, labels.shape, strict=True)
        rims = [(int(part.start > 0), int(part.stop < size)) for part, size in ends]
        inside = np.pad(self.within(_thinned(self.box, (stride, stride))), rims)
        depth = _distance(inside, (spacing[0] * stride, spacing[1] * stride))
        self.radius = min(float(depth.max()), max(down * spacing[0], across * spacing[1]))

    def within(self, box: Box) -> Mask:
        """Return the hole's pixels in a part of the map."""
        return np.asarray(self._labels[box] == self.number)

    def around(self, reach: float, spacing: tuple[float, float]) -> Box:
        """Return the part of the map that holds the hole and what is within reach of it, mm."""
        down, across = (
            slice(
                max(part.start - math.ceil(reach / step), 0), min(part.stop + math.ceil(reach / step), size)
            )
            for part, step, size in zip(self.box, spacing, self._labels.shape, strict=True)
        )
        return down, across


class _Ring(NamedTuple):
    """What is known around a hole: a box, and samples of it with the ends of their intervals."""

    box: Box
    strides: tuple[int, int]
    hole: Mask
    low: Doubles
    high: Doubles


def _distance(inside: Mask, spacing: tuple[float, float]) -> Floats:
    """Return the distance of each pixel of a region to the nearest one outside."""
    finest = min(spacing)
    down, across = (round(length * step / finest) for length, step in zip(inside.shape, spacing, strict=True))
    even = cv2.resize(inside.view(np.uint8), (across, down), interpolation=cv2.INTER_NEAREST)
    distance = cv2.distanceTransform(even, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    back = cv2.resize(distance, inside.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(back * np.float32(finest), np.float32)


def _thinned(box: Box, strides: tuple[int, int]) -> Box:
    """Return a box of which only some rows and columns count."""
    rows, columns = box
    return slice(rows.start, rows.stop, strides[0]), slice(columns.start, columns.stop, strides[1])


def _ring(field: _Field, hole: _Hole, width: float) -> _Ring | None:
    """Return the known pixels around a hole, in a box; farther out where they span too few terraces."""
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
        beside = np.zeros(count, bool)
        beside[groups[cv2.dilate(inside.view(np.uint8), _SQUARE) > 0]] = True
        beside[0] = False
        known = beside[groups] & (_distance(~inside, apart) <= reach)
        if not known.any():
            return None
        terrace = np.median((high - low)[known])
        if np.ptp(low[known]) >= _TERRACES * terrace or width >= _WIDEST:
            return _Ring(box, (down, across), inside, np.where(known | inside, low, np.nan), high)
        width *= _WIDER


def _size(box: Box) -> tuple[int, int]:
    return box[0].stop - box[0].start, box[1].stop - box[1].start


def _cells(shape: tuple[int, int], spacing: tuple[float, float], radius: float) -> tuple[int, int] | None:
    """Return the splines' cells along y and x; None if the box is too small, or the hole too thin for it."""
    down, across = (
        math.ceil((count - 1) * step / radius) for count, step in zip(shape, spacing, strict=True)
    )
    return (down, across) if min(down, across) >= 1 and max(down, across) <= _MOST_CELLS else None


def _span(field: _Field, hole: _Hole, ring: _Ring, cells: tuple[int, int], steepest: float) -> Doubles | None:
    """Return the smoothest surface within a ring's intervals, over the hole's box, if it is dark there."""
    spacing = field.spacing[0] / hole.radius, field.spacing[1] / hole.radius
    spline = Spline(_size(ring.box), spacing, cells, ring.strides)
    bounded = np.isfinite(ring.low) & np.isfinite(ring.high)
    resolution = np.median((ring.high - ring.low)[bounded]) / 2 / (_DEPTH * hole.radius)
    fit = fit_within(spline, ring.low, ring.high, _STIFFNESS * float(resolution) ** 2)
    apart = (step * stride for step, stride in zip(field.spacing, ring.strides, strict=True))
    slopes = np.hypot(*np.gradient(fit.height, *apart))
    if fit.misfit > _MISFIT or np.mean(slopes[ring.hole] > steepest) > _STEEP_SHARE:
        return None
    (own_rows, own_columns), (rows, columns) = hole.box, ring.box
    return spline.over(
        fit.factors,
        (
            slice(own_rows.start - rows.start, own_rows.stop - rows.start),
            slice(own_columns.start - columns.start, own_columns.stop - columns.start),
        ),
    )


def _stretch_over(field: _Field, answered: Mask, holes: Bytes, result: Floats) -> None:
    """Put membranes over holes, which nowhere lie deeper than is known."""
    # Rows and columns without a hole or its rim are left out.
    rows, columns = (np.flatnonzero(np.convolve(holes.any(axis=axis), np.ones(3), "same")) for axis in (1, 0))
    if not rows.size:
        return
    part = np.ix_(rows, columns)
    known, unknown, above = answered[part], holes[part] > 0, field.above[part]
    height = field.height[part]
    stretched = stretch(height, known, unknown, field.spacing)
    deeper = unknown & (stretched < above)
    if deeper.any():
        fixed = np.where(deeper, above, height)
        stretched = stretch(fixed, known | deeper, unknown & ~deeper, field.spacing)
    result[holes > 0] = stretched[unknown]
