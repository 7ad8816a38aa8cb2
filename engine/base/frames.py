"""Checks of frames, and estimates from the first frames: type, size, noise, dark and bright levels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, as_any_array, viewed
from mirrorskin.io import InputError
from mirrorskin.io.base.samples import convert_samples, frame_dtype
from mirrorskin.io.base.types import FRAME_DTYPES
from mirrorskin.io.watch.traces import FrameSamples
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.numerics.least_squares import mad_sigma, median
from mirrorskin.kernels.numerics.samples import Grid, take_grids, take_samples

SAMPLES = 65536
"""Smallest number of pixels from which the noise of a larger frame is estimated."""
QUANTUM = 1 / math.sqrt(12)
"""Standard deviation of the rounding of integer counts."""

_AT_ONCE = 65536  # pixels processed at once
_MAX_PAIRS = 16  # of frames for an estimate of the noise
_MIN_SAMPLES = 64  # of a pair of frames
_MEDIAN = 0.6745  # magnitude of half of the values of a normal distribution, standard deviations
_CLIP_ITERATIONS = 3  # of clipping, after which the noise changes by less than a percent
_CLIP = 4.0  # standard deviations beyond which differences are clipped


def check_dtype(dtype: DTypeLike) -> np.dtype[Any]:
    """Return the type of samples; raise InputError if kernels do not accept it."""
    sample_type = np.dtype(dtype)
    if sample_type not in FRAME_DTYPES:
        raise InputError(f"frames of type {sample_type}: uint8, uint16 or float32 are needed")
    return sample_type


def as_frames(name: str, value: Any) -> AnyArray:
    """Return an argument as an array of a type that kernels accept; see `frame_dtype`."""
    array = as_any_array(name, value)
    if not isinstance(array, np.ndarray):
        check_dtype(array.dtype)
        return array
    return convert_samples(array, frame_dtype(array.dtype, name), name)


def check_frames(frames: NDArray[Any], dtype: np.dtype[Any], shape: tuple[int, int]) -> None:
    """Raise InputError unless frames are one or more of a type and size, (n, *shape)."""
    if frames.dtype != dtype or frames.shape[1:] != shape or len(frames) == 0:
        raise InputError(
            f"frames of {frames.dtype} {frames.shape}: {dtype} (n, {shape[0]}, {shape[1]}) is needed"
        )


class Noise:
    """The standard deviation of a sample, counts: given, or estimated from the first two frames.

    ``integer``: samples are integers.
    """

    def __init__(self, noise: float | None, integer: bool) -> None:
        if noise is not None and not 0 <= noise < np.inf:
            raise InputError(f"noise {noise}: a standard deviation in counts is needed, such as 1.5")
        self._given, self._integer = noise, integer
        self.reset()

    def reset(self, noise: float | None = None) -> None:
        """Forget the frames so far; the noise may be specified, from other frames."""
        self._samples: list[NDArray[np.float64]] = []
        self.value = self._given if noise is None else noise

    def look(self, frames: AnyArray) -> None:
        """Use the next frames, (n, H, W), if they are among the first two."""
        if self.value is not None:
            return
        self._samples += [*thinned(frames[: 2 - len(self._samples)])[0].astype(np.float64)]
        if len(self._samples) == 2:
            self.value = estimate_noise(self._samples[0], self._samples[1], self._integer)


def thinning(shape: tuple[int, ...]) -> int:
    """Return n such that every n-th pixel of a frame gives enough samples."""
    return max(1, math.prod(shape) // SAMPLES)


def typical_value(values: AnyArray) -> float:
    """Return the median of evenly spaced values of a map that are numbers; 0 if none is."""
    [samples] = thinned(values)
    finite = samples[np.isfinite(samples)]
    return float(median(finite)) if finite.size else 0.0


def thinned(*arrays: AnyArray) -> list[NDArray[Any]]:
    """Return evenly spaced samples of arrays, (..., H, W), enough to estimate the noise within 0.5 %.

    All arrays are on the host, or all on one device, which is waited for once.
    """
    samples, grids = [], []
    for array in map(viewed, arrays):
        *count, rows, columns = array.shape
        step, pixels = thinning((rows, columns)), rows * columns
        if isinstance(array, Array):
            grids.append(Grid(array, 0, (pixels, 0, step), (math.prod(count), 1, -(-pixels // step))))
        else:
            samples.append(array.reshape(*count, -1)[..., ::step])
    if grids:
        samples = take_grids(*grids)
    return [values.reshape(*array.shape[:-2], -1) for array, values in zip(arrays, samples, strict=True)]


def take_grid(frames: AnyArray, grid: FrameSamples) -> NDArray[Any]:
    """Return a copy of the samples of frames, (n, H, W), on the host or a device, at the pixels of a grid."""
    frames = viewed(frames)
    if not isinstance(frames, Array):
        return grid.of_frames(frames)
    rows, columns = grid.rows, grid.columns
    count, height, width = frames.shape
    down, step = (int(pixels[1] - pixels[0]) if len(pixels) > 1 else 0 for pixels in (rows, columns))
    steps, shape = (height * width, down * width, step), (count, len(rows), len(columns))
    return take_samples(frames, int(rows[0] * width + columns[0]), steps, shape)


def take_neighbours(values: AnyArray, grid: FrameSamples) -> list[NDArray[Any]]:
    """Return a map, (H, W), at the pixels of a grid, and at those to the left, right, above and below them.

    At the border of the map, a pixel is next to itself.
    """
    values = viewed(values)
    height, width = values.shape
    rows, columns = grid.rows, grid.columns
    at_border = 0 in (rows[0], columns[0]) or rows[-1] == height - 1 or columns[-1] == width - 1
    if isinstance(values, Array) and not at_border:
        down, step = (int(pixels[1] - pixels[0]) for pixels in (rows, columns))
        first, shape = int(rows[0] * width + columns[0]), (3, len(rows), len(columns))
        [across], [along] = take_grids(
            *(Grid(values, first - apart, (apart, down * width, step), shape) for apart in (1, width))
        )
        return [across[1], across[0], across[2], along[0], along[2]]
    array: NDArray[Any] = np.asarray(values)
    before, after = np.maximum(columns - 1, 0), np.minimum(columns + 1, width - 1)
    above, below = np.maximum(rows - 1, 0), np.minimum(rows + 1, height - 1)
    places = (rows, columns), (rows, before), (rows, after), (above, columns), (below, columns)
    return [array[np.ix_(*place)] for place in places]


def take_places(
    maps: Sequence[AnyArray], rows: range, columns: range, places: Sequence[tuple[int, int]]
) -> list[list[NDArray[Any]]]:
    """Return maps, (H, W) or (H, W, components), at rows and columns moved down and right to each place.

    They are (rows, columns) or (components, rows, columns), and only views if the maps are on the host.
    """
    maps = [viewed(values) for values in maps]
    if any(isinstance(values, np.ndarray) for values in maps):
        parts = [
            tuple(slice(each[0] + by, each[-1] + by + 1, each.step) for each, by in moved)
            for moved in (((rows, down), (columns, right)) for down, right in places)
        ]
        hosts: list[Any] = [
            (np.moveaxis(values, -1, 0) if values.ndim == 3 else values) for values in map(np.asarray, maps)
        ]
        return [[values[(..., *part)] for part in parts] for values in hosts]
    grids = []
    for values in maps:
        width, components = values.shape[1], math.prod(values.shape[2:])
        steps = 1, components * width * rows.step, components * columns.step
        shape = components, len(rows), len(columns)
        firsts = [components * ((rows[0] + down) * width + columns[0] + right) for down, right in places]
        for first, second in zip_longest(firsts[::2], firsts[1::2]):  # two places in a launch
            pair = (1, 0) if second is None else (2, second - first)
            grids.append(Grid(values, first, steps, shape, *pair))
    samples = (part for parts in take_grids(*grids) for part in parts)
    return [[next(samples) if values.ndim == 3 else next(samples)[0] for _ in places] for values in maps]


def estimate_noise(first: NDArray[np.float64], second: NDArray[np.float64], integer: bool) -> float:
    """Estimate the standard deviation of a sample, counts, from two samples of each pixel, (n,) each.

    Iterative clipping at four sigma excludes pixels that changed in between, if they are fewer than half.
    Integer counts have at least the noise of their rounding.
    """
    usable = np.isfinite(first) & np.isfinite(second)
    difference = second[usable] - first[usable]
    if difference.size == 0:
        return QUANTUM if integer else 0.0
    spread = max(mad_sigma(difference), 1.0 if integer else 0.0)
    for _ in range(10):
        kept = difference[np.abs(difference) <= _CLIP * spread]
        if spread == (spread := float(np.sqrt(np.mean(kept**2)))):
            break
    noise = spread / np.sqrt(2)
    return float(max(noise, QUANTUM) if integer else noise)


def estimate_noise_of_all(samples: NDArray[Any]) -> float:
    """Estimate the standard deviation of a sample, counts, from the same pixels of all frames, (T, n).

    It is the median over at most 16 pairs of consecutive frames, so a repeated frame or a lamp that settles
    has little influence. Pixels that turn light (or dark) all change in one direction, while noise changes as
    many in each direction: the noise is estimated from the direction with the smaller changes. Samples at the
    ends of the scale, where noise is clipped, are excluded.
    """
    integer = samples.dtype.kind == "u"
    pairs = np.unique(np.linspace(0, len(samples) - 2, _MAX_PAIRS).round().astype(int))
    first, second = (samples[pairs + step].astype(np.float32) for step in (0, 1))
    usable = np.isfinite(first) & np.isfinite(second)
    if integer:
        top = samples.max()
        usable &= (first > 0) & (second > 0) & (first < top) & (second < top)
    enough = np.count_nonzero(usable, axis=1) >= _MIN_SAMPLES
    if not enough.any():
        return math.nan
    change = np.where(usable, second - first, np.nan)[enough]
    spread = np.minimum(_side(change, integer), _side(-change, integer))
    noise = float(np.median(spread)) / math.sqrt(2)
    return max(noise, QUANTUM) if integer else noise


def _side(change: NDArray[np.float32], integer: bool) -> NDArray[np.float64]:
    """Return the standard deviation of changes, (P, n), from those below 0, without outliers."""
    below, same = change < 0, np.count_nonzero(change == 0, axis=1) / 2
    count = np.count_nonzero(below, axis=1)
    square = np.where(below, change * change, 0)
    ordered = np.sort(np.where(below, square, np.inf), axis=1)
    place = np.clip(((count + same) / 2 - same).astype(int), 0, None)  # index of the median, after the zeros
    middle = np.sqrt(ordered[np.arange(len(ordered)), np.minimum(place, np.maximum(count - 1, 0))])
    spread = np.maximum(np.where(count > 0, middle, 0) / _MEDIAN, 1.0 if integer else 0.0)
    for _ in range(_CLIP_ITERATIONS):
        kept = below & (square <= (_CLIP * spread[:, np.newaxis]) ** 2)
        spread = np.sqrt(np.sum(square, axis=1, where=kept) / np.maximum(kept.sum(axis=1) + same, 1))
    return np.asarray(spread)


def noise_of_residual(residual: NDArray[Any], freedom: ArrayLike) -> float:
    """Return the standard deviation of a sample from residuals of fits; NaN without any.

    The residuals have n degrees of freedom each, scalar or a map. Their median is the median of
    sqrt(chi^2 / n), in the approximation of Wilson and Hilferty (PNAS 17, 1931).
    """
    degrees = np.asarray(freedom)
    determined = (degrees > 0) & np.isfinite(residual)
    if not determined.any():
        return math.nan
    if degrees.ndim:
        degrees = degrees[determined]
    ratio = (1 - 2 / (9 * np.maximum(degrees, 1).astype(residual.dtype))) ** 1.5
    return float(np.median(residual[determined] / ratio))


def reference_maps(
    dark: ArrayLike | None, bright: ArrayLike | None, shape: tuple[int, int], dtype: np.dtype[Any]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Check the references; missing ones are replaced by the range of the frames' type.

    Dark and bright are counts without light and with full light, scalar or (H, W). InputError if a shape
    differs from the frames', float frames have no references, no pixel has both, or bright is not above dark
    at half or more of the pixels that have both.
    """
    if dtype.kind == "f" and (dark is None or bright is None):
        raise InputError("float frames have no natural range: give dark and bright, as counts or as maps")
    top = 0 if dtype.kind == "f" else np.iinfo(dtype).max
    low = _as_map("dark", 0 if dark is None else dark, shape)
    high = _as_map("bright", top if bright is None else bright, shape)
    defined, usable = _count_usable(low, high)
    if defined == 0:
        raise InputError("no pixel has a finite dark and bright: take the references again")
    if 2 * usable <= defined:
        percent = 100 * (1 - usable / defined)
        raise InputError(f"bright is not above dark at {percent:.3g} % of the pixels: are they swapped?")
    return low, high


