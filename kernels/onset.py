"""Onset of the light state: what ``onset.cl`` computes, in plain NumPy with float64 inside.

A pixel is light in a frame when its sample is at least its light level. Its onset is the first frame of
the first run of light frames that lasts for `hold` frames, or until the stack ends. The scan goes through
a stack block by block and keeps, per pixel, the start of the present or the decided run and the samples
around it; the heights follow from those.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

DARK = -1
INVALID = -2


def onset_scan(
    frames: NDArray[Any],
    first: int,
    hold: int,
    tolerance: float,
    level: NDArray[np.float32],
    light: NDArray[Any],
    onset: NDArray[np.int32],
    below: NDArray[np.int32],
    last: NDArray[Any],
    before: NDArray[Any],
    at: NDArray[Any],
    after: NDArray[Any],
) -> None:
    """Go through a block of frames; the maps are the state, changed in place.

    Parameters
    ----------
    frames : ndarray, (n, P), uint8, uint16 or float32
        Samples; the kernel is told ``n`` and ``P`` after it.
    first : int
        Number of the block's first frame in the stack.
    hold : int
        Light frames in a row that make an onset.
    tolerance : float
        Counts by which a sample must miss the level to be surely dark.
    level : ndarray, (P,), float32
        Counts at which a pixel turns light.
    light : ndarray, (P,), as frames
        Smallest sample that is light.
    onset : ndarray, (P,), int32
        Frame at which the run began; ``DARK`` without one, ``INVALID`` after a sample that is no number.
    below : ndarray, (P,), int32
        Last frame before the run that was surely dark; the first frame is taken for dark.
    last : ndarray, (P,), as frames
        The sample before the block.
    before, at, after : ndarray, (P,), as frames
        Samples one before and at the onset, and the lesser of the two that follow it.
    """
    for number, frame in enumerate(frames, start=first):
        undecided = (onset == DARK) | ((onset >= 0) & (number - onset < hold))
        is_light = frame >= light

        begins = undecided & is_light & (onset == DARK)
        onset[begins] = number
        before[begins] = last[begins]
        at[begins] = frame[begins]
        onset[undecided & ~is_light] = DARK
        if number > 0:
            below[undecided & ~is_light & (frame <= level - np.float32(tolerance))] = number
        onset[undecided & ~np.isfinite(frame)] = INVALID

        next_to = onset == number - 1
        after[next_to] = frame[next_to]
        # A bright spike is no plateau: of two samples the lesser is the safer one.
        second = (onset == number - 2) & (onset >= 0)
        after[second] = np.fmin(after[second], frame[second])
        last[:] = frame


def onset_heights(
    onset: NDArray[np.int32],
    below: NDArray[np.int32],
    before: NDArray[Any],
    at: NDArray[Any],
    after: NDArray[Any],
    level: NDArray[np.float32],
    dark: NDArray[np.float32],
    travel: NDArray[np.float64],
    dark_tolerance: float,
    light_tolerance: float,
    noise: float,
    subframe: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8]]:
    """Turn onsets into heights.

    The crossing lies between the frame before the onset and the onset. Where both samples sit on the
    pixel's plateaus, nothing is known but that interval: its middle is the unbiased guess, and its
    half-width over sqrt(3) the standard deviation. Elsewhere the samples tell where the level was
    crossed, as well as the noise allows if the change was under way in both of them; a sample on a plateau
    does not tell when the change began or ended, so with one of them there the interval's share is added.
    A pixel may also hover about its level and cross it when noise says so: its step is within the noise, or
    it was near the level for longer than its step would take. It may have crossed at any time since the last
    frame in which it was surely dark.
    Without `subframe` the height is that of the paper's equation 4, at the onset itself, which is wrong by
    half a step on average.

    Parameters
    ----------
    onset, below, before, at, after : ndarray, (P,)
        As ``onset_scan`` leaves them; the kernel is told ``P`` and the number of frames before them.
    level : ndarray, (P,), float32
        Counts at which a pixel turns light.
    dark : ndarray, (P,), float32
        Counts of the dark plateau.
    travel : ndarray, (T,), float64
        Millimetres, one a frame; the kernel takes each as the sum of two floats.
    dark_tolerance, light_tolerance : float
        Counts by which a sample on a plateau may differ from it.
    noise : float
        Standard deviation of a sample, counts.
    subframe : bool
        Whether to look inside the interval.

    Returns
    -------
    height, sigma : ndarray, (P,), float64
        Millimetres, NaN where there is no onset.
    status : ndarray, (P,), uint8
        0 invalid input, 1 onset, 2 never light, 3 light at start.
    """
    status = np.select([onset == INVALID, onset == DARK, onset == 0], [0, 2, 3], 1).astype(np.uint8)
    height = np.full(onset.shape, np.nan)
    sigma = np.full(onset.shape, np.nan)
    found = status == 1
    start = onset[found]
    low, high = before[found].astype(np.float64), at[found].astype(np.float64)
    settled = np.where(start + 1 < len(travel), after[found], high)
    width = travel[start] - travel[start - 1]

    from_dark, to_light = low <= dark[found] + dark_tolerance, high >= settled - light_tolerance
    sudden, under_way = from_dark & to_light, ~(from_dark | to_light)

    step = high - low
    crossed = (np.minimum(level[found], high) - low) / step
    known = width * noise * np.hypot(crossed, 1 - crossed) / step
    hovered = (step <= light_tolerance) | ((start - 2 - below[found]) * step > 2.5 * light_tolerance)
    guessed = np.where(hovered, travel[start] - travel[below[found]], width) / 2 / np.sqrt(3)
    share = np.where(sudden, 0.5, crossed) if subframe else np.ones_like(width)
    spread = np.select([sudden | hovered, under_way], [guessed, known], np.hypot(known, guessed))

    height[found] = -(travel[start - 1] + width * share)
    sigma[found] = spread if subframe else 2 * guessed
    return height, sigma, status
