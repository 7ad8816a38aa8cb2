"""Dark and bright references from recordings, with their errors, and the pixels that are defective."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.calibration.levels import (
    FEWEST,
    Level,
    Mask,
    Moments,
    find_plateau,
    level_above,
    level_below,
    rare_ratio,
    rounding_error,
)
from mirrorskin.io import Block, InputError, References, Source
from mirrorskin.io.calibration.types import DEAD, HOT, SATURATED
from mirrorskin.io.types import Floats

_BLOCK = 8  # frames that are read at a time
_CHUNK = 8_000_000  # bytes of float64 samples that are processed together
_MEMORY = 256_000_000  # bytes of frames of a rolled ball that are held
_BITS = 8  # of a camera's scale, at least
_UNSTEADY = 0.1  # of full light: noise above that is changing light
_MOST_HOT = 0.05  # of the pixels

_WINDOW = 5  # pixels across and down of a neighbourhood
_MEDIAN = 0.6745  # median magnitude of a standard normal variate
_FAR = 7.0  # standard deviations
_GLOW = 0.05  # of full light: what a pixel may glow more than its neighbours, whatever its noise
_GLARE = 0.5  # of full light: what no sound pixel shows without light
_UNREST = 16.0  # usual variances: four times the usual noise
_WEAK = 0.5  # of the neighbours' light
_BLIND = 0.1  # of the light of the picture's brighter pixels
_BRIGHTER = 90.0  # percentile of light that stands for the picture's brighter pixels
_FULL = 0.1  # share of clipped samples of a saturated pixel


@dataclass(frozen=True, slots=True)
class LevelReport:
    """How well a level was measured, counts; noise and sigma are those of the median pixel."""

    frames: int  # of all recordings together
    noise: float  # standard deviation of a sample
    sigma: float  # standard error of the reference
    rounding: float  # the part of that which no number of frames averages out
    drift: float  # mean of the second half of the frames less that of the first; NaN for a rolled ball
    clipped: int  # pixels with samples on the end of the camera's scale, whose mean was corrected

    def missing(self, noise: float) -> int | None:
        """Return how many more frames a standard error of so many counts needs; None if no number does."""
        if self.sigma <= noise:
            return 0
        if noise <= self.rounding:
            return None
        more = (self.sigma**2 - self.rounding**2) / (noise**2 - self.rounding**2)
        return math.ceil(self.frames * more) - self.frames


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """References, and how well their levels were measured."""

    references: References
    dark: LevelReport
    bright: LevelReport


def measure_references(
    dark: Sequence[Source],
    bright: Sequence[Source],
    *,
    rolled: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Measured:
    """Measure the dark and bright references of a camera, their errors, and its defective pixels.

    ``dark`` frames are of a sheet that touches nothing, ``bright`` ones of full light, where ``rolled`` says
    that a ball was rolled about and each pixel is in full light in some of them only: they are then read once
    for every 256 MB. ``progress`` is called with the number of frames so far. InputError where the frames are
    of different cameras, too few, not of steady light, or not brighter than the dark ones.
    """
    _check_alike([*dark, *bright])
    reader = _Reader(progress)
    unlit, drift = reader.moments(dark)
    low = level_above(unlit, 0.0 if unlit.integer or unlit.lowest.min() == 0 else None)
    _check_level(low, unlit, dark[0].name)
    if rolled:
        high, frames, shift = _rolled_level(bright, low, reader), _length(bright), math.nan
    else:
        lit, shift = reader.moments(bright)
        high, frames = level_below(lit, _scale_top_of(lit.highest, lit.integer)), lit.frames
        _check_level(high, lit, bright[0].name)
    _check_light(low, high, rolled, dark[0].name, bright[0].name)
    defects = find_defects(low, high, int(np.median(unlit.count)) - 1, unlit.integer)
    _check_defects(defects, dark[0].name)
    sound = defects == 0
    maps = low.value, high.value, low.sigma, high.sigma
    values = [np.where(sound, one, np.nan).astype(np.float32) for one in maps]
    return Measured(
        References(values[0], values[1], values[2], values[3], defects),
        _report(low, unlit.frames, drift, sound, unlit.integer),
        _report(high, frames, shift, sound, unlit.integer),
    )


def find_defects(dark: Level, bright: Level, freedom: int, integer: bool) -> NDArray[np.uint8]:
    """Return the defect bits of each pixel: a sum of 1 hot, 2 dead, 4 saturated.

    Vignetting, uneven gains and a dark level that rises across the picture are no defects: a pixel is
    compared with the median of the 5 x 5 around it.

    - *hot*: its dark level is above theirs by more than seven standard deviations of such differences
      (from their median) and by more than 5 % of full light, or is above half of full light; or its dark
      samples scatter four times as much as usual (``freedom``: degrees of freedom of its variance).
    - *dead*: light makes less than half as much of it as of them, or less than a tenth of what it makes of
      the picture's brighter pixels, or no more than its noise; or it gave no numbers.
    - *saturated*: a tenth of its samples in full light lie on the top of the camera's scale.
    """
    span = bright.value - dark.value
    light = _full_span(span)
    above = dark.value - _neighbourhood(dark.value)
    known = above[np.isfinite(above)]
    usual = float(np.median(np.abs(known))) / _MEDIAN if known.size else 0.0
    middle = float(np.nanmedian(dark.value)) if known.size else 0.0
    glows = (above > max(_FAR * usual, _GLOW * light)) | (dark.value > middle + _GLARE * light)
    # Almost without noise, samples that jump between two integers scatter far more than usual ones.
    restless = dark.excess > max(_UNREST, rare_ratio(max(freedom, 1)))
    restless &= (dark.excess * dark.noise**2 > 1) | (not integer)
    noise = _FAR * np.sqrt(dark.sigma**2 + bright.sigma**2)
    alive = (span > np.maximum(noise, max(_BLIND * light, 0.0))) & (span >= _WEAK * _neighbourhood(span))
    bits = HOT * (glows | restless) + DEAD * ~alive + SATURATED * (bright.clipped >= _FULL)
    return np.asarray(bits, np.uint8)


def _full_span(span: Floats) -> float:
    """Return how many counts light makes in the picture's brighter pixels; 0 if unknown."""
    known = span[np.isfinite(span)]
    return float(np.percentile(known, _BRIGHTER)) if known.size else 0.0