def reference_pair(
    dark: ArrayLike | None, bright: ArrayLike | None, shape: tuple[int, int], dtype: np.dtype[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the references of `reference_maps` as maps (H, W), float64.

    Both are NaN where bright is not above dark, as in dead or hot pixels.
    """
    low, high = reference_maps(dark, bright, shape, dtype)
    usable = _usable(low, high)
    dark_map, bright_map = (
        np.broadcast_to(np.where(usable, part.astype(np.float64), np.nan), shape) for part in (low, high)
    )
    return dark_map, bright_map


def _count_usable(dark: NDArray[np.float32], bright: NDArray[np.float32]) -> tuple[int, int]:
    """Return the number of pixels where both are finite, and where bright is also above dark."""
    defined = usable = 0
    if dark.ndim == bright.ndim == 0:
        dark, bright = np.atleast_1d(dark, bright)
    dark, bright = np.broadcast_arrays(dark, bright)
    step = max(1, _AT_ONCE // (dark[0].size))
    for start in range(0, len(dark), step):  # parts that stay in the cache
        with np.errstate(invalid="ignore", over="ignore"):
            span = bright[start : start + step] - dark[start : start + step]
        defined += int(np.count_nonzero(np.isfinite(span)))
        usable += int(np.count_nonzero(span > 0) - np.count_nonzero(span == np.inf))
    return defined, usable


def _usable(dark: NDArray[np.float32], bright: NDArray[np.float32]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(dark) & np.isfinite(bright) & (bright > dark))


def _as_map(name: str, values: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float32]:
    array = np.asarray(values, np.float32)
    if array.shape not in ((), shape):
        raise InputError(
            f"{name} reference has shape {array.shape}, the frames are {shape[0]} x {shape[1]}: "
            "give one number or a map of the frames' size"
        )
    return array
