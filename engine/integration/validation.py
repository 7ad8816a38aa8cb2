"""Inputs of an integration: slopes, mask, weights and known heights, checked once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.integration.camera import (
    Box,
    Camera,
    Mask,
    Slopes,
    find_box,
    find_slopes,
    sight_within,
    weigh_slopes,
)
from mirrorskin.io import InputError
from mirrorskin.io.base.arguments import check_pixel_size

Floats = NDArray[np.float32]
Flags = NDArray[np.uint8]

LEAST, MOST = 1e-4, 1e3
"""Range of the weights of slopes, relative to the median, that can be solved in float32."""

MOST_NOISE = 0.1**2
"""Variance of normals, radians^2, above which a typical weight cannot be the inverse of one."""
_LARGEST_HEIGHT_WEIGHT = 1e4  # relative to the weight of a link; larger weights are clipped
SAMPLES = 65536
"""Number of pixels from which the median weight is computed."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """Checked maps of one size, (H, W), and numbers."""

    # (H, W), or (K, H, W) of several surfaces with the same other maps, float32
    dz_dx: Floats
    dz_dy: Floats
    pixel_size: tuple[float, float]  # width and height, mm
    # (H, W), uint8
    mask: Flags | None = None
    edges: Flags | None = None
    # (H, W), float32: ``weight_y`` is None if it equals ``weight_x``; both are None if all weights are equal.
    weight_x: Floats | None = None
    weight_y: Floats | None = None
    typical_weight: float = 1.0  # the weight of all pixels, or the median
    weights_given: bool = True  # whether weights of slopes were given; they are inverse variances
    # (H, W), float32: heights relative to ``datum``; the weights are None if all are equal.
    known_heights: Floats | None = None
    known_height_weights: Floats | None = None
    known_height_weight: float = 1.0  # the weight of all known heights, otherwise 1
    datum: float = 0.0  # subtracted from the known heights, mm
    # (H, W), float32: squared cosine between normal and line of sight; None: it follows from the slopes.
    steep: Floats | None = None
    # (H, W), float32: factors of the weights of both slopes, because they are from normals, if not applied.
    slant_factors: tuple[Floats, ...] = ()
    picture: tuple[int, int] = (0, 0)  # rows and columns of the whole picture
    box: Box = (slice(None), slice(None))  # part of the picture covered by the maps
    lost: int = 0  # wanted pixels outside the box

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.dz_dx.shape[-2:]
        return rows, columns

    def each(self) -> list[Inputs]:
        """Return the inputs of each surface."""
        if self.dz_dx.ndim == 2:
            return [self]
        slopes = zip(self.dz_dx, self.dz_dy, strict=True)
        return [replace(self, dz_dx=x, dz_dy=y) for x, y in slopes]

    def agreed(self) -> Inputs | None:
        """Return inputs whose surfaces all have slopes at the same pixels; None if these already do."""
        finite = np.isfinite(self.dz_dx) & np.isfinite(self.dz_dy)
        missing = ~finite.all(axis=0, keepdims=True)
        if self.dz_dx.ndim == 2 or not (missing & finite).any():
            return None
        x, y = (np.where(missing, np.float32(np.nan), slope) for slope in (self.dz_dx, self.dz_dy))
        return replace(self, dz_dx=x, dz_dy=y)

    def weighted(self) -> Inputs:
        """Return inputs whose slopes have the weights of equally noisy normals."""
        if not self.slant_factors:
            return self
        given_planes = [plane for plane in (self.weight_x, self.weight_y) if plane is not None]
        planes = _multiplied(self.slant_factors, self.typical_weight, given_planes)
        typical = _median(planes)
        planes = [_clipped(plane, typical * LEAST, typical * MOST) for plane in planes]
        second = planes[1] if len(planes) > 1 else None
        return replace(self, weight_x=planes[0], weight_y=second, typical_weight=typical, slant_factors=())

    @property
    def weight(self) -> float:
        """Factor of the maps of weights; without maps, the weight of all pixels."""
        return self.typical_weight if self.weight_x is None else 1.0


def check_inputs(
    dz_dx: ArrayLike | None = None,
    dz_dy: ArrayLike | None = None,
    pixel_size: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    slope_weights: ArrayLike | None = None,
    edges: ArrayLike | None = None,
    known_heights: ArrayLike | None = None,
    known_height_weights: ArrayLike | None = None,
    *,
    normals: ArrayLike | None = None,
    camera: Camera | None = None,
    robust: bool = False,
    crop: bool = False,
    several: bool = False,
) -> Inputs:
    """Return the arguments of ``integrate`` as maps of one size, or raise InputError.

    With a camera, heights become logarithms of depths. Weights of normals are converted to weights of slopes
    unless ``robust``. ``crop``: cut out the box of the pixels that may have an answer. ``several``: accept
    the slopes of several surfaces, (K, H, W).
    """
    shape, slopes = _find_source(dz_dx, dz_dy, normals, camera, several)
    if camera is not None and pixel_size is not None:
        raise InputError(f"pixel_size {pixel_size!r}: a camera determines it; leave one of the two out")
    size = check_pixel_size(pixel_size) if camera is None else camera.pixel_size
    weight, planes = split_weights("slope_weights", slope_weights, shape)
    height_weight, height_planes = split_weights("known_height_weights", known_height_weights, shape, 1)
    marks, cuts = as_marks("mask", mask, shape), as_marks("edges", edges, shape)
    heights = None if known_heights is None else check_map("known_heights", known_heights, shape)
    if not weight:
        planes = [np.zeros(shape, np.float32)]
    box, lost = (slice(0, shape[0]), slice(0, shape[1])), 0
    if crop:
        whole, box = box, find_box(shape, lambda part: _may_answer(part, slopes, marks, heights))
        lost = 0 if box == whole else _count(whole, marks, planes) - _count(box, marks, planes)
    marks, cuts = (None if flags is None else flags[box] for flags in (marks, cuts))
    planes, height_planes = ([plane[box] for plane in maps] for maps in (planes, height_planes))
    x, y, steep = slopes(box)
    factors: tuple[Floats, ...] = () if steep is None else (steep,)
    if steep is not None and slope_weights is not None:
        x, y, factors = _weigh(x, y, sight_within(camera, shape, box), marks, weight, planes)
    if factors and not robust:
        planes, factors = _multiplied(factors, weight, planes), ()
    typical = _median(planes) if planes else weight
    relative_heights, datum = None, 0.0
    if heights is not None and height_weight:
        exact = np.asarray(heights[box], np.float64)
        if camera is not None:
            squares = np.asarray(height_weight * exact**2, np.float32)
            height_planes = [plane * squares for plane in height_planes] or [squares]
            height_weight, exact = 1.0, logarithm("known_heights", exact)
        counted = np.isfinite(exact) if marks is None else np.isfinite(exact) & (marks != 0)
        for plane in height_planes:
            counted &= plane > 0
        if counted.any():  # relative to their mean, because float32 would lose digits
            datum = float(np.mean(exact, where=counted))
            relative_heights = np.where(counted, exact - datum, np.nan).astype(np.float32)
    largest = _LARGEST_HEIGHT_WEIGHT * typical / min(size) ** 2
    planes = [_clipped(plane, typical * LEAST, typical * MOST) for plane in planes]
    height_planes = [_clipped(plane, 0.0, largest) for plane in height_planes]
    return Inputs(
        dz_dx=x,
        dz_dy=y,
        pixel_size=size,
        mask=marks,
        edges=cuts,
        weight_x=planes[0] if planes else None,
        weight_y=planes[1] if len(planes) > 1 else None,
        typical_weight=typical,
        weights_given=slope_weights is not None,
        steep=steep,
        slant_factors=factors,
        known_heights=relative_heights,
        known_height_weights=height_planes[0] if height_planes and relative_heights is not None else None,
        known_height_weight=min(height_weight, largest),
        datum=datum,
        picture=shape,
        box=box,
        lost=lost,
    )


def _multiplied(factors: tuple[Floats, ...], weight: float, planes: list[Floats]) -> list[Floats]:
    """Return the products of weights, a number or maps, with factors of one or both slopes."""
    count = max(len(factors), len(planes), 1)
    each = [planes[min(k, len(planes) - 1)] if planes else np.float32(weight) for k in range(count)]
    return [factors[min(k, len(factors) - 1)] * each[k] for k in range(count)]


def _weigh(
    x: Floats, y: Floats, sight: tuple[Any, Any], mask: Flags | None, weight: float, planes: list[Floats]
) -> tuple[Floats, Floats, tuple[Floats, ...]]:
    """Return slopes of normals without their bias, and the factors of their weights; see `weigh_slopes`."""
    defined = np.isfinite(x) & np.isfinite(y) & (True if mask is None else mask != 0)
    for plane in planes:
        defined &= plane > 0
    variance = noise_variance(median_weight(planes) if planes else weight)
    variances = [
        np.divide(1, plane, out=np.zeros_like(plane), where=plane > 0) if variance else plane * 0
        for plane in planes
    ] or [np.full(x.shape, variance, np.float32)]
    (x, y), factors = weigh_slopes((x, y), [np.minimum(v, MOST_NOISE) for v in variances], sight, defined)
    return x, y, tuple(factors)


def noise_variance(weight: float) -> float:
    """Return the variance of normals of a weight; 0 if that is too small to be an inverse variance."""
    return 1 / weight if weight * MOST_NOISE >= 1 else 0.0


def check_one_source(dz_dx: Any, dz_dy: Any, normals: Any) -> None:
    """Raise InputError if there are both slopes and normals."""
    if normals is not None and (dz_dx is not None or dz_dy is not None):
        raise InputError("both slopes and normals are given: leave one of the two out")


def _find_source(
    dz_dx: ArrayLike | None,
    dz_dy: ArrayLike | None,
    normals: ArrayLike | None,
    camera: Camera | None,
    several: bool,
) -> tuple[tuple[int, int], Callable[[Box], Slopes]]:
    """Return rows and columns of the picture, and a function that returns the slopes within a box."""
    check_one_source(dz_dx, dz_dy, normals)
    if normals is not None:
        vectors = np.asarray(normals)
        if vectors.ndim != 3 or vectors.shape[2] != 3 or 0 in vectors.shape:
            raise InputError(f"normals: shape {vectors.shape}; vectors (H, W, 3) are needed")
        return (vectors.shape[0], vectors.shape[1]), lambda box: find_slopes(vectors, camera, box)
    if camera is not None:
        raise InputError("a camera needs normals: give normals=, (H, W, 3), instead of slopes")
    if dz_dx is None or dz_dy is None:
        raise InputError("there are no slopes: give dz_dx and dz_dy, or normals=")
    x, y = np.asarray(dz_dx), np.asarray(dz_dy)
    if x.ndim not in ((2, 3) if several else (2,)) or x.shape != y.shape or 0 in x.shape:
        more = ", or (K, H, W) of several surfaces," if several else ""
        raise InputError(
            f"slopes have shapes {x.shape} and {y.shape}: two maps of one size (H, W){more} are needed"
        )
    shape = x.shape[-2], x.shape[-1]
    order: Literal["K", "C"] = "K" if x.ndim == 2 else "C"  # kernels read several maps in C order

    def part(box: Box) -> Slopes:
        x_part, y_part = (np.asarray(slope[(..., *box)], np.float32, order=order) for slope in (x, y))
        return x_part, y_part, None

    return shape, part


def _may_answer(
    box: Box, slopes: Callable[[Box], Slopes], mask: Flags | None, heights: NDArray[Any] | None
) -> Mask:
    """Return which pixels of a box have slopes or a known height."""
    selected: Mask | None = None if mask is None else mask[box] != 0
    if selected is not None and not selected.any():
        return selected
    x, y, _ = slopes(box)
    answered: Mask = np.isfinite(x) & np.isfinite(y)
    if answered.ndim == 3:
        answered = np.logical_and.reduce(answered)
    if heights is not None:
        answered |= np.isfinite(heights[box])
    return answered if selected is None else answered & selected


def _count(box: Box, mask: Flags | None, weights: list[Floats]) -> int:
    """Return the number of pixels of a box whose slopes are wanted."""
    selected = np.ones([part.stop - part.start for part in box], bool) if mask is None else mask[box] != 0
    if weights:
        selected = selected & np.logical_or.reduce([plane[box] > 0 for plane in weights])
    return int(np.count_nonzero(selected))


def logarithm(name: str, depths: NDArray[Any]) -> NDArray[np.float64]:
    """Return the logarithms of depths, which are NaN where unknown."""
    exact = np.asarray(depths, np.float64)
    if np.any(exact <= 0):
        raise InputError(f"{name}: some are not above 0; with a camera give depths, NaN where unknown")
    return np.log(exact)


def check_map(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return a map that has the shape of the slopes."""
    array = np.asarray(values)
    if array.shape != shape:
        raise InputError(f"{name}: shape {array.shape}, but the slopes have {shape}; give maps of one size")
    return array


