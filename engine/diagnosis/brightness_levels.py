"""Levels of dark and light: estimated from the frames, and what their uncertainty does to heights."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.frames import estimate_noise, thinned
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.diagnosis.blur import first_travel
from mirrorskin.io import Block, Result, Source
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.io.watch.traces import FrameSamples
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma, median

if TYPE_CHECKING:
    from mirrorskin.engine.press.crossing import Event, PressOperation

_MIN_PIXELS = 16  # pixels that must have turned light
_RISE = 8.0  # standard deviations of the noise: least rise of brightness between dark and light

_END_FRACTION = 0.1  # of the frames, at each end, in which levels are compared with the references
_MIN_DISTANCE = 0.3  # of the travel, least distance of these frames from the onset of a pixel
_MIN_GRID_PIXELS = 64  # pixels
_FLAT_QUANTILE = 0.25  # share of the pixels: the flattest ones
_OF_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
_CLEAR_Z_SCORE = 5.0  # standard errors from which on a level differs from its reference
_MIN_DIFFERENCE = 0.01  # share of the rise to light from which on it differs
_COMMON_Z_SCORE = 2.0  # sigmas of the pixels' own differences above which a difference is common


T = TypeVar("T", bound="PressOperation")


def with_estimated_levels(operation: T, source: Source, oscillates: bool = False) -> T:
    """Return an operation with levels that neither its options nor the source specify, from the frames."""
    missing = [name for name in ("dark", "bright") if getattr(operation, name) is None]
    travel = _travel_of(source) if missing else None
    if travel is None:
        return operation
    frames = range(len(travel)) if oscillates else frames_of(travel, operation.event)
    levels = estimate_levels(source, travel, frames, operation.dark, operation.bright)
    if levels is None:
        return operation
    changes: dict[str, Any] = {name: getattr(levels, name) for name in missing}
    for name in ("dark_sigma", "bright_sigma"):
        if operation.option_values().get(name) == 0:
            changes[name] = getattr(levels, name)
    return operation.with_options(**changes, estimated_levels=missing)


def _travel_of(source: Source) -> NDArray[np.float64] | None:
    """Return the travel of all frames, if known; None of frames that come, or came, while the body moves."""
    if hasattr(source, "now") or getattr(source, "used_live", False) or source.motion != "vertical":
        return None
    travel: NDArray[np.float64] | None = getattr(source, "travel", None)
    if travel is None and source.rewindable:
        parts = [block.travel for block in _blocks(source) if block.travel is not None]
        travel = np.concatenate(parts) if parts else None
    return travel if travel is not None and np.isfinite(travel).all() else None  # the run refuses others


def _pictures(source: Source, *numbers: int) -> list[NDArray[Any]]:
    """Return some frames of a source."""
    read: Callable[[int], NDArray[Any]] | None = getattr(source, "frame", None)
    if read is not None:
        return [read(number) for number in numbers]
    pictures: dict[int, NDArray[Any]] = {}
    for block in _blocks(source):
        here = range(block.index, block.index + len(block.frames))
        pictures |= {
            number: block.frames[number - block.index].copy() for number in numbers if number in here
        }
    return [pictures[number] for number in numbers]


def _blocks(source: Source) -> Iterator[Block]:
    source.rewind()
    while (block := source.read()) is not None:
        yield block


def frames_of(travel: NDArray[np.float64], event: Event) -> range:
    """Return the frames of a press up to the greatest travel, or of a release from there."""
    deepest = np.flatnonzero(travel == travel.max())
    return range(int(deepest[0]), len(travel)) if event == "release" else range(int(deepest[-1]) + 1)


class EstimatedLevelNote(Step):
    """Note which levels were not given."""

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with a note, if levels were estimated or assumed."""
        operation = cast("PressOperation", context.operation)
        missing = [name for name in ("dark", "bright") if getattr(operation, name) is None]
        if estimated := operation.estimated_levels:
            counts = " and ".join(f"{getattr(operation, name):.4g}" for name in estimated)
            names = " and ".join(estimated)
            text = f"no {names} given: estimated as {counts} counts (give {names}, or take references)"
            result = with_findings(result, Finding("estimated levels", text, False))
        if missing:
            names = " and ".join(missing)
            text = (
                f"no {names} given: the range of the frames' type is taken, and heights may be wrong by more"
                f" than height_sigma (give {names}, or take references)"
            )
            result = with_findings(result, Finding("assumed levels", text, False))
        return result


