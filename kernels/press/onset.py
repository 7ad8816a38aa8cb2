"""Onset of the light state: ``onset.cl`` in plain NumPy with float64.

A pixel is light in a frame if its sample is at least its light level. Its onset is the first frame of the
first run of light frames that lasts for `hold` frames, or until the stack ends. The scan processes a stack
block by block and keeps, per pixel, the start of the current or the confirmed run and the samples around it;
the heights are computed from those. The kernel does both at once: it computes a pixel as soon as no further
frame can change its result.

The end of the light state is the onset of the dark one: the same with complemented samples and levels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

DARK = -1
INVALID = -2
BENT = 1.5
"""Coefficient of the normal quantile of a share v + 1/2: v + BENT v^3, within a tenth from 0.1 to 0.9."""
NEAR_PLATEAU = 0.06
"""Share of a step within which light of neighbours may move a sample off its plateau."""
_CLEAR_RISE = 34  # standard deviations: a quarter of it is 8.5, which noise does not reach


def complement(samples: Array) -> Array:
    """Return complemented samples: the distance to the type's largest number, or the negative of a float."""
    return -samples if samples.dtype.kind == "f" else ~samples


def onset_levels(
    bright: Array, dark: Array, threshold: float, dtype: np.dtype[Any], release: bool = False
) -> tuple[Array, Array, Array]:
    """Return level, plateau and light for a share of the range from dark to bright, counts.

    ``level`` is the smallest float32 that reaches the threshold, NaN where bright is not above dark;
    ``plateau`` the counts without light; ``light`` the smallest light sample; saturated samples are always
    light. For a release all are complemented: the plateau is that with light, and ``light`` the smallest
    complemented sample that is not light.
    """
    low, high = dark.astype(np.float64), bright.astype(np.float64)
    with np.errstate(invalid="ignore"):
        usable = (high > low) & np.isfinite(high) & np.isfinite(low)
        exact = np.where(usable, low + threshold * (high - low), np.nan)
    level = exact.astype(np.float32)
    level = np.where(level < exact, np.nextafter(level, np.float32(np.inf)), level)
    if dtype.kind == "f":
        if release:
            return -level, -bright, np.nextafter(-level, np.float32(np.inf))
        return level, dark, level
    top = np.iinfo(dtype).max
    light = np.ceil(np.nan_to_num(level, nan=top)).clip(0, top).astype(dtype)
    if release:
        level = np.where(light > 0, np.float32(top) - level, np.float32(np.nan))
        return level, np.float32(top) - bright, complement(light) + dtype.type(1)
    return level, dark, light


def onset_sure(level: Array, light: Array, tolerance: float) -> Array:
    """Return the smallest samples, (P,), that are within the tolerance, counts, of the level.

    Samples below them are certainly dark. They are never above `light`, and equal to `light` if the level is
    beyond the range of the type.
    """
    sure = np.nan_to_num(level) - np.float32(tolerance)
    if light.dtype.kind == "f":
        return np.asarray(np.minimum(np.nextafter(sure, np.float32(np.inf)), light))
    top = np.iinfo(light.dtype).max
    above = np.where(level < 0, light, np.floor(sure + 1.0).clip(0, top))
    return np.asarray(np.minimum(above, light), light.dtype)


def onset_near(level: Array, dark: Array, dark_limit: Array) -> Array:
    """Return the smallest samples, (P,), within a quarter of the range from dark to the level.

    They are never above `dark_limit`, and equal to `dark_limit` where nothing is that far below the level.
    """
    level = level.astype(np.float32)
    below = np.float32(0.25) * (level - dark)
    near = np.nan_to_num(level - np.maximum(below, np.float32(0)), nan=np.inf)
    if dark_limit.dtype.kind == "f":
        return np.asarray(np.minimum(near, dark_limit))
    top = np.iinfo(dark_limit.dtype).max
    return np.asarray(np.minimum(np.ceil(near).clip(0, top), dark_limit), dark_limit.dtype)


def onset_scan(frames: Array, first: int, hold: int, light: Array, dark_limit: Array, near_limit: Array,
               onset: Array, last_dark: Array, last_far: Array, first_rise: Array, last: Array,
               before: Array, at: Array, after: Array) -> None:  # fmt: skip
    """Process a block of frames; the maps are the state, updated in place.

    Parameters
    ----------
    frames : (n, P), uint8, uint16 or float32
    first : number of the block's first frame in the stack
    hold : number of consecutive light frames that confirm an onset
    light, dark_limit, near_limit : (P,), smallest samples that are light, not certainly dark, near the level
    onset : (P,), first frame of the run; ``DARK`` without a run, ``INVALID`` after a NaN sample, for which
        the kernel stores ``DARK`` and that no frame is left
    last_dark : (P,), last certainly dark frame before the run; the first frame counts as dark. The
        kernel stores it only where it is not the last frame before the run
    last_far : (P,), last frame before the run that was not near the level, stored like ``last_dark``
    first_rise : (P,), the sample after it
    last : (P,), last sample of the preceding block
    before, at, after : (P,), samples before and at the onset, and the smaller one of the next two
    """
    for number, frame in enumerate(frames, start=first):
        undecided = (onset == DARK) | ((onset >= 0) & (number - onset < hold))
        is_light = frame >= light

        begins = undecided & is_light & (onset == DARK)
        onset[begins] = number
        before[begins] = last[begins]
        at[begins] = frame[begins]
        onset[undecided & ~is_light] = DARK
        after_far = undecided & (last_far == number - 1)
        first_rise[after_far] = frame[after_far]
        if number > 0:
            last_dark[undecided & (frame < dark_limit)] = number
            last_far[undecided & (frame < near_limit)] = number
        onset[undecided & ~np.isfinite(frame)] = INVALID

        next_to = onset == number - 1
        after[next_to] = frame[next_to]
        # A bright spike is not a plateau, so the smaller of two samples is used.
        second = (onset == number - 2) & (onset >= 0)
        after[second] = np.fmin(after[second], frame[second])
        last[:] = frame


