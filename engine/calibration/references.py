"""Dark and bright references from recordings, with their errors, and defective pixels."""

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
from mirrorskin.engine.calibration.sources import check_one_camera, read_blocks
from mirrorskin.io import Block, InputError, References, Source
from mirrorskin.io.base.types import Floats
from mirrorskin.io.model.calibration import DEAD, HOT, SATURATED
from mirrorskin.io.watch.saturation import scale_top
from mirrorskin.kernels.numerics.least_squares import mad_sigma

_CHUNK = 8_000_000  # bytes of float64 samples that are processed at a time
_MEMORY = 256_000_000  # bytes of frames of a rolled ball that are kept in memory
_UNSTEADY = 0.1  # noise above which the light is unsteady, as a share of full light
_MOST_HOT = 0.05  # maximum share of hot pixels

# Limits of `find_defects`; "full light" is bright minus dark of the picture's brighter pixels.
_WINDOW = 5  # side of the neighbourhood, pixels
_FAR = 7.0  # standard deviations: minimum excess of a hot pixel's dark level, and of a live pixel's light
_GLOW = 0.05  # minimum excess of a hot pixel over its neighbours, as a share of full light
_GLARE = 0.5  # dark level above which a pixel is hot in any case, as a share of full light
_UNREST = 16.0  # ratio of variances (four times the noise) above which a pixel is hot
_WEAK = 0.5  # minimum light of a live pixel, as a share of its neighbours' light
_BLIND = 0.1  # minimum light of a live pixel, as a share of full light
_BRIGHTER = 90.0  # percentile of light that represents the picture's brighter pixels
_FULL = 0.1  # share of clipped samples of a saturated pixel


@dataclass(frozen=True, slots=True)
class LevelReport:
    """Quality of a measured level, counts; noise and sigma are medians over pixels."""

    frames: int  # number of frames of all recordings
    noise: float  # standard deviation of a sample
    sigma: float  # standard error of the reference
    rounding: float  # part of the standard error that more frames do not reduce
    drift: float  # mean of the second half of the frames minus that of the first; NaN for a rolled ball
    clipped: int  # pixels with samples at the end of the camera's scale, whose mean was corrected

    def missing(self, noise: float) -> int | None:
        """Return the number of further frames for a standard error, counts; None if it cannot be reached."""
        if self.sigma <= noise:
            return 0
        if noise <= self.rounding:
            return None
        more = (self.sigma**2 - self.rounding**2) / (noise**2 - self.rounding**2)
        return math.ceil(self.frames * more) - self.frames


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """References, and the quality of their levels."""

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

    Parameters
    ----------
    dark : sequence of Source
        Recordings of the sheet without contact.
    bright : sequence of Source
        Recordings of full light.
    rolled : bool
        Whether the bright recordings show a ball that is rolled over the sheet, so that each pixel is in full
        light in some frames only. They are then read once per 256 MB.
    progress : callable, optional
        Called with the number of frames so far.

    Raises
    ------
    mirrorskin.io.InputError
        The frames are from different cameras or too few, the light is unsteady, or bright frames are not
        brighter than dark ones.
    """
    check_one_camera([*dark, *bright])
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
    values = [np.where(sound, level, np.nan).astype(np.float32) for level in maps]
    return Measured(
        References(values[0], values[1], values[2], values[3], defects),
        _report(low, unlit.frames, drift, sound, unlit.integer),
        _report(high, frames, shift, sound, unlit.integer),
    )


def find_defects(dark: Level, bright: Level, freedom: int, integer: bool) -> NDArray[np.uint8]:
    """Return the defect bits of each pixel: a sum of 1 hot, 2 dead, 4 saturated.

    A pixel is compared with the median of the 5 x 5 pixels around it, so vignetting, uneven gains and a
    gradient of the dark level are not defects.

    - *hot*: the dark level exceeds the neighbours' by more than seven standard deviations of such differences
      (estimated from their median) and by more than 5 % of full light; or it exceeds half of full light; or
      the noise of dark samples is four times the usual noise (``freedom``: degrees of freedom of the
      variance).
    - *dead*: the response to light is less than half of the neighbours', less than a tenth of the response of
      the picture's brighter pixels, or less than the noise; or there are no samples.
    - *saturated*: at least a tenth of the samples in full light are at the top of the camera's scale.
    """
    span = bright.value - dark.value
    light = _full_span(span)
    above = dark.value - _neighbourhood(dark.value)
    finite = above[np.isfinite(above)]
    usual = mad_sigma(finite)
    middle = float(np.nanmedian(dark.value)) if finite.size else 0.0
    glows = (above > max(_FAR * usual, _GLOW * light)) | (dark.value > middle + _GLARE * light)
    # With almost no noise, samples that alternate between two integers have a far larger variance.
    restless = dark.excess > max(_UNREST, rare_ratio(max(freedom, 1)))
    restless &= (dark.excess * dark.noise**2 > 1) | (not integer)
    noise = _FAR * np.sqrt(dark.sigma**2 + bright.sigma**2)
    alive = (span > np.maximum(noise, max(_BLIND * light, 0.0))) & (span >= _WEAK * _neighbourhood(span))
    bits = HOT * (glows | restless) + DEAD * ~alive + SATURATED * (bright.clipped >= _FULL)
    return np.asarray(bits, np.uint8)


def _full_span(span: Floats) -> float:
    """Return bright minus dark of the picture's brighter pixels, counts; 0 if unknown."""
    finite = span[np.isfinite(span)]
    return float(np.percentile(finite, _BRIGHTER)) if finite.size else 0.0


