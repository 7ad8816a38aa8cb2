"""Numba: tiles of pixels on all cores, each frame by frame so that the inner loop becomes vector code."""

from __future__ import annotations

import functools
import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers import THREADS
from mirrorskin.bench.peers.onset.peer import Heights, Levels, Peer, References
from mirrorskin.bench.peers.onset.samples import PLATEAU, SURELY
from mirrorskin.bench.peers.onset.suspects import INVALID

_TILE = 16_384  # pixels
_COUNTABLE = 255  # frames that a byte counts

numba.set_num_threads(min(THREADS, numba.config.NUMBA_NUM_THREADS))


def first_light(frames: NDArray[Any], light: Levels, hold: int) -> NDArray[np.int32]:
    """See `Peer`."""
    onset = np.empty(frames.shape[1:], np.int32)
    each = light.ndim > 0
    scan = _scan(each, hold, frames.dtype.kind == "f")
    scan(_flat(frames), light.reshape(-1) if each else light[()], onset.reshape(-1))
    return onset


def heights(frames: NDArray[Any], travel: NDArray[np.float64], known: References, noise: float) -> Heights:
    """See `Peer`."""
    maps = Heights.empty(frames.shape[1:])
    run = _heights(frames.dtype.kind == "f")
    run(_flat(frames), travel, *(values.reshape(-1) for values in (*known, *maps)), noise)
    return maps


def _flat(frames: NDArray[Any]) -> NDArray[Any]:
    return frames.reshape(len(frames), -1)


@functools.cache
def _scan(each: bool, hold: int, floats: bool) -> Any:
    search = _search(each, hold, floats)

    def scan(frames, light, onset):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-len(onset) // _TILE)):
            first, end = tile * _TILE, min(len(onset), (tile + 1) * _TILE)
            search(frames, first, end, light[first:end] if each else light, onset[first:end])

    return numba.njit(parallel=True, error_model="numpy")(scan)


@functools.cache
def _heights(floats: bool) -> Any:
    search, answer = _search(True, 2, floats), numba.njit(_answer, error_model="numpy")

    def run(frames, travel, level, light, dark, height, sigma, status, noise):  # type: ignore[no-untyped-def]
        for tile in numba.prange(-(-len(status) // _TILE)):
            first, end = tile * _TILE, min(len(status), (tile + 1) * _TILE)
            onset = np.empty(end - first, np.int32)
            search(frames, first, end, light[first:end], onset)
            for p in range(first, end):
                start = onset[p - first]
                dead = np.isnan(level[p]) or start == INVALID
                status[p] = 0 if dead else 2 if start == -1 else 3 if start == 0 else 1
                if status[p] == 1:
                    height[p], sigma[p] = answer(frames, p, start, travel, level[p], light[p], dark[p], noise)
                else:
                    height[p], sigma[p] = np.nan, np.nan

    return numba.njit(parallel=True, error_model="numpy")(run)


@functools.cache
def _search(each: bool, hold: int, floats: bool) -> Any:
    """Make the search for the onsets of one tile.

    Parameters
    ----------
    each : bool
        Whether each pixel has a light level of its own.
    hold : int
        1 or 2.
    floats : bool
        Whether samples may be no numbers.
    """
    settle, carry = numba.njit(_settle), numba.njit(_carry)

    def search(frames, first, end, light, onset):  # type: ignore[no-untyped-def]
        count, pixels = len(frames), end - first
        undecided, few = np.ones(pixels, np.uint8), np.zeros(pixels, np.uint8)
        sums = np.zeros(pixels if floats else 0, np.float32)
        onset[:] = 0
        for t in range(count):
            # Cut from a whole row: of a part of all rows, Numba does not know that samples lie side by side.
            now, then = frames[t, first:end], frames[min(t + hold, count) - 1, first:end]
            for p in range(pixels):
                sample = now[p] if hold == 1 else min(now[p], then[p])
                open_ = undecided[p] & np.uint8(sample < (light[p] if each else light))
                undecided[p] = open_
                few[p] += open_
            if floats:
                for p in range(pixels):
                    sums[p] += now[p]
            if (t + 1) % _COUNTABLE == 0 or t + 1 == count:
                carry(few, onset)
        for p in range(pixels):
            if undecided[p]:
                onset[p] = -1
            if floats and not np.isfinite(sums[p]):
                onset[p] = settle(frames[:, first + p], light[p] if each else light, hold)

    return numba.njit(search)


def _carry(few, many):  # type: ignore[no-untyped-def]
    """Move counts from bytes to where there is room for more."""
    for p in range(len(few)):
        many[p] += few[p]
        few[p] = 0


def _settle(series, light, hold):  # type: ignore[no-untyped-def]
    """Find the onset of one pixel, or that a sample which is no number came before it was decided."""
    run = 0
    for t in range(len(series)):
        if not np.isfinite(series[t]):
            return INVALID
        run = run + 1 if series[t] >= light else 0
        if run == hold:
            return t + 1 - hold
    return len(series) - run if run else -1


def _answer(frames, pixel, start, travel, level, light, dark, noise):  # type: ignore[no-untyped-def]
    """Return height and sigma of one pixel with an onset."""
    surely = level - np.float32(SURELY * noise)
    below = start - 1
    while below > 0 and (frames[below, pixel] >= light or frames[below, pixel] > surely):
        below -= 1

    low, high = np.float64(frames[start - 1, pixel]), np.float64(frames[start, pixel])
    last = len(frames) - 1
    after = np.fmin(frames[min(start + 1, last), pixel], frames[min(start + 2, last), pixel])
    sudden_step = PLATEAU * noise * math.sqrt(2)
    from_dark, to_light = low <= dark + PLATEAU * noise, high >= after - sudden_step

    step = high - low
    share = (min(np.float64(level), high) - low) / step
    width = travel[start] - travel[start - 1]
    told = width * noise * math.sqrt(share * share + (1 - share) * (1 - share)) / step
    hovers = step <= sudden_step or (start - 2 - below) * step > 2.5 * sudden_step
    interval = (travel[start] - travel[below] if hovers else width) / math.sqrt(12)

    sudden = from_dark and to_light
    spread = math.sqrt(told * told + interval * interval) if from_dark or to_light else told
    height = -(travel[start - 1] + width * (0.5 if sudden else share))
    return height, interval if sudden or hovers else spread


PEER = Peer("Numba", first_light, heights)
