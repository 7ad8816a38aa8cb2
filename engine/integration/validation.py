"""What is integrated: slopes, where they are and their weights, and known heights; checked once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.integration.camera import Camera, Slopes, find_slopes
from mirrorskin.engine.integration.crop import Box, Mask, find_box
from mirrorskin.io import InputError
from mirrorskin.io.arguments import as_array

Floats = NDArray[np.float32]
Flags = NDArray[np.uint8]

LEAST, MOST = 1e-4, 1e3
"""Of the median, between which weights of slopes count: float32 solves no more."""

_FIRMEST = 1e4  # of a link's weight, above which a known height does not count more
_SAMPLES = 65536  # pixels that the median is taken of


@dataclass(frozen=True, slots=True)
class Inputs:
    """Maps of one size, (H, W), and numbers, fit to be integrated."""

    # (H, W), or of several surfaces with all else the same (K, H, W), float32
    dz_dx: Floats
    dz_dy: Floats
    pixel_size: tuple[float, float]  # width and height, mm
    # (H, W), uint8
    mask: Flags | None = None
    edges: Flags | None = None
    # (H, W), float32: ``weight_y`` is None where it is ``weight_x``; both are where all have the same.
    weight_x: Floats | None = None
    weight_y: Floats | None = None
    typical_weight: float = 1.0  # that same weight, or the median
    # Whether the weights of the slopes were given, and are to be taken for inverse variances.
    weights_given: bool = True
    # (H, W), float32: heights relative to ``datum``; weights None where all have the same.
    known_heights: Floats | None = None
    known_height_weights: Floats | None = None
    known_height_weight: float = 1.0  # that same weight, else 1
    datum: float = 0.0  # what the known heights are relative to, mm
    # (H, W), float32: squared share of a unit normal that is along the line of sight; None where it is as the
    # slopes say.
    steep: Floats | None = None
    picture: tuple[int, int] = (0, 0)  # rows and columns of the picture that they are a box of
    box: Box = (slice(None), slice(None))  # of the picture that the maps show
    lost: int = 0  # pixels outside the box that slopes are wanted of

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.dz_dx.shape[-2:]
        return rows, columns

    def each(self) -> list[Inputs]:
        """Return those of each surface."""
        if self.dz_dx.ndim == 2:
            return [self]
        slopes = zip(self.dz_dx, self.dz_dy, strict=True)
        return [replace(self, dz_dx=x, dz_dy=y) for x, y in slopes]

    def agreed(self) -> Inputs | None:
        """Return the same without slopes where those of any surface are no numbers; None if it is this."""
        wanted = np.isfinite(self.dz_dx) & np.isfinite(self.dz_dy)
        lost = ~wanted.all(axis=0, keepdims=True)
        if self.dz_dx.ndim == 2 or not (lost & wanted).any():
            return None
        x, y = (np.where(lost, np.float32(np.nan), one) for one in (self.dz_dx, self.dz_dy))
        return replace(self, dz_dx=x, dz_dy=y)

    @property
    def weight(self) -> float:
        """What the maps of weights are multiplied by; what all weigh without."""
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
    """Return the arguments of ``integrate`` as maps of one size; InputError where they cannot be.

    With a camera, heights are logarithms of depths. ``robust``: weights are those of normals; else those of
    the slopes that normals make. ``crop``: only the box of the pixels that may have an answer is kept.
    ``several``: slopes may be those of several surfaces, (K, H, W).
    """
    shape, slopes = _find_source(dz_dx, dz_dy, normals, camera, several)
    if camera is not None and pixel_size is not None:
        raise InputError(f"pixel_size {pixel_size!r}: a camera says it; leave one of the two out")
    size = check_pixel_size(pixel_size) if camera is None else camera.pixel_size
    weight, planes = _split_weights("slope_weights", slope_weights, shape)
    height_weight, height_planes = _split_weights("known_height_weights", known_height_weights, shape, 1)
    marks, cuts = _marks("mask", mask, shape), _marks("edges", edges, shape)
    heights = None if known_heights is None else check_map("known_heights", known_heights, shape)
    if not weight:
        planes = [np.zeros(shape, np.float32)]
    box, lost = (slice(0, shape[0]), slice(0, shape[1])), 0
    if crop:
        whole, box = box, find_box(shape, lambda part: _may_answer(part, slopes, marks, heights))
        lost = 0 if box == whole else _count(whole, marks, planes) - _count(box, marks, planes)
    marks, cuts = (None if one is None else one[box] for one in (marks, cuts))
    planes, height_planes = ([plane[box] for plane in some] for some in (planes, height_planes))
    x, y, steep = slopes(box)
    if steep is not None and not robust:
        planes = [steep * plane for plane in planes] or [np.float32(weight) * steep]
    typical = _median(planes) if planes else weight
    known, datum = None, 0.0
    if heights is not None and height_weight:
        exact = np.asarray(heights[box], np.float64)
        if camera is not None:
            squares = np.asarray(height_weight * exact**2, np.float32)
            height_planes = [plane * squares for plane in height_planes] or [squares]
            height_weight, exact = 1.0, logarithm("known_heights", exact)
        counted = np.isfinite(exact) if marks is None else np.isfinite(exact) & (marks != 0)
        for plane in height_planes:
            counted &= plane > 0
        if counted.any():  # relative to their mean: with it, float32 would lose their digits
            datum = float(np.mean(exact, where=counted))
            known = np.where(counted, exact - datum, np.nan).astype(np.float32)
    firmest = _FIRMEST * typical / min(size) ** 2
    planes = [_bounded(plane, typical * LEAST, typical * MOST) for plane in planes]
    height_planes = [_bounded(plane, 0.0, firmest) for plane in height_planes]
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
        known_heights=known,
        known_height_weights=height_planes[0] if height_planes and known is not None else None,
        known_height_weight=min(height_weight, firmest),
        datum=datum,
        picture=shape,
        box=box,
        lost=lost,
    )


def _find_source(
    dz_dx: ArrayLike | None,
    dz_dy: ArrayLike | None,
    normals: ArrayLike | None,
    camera: Camera | None,
    several: bool,
) -> tuple[tuple[int, int], Callable[[Box], Slopes]]:
    """Return rows and columns of the picture, and what gives the slopes within a box."""
    if normals is not None:
        if dz_dx is not None or dz_dy is not None:
            raise InputError("both slopes and normals are given: leave one of the two out")
        given = np.asarray(normals)
        if given.ndim != 3 or given.shape[2] != 3 or 0 in given.shape:
            raise InputError(f"normals: shape {given.shape}; vectors (H, W, 3) are needed")
        return (given.shape[0], given.shape[1]), lambda box: find_slopes(given, camera, box)
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
    return shape, lambda box: (_part(x, box), _part(y, box), None)


def _part(slopes: NDArray[Any], box: Box) -> Floats:
    """Return a part of slopes; of several maps so that kernels can read each where it lies."""
    return np.asarray(slopes[(..., *box)], np.float32, order="K" if slopes.ndim == 2 else "C")


def _may_answer(
    box: Box, slopes: Callable[[Box], Slopes], mask: Flags | None, heights: NDArray[Any] | None
) -> Mask:
    """Tell which pixels of a box have slopes or a known height."""
    wanted: Mask | None = None if mask is None else mask[box] != 0
    if wanted is not None and not wanted.any():
        return wanted
    x, y, _ = slopes(box)
    found: Mask = np.isfinite(x) & np.isfinite(y)
    if found.ndim == 3:
        found = np.logical_and.reduce(found)
    if heights is not None:
        found |= np.isfinite(heights[box])
    return found if wanted is None else found & wanted


def _count(box: Box, mask: Flags | None, weights: list[Floats]) -> int:
    """Count the pixels of a box whose slopes are wanted."""
    wanted = np.ones([part.stop - part.start for part in box], bool) if mask is None else mask[box] != 0
    if weights:
        wanted = wanted & np.logical_or.reduce([plane[box] > 0 for plane in weights])
    return int(np.count_nonzero(wanted))


def logarithm(name: str, depths: NDArray[Any]) -> NDArray[np.float64]:
    """Return logarithms of depths, NaN where there is none."""
    exact = np.asarray(depths, np.float64)
    if np.any(exact <= 0):
        raise InputError(f"{name}: some are not above 0; with a camera give depths, NaN where there is none")
    return np.log(exact)


def check_pixel_size(pixel_size: ArrayLike | None) -> tuple[float, float]:
    """Return width and height of a pixel, mm, of one number or both."""
    size = as_array("pixel_size", pixel_size)
    told = size.tolist() if isinstance(pixel_size, np.ndarray) else pixel_size
    if size.shape not in ((), (2,)):
        raise InputError(f"pixel size {told}: one length in mm, or (x, y), is needed")
    if not np.all((size > 1e-9) & (size < 1e6)):
        raise InputError(f"pixel size {told}: a length from 1e-9 to 1e6 mm is needed")
    width, height = np.broadcast_to(size, 2).tolist()
    return width, height


def check_above_zero(**numbers: float | None) -> None:
    """Check numbers that may be left out, by their names."""
    for name, number in numbers.items():
        if number is not None and not 0 < number < math.inf:
            raise InputError(f"{name} {number}: a number above 0 is needed")


def check_map(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return a map that has the shape of the slopes."""
    given = np.asarray(values)
    if given.shape != shape:
        raise InputError(f"{name}: shape {given.shape}, but the slopes have {shape}; give maps of one size")
    return given


def _marks(name: str, values: ArrayLike | None, shape: tuple[int, ...]) -> Flags | None:
    """Return a map of bytes that are 0 where the values are, or are no number."""
    if values is None:
        return None
    given = check_map(name, values, shape)
    if given.dtype in (np.bool_, np.uint8):
        return given.view(np.uint8)
    return np.asarray((given != 0) & (given == given)).view(np.uint8)  # NaN marks nothing


def _split_weights(
    name: str, values: ArrayLike | None, shape: tuple[int, ...], most: int = 2
) -> tuple[float, list[Floats]]:
    """Return a factor, and the maps to be multiplied with it: none where one number says it all."""
    if values is None:
        return 1.0, []
    given = np.asarray(values)
    if given.ndim == 0:
        weight = float(given)
        if not 0 <= weight < math.inf:
            raise InputError(f"{name} {weight}: an inverse variance of 0 or more is needed")
        return weight, []
    if given.shape != shape and (most == 1 or given.shape != (2, *shape)):
        pairs = " or (2, H, W)" if most == 2 else ""
        raise InputError(f"{name}: shape {given.shape}; one number, (H, W){pairs} as the slopes is needed")
    if not (given.min() >= 0 and given.max() < math.inf):
        raise InputError(
            f"{name}: some are negative or no number; give inverse variances, 0 where nothing is known"
        )
    return 1.0, [np.asarray(plane, np.float32) for plane in ([given] if given.ndim == 2 else given)]


def _median(planes: list[Floats]) -> float:
    """Return the median of weights above 0, of evenly spread pixels, or 1."""
    step = max(1, math.isqrt(planes[0].size // _SAMPLES))
    some = np.concatenate([plane[step // 2 :: step, step // 2 :: step].ravel() for plane in planes])
    some = some[some > 0]
    return float(np.median(some)) if some.size else 1.0


def _bounded(plane: Floats, least: float, most: float) -> Floats:
    """Return weights of which those above 0 lie within bounds."""
    positive = plane > 0
    if np.min(plane, where=positive, initial=np.inf) >= least and plane.max() <= most:
        return plane
    return np.where(positive, np.clip(plane, least, most), 0).astype(np.float32)