def onset_heights(onset: Array, last_dark: Array, last_far: Array, first_rise: Array, before: Array,
                  at: Array, after: Array, level: Array, dark: Array, threshold: float,
                  travel: NDArray[np.float64], noise: float, dark_tolerance: float, light_tolerance: float,
                  subframe: bool) -> tuple[NDArray[np.float64], NDArray[np.float64], Array]:  # fmt: skip
    """Return heights, standard deviations (mm) and status for onsets.

    The crossing is between the frame before the onset and the onset. If both samples are on the pixel's
    plateaus, only that interval is known: its middle is the unbiased estimate, and its half-width over
    sqrt(3) the standard deviation. If both are in transition, they determine the crossing as accurately as
    the noise allows. If one of them is in transition, linear interpolation assumes the longest edge that
    leaves the other one on its plateau. An edge is more likely to be sampled the longer it is. Its length is
    then two thirds of the longest, and the error of the crossing has the mean square 1/6 of the square of the
    distance from the sample in transition.

    A sample is on its plateau within the tolerance, but also within the share ``NEAR_PLATEAU`` of the step,
    because neighbours contribute light. From there to twice as much, the weight of that case falls from 1 to
    0, so that heights and standard deviations are continuous.

    Brightness rises linearly where a slope crosses a pixel, and like the integral of a normal distribution
    behind a lens that blurs: the difference of the two crossings is added to the standard deviation of a
    sample in transition.

    A pixel may also hover about its level, so that noise determines the crossing: its step is within the
    noise, or it stays near the level for longer than its step takes. The crossing may then be anywhere since
    the last frame in which the pixel was certainly dark. There is one exception: if a pixel rises to its
    light plateau in one step, and the plateau is so near the level that noise delays the onset, the crossing
    is in that step.

    Without `subframe` the height is that of the paper's equation 4, at the onset itself, whose error is half
    a step on average and up to a whole one.

    Parameters
    ----------
    onset, last_dark, last_far, first_rise, before, at, after : results of ``onset_scan``
    level, dark : (P,), counts at which a pixel turns light, and of the dark plateau
    threshold : level, as a share of the range from the dark to the light plateau
    travel : (T,), mm, per frame
    noise : standard deviation of a sample, counts
    dark_tolerance, light_tolerance : largest difference of a sample on a plateau from the plateau, counts
    """
    status = np.select([onset == INVALID, onset == DARK, onset == 0], [0, 2, 3], 1).astype(np.uint8)
    height = np.full(onset.shape, np.nan)
    sigma = np.full(onset.shape, np.nan)
    has_onset = status == 1
    start = onset[has_onset]
    width = travel[start] - travel[start - 1]
    if not subframe:
        height[has_onset], sigma[has_onset] = -travel[start], np.abs(width) / np.sqrt(3)
        return height, sigma, status

    low, high = before[has_onset].astype(np.float64), at[has_onset].astype(np.float64)
    settled = np.where(start + 1 < len(travel), after[has_onset], high)
    step = high - low
    rise = level[has_onset] - dark[has_onset]
    jumped = (
        (last_far[has_onset] + 1 < start)
        & (first_rise[has_onset] >= settled - rise / 8)
        & (rise >= _CLEAR_RISE * noise)
    )
    from_dark, to_light = (
        np.clip(2 - away / np.maximum(tolerance, NEAR_PLATEAU * step), 0, 1)
        for away, tolerance in ((low - dark[has_onset], dark_tolerance), (settled - high, light_tolerance))
    )
    sudden = np.where(jumped, 1, from_dark * to_light)
    end = np.where(jumped, last_far[has_onset] + 1, start)
    width = travel[end] - travel[end - 1]

    crossed = (np.clip(level[has_onset], low, high) - low) / step
    rest = 1 - crossed
    per_count = np.divide(threshold, rise, out=np.zeros_like(low), where=rise > 0)
    first, second = ((part - dark[has_onset]) * per_count - 0.5 for part in (low, high))
    middle, both = threshold - 0.5, first**2 + first * second + second**2
    # Minus the crossing of the quantile z(v) = v + BENT v^3: (z(middle) - z(first)) / (z(second) - z(first)).
    off = crossed * BENT * (middle - second) * (middle + first + second) / (1 + BENT * both)
    from_edge = (noise / step) ** 2 * (crossed**2 + rest**2) + off**2
    from_shape = (from_dark * (1 - to_light) * rest**2 + to_light * (1 - from_dark) * crossed**2) / 6
    variance = width**2 * ((1 - sudden) * from_edge + np.where(jumped, 0, from_shape) + sudden / 12)
    hovered = (step <= light_tolerance) | ((start - 2 - last_dark[has_onset]) * step > 2.5 * light_tolerance)
    hovered &= ~jumped
    unclear = travel[start] - travel[last_dark[has_onset]]
    height[has_onset] = -(travel[end - 1] + width * (crossed + sudden * (0.5 - crossed)))
    sigma[has_onset] = np.where(hovered, np.abs(unclear) / np.sqrt(12), np.sqrt(variance))
    return height, sigma, status