@dataclass(frozen=True, slots=True)
class EstimatedLevels:
    """Dark and bright levels, counts, and the standard deviations of the pixels' levels about them."""

    dark: float
    bright: float
    dark_sigma: float
    bright_sigma: float


def estimate_levels(
    source: Source,
    travel: NDArray[np.float64],
    frames: range,
    dark: ArrayLike | None = None,
    bright: ArrayLike | None = None,
) -> EstimatedLevels | None:
    """Estimate the dark and bright levels from the frames of least and greatest travel.

    Pixels turned light if their brightness differs between these frames by more than half of the 16th largest
    difference. The levels are the medians of these pixels; their standard deviations exclude the noise.
    Given levels are unchanged, with a standard deviation of 0.

    Parameters
    ----------
    source : Source
        It can be read again.
    travel : ndarray, (T,)
        Of all frames, mm.
    frames : range
        The press, or the release.
    dark, bright : array_like, scalar or (H, W), optional
        Given levels.

    Returns
    -------
    EstimatedLevels or None
        None if nothing turns light.
    """
    if len(frames) < 2:
        return None
    part = travel[frames.start : frames.stop]
    lowest, deepest = (frames.start + int(number) for number in (np.argmin(part), np.argmax(part)))
    neighbour = lowest + (1 if lowest + 1 < frames.stop else -1)
    pictures = _pictures(source, lowest, neighbour, deepest)
    samples = np.stack(thinned(*pictures), dtype=np.float64)
    first, second, last = samples[:, np.isfinite(samples).all(axis=0)]
    integer = pictures[0].dtype.kind == "u"
    rise = last - first
    if rise.size < _MIN_PIXELS:
        return None
    top = float(np.partition(rise, -_MIN_PIXELS)[-_MIN_PIXELS])
    noise = estimate_noise(first, second, integer)
    if top < _RISE * noise:
        return None
    lit = rise >= top / 2
    low, low_sigma = _middle(first[lit], noise, integer) if dark is None else (_median(dark), 0.0)
    high, high_sigma = _middle(last[lit], noise, integer) if bright is None else (_median(bright), 0.0)
    return EstimatedLevels(low, high, low_sigma, high_sigma) if high > low else None


def _middle(counts: NDArray[np.float64], noise: float, integer: bool) -> tuple[float, float]:
    """Return the median of counts, and their robust standard deviation without the noise."""
    middle = _median(counts)
    spread = math.sqrt(2) * estimate_noise(np.full_like(counts, middle), counts, integer)
    return middle, math.sqrt(max(0.0, spread**2 - noise**2) + noise**2 / counts.size)


def _median(counts: ArrayLike) -> float:
    return float(np.nanmedian(np.asarray(counts, np.float64)))


class LevelUncertainty(Step):
    """Add to the standard deviation of heights what uncertain levels of dark and light do.

    A level that is wrong by the share u of the rise to light moves the crossing by u times the travel in
    which the pixel turns light. This is the slope g, and more if the lens blurs or the skin touches slowly,
    which a grid of pixels shows. Levels of pixels scatter by `dark_sigma` and `bright_sigma`. They may also
    have changed: the darkness of the first frames and the light of the last ones are compared with the
    references, at pixels that turn light much later or earlier.
    """

    needs = ("height", "height_sigma")

    dark_sigma: float = option(
        default=0.0,
        unit="counts",
        within=(0, None),
        help="standard deviation of the pixels' own dark levels about `dark`",
        python_only=True,
    )
    bright_sigma: float = option(
        default=0.0,
        unit="counts",
        within=(0, None),
        help="standard deviation of the pixels' own bright levels about `bright`",
        python_only=True,
    )

    def apply(self, result: Result, context: Context) -> Result:
        """Return heights with larger standard deviations, and a note if levels changed."""
        operation = cast("PressOperation", context.operation)
        dark, bright, samples = operation.dark, operation.bright, context.samples
        if dark is None or bright is None:
            return result
        fraction, threshold = 0.0, operation.lowest_threshold
        if self.dark_sigma or self.bright_sigma:
            scatter = math.hypot((1 - threshold) * self.dark_sigma, threshold * self.bright_sigma)
            rise = np.asarray(bright, np.float64) - np.asarray(dark, np.float64)
            fraction = scatter / float(np.nanmedian(rise))
        if samples is not None:
            trace = _PixelTraces.of(samples, context.positions("travel"), dark, bright, operation.shape)
            height, *beside = context.neighbours(result)
            errors = _find_errors(trace, -height.astype(np.float64))
            fraction = math.hypot(fraction, *(error / math.sqrt(2) for error in errors))
            if any(errors):
                changes = " and ".join(
                    f"{name} by {100 * error:+.2g} %"
                    for name, error in zip(("dark", "light"), errors, strict=True)
                    if error
                )
                text = (
                    f"levels differ from their references, {changes} of the rise; height_sigma includes this"
                )
                result = with_findings(result, Finding("levels", text, False))
        if not fraction:
            return result
        width = 0.0 if samples is None else _width(trace, _rise(*beside))
        return result.assign(height_sigma=partial(_with_levels, result, fraction, width))


class _PixelTraces(NamedTuple):
    """What a grid of pixels shows from the least travel on, and their levels."""

    values: NDArray[Any]  # (T, rows, columns)
    travel: Doubles
    dark: NDArray[np.float32]
    bright: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        samples: FrameSamples,
        travel: Doubles,
        dark: ArrayLike,
        bright: ArrayLike,
        shape: tuple[int, ...],
    ) -> _PixelTraces:
        """Return the samples of a press or a release."""
        low, high = (
            samples.of_map(np.broadcast_to(np.asarray(level, np.float32), shape)) for level in (dark, bright)
        )
        forward = slice(None, None, -1 if travel[-1] < travel[0] else 1)
        return cls(samples.values[forward], travel[forward], low, high)


def _find_errors(trace: _PixelTraces, onset: Doubles) -> tuple[float, float]:
    """Return by how much dark and light differ from the references, in shares of the rise; 0 if hardly."""
    values, travel, low, high = trace
    few, start, end = max(1, round(_END_FRACTION * len(travel))), float(travel.min()), float(travel.max())
    away = _MIN_DISTANCE * (end - start)
    level_errors = []
    for frames, level, usable in (
        (values[:few], low, onset > start + away),
        (values[-few:], high, onset < end - away),
    ):
        error = ((frames.mean(axis=0) - level) / (high - low))[usable]
        error = error[np.isfinite(error)]
        if error.size < _MIN_GRID_PIXELS:
            level_errors.append(0.0)
            continue
        middle = float(np.median(error))
        spread = mad_sigma(error - middle)
        clear = max(
            _MIN_DIFFERENCE,
            _COMMON_Z_SCORE * spread,
            _CLEAR_Z_SCORE * _OF_MEDIAN * spread / math.sqrt(error.size),
        )
        level_errors.append(middle if abs(middle) > clear else 0.0)
    return level_errors[0], level_errors[1]


def _width(trace: _PixelTraces, slope: NDArray[np.float32]) -> float:
    """Return the travel in which the flattest pixels turn light in addition to their slopes, mm."""
    values, travel, low, high = trace
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = ((values - low) / (high - low)).reshape(len(travel), -1)
    width = 2 * (first_travel(shares, travel, 0.75) - first_travel(shares, travel, 0.25))
    slope = slope.ravel()
    finite = np.isfinite(width) & np.isfinite(slope)
    if np.count_nonzero(finite) < _MIN_GRID_PIXELS:
        return 0.0
    width, slope = width[finite], slope[finite]
    flat = slope <= np.quantile(slope, _FLAT_QUANTILE)
    return math.sqrt(max(0.0, float(np.median(width[flat] ** 2 - slope[flat] ** 2))))


def _with_levels(result: Result, fraction: float, width: float) -> NDArray[np.float32]:
    """Return the standard deviations of heights with that of levels, a share of the rise to light."""
    height = np.pad(np.asarray(result.height, np.float32), 1, "edge")
    moved = _rise(height[1:-1, :-2], height[1:-1, 2:], height[:-2, 1:-1], height[2:, 1:-1])
    finite = np.isfinite(moved)  # not at the border of the contact
    moved[~finite] = median(moved[finite]) if finite.any() else 0
    np.hypot(moved, np.float32(width), out=moved)
    moved *= np.float32(fraction)
    return np.asarray(np.hypot(result.height_sigma, moved))


def _rise(
    before: NDArray[Any], after: NDArray[Any], above: NDArray[Any], below: NDArray[Any]
) -> NDArray[np.float32]:
    """Return by how much heights change over a pixel, from those next to it."""
    rise: NDArray[np.float32] = np.abs(after - before)
    rise += np.abs(below - above)
    rise /= 2
    return rise