def _neighbourhood(values: Floats) -> Floats:
    """Return the median around each pixel; pixels without a value count as the median of all."""
    from scipy.ndimage import median_filter

    known = values[np.isfinite(values)]
    filled = np.where(np.isfinite(values), values, np.median(known) if known.size else 0.0)
    return np.asarray(median_filter(filled.astype(np.float32), _WINDOW, mode="mirror"), np.float64)


class _Reader:
    """Reads sources block by block, and counts the frames."""

    def __init__(self, progress: Callable[[int], None] | None) -> None:
        self._progress, self._done = progress, 0

    def blocks(self, sources: Sequence[Source]) -> Iterator[Block]:
        for source in sources:
            if source.rewindable:
                source.rewind()
            room = np.empty((_BLOCK, *source.shape[1:]), source.dtype)
            while (block := source.read(room)) is not None:
                yield block
                self._done += len(block.frames)
                if self._progress is not None:
                    self._progress(self._done)

    def moments(self, sources: Sequence[Source]) -> tuple[Moments, float]:
        """Return the moments of all frames, and by how much the last half is above the first."""
        moments, half = Moments(sources[0].shape[1:], sources[0].dtype), _length(sources) // 2
        early, count = np.zeros_like(moments.sum), np.zeros_like(moments.count)  # of the first half
        for block in self.blocks(sources):
            for frame in block.frames:
                if moments.frames == half:
                    early, count = moments.sum.copy(), moments.count.copy()
                moments.push(frame[np.newaxis])
        if not moments.frames:
            raise InputError(f"{sources[0].name} holds no frames: take some")
        with np.errstate(invalid="ignore"):
            change = (moments.sum - early) / (moments.count - count) - early / count
        # The mean of the middle half is as robust as a median, and not as coarse.
        known = np.sort(change[np.isfinite(change)])
        middle = known[known.size // 4 : known.size - known.size // 4]
        return moments, float(middle.mean()) if middle.size else math.nan


def _length(sources: Sequence[Source]) -> int:
    return sum(source.shape[0] for source in sources)


def _scale_top_of(highest: Floats, integer: bool) -> float | None:
    known = highest[np.isfinite(highest)]
    return scale_top(float(known.max()), integer) if known.size else None


def scale_top(highest: float, integer: bool) -> float | None:
    """Return the greatest sample if it is the top of a camera's scale, else None.

    That is 1 of floats, or in binary eight ones or more and any number of zeros behind them, as of a camera
    of 12 bits in frames of 16.
    """
    if highest == 1 and not integer:
        return highest
    if highest < 2**_BITS - 1 or highest % 1 or highest >= 2**32:
        return None
    ones = int(highest) // (int(highest) & -int(highest))
    return highest if ones & (ones + 1) == 0 and ones >= 2**_BITS - 1 else None


def _rolled_level(sources: Sequence[Source], dark: Level, reader: _Reader) -> Level:
    """Find each pixel's plateau, in as many bands of rows as there is memory for."""
    frames, (_, rows, columns), dtype = _length(sources), sources[0].shape, sources[0].dtype
    height = max(1, _MEMORY // max(1, frames * columns * dtype.itemsize))
    if height < rows and not all(source.rewindable for source in sources):
        raise InputError(f"{sources[0].name} cannot be read twice and is too large: record it first")
    maps = np.full((5, rows, columns), np.nan)
    for start in range(0, rows, height):
        band = slice(start, min(start + height, rows))
        samples = _samples_of_rows(sources, band, frames, reader)
        maps[:, band] = _plateaus(samples, dark.value[band].ravel()).reshape(5, -1, columns)
    value, sigma, noise, clipped, highest = maps
    top = _scale_top_of(highest, dtype.kind == "u")
    return Level(value, sigma, noise, np.ones_like(value), np.where(highest == top, clipped, 0.0))


def _samples_of_rows(sources: Sequence[Source], band: slice, frames: int, reader: _Reader) -> NDArray[Any]:
    """Read the samples of some rows, (T, pixels)."""
    samples = np.empty((frames, band.stop - band.start, sources[0].shape[2]), sources[0].dtype)
    done = 0
    for block in reader.blocks(sources):
        kept = block.frames[: frames - done, band]
        samples[done : done + len(kept)] = kept
        done += len(kept)
    if done < FEWEST:
        raise InputError(f"{sources[0].name} holds {done} frames: roll the ball over the field in many more")
    return samples[:done].reshape(done, -1)


def _plateaus(samples: NDArray[Any], dark: Floats) -> Floats:
    """Return level, error, noise, share of the brightest sample, and that sample, (5, pixels)."""
    maps = np.empty((5, samples.shape[1]))
    together = max(1, _CHUNK // (8 * len(samples)))
    for start in range(0, samples.shape[1], together):
        part = slice(start, start + together)
        these = samples[:, part].astype(np.float64)
        these[~np.isfinite(these)] = np.nan
        found = find_plateau(these, dark[part], samples.dtype.kind == "u")
        highest = np.fmax.reduce(these, axis=0)
        share = (these == highest).sum(axis=0) / np.maximum(found.count, 1)
        maps[:, part] = found.value, found.sigma, found.noise, share, highest
    return maps


def _check_alike(sources: Sequence[Source]) -> None:
    first = sources[0]
    for other in sources[1:]:
        if other.shape[1:] != first.shape[1:] or other.dtype != first.dtype:
            sizes = [f"{one.shape[2]} x {one.shape[1]} {one.dtype.name}" for one in (first, other)]
            raise InputError(
                f"{other.name} is of {sizes[1]} and {first.name} of {sizes[0]}: take both with one camera"
            )


def _check_level(level: Level, moments: Moments, name: str) -> None:
    if moments.frames < 2:
        raise InputError(f"{name} holds 1 frame, which does not show its noise: take 2 or more")
    if not np.isfinite(level.sigma).any():
        raise InputError(f"{name} holds no pixel with two samples that are numbers: take it again")


def _check_light(dark: Level, bright: Level, rolled: bool, dark_name: str, name: str) -> None:
    """Refuse bright frames that are not brighter, and levels that are not steady."""
    light = _full_span(bright.value - dark.value)
    if not light > float(np.nanmedian(dark.sigma)) + _median(bright.sigma):
        raise InputError(f"{name} is no brighter than {dark_name}: are dark and bright frames exchanged?")
    for level, who, remedy in (
        (dark, dark_name, "take it with the body lifted"),
        (bright, name, "take it in steady light, or give --rolled if a ball was rolled about"),
    ):
        noise = _median(level.noise)
        if noise > _UNSTEADY * light and not (rolled and level is bright):
            raise InputError(
                f"{who} is not of steady light, as its samples scatter by {noise:.3g} counts: {remedy}"
            )


def _check_defects(defects: NDArray[np.uint8], dark_name: str) -> None:
    hot = np.count_nonzero(defects & HOT) / defects.size
    if hot > _MOST_HOT:
        raise InputError(
            f"{dark_name} has {hot:.0%} hot pixels: it is not dark; take it with the body lifted"
        )
    if defects.all():
        raise InputError(f"{dark_name} and the bright frames leave no sound pixel: take them again")


def _report(level: Level, frames: int, drift: float, sound: Mask, integer: bool) -> LevelReport:
    noise = _median(level.noise[sound])
    rounding = math.sqrt(float(rounding_error(np.array(noise**2)))) if integer else 0.0
    clipped = int(np.count_nonzero(level.clipped[sound]))
    return LevelReport(frames, noise, _median(level.sigma[sound]), rounding, drift, clipped)


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan
