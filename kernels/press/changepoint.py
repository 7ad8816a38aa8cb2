"""The change-point of a pixel's brightness: ``changepoint.cl`` in plain NumPy.

Brightness changes from a dark to a light level once, suddenly or along a ramp. If both levels are known,
`changepoint_scan` finds the change in one pass (Page, Biometrika 41, 1954). Otherwise `changepoint_sum` and
`changepoint_split` find it in two (Hinkley, Biometrika 57, 1970). Both keep the samples around the change,
from which `changepoint_heights` computes the crossing of the level.

A change from light to dark is the same with a negative gain: dark and light are exchanged, and shares are
relative to the range from light to dark.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.press.onset import BENT

Array = NDArray[Any]
Floats = NDArray[np.float64]

INVALID = -2
DECIDED = np.iinfo(np.int32).max

REACH = 12  # frames that are kept before and after the change
SLOTS = 2 * REACH + 1
UNIT = 1 << 20  # unit of the scan: one fully light frame
STEP = 1 << 12  # unit of the heights: the range from dark to bright

STRAIGHT = 0.005  # share of that range to which no transition is a straight ramp
SPIKE = 8  # a sample that exceeds both neighbours by this many sigmas is a spike
DOUBT = 2  # tolerated misfit of the best hypothesis, in times of the expected one
SPREAD = 0.3  # standard deviation of a pixel's own levels about the given ones, as a share of that range
PLATEAU = 3  # sigmas within which a sample is on a level
SAME_TIME = 1e-4  # frames; a crossing that close to a sample is at the sample
# prior odds of one frame in transition and of a ramp, relative to a sudden change
SINGLE, RAMP = 1 / 3, 1 / 5


def changepoint_scan(frames: Array, first: int, level: int, min_excess: int, quiet: np.float32, dark: Array,
                     gain: Array, start: Array, excess: Array, below: Array,
                     ring: Array) -> None:  # fmt: skip
    """Search a block of frames for a change between known levels; the maps are updated in place.

    This is Page's cumulative sum: the excess over the level is accumulated and clipped at zero. The most
    likely change is after the last frame in which the sum was zero. Sums are integers, so the result does not
    depend on the length of the stack or on the rounding of a device.

    Parameters
    ----------
    frames : (n, P), uint8, uint16 or float32
    first : number of the block's first frame in the stack
    level : units, of ``UNIT`` from dark to bright, at which a pixel is light
    min_excess : excess, in units, that confirms a change; an excess for ``REACH`` frames confirms it as well
    quiet : counts^2; times gain^2, it is the excess caused by noise
    dark, gain : (P,), counts without light, and 1 / (counts from dark to bright). For a release: counts with
        full light, and 1 / (counts from bright to dark), which is negative
    start : (P,), first frame after the change; ``INVALID`` after a NaN sample
    excess : (P,), accumulated excess, units; ``DECIDED`` once the change is confirmed
    below : (P,), last frame whose sample was closer to dark than to the level
    ring : (SLOTS, P), ring buffer of the samples around the change; frame t is in slot t % ``SLOTS``
    """
    alarm = np.maximum(min_excess, excess_of_noise(quiet, gain))
    for number, frame in enumerate(frames, start=first):
        excess[start == INVALID] = DECIDED
        undecided = excess != DECIDED
        fraction = np.clip(_fraction(frame, dark, gain), 0, 1)
        units = np.rint(np.nan_to_num(fraction) * np.float32(UNIT)).astype(np.int64)
        grown = np.maximum(excess + units - level, 0)
        start[undecided & (grown == 0)] = number + 1
        below[undecided & (2 * units < level)] = number
        certain = (grown >= alarm) | ((grown > 0) & (number - start >= REACH))
        excess[undecided] = np.where(certain & (number > 0), DECIDED, grown)[undecided]

        taken = number - start <= REACH
        ring[number % SLOTS, taken] = frame[taken]
        start[taken & ~np.isfinite(frame)] = INVALID


def changepoint_sum(frames: Array, total: Floats) -> None:
    """Add a block of frames to totals, which the kernel stores as sums of two floats."""
    for frame in frames:
        total += frame


def changepoint_split(frames: Array, first: int, mean: Floats, weight: Array, total: Floats, start: Array,
                      since: Array, score: Array, ring: Array) -> None:  # fmt: skip
    """Search a block of frames for a change between unknown levels; the maps are updated in place.

    Splitting T frames into k and T - k explains D^2 T / (k (T - k)) of the sum of squared deviations, with D
    the sum of the first k deviations from the mean. The k that explains most is the most likely change. D
    must be negative (the second level is higher), or positive for a release.

    Parameters
    ----------
    frames, first, ring : as of ``changepoint_scan``
    mean : (P,), mean of all frames, counts; the kernel stores it and ``total`` as sums of two floats
    weight : (T + 1,), 1 / sqrt(k (T - k)) for each k, negative for a release; 0 at both ends
    total : (P,), sum of the deviations so far, counts
    start : (P,), first frame after the best split so far
    since : (P,), frame from which on the ring buffer is complete
    score : (P,), -D times the weight for the best split
    """
    for number, frame in enumerate(frames, start=first):
        total += frame - mean
        explained = -total.astype(np.float32) * weight[number + 1]
        better = explained > score
        since[better & (number - start > REACH)] = number
        start[better] = number + 1
        score[better] = explained[better]
        taken = number - start <= REACH
        ring[number % SLOTS, taken] = frame[taken]


def changepoint_heights(start: Array, excess: Array, below: Array, since: Array, dark: Array, gain: Array,
                        ring: Array, travel: Floats, noise: float, quiet: np.float32, level: float,
                        own_levels: bool) -> tuple[Floats, Floats, Array]:  # fmt: skip
    """Return heights, standard deviations (mm) and status, from the samples around the changes.

    A hypothesis divides these samples into three groups: on the dark level, in transition, and on the light
    level. The levels may differ from the given ones. The samples in transition are on a straight line, which
    meets both levels between the adjacent samples. A hypothesis determines the crossing of the level and the
    likelihood of the samples. The result is the posterior mean and standard deviation over all hypotheses
    (the Bayes estimate, which minimises the mean square error).

    A lens blurs the edge, so the transition is not a straight line. If the samples on both sides of the
    crossing are in transition, the squared distance to the crossing of a blurred edge is added to the
    variance. If the samples do not rise significantly, as at a pixel that hovers about its level, noise
    determines the crossing: the change may be anywhere since the last frame closer to dark.

    Parameters
    ----------
    start, excess, below, since, dark, gain, ring : results of the passes above
    travel : (T,), mm, per frame; the kernel takes each as the sum of two floats
    noise : standard deviation of a sample, counts
    quiet : as of ``changepoint_scan``
    level : the level to be crossed, as a share of the range from dark to bright
    own_levels : whether the share refers to the pixel's own levels instead of the given ones
    """
    never = excess <= excess_of_noise(quiet, gain)
    status = np.select([start == INVALID, never, start == 0], [0, 2, 3], 1).astype(np.uint8)
    height, sigma = np.full((2, start.size), np.nan)
    changed = np.flatnonzero(status == 1)
    if changed.size:
        spread = np.maximum(noise * np.abs(gain[changed].astype(np.float64)), STRAIGHT)
        values, available = _gather(
            start[changed], since[changed], ring[:, changed], dark[changed], gain[changed], len(travel)
        )
        samples = _add_up(_without_spikes(values, available, np.rint(SPIKE * spread * STEP)), available)
        dim = start[changed] - below[changed]
        hovered = (dim > REACH) & _flat(samples, spread)
        crossing, deviation, misfit = _weigh(samples, spread, level, own_levels)
        # Samples that no hypothesis fits are noisier than stated, or change in another way.
        blur = _variance_of_blur(samples, spread, level, crossing)
        odd = misfit > DOUBT * samples.freedom
        spread = np.where(odd, spread * np.sqrt(misfit / samples.freedom), spread)
        again = _weigh(samples, spread, level, own_levels)
        deviation = np.where(odd, np.hypot(again[1], again[0] - crossing), deviation)
        deviation = np.hypot(deviation, np.sqrt(blur))
        crossing, deviation = np.where(hovered, (-dim / 2, dim / np.sqrt(12)), (crossing, deviation))
        crossing = np.clip(crossing + start[changed], 0, len(travel) - 1)
        height[changed] = -_travel_at(travel, crossing)
        late, early = (_travel_at(travel, crossing + side * deviation) for side in (1, -1))
        sigma[changed] = np.abs(late - early) / 2
    return height, sigma, status


def excess_of_noise(quiet: np.float32, gain: Array) -> Array:
    """Return the excess caused by noise, in units; inlined in the kernel."""
    excess = np.minimum(quiet * gain * gain, np.float32(1000))
    return np.asarray(np.rint(excess * np.float32(UNIT)), np.int32)


@dataclass(frozen=True)
class _Samples:
    """Samples around each change: running sums, (SLOTS + 1, P), and the available range, [low, high)."""

    low: Array
    high: Array
    values: Floats
    moments: Floats
    squares: Floats

    @property
    def freedom(self) -> Array:
        """Number of samples minus the number of parameters of a ramp."""
        return np.asarray(np.maximum(self.high - self.low - 4, 1), np.intp)

    def total(self, start: Array | int, stop: Array | int) -> tuple[Floats, Floats]:
        """Return the sums of the values and of their squares over the slots from start to stop."""
        every = np.arange(self.low.size)
        values, squares = (part[stop, every] - part[start, every] for part in (self.values, self.squares))
        return values, squares


@dataclass(frozen=True)
class _Levels:
    """Each pixel's own levels, the level to be crossed, and its variance."""

    dark: Floats
    light: Floats
    crossed: Floats
    variance: Floats


