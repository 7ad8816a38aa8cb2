"""Holes in a height map: flat tops and vertices, which never turn light, filled from what is around them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

from mirrorskin.engine.integration.validation import check_pixel_size
from mirrorskin.engine.press.spline import Spline, fit_within
from mirrorskin.io import InputError

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Box = tuple[slice, slice]

_SQUARE = np.ones((3, 3), bool)
_SMALL = 2.0  # pixels from its rim that a hole must reach to be worth a smooth surface
_RING = 1.1  # width of the ring that determines the fill, in radii of the hole
_NARROW = 0.6  # of one tried where the surface beyond is another one
_LEAST_RING = 3.0  # pixels
_TERRACES = 1.9  # that a ring's heights must span: two steps, but for rounding, show how the slope changes
_WIDEST, _WIDER = 3.0, 1.3  # radii, and by how much to widen
_CELLS = 2  # of the splines in a hole's radius
_LEAST_CELLS = 1.2  # below which a hole is too long and thin for splines
_MOST_CELLS = 30  # along the picture's axes
_STIFFNESS = 2e-4  # of a surface over a hole of radius 1, with intervals of half-width _DEPTH
_MISFIT = 0.5  # RMS excess, in half-widths, beyond which the ring is not one smooth surface
_STEEP_SHARE = 0.05  # of a hole's pixels that may be steeper than dark ones are
_DEPTH = 0.1  # of a round cap that is dark up to 11.8 degrees, in radii of its hole
_MOST_CUT = 16  # holes at the border that are looked at, the largest ones
_CUT = 0.2  # of a hole's outline along the picture's border, up to which it is still surrounded
_EFFORT = 300  # of a smooth surface, in splines
_WORK = 30_000  # in all: the smallest of very many holes get membranes
_DIRECT = 10_000  # unknowns that a direct solution is quick for
_TOLERANCE = 1e-5  # of the right side
_ITERATIONS = 200
_EXACT = 0.01  # pixel sizes: half-width of a height that claims to be exact


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
    filled = field.labels > 0
    result, left = field.height.copy(), filled & ~field.cut[field.labels]
    filled[:] = left
    for number, box, smooth in _smooth_surfaces(field, steepest):
        own = field.labels[box] == number
        result[box][own] = smooth[own]
        filled[box] |= own
        left[box] &= ~own
    result = _stretch_over(field, result, left)
    result = np.where(filled, np.fmax(result, field.low), field.height)
    if deepest is not None and filled.any():
        filled &= result > deepest + _step(field, filled)
    return np.where(filled, result, field.height).astype(np.float32), filled.astype(np.uint8)


class _Field(NamedTuple):
    """A map with holes.

    Heights, NaN where there are none, and what is known of them: the ends of their intervals, NaN where
    nothing is, infinite where there is no upper one. The holes' numbers, from 1 on, whether the picture cuts
    them, and the parts of the map that they lie in. The distances of rows and of columns. Lengths are in mm.
    """

    height: Doubles
    low: Doubles
    high: Doubles
    labels: NDArray[np.int32]
    cut: Mask
    boxes: list[Box]
    spacing: tuple[float, float]


def _field_of(height: ArrayLike, sigma: ArrayLike, pixel_size: ArrayLike, above: ArrayLike | None) -> _Field:
    """Return the map that the arguments describe, with its holes found."""
    heights = np.array(height, np.float64)
    if heights.ndim != 2 or 0 in heights.shape:
        raise InputError(f"heights have shape {heights.shape}: one map (H, W) is needed")
    sigmas = _like("sigma", sigma, heights)
    least = _like("above", np.nan if above is None else above, heights)
    if np.any(sigmas < 0):
        raise InputError("sigma is negative somewhere: standard deviations in mm are needed")
    width, tall = check_pixel_size(pixel_size)
    answered = np.isfinite(heights)
    labels, cut = _find_holes(answered)
    half = np.where(answered, np.maximum(np.sqrt(3) * sigmas, _EXACT * min(width, tall)), np.nan)
    low = np.where(answered, heights - half, np.where(labels > 0, least, np.nan))
    high = np.where(answered, heights + half, np.inf)
    return _Field(heights, low, high, labels, cut, ndimage.find_objects(labels), (tall, width))


def _like(name: str, values: ArrayLike, heights: Doubles) -> Doubles:
    """Return one number a pixel."""
    given = np.asarray(values, np.float64)
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


def _find_holes(answered: Mask) -> tuple[NDArray[np.int32], Mask]:
    """Find the holes: their numbers, from 1 on, and which of them the picture cuts.

    What is dark is a hole if it does not reach the picture's border, or lies in the convex hull of what is
    around it; small gaps are closed before, and what that hides of a hole is added again.
    """
    closed = ndimage.binary_closing(np.pad(answered, 2), _SQUARE)[2:-2, 2:-2]
    dark, count = ndimage.label(~closed)
    border = np.ones_like(answered)
    border[1:-1, 1:-1] = False
    outside = np.bincount(dark[border], minlength=count + 1) > 0
    outside[0] = False
    groups, _ = ndimage.label(answered, _SQUARE)
    largest = np.argsort(-np.where(outside, np.bincount(dark.ravel(), minlength=count + 1), 0), kind="stable")
    for number in largest[:_MOST_CUT]:
        outside[number] &= not _in_hull(dark == number, groups)
    outside[0] = True
    core = ndimage.binary_dilation(~outside[dark], _SQUARE)
    holes, count = ndimage.label((core | ndimage.binary_fill_holes(answered)) & ~answered)
    rim = np.bincount(holes[ndimage.binary_dilation(answered)], minlength=count + 1)
    edge = np.bincount(holes[border], minlength=count + 1)
    cut = edge > _CUT * (edge + rim)
    cut[0] = False
    return np.where(rim[holes] > 0, holes, 0), cut


def _in_hull(region: Mask, groups: NDArray[np.int32]) -> bool:
    """Return whether a region lies in the convex hull of the groups that it touches, gaps included."""
    touched = np.unique(groups[ndimage.binary_dilation(region, _SQUARE, iterations=2)])
    around = np.isin(groups, touched[touched > 0])
    if not around.any():
        return False
    import cv2  # a tenth of a second to load

    corners = cv2.convexHull(np.argwhere(around)[:, ::-1].astype(np.int32))
    hull = cv2.fillConvexPoly(np.zeros(region.shape, np.uint8), corners, 1)
    return not np.any(region & (hull == 0))


def _smooth_surfaces(field: _Field, steepest: float) -> Iterator[tuple[int, Box, Doubles]]:
    """Yield holes that a smooth surface fits, with these surfaces over boxes; the largest holes first."""
    radii = _radii(field)
    work = 0
    for number in np.argsort(-radii, kind="stable"):
        if radii[number] < _SMALL * max(field.spacing) or work > _WORK:
            return
        for width in (_RING, _NARROW):
            ring = _ring(field, number, radii[number], width)
            cells = None if ring is None else _cells(ring[1].shape, field.spacing, radii[number])
            if ring is None or cells is None:
                break
            work += _EFFORT + (cells[0] + 3) * (cells[1] + 3)
            smooth = _span(field, number, *ring, cells, radii[number], steepest)
            if smooth is not None:
                yield int(number), ring[0], smooth
                break


def _radii(field: _Field) -> Doubles:
    """Return the radius of the largest circle in each hole, mm; 0 for what is no hole."""
    depth = ndimage.distance_transform_edt(field.labels > 0, sampling=field.spacing)
    radii = np.zeros(int(field.labels.max()) + 1)
    np.maximum.at(radii, field.labels, depth)
    radii[0] = 0.0
    return radii


def _ring(field: _Field, number: int, radius: float, width: float) -> tuple[Box, Mask] | None:
    """Return the known pixels around a hole, in a box; farther out where they span too few terraces."""
    while True:
        reach = max(width * radius, _LEAST_RING * max(field.spacing))
        box = _box(field, number, reach)
        hole = field.labels[box] == number
        bounded = np.isfinite(field.low[box]) & np.isfinite(field.high[box])
        distance = ndimage.distance_transform_edt(~hole, sampling=field.spacing)
        groups, _ = ndimage.label(bounded, _SQUARE)
        next_to = np.unique(groups[ndimage.binary_dilation(hole, _SQUARE)])
        known = bounded & (distance <= reach) & np.isin(groups, next_to[next_to > 0])
        if not known.any():
            return None
        terrace = np.median((field.high[box] - field.low[box])[known])
        if np.ptp(field.height[box][known]) >= _TERRACES * terrace or width >= _WIDEST:
            return box, known
        width *= _WIDER


def _box(field: _Field, number: int, reach: float) -> Box:
    """Return the part of the map that holds a hole and what is within reach of it."""
    rows, columns = field.boxes[number - 1]
    down, across = (math.ceil(reach / step) for step in field.spacing)
    return (
        slice(max(rows.start - down, 0), rows.stop + down),
        slice(max(columns.start - across, 0), columns.stop + across),
    )


def _cells(shape: tuple[int, ...], spacing: tuple[float, float], radius: float) -> tuple[int, int] | None:
    """Return the splines' cells along y and x; None if the box is too small, or the hole too thin for it."""
    if min(shape) < 2:
        return None
    spans = [(length - 1) * step for length, step in zip(shape, spacing, strict=True)]
    down, across = (min(math.ceil(_CELLS * span / radius), _MOST_CELLS) for span in spans)
    coarsest = max(spans[0] / down, spans[1] / across)
    return (down, across) if coarsest * _LEAST_CELLS <= radius else None


