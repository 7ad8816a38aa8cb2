"""Dark and bright references from recordings, with their errors, and the pixels that are defective."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from mirrorskin.engine.calibration.levels import (
    LEAST,
    Level,
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

_WINDOW = 5  # pixels across and down of a neighbourhood
_MEDIAN = 0.6745  # of the magnitude of a normal variate
_FAR = 7.0  # standard deviations
_GLOW = 0.05  # of full light: what a pixel may glow more than its neighbours, whatever its noise
_GLARE = 0.5  # of full light: what no sound pixel shows without light
_UNREST = 16.0  # usual variances: four times the usual noise
_WEAK = 0.5  # of the neighbours' light
_BLIND = 0.1  # of the light of the picture's brighter pixels
_BRIGHTER = 90.0  # per cent of the pixels that show less light than these
_FULL = 0.1  # of a pixel's samples that are clipped


def full_span(span: Floats) -> float:
    """Return how many counts light makes in the picture's brighter pixels; 0 if none is told."""
    known = span[np.isfinite(span)]
    return float(np.percentile(known, _BRIGHTER)) if known.size else 0.0


def find_defects(dark: Level, bright: Level, freedom: int, whole: bool) -> NDArray[np.uint8]:
    """Find the pixels that are of no use.

    Vignetting, uneven gains and a dark level that rises across the picture are no defects: what decides is
    how a pixel compares with the median of the 5 x 5 around it.

    - *hot*: its dark level is above theirs by more than seven standard deviations of such differences
      (told from their median) and by more than 5 % of full light, or is above half of full light; or
      its dark samples scatter four times as much as usual.
    - *dead*: light makes less than half as much of it as of them, or less than a tenth of what it makes of
      the picture's brighter pixels, or no more than its noise; or it gave no numbers.
    - *saturated*: a tenth of its samples in full light lie on the top of the camera's scale.

    Parameters
    ----------
    dark, bright : Level
    freedom : int
        Degrees of freedom of a pixel's own dark variance.
    whole : bool
        Whether samples are whole numbers; their rounding is no unrest.

    Returns
    -------
    ndarray, (H, W), uint8
        A sum of 1 hot, 2 dead, 4 saturated; 0 of a sound pixel.
    """
    span = bright.value - dark.value
    light = full_span(span)
    hot = _glows(dark.value, bright.value, light) | _is_restless(dark, freedom, whole)
    bits = HOT * hot + DEAD * _is_dead(span, light, dark, bright) + SATURATED * (bright.clipped >= _FULL)
    return np.asarray(bits, np.uint8)


def _glows(dark: Floats, bright: Floats, light: float) -> NDArray[np.bool_]:
    above = dark - _around(dark)
    known = above[np.isfinite(above)]
    usual = float(np.median(np.abs(known))) / _MEDIAN if known.size else 0.0
    middle = float(np.nanmedian(dark)) if known.size else 0.0
    return np.asarray((above > max(_FAR * usual, _GLOW * light)) | (dark > middle + _GLARE * light))


def _is_restless(dark: Level, freedom: int, whole: bool) -> NDArray[np.bool_]:
    usual = max(_UNREST, rare_ratio(max(freedom, 1)))
    # Almost without noise, samples that jump between two whole numbers scatter far more than usual ones.
    return np.asarray((dark.excess > usual) & ((dark.excess * dark.noise**2 > 1) | (not whole)))


def _is_dead(span: Floats, light: float, dark: Level, bright: Level) -> NDArray[np.bool_]:
    noise = _FAR * np.sqrt(dark.sigma**2 + bright.sigma**2)
    seen = span > np.maximum(noise, max(_BLIND * light, 0.0))
    return np.asarray(~(seen & (span >= _WEAK * _around(span))))


def _around(values: Floats) -> Floats:
    """Return the median of each pixel's neighbourhood; pixels without a value count as the median of all."""
    known = values[np.isfinite(values)]
    filled = np.where(np.isfinite(values), values, np.median(known) if known.size else 0.0)
    return np.asarray(median_filter(filled.astype(np.float32), _WINDOW, mode="mirror"), np.float64)


Progress = Callable[[int], None]

_ROOM = 8  # frames that are read at a time
_CHUNK = 8_000_000  # bytes of samples, as float64, that are looked at together
_MEMORY = 256_000_000
_BITS = 8  # of a camera's scale, at least
_UNSTEADY = 0.1  # of full light: noise that is none
_LIGHT = 0.05  # of the pixels that may be hot


@dataclass(frozen=True, slots=True)
class LevelReport:
    """How well a level was taken.

    Attributes
    ----------
    frames : int
        Of all recordings together.
    noise : float
        Standard deviation of a sample, counts; of the median pixel.
    sigma : float
        Standard error of the reference, counts; of the median pixel.
    rounding : float
        The part of it that no number of frames averages out, counts.
    drift : float
        By how much the frames' last half is above the first half, counts; of the middle half of the
        pixels. NaN where pixels are in full light only now and then.
    clipped : int
        Pixels of which samples lie on the end of the camera's scale, so that their mean had to be corrected.
    """

    frames: int
    noise: float
    sigma: float
    rounding: float
    drift: float
    clipped: int

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
    """References, and how well they were taken.

    Attributes
    ----------
    references : References
    dark, bright : LevelReport
    """

    references: References
    dark: LevelReport
    bright: LevelReport