def _neighbourhood(values: Floats) -> Floats:
    """Return the median around each pixel; pixels without a value are replaced by the median of all."""
    from scipy.ndimage import median_filter

    finite = np.isfinite(values)
    filled = np.where(finite, values, np.median(values[finite]) if finite.any() else 0.0)
    return np.asarray(median_filter(filled.astype(np.float32), _WINDOW, mode="mirror"), np.float64)


class _Reader:
    """Reads sources block by block, and reports the number of frames."""

    def __init__(self, progress: Callable[[int], None] | None) -> None:
        self._progress, self._count = progress, 0

    def blocks(self, sources: Sequence[Source]) -> Iterator[Block]:
        for source in sources:
            for block in read_blocks(source):
                yield block
                self._count += len(block.frames)
                if self._progress is not None:
                    self._progress(self._count)

    def moments(self, sources: Sequence[Source]) -> tuple[Moments, float]:
        """Return the moments of all frames, and the mean of the last half minus that of the first."""
        moments, half = Moments(sources[0].shape[1:], sources[0].dtype), _length(sources) // 2
        early, count = np.zeros_like(moments.sum), np.zeros_like(moments.count)  # of the first half
        for block in self.blocks(sources):
            for frame in block.frames:
                if moments.frames == half:
                    early, count = moments.sum.copy(), moments.count.copy()
                moments.push(frame[np.newaxis])
        if not moments.frames:
            raise InputError(f"{sources[0].name} contains no frames: record some")
        with np.errstate(invalid="ignore"):
            change = (moments.sum - early) / (moments.count - count) - early / count
        # The interquartile mean is as robust as the median, and has a finer resolution.
        change = np.sort(change[np.isfinite(change)])
        middle = change[change.size // 4 : change.size - change.size // 4]
        return moments, float(middle.mean()) if middle.size else math.nan


def _length(sources: Sequence[Source]) -> int:
    return sum(source.shape[0] for source in sources)


def _scale_top_of(highest: Floats, integer: bool) -> float | None:
    finite = highest[np.isfinite(highest)]
    return scale_top(float(finite.max()), integer) if finite.size else None


def _rolled_level(sources: Sequence[Source], dark: Level, reader: _Reader) -> Level:
    """Find the plateau of each pixel, in bands of rows that fit into memory."""
    frames, (_, rows, columns), dtype = _length(sources), sources[0].shape, sources[0].dtype
    height = max(1, _MEMORY // max(1, frames * columns * dtype.itemsize))
    if height < rows and not all(source.rewindable for source in sources):
        raise InputError(f"{sources[0].name} cannot be read twice and is too large: record it first")
    maps = np.full((5, rows, columns), np.nan)
    for start in range(0, rows, height):
        band = slice(start, min(start + height, rows))
        samples, count = np.empty((frames, band.stop - band.start, columns), dtype), 0
        for block in reader.blocks(sources):
            part = block.frames[: frames - count, band]
            samples[count : count + len(part)] = part
            count += len(part)
        if count < FEWEST:
            raise InputError(
                f"{sources[0].name} contains {count} frames: roll the ball over the field in many more"
            )
        levels = _plateaus(samples[:count].reshape(count, -1), dark.value[band].ravel())
        maps[:, band] = levels.reshape(5, -1, columns)
    value, sigma, noise, clipped, highest = maps
    top = _scale_top_of(highest, dtype.kind == "u")
    return Level(value, sigma, noise, np.ones_like(value), np.where(highest == top, clipped, 0.0))


def _plateaus(samples: NDArray[Any], dark: Floats) -> Floats:
    """Return level, error, noise, share of the brightest sample, and that sample, (5, pixels)."""
    maps = np.empty((5, samples.shape[1]))
    chunk = max(1, _CHUNK // (8 * len(samples)))
    for start in range(0, samples.shape[1], chunk):
        part = slice(start, start + chunk)
        values = samples[:, part].astype(np.float64)
        values[~np.isfinite(values)] = np.nan
        plateau = find_plateau(values, dark[part], samples.dtype.kind == "u")
        highest = np.fmax.reduce(values, axis=0)
        at_highest = (values == highest).sum(axis=0) / np.maximum(plateau.count, 1)
        maps[:, part] = plateau.value, plateau.sigma, plateau.noise, at_highest, highest
    return maps


def _check_level(level: Level, moments: Moments, name: str) -> None:
    if moments.frames < 2:
        raise InputError(f"{name} contains 1 frame, which does not show its noise: take 2 or more")
    if not np.isfinite(level.sigma).any():
        raise InputError(f"{name} contains no pixel with two finite samples: take it again")


def _check_light(dark: Level, bright: Level, rolled: bool, dark_name: str, name: str) -> None:
    """Raise InputError if bright frames are not brighter, or levels are not steady."""
    light = _full_span(bright.value - dark.value)
    if not light > float(np.nanmedian(dark.sigma)) + _median(bright.sigma):
        raise InputError(f"{name} is no brighter than {dark_name}: are dark and bright frames exchanged?")
    remedies = [(dark, dark_name, "take it with the body lifted")]
    if not rolled:
        remedy = "take it in steady light, or give --rolled if a ball was rolled about"
        remedies.append((bright, name, remedy))
    for level, source, remedy in remedies:
        noise = _median(level.noise)
        if noise > _UNSTEADY * light:
            raise InputError(
                f"{source} is not of steady light: the noise of its samples is {noise:.3g} counts: {remedy}"
            )


def _check_defects(defects: NDArray[np.uint8], dark_name: str) -> None:
    hot = np.count_nonzero(defects & HOT) / defects.size
    if hot > _MOST_HOT:
        raise InputError(f"{dark_name} is not dark: {hot:.0%} are hot pixels: take it with the body lifted")
    if defects.all():
        raise InputError(f"{dark_name} and the bright frames leave no sound pixel: take them again")


def _report(level: Level, frames: int, drift: float, sound: Mask, integer: bool) -> LevelReport:
    noise = _median(level.noise[sound])
    rounding = math.sqrt(float(rounding_error(np.array(noise**2)))) if integer else 0.0
    clipped = int(np.count_nonzero(level.clipped[sound]))
    return LevelReport(frames, noise, _median(level.sigma[sound]), rounding, drift, clipped)


def _median(values: Floats) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.nan