def as_marks(name: str, values: ArrayLike | None, shape: tuple[int, ...]) -> Flags | None:
    """Return a map of bytes that are 0 where the values are 0 or NaN."""
    if values is None:
        return None
    array = check_map(name, values, shape)
    if array.dtype in (np.bool_, np.uint8):
        return array.view(np.uint8)
    return np.asarray((array != 0) & (array == array)).view(np.uint8)


def split_weights(
    name: str, values: ArrayLike | None, shape: tuple[int, ...], max_planes: int = 2
) -> tuple[float, list[Floats]]:
    """Return a factor, and the maps to be multiplied by it; no maps if all weights are equal."""
    if values is None:
        return 1.0, []
    array = np.asarray(values)
    if array.ndim == 0:
        weight = float(array)
        if not 0 <= weight < math.inf:
            raise InputError(f"{name} {weight}: an inverse variance of 0 or more is needed")
        return weight, []
    if array.shape != shape and (max_planes == 1 or array.shape != (2, *shape)):
        pairs = " or (2, H, W)" if max_planes == 2 else ""
        raise InputError(f"{name}: shape {array.shape}; one number, (H, W){pairs} as the slopes is needed")
    if not (array.min() >= 0 and array.max() < math.inf):
        raise InputError(f"{name}: some are negative or not finite; give inverse variances, 0 where unknown")
    return 1.0, [np.asarray(plane, np.float32) for plane in ([array] if array.ndim == 2 else array)]


def median_weight(samples: list[Floats]) -> float:
    """Return the median of weights above 0, or 1."""
    weights = np.concatenate([part.ravel() for part in samples])
    weights = weights[weights > 0]
    return float(np.median(weights)) if weights.size else 1.0


def _median(planes: list[Floats]) -> float:
    """Return the median of weights above 0, from a regular subset of the pixels, or 1."""
    step = max(1, math.isqrt(planes[0].size // SAMPLES))
    return median_weight([plane[step // 2 :: step, step // 2 :: step] for plane in planes])


def _clipped(plane: Floats, lowest: float, highest: float) -> Floats:
    """Return weights, clipped where they are above 0."""
    positive = plane > 0
    if np.min(plane, where=positive, initial=np.inf) >= lowest and plane.max() <= highest:
        return plane
    return np.where(positive, np.clip(plane, lowest, highest), 0).astype(np.float32)