def take_references(
    dark: Source | Sequence[Source], bright: Source | Sequence[Source], *, rolled: bool = False
) -> References:
    """Take the references of a camera; see ``measure_references``."""
    return measure_references(dark, bright, rolled=rolled).references


def measure_references(
    dark: Source | Sequence[Source],
    bright: Source | Sequence[Source],
    *,
    rolled: bool = False,
    progress: Progress | None = None,
) -> Measured:
    """Take the references of a camera, and tell how well.

    Parameters
    ----------
    dark : Source or sequence of Source
        Frames of a sheet that touches nothing.
    bright : Source or sequence of Source
        Frames in full light.
    rolled : bool
        Whether each pixel is in full light in some of the bright frames only, as a ball was rolled about.
        The frames are then read as often as they do not fit into 256 MB.
    progress : callable, optional
        Told the number of frames so far.

    Returns
    -------
    Measured

    Raises
    ------
    InputError
        The frames are of different cameras, too few, not of steady light, or not brighter than the dark ones.
    """
    darks, brights = _listed(dark), _listed(bright)
    _check_alike([*darks, *brights])
    count = _Count(progress)
    unlit, drift = _take_in(darks, count)
    low = level_above(unlit, _floor(unlit))
    _check_level(low, unlit, darks[0].name)
    if rolled:
        high, frames, shift = _rolled(brights, low, count), _length(brights), math.nan
    else:
        lit, shift = _take_in(brights, count)
        high, frames = level_below(lit, _top(lit)), lit.frames
        _check_level(high, lit, brights[0].name)
    _check_light(low, high, rolled, darks[0].name, brights[0].name)
    defects = find_defects(low, high, int(np.median(unlit.count)) - 1, unlit.whole)
    _check_defects(defects, darks[0].name)
    return Measured(
        _references(low, high, defects),
        _report(low, unlit.frames, drift, defects, unlit.whole),
        _report(high, frames, shift, defects, unlit.whole),
    )


def _listed(sources: Source | Sequence[Source]) -> list[Source]:
    return list(sources) if isinstance(sources, Sequence) else [sources]


def _length(sources: Sequence[Source]) -> int:
    return sum(source.shape[0] for source in sources)


def _check_alike(sources: Sequence[Source]) -> None:
    """Refuse frames of different cameras."""
    first = sources[0]
    for other in sources[1:]:
        if other.shape[1:] != first.shape[1:] or other.dtype != first.dtype:
            sizes = [f"{one.shape[2]} x {one.shape[1]} {one.dtype.name}" for one in (first, other)]
            raise InputError(
                f"{other.name} is of {sizes[1]} and {first.name} of {sizes[0]}: take both with one camera"
            )


class _Count:
    """Counts the frames that were read."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress, self._done = progress, 0

    def add(self, frames: int) -> None:
        self._done += frames
        if self._progress is not None:
            self._progress(self._done)


def _blocks(sources: Sequence[Source], count: _Count) -> Iterator[Block]:
    for source in sources:
        if source.rewindable:
            source.rewind()
        room = np.empty((_ROOM, *source.shape[1:]), source.dtype)
        while (block := source.read(room)) is not None:
            yield block
            count.add(len(block.frames))


def _take_in(sources: Sequence[Source], count: _Count) -> tuple[Moments, float]:
    """Return the moments of all frames, and by how much the last half is above the first."""
    first, last = (Moments(sources[0].shape[1:], sources[0].dtype) for _ in range(2))
    half, done = _length(sources) // 2, 0
    for block in _blocks(sources, count):
        early = min(max(half - done, 0), len(block.frames))
        first.push(block.frames[:early])
        last.push(block.frames[early:])
        done += len(block.frames)
    change = last.mean - first.mean
    known = change[np.isfinite(change)]
    first.join(last)
    if not first.frames:
        raise InputError(f"{sources[0].name} holds no frames: take some")
    return first, _midmean(known)


def _floor(moments: Moments) -> float | None:
    """Return the count below which there is none: 0, unless samples are floats below it."""
    return 0.0 if moments.whole or moments.lowest.min() == 0 else None


def _top(moments: Moments) -> float | None:
    """Return the top of the camera's scale if samples lie there.

    It is the greatest sample if that is 1 of floats, or if in binary it is eight ones or more and any number
    of zeros behind them, as of a camera of 12 bits in frames of 16.
    """
    known = moments.highest[np.isfinite(moments.highest)]
    return scale_top(float(known.max()), moments.whole) if known.size else None


def scale_top(highest: float, whole: bool) -> float | None:
    """Return the greatest sample if it is the top of a camera's scale, else None."""
    if highest == 1 and not whole:
        return highest
    if highest < 2**_BITS - 1 or highest % 1 or highest >= 2**32:
        return None
    ones = int(highest) // (int(highest) & -int(highest))
    return highest if ones & (ones + 1) == 0 and ones >= 2**_BITS - 1 else None


