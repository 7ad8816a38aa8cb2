"""Levels of dark and light: estimated from the frames, and what their uncertainty does to heights."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.frames import estimate_noise, thinned
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.io import Block, Result, Source
from mirrorskin.io.base.findings import Finding, with_findings

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