def _fraction(frame: Array, dark: Array, gain: Array) -> Array:
    """Return the share of the range from dark to bright; a saturated sample is light."""
    fraction = (frame.astype(np.float32) - dark) * gain
    if frame.dtype.kind == "f":
        return fraction
    light = np.where(gain < 0, np.minimum(fraction, np.float32(0)), np.maximum(fraction, np.float32(1)))
    return np.where(frame == np.iinfo(frame.dtype).max, light, fraction)


def _gather(
    start: Array, since: Array, ring: Array, dark: Array, gain: Array, count: int
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the samples around each change, (SLOTS, P), in integer steps, and which are available."""
    number = start + np.arange(-REACH, REACH + 1)[:, np.newaxis]
    available = (number >= since) & (number < count) & (number >= 0)
    fraction = np.clip(_fraction(np.take_along_axis(ring, number % SLOTS, 0), dark, gain), -1, 2)
    return np.where(available, np.rint(fraction * np.float32(STEP)), 0.0), available


def _without_spikes(values: Floats, available: NDArray[np.bool_], limit: Floats) -> Floats:
    """Replace a sample that exceeds both of its neighbours by the nearer one."""
    calm = values.copy()
    inner = available[:-2] & available[2:]
    sides = np.stack([values[:-2], values[2:]])
    low, high = sides.min(axis=0), sides.max(axis=0)
    middle = values[1:-1]
    calm[1:-1] = np.where(inner & (middle > high + limit), high, middle)
    calm[1:-1] = np.where(inner & (middle < low - limit), low, calm[1:-1])
    return calm


def _add_up(values: Floats, available: NDArray[np.bool_]) -> _Samples:
    place = np.arange(-REACH, REACH + 1)[:, np.newaxis]
    fractions = values / STEP
    low = np.argmax(available, axis=0)
    sums = (np.cumsum(part, axis=0) for part in (fractions, place * fractions, fractions**2))
    return _Samples(low, low + np.sum(available, axis=0), *(np.pad(part, ((1, 0), (0, 0))) for part in sums))


def _flat(samples: _Samples, noise: Floats) -> NDArray[np.bool_]:
    """Return where the samples do not rise significantly at the change."""
    before, after = REACH - samples.low, samples.high - REACH
    dark = samples.total(samples.low, REACH)[0] / before
    light = samples.total(REACH, samples.high)[0] / after
    return np.asarray(light - dark < 6 * noise * np.sqrt(1 / before + 1 / after))


def _hypotheses(
    samples: _Samples, noise: Floats, level: float, own_levels: bool
) -> Iterator[tuple[Floats, Floats, Floats, Floats]]:
    """Yield misfit, prior, crossing in frames from the start, and its variance of each hypothesis."""
    for length in range(SLOTS + 1):
        for begin in range(SLOTS - length + 1):
            yield _hypothesis(samples, noise, level, own_levels, begin, length)


def _hypothesis(
    samples: _Samples, noise: Floats, level: float, own_levels: bool, begin: int, length: int
) -> tuple[Floats, Floats, Floats, Floats]:
    end = begin + length
    before, after = begin - samples.low, samples.high - end
    fits = (before >= 0) & (after >= 0)
    if length < 2:
        fits &= (before > 0) & (after > 0)
    slack = np.where(fits, (noise / SPREAD) ** 2, 1e9)
    low_sum, low_square = samples.total(samples.low, begin)
    high_sum, high_square = samples.total(end, samples.high)
    lack = after - high_sum
    dark, light = low_sum / (before + slack), 1 - lack / (after + slack)
    misfit = low_square - low_sum * dark + high_square - after + 2 * lack - lack * (1 - light)

    levels = _Levels(dark, light, np.full_like(dark, level), np.zeros_like(dark))
    if own_levels:
        level_variance = noise**2 * ((1 - level) ** 2 / (before + slack) + level**2 / (after + slack))
        levels = _Levels(dark, light, dark + level * (light - dark), level_variance)
    if length == 0:
        shape = np.ones_like(noise)
        missed, prior, crossing, variance = 0 * shape, shape, (begin - REACH - 0.5) * shape, shape / 12
    elif length == 1:
        missed, prior, crossing, variance = _single(samples, begin, levels, noise)
    else:
        missed, prior, crossing, variance = _ramp(samples, begin, length, levels, noise)
    return np.where(fits, misfit + missed, np.inf), prior, crossing, variance


def _single(
    samples: _Samples, begin: int, levels: _Levels, noise: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """One sample in transition between samples on the levels: the length of the ramp is not determined.

    It lasts at most 1 / max(fraction, 1 - fraction) frames, otherwise a neighbour would be in transition,
    too. Longer ramps are more likely to be sampled: the mean length is two thirds of that, with a variance of
    an eighteenth.
    """
    above = samples.total(begin, begin + 1)[0] - levels.dark
    rise = np.maximum(levels.light - levels.dark, 0.1)
    fraction = np.clip(above / rise, 0, 1)
    longest = 1 / np.maximum(fraction, 1 - fraction)
    shift = longest * ((levels.crossed - levels.dark) / rise - fraction)
    variance = (2 / 3 * longest * noise / rise) ** 2 + shift**2 / 18
    prior = SINGLE * np.sqrt(2 * np.pi) * noise
    return (above - fraction * rise) ** 2, prior, begin - REACH + 2 / 3 * shift, variance


def _ramp(
    samples: _Samples, begin: int, length: int, levels: _Levels, noise: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Fit a straight line to the samples in transition.

    It should meet the levels at its ends; deviations there are added to the misfit. The crossing is on the
    line.
    """
    first, last = begin - REACH, begin - REACH + length - 1
    middle, spread = (first + last) / 2, length * (length**2 - 1) / 12
    value, square = samples.total(begin, begin + length)
    moment = samples.moments[begin + length] - samples.moments[begin]
    slope = (moment - middle * value) / spread
    rises = slope > 1e-3
    duration = 1 / np.where(rises, slope, 1)
    crossing, leaves, arrives = (
        middle + (part - value / length) * duration for part in (levels.crossed, levels.dark, levels.light)
    )
    early = np.where(begin > samples.low, first - 1 - leaves, 0)
    late = np.where(begin + length < samples.high, arrives - last - 1, 0)
    away = np.maximum(np.maximum(early, leaves - first), 0)
    back = np.maximum(np.maximum(late, last - arrives), 0)

    missed = np.maximum(square - value**2 / length - slope**2 * spread, 0) + (away**2 + back**2) / duration**2
    prior = RAMP * 2 * np.pi * noise**2 * np.sqrt(12) * duration / length
    reach = (length + 1) / 2
    off = np.clip(crossing - middle, -reach, reach)
    variance = duration**2 * (noise**2 * (1 / length + off**2 / spread) + levels.variance)
    return np.where(rises, missed, np.inf), prior, middle + off, np.minimum(variance, reach**2 / 3)


def _variance_of_blur(samples: _Samples, noise: Floats, level: float, crossing: Floats) -> Floats:
    """Return the variance of the crossing of an edge blurred by a lens, in excess of the noise."""
    # If a sample is at the crossing, the level determines whether it is the earlier or the later one.
    nearest = np.rint(crossing).astype(np.intp)
    at = np.clip(nearest + REACH, samples.low, samples.high - 1)
    later = samples.total(at, at + 1)[0] >= level
    frame = np.where(np.abs(crossing - nearest) < SAME_TIME, nearest - later, np.floor(crossing)).astype(
        np.intp
    )
    slot = np.clip(frame + REACH, samples.low, samples.high - 2)
    low, high = (samples.total(slot + side, slot + side + 1)[0] for side in (0, 1))
    under_way = (slot == frame + REACH) & (low < level) & (high >= level)
    under_way &= (low >= PLATEAU * noise) & (high <= 1 - PLATEAU * noise)
    rise = np.where(under_way, high - low, 1)
    first, second, middle, fraction = low - 0.5, high - 0.5, level - 0.5, (level - low) / rise
    both = first**2 + first * second + second**2
    # The quantile of a share is proportional to v + BENT v^3, with v = share - 1/2.
    bent = fraction * (1 + BENT * (middle**2 + middle * first + first**2)) / (1 + BENT * both)
    variance = (frame + bent - crossing) ** 2 - (noise / rise) ** 2 * (fraction**2 + (1 - fraction) ** 2)
    return np.where(under_way, np.maximum(variance, 0), 0)


def _travel_at(travel: Floats, frame: Floats) -> Floats:
    """Return the travel between frames, extrapolated beyond the ends."""
    before = np.clip(np.floor(frame).astype(np.intp), 0, len(travel) - 2)
    return np.asarray(travel[before] + (frame - before) * (travel[before + 1] - travel[before]))


def _weigh(samples: _Samples, noise: Floats, level: float, own_levels: bool) -> tuple[Floats, Floats, Floats]:
    """Return mean and standard deviation over all hypotheses, and the least misfit, squared sigmas."""
    answers = zip(*_hypotheses(samples, noise, level, own_levels), strict=True)
    misfit, prior, crossing, variance = (np.array(part) for part in answers)
    misfit /= noise**2
    best = misfit.min(axis=0)
    weight = prior * np.exp((best - misfit) / 2)
    weight /= weight.sum(axis=0)
    mean = np.sum(weight * crossing, axis=0)
    spread = np.sum(weight * (variance + (crossing - mean) ** 2), axis=0)
    return mean, np.sqrt(spread), best