def _rolled(sources: Sequence[Source], dark: Level, count: _Count) -> Level:
    """Find each pixel's plateau, in as many bands of rows as there is memory for."""
    frames, (_, rows, columns), dtype = _length(sources), sources[0].shape, sources[0].dtype
    height = max(1, _MEMORY // max(1, frames * columns * dtype.itemsize))
    if height < rows and not all(source.rewindable for source in sources):
        raise InputError(f"{sources[0].name} cannot be read twice and is too large: record it first")
    value, sigma, noise, clipped, highest = (np.full((rows, columns), np.nan) for _ in range(5))
    for start in range(0, rows, height):
        band = slice(start, min(start + height, rows))
        samples = _gather(sources, band, frames, count)
        maps = [one[band].reshape(-1) for one in (value, sigma, noise, clipped, highest)]
        _find_plateaus(samples, dark.value[band].reshape(-1), maps)
    known = highest[np.isfinite(highest)]
    top = scale_top(float(known.max()), dtype.kind == "u") if known.size else None
    return Level(value, sigma, noise, np.ones_like(value), np.where(highest == top, clipped, 0.0))


def _gather(sources: Sequence[Source], band: slice, frames: int, count: _Count) -> NDArray[Any]:
    """Read the samples of some rows, (T, pixels)."""
    rows, columns = band.stop - band.start, sources[0].shape[2]
    samples = np.empty((frames, rows, columns), sources[0].dtype)
    done = 0
    for block in _blocks(sources, count):
        kept = block.frames[: frames - done, band]
        samples[done : done + len(kept)] = kept
        done += len(kept)
    if done < LEAST:
        raise InputError(f"{sources[0].name} holds {done} frames: roll the ball over the field in many more")
    return samples[:done].reshape(done, -1)


def _find_plateaus(samples: NDArray[Any], dark: Floats, maps: Sequence[Floats]) -> None:
    """Write level, error, noise, the brightest sample and its share of those in full light, of each pixel."""
    value, sigma, noise, clipped, highest = maps
    whole = samples.dtype.kind == "u"
    together = max(1, _CHUNK // (8 * len(samples)))
    for start in range(0, samples.shape[1], together):
        part = slice(start, start + together)
        these = samples[:, part].astype(np.float64)
        these[~np.isfinite(these)] = np.nan
        found = find_plateau(these, dark[part], whole)
        value[part], sigma[part], noise[part] = found.value, found.sigma, found.noise
        highest[part] = np.fmax.reduce(these, axis=0)
        clipped[part] = (these == highest[part]).sum(axis=0) / np.maximum(found.count, 1)


def _check_level(level: Level, moments: Moments, name: str) -> None:
    if moments.frames < 2:
        raise InputError(f"{name} holds 1 frame, which does not tell its noise: take 2 or more")
    if not np.isfinite(level.sigma).any():
        raise InputError(f"{name} holds no pixel with two samples that are numbers: take it again")


def _check_light(dark: Level, bright: Level, rolled: bool, dark_name: str, name: str) -> None:
    """Refuse bright frames that are not brighter, and levels that are not steady."""
    light = full_span(bright.value - dark.value)
    error = float(np.nanmedian(dark.sigma)) + _median(bright.sigma)
    if not light > error:
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
    if hot > _LIGHT:
        raise InputError(
            f"{dark_name} has {hot:.0%} hot pixels: it is not dark; take it with the body lifted"
        )
    if defects.all():
        raise InputError(f"{dark_name} and the bright frames leave no sound pixel: take them again")


def _report(level: Level, frames: int, drift: float, defects: NDArray[np.uint8], whole: bool) -> LevelReport:
    sound = defects == 0
    noise = _median(level.noise[sound])
    rounding = math.sqrt(float(rounding_error(np.array(noise**2)))) if whole else 0.0
    clipped = int(np.count_nonzero(level.clipped[sound]))
    return LevelReport(frames, noise, _median(level.sigma[sound]), rounding, drift, clipped)


def _references(dark: Level, bright: Level, defects: NDArray[np.uint8]) -> References:
    def sound(values: Floats) -> NDArray[np.float32]:
        return np.where(defects == 0, values, np.nan).astype(np.float32)

    maps = sound(dark.value), sound(bright.value), sound(dark.sigma), sound(bright.sigma)
    return References(*maps, defects=defects)


def _midmean(values: Floats) -> float:
    """Return the mean of the middle half, which is as robust as a median and not as coarse."""
    middle = np.sort(values)[values.size // 4 : values.size - values.size // 4]
    return float(middle.mean()) if middle.size else math.nan


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan
