"""What is integrated: slopes, where they are and their weights, and known heights; checked once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import InputError

Floats = NDArray[np.float32]
Flags = NDArray[np.uint8]

LEAST, MOST = 1e-4, 1e3
"""Of the median, between which weights of slopes count: float32 solves no more."""

_FIRMEST = 1e4  # of a link's weight, above which a known height does not count more
_SAMPLES = 65536  # pixels that the median is taken of


@dataclass(frozen=True, slots=True)
class Inputs:
    """Maps of one size, (H, W), and numbers, fit to be integrated."""

    # (H, W), float32
    dz_dx: Floats
    dz_dy: Floats
    pixel_size: tuple[float, float]  # width and height, mm
    # (H, W), uint8
    mask: Flags | None = None
    edges: Flags | None = None
    # (H, W), float32: ``weight_y`` is None where it is ``weight_x``; both are where all have the same.
    weight_x: Floats | None = None
    weight_y: Floats | None = None
    weight: float = 1.0  # that same weight, else 1
    typical_weight: float = 1.0  # the median weight
    # Whether the weights of the slopes were given, and are to be taken for inverse variances.
    weights_given: bool = True
    # (H, W), float32: heights relative to ``datum``; weights None where all have the same.
    known_heights: Floats | None = None
    known_height_weights: Floats | None = None
    known_height_weight: float = 1.0  # that same weight, else 1
    datum: float = 0.0  # what the known heights are relative to, mm

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.dz_dx.shape
        return rows, columns


def check_inputs(
    dz_dx: ArrayLike,
    dz_dy: ArrayLike,
    pixel_size: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    slope_weights: ArrayLike | None = None,
    edges: ArrayLike | None = None,
    known_heights: ArrayLike | None = None,
    known_height_weights: ArrayLike | None = None,
) -> Inputs:
    """Return the arguments of ``integrate`` as maps of one size; InputError where they cannot be."""
    x, y = np.asarray(dz_dx), np.asarray(dz_dy)
    if x.ndim != 2 or x.shape != y.shape or 0 in x.shape:
        raise InputError(
            f"slopes have shapes {x.shape} and {y.shape}: two maps of one size (H, W) are needed"
        )
    shape, size = x.shape, check_pixel_size(pixel_size)
    weight, planes = _split_weights("slope_weights", slope_weights, shape)
    height_weight, height_planes = _split_weights("known_height_weights", known_height_weights, shape, 1)
    known, datum = None, 0.0
    if known_heights is not None and height_weight:
        counted = np.ones(shape, bool) if mask is None else check_map("mask", mask, shape) != 0
        for plane in height_planes:
            counted &= plane > 0
        known, datum = _relative(check_map("known_heights", known_heights, shape), counted)
    if not weight:
        planes = [np.zeros(shape, np.float32)]
    typical = _median(planes) if planes else weight
    planes = [_bounded(plane, typical * LEAST, typical * MOST) for plane in planes]
    firmest = _FIRMEST * typical / min(size) ** 2
    height_planes = [_bounded(plane, 0.0, firmest) for plane in height_planes]
    return Inputs(
        dz_dx=np.asarray(x, np.float32),
        dz_dy=np.asarray(y, np.float32),
        pixel_size=size,
        mask=_marks("mask", mask, shape),
        edges=_marks("edges", edges, shape),
        weight_x=planes[0] if planes else None,
        weight_y=planes[1] if len(planes) > 1 else None,
        weight=weight or 1.0,
        typical_weight=typical,
        weights_given=slope_weights is not None,
        known_heights=known,
        known_height_weights=height_planes[0] if height_planes and known is not None else None,
        known_height_weight=min(height_weight, firmest),
        datum=datum,
    )


def check_pixel_size(pixel_size: ArrayLike) -> tuple[float, float]:
    """Return width and height of a pixel, mm, of one number or both."""
    size = np.asarray(pixel_size, np.float64)
    if size.shape not in ((), (2,)) or not np.all((size > 0) & (size < np.inf)):
        raise InputError(f"pixel size {pixel_size!r}: one length in mm above 0, or (x, y), is needed")
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


def _relative(heights: NDArray[Any], counted: NDArray[np.bool_]) -> tuple[Floats | None, float]:
    """Return heights less the mean of those that count, which would cost float32 its digits, and that mean.

    Others are NaN; None where none counts.
    """
    exact = np.asarray(heights, np.float64)
    known = np.isfinite(exact) & counted
    if not known.any():
        return None, 0.0
    datum = float(np.mean(exact, where=known))
    return np.where(known, exact - datum, np.nan).astype(np.float32), datum