def _span(
    field: _Field,
    number: int,
    box: Box,
    known: Mask,
    cells: tuple[int, int],
    radius: float,
    steepest: float,
) -> Doubles | None:
    """Return the smoothest surface within the known pixels' intervals, if one is dark in the hole."""
    hole = field.labels[box] == number
    low, high = np.where(known | hole, field.low[box], np.nan), field.high[box]
    spline = Spline(low.shape, (field.spacing[0] / radius, field.spacing[1] / radius), cells)
    resolution = np.median((high - low)[known]) / 2 / (_DEPTH * radius)
    fit = fit_within(spline, low, high, _STIFFNESS * float(resolution) ** 2)
    slopes = np.hypot(*np.gradient(fit.height, *field.spacing))
    dark = np.mean(slopes[hole] > steepest) <= _STEEP_SHARE
    return fit.height if fit.misfit <= _MISFIT and dark else None


def _stretch_over(field: _Field, height: Doubles, holes: Mask) -> Doubles:
    """Return the heights with membranes over some holes, which nowhere lie deeper than is known."""
    answered = np.isfinite(field.height)
    stretched = stretch(height, answered, holes, field.spacing)
    deeper = holes & (stretched < field.low)
    if not deeper.any():
        return stretched
    fixed = np.where(deeper, field.low, height)
    return stretch(fixed, answered | deeper, holes & ~deeper, field.spacing)


def _step(field: _Field, filled: Mask) -> float:
    """Return the usual width of the intervals at the rims of holes, mm."""
    rim = ndimage.binary_dilation(filled) & np.isfinite(field.height) & np.isfinite(field.low)
    return float(np.median((field.high - field.low)[rim])) if rim.any() else 0.0


def stretch(height: Doubles, known: Mask, unknown: Mask, spacing: tuple[float, float]) -> Doubles:
    """Solve Laplace's equation: each unknown pixel is the mean of its four neighbours.

    It reproduces planes, and never leaves the range of the known heights. Each group of unknown pixels
    touches a known one; at pixels that are neither the membrane is free.
    """
    if not unknown.any():
        return height
    datum = float(np.mean(height[known]))
    matrix, right = _equations(np.where(known, height - datum, 0.0), known, unknown, spacing)
    if len(right) <= _DIRECT:
        found = spsolve(matrix.tocsc(), right, permc_spec="MMD_AT_PLUS_A")
    else:
        start = _coarse(height - datum, known, unknown, spacing)[unknown]
        found = _iterate(matrix, right, start)
    stretched = height.copy()
    stretched[unknown] = found + datum
    return stretched


def _equations(
    height: Doubles, known: Mask, unknown: Mask, spacing: tuple[float, float]
) -> tuple[sparse.csr_matrix, Doubles]:
    """Return the matrix and the right side for the unknown pixels, in reading order."""
    count = int(np.count_nonzero(unknown))
    number = np.full(unknown.shape, -1)
    number[unknown] = np.arange(count)
    diagonal, right = np.zeros(count), np.zeros(count)
    rows, columns, values = [np.arange(count)], [np.arange(count)], [diagonal]
    links = (np.s_[:-1], np.s_[1:], spacing[0] ** -2), (np.s_[:, :-1], np.s_[:, 1:], spacing[1] ** -2)
    for one, other, weight in links:
        for here, there in ((one, other), (other, one)):
            fixed = unknown[here] & known[there]
            free = unknown[here] & unknown[there]
            np.add.at(diagonal, number[here][fixed | free], weight)
            np.add.at(right, number[here][fixed], weight * height[there][fixed])
            rows.append(number[here][free])
            columns.append(number[there][free])
            values.append(np.full(len(rows[-1]), -weight))
    places = np.concatenate(rows), np.concatenate(columns)
    return sparse.csr_matrix((np.concatenate(values), places), shape=(count, count)), right


def _coarse(height: Doubles, known: Mask, unknown: Mask, spacing: tuple[float, float]) -> Doubles:
    """Return a first guess: the membrane on pixels of twice the size, which are known if any part is."""
    rows, columns = height.shape
    blocks = -(-rows // 2), 2, -(-columns // 2), 2
    border = ((0, -rows % 2), (0, -columns % 2))
    parts = np.pad(known, border).reshape(blocks).sum(axis=(1, 3))
    sums = np.pad(np.where(known, height, 0.0), border).reshape(blocks).sum(axis=(1, 3))
    wanted = np.pad(unknown, border).reshape(blocks).any(axis=(1, 3)) & (parts == 0)
    large = stretch(sums / np.maximum(parts, 1), parts > 0, wanted, (2 * spacing[0], 2 * spacing[1]))
    return np.repeat(np.repeat(large, 2, axis=0), 2, axis=1)[:rows, :columns]


def _iterate(matrix: sparse.csr_matrix, right: Doubles, start: Doubles) -> Doubles:
    """Solve by conjugate gradients; SciPy's own use BLAS, whose threads wait for each other."""
    found, rest = start, right - matrix @ start
    direction, square = rest, float(np.sum(rest * rest))
    enough = _TOLERANCE**2 * float(np.sum(right * right))
    for _ in range(_ITERATIONS):
        if square <= enough:
            break
        image = matrix @ direction
        length = square / float(np.sum(direction * image))
        found, rest = found + length * direction, rest - length * image
        before, square = square, float(np.sum(rest * rest))
        direction = rest + square / before * direction
    return found
