"""OpenCV: stripes of rows, each by one thread; operations in place and on bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers import THREADS
from mirrorskin.bench.peers.onset.peer import Heights, Levels, Peer, References
from mirrorskin.bench.peers.onset.samples import heights_of
from mirrorskin.bench.peers.onset.suspects import settle_suspects

_SEARCHED = 1_200_000  # pixels of a stripe at most, where onsets are all that is wanted
_ANSWERED = 200_000  # where heights are, which take more memory a pixel
_COUNTABLE = 255  # frames that a byte counts

_pool = ThreadPoolExecutor(THREADS)


def first_light(frames: NDArray[Any], light: Levels, hold: int) -> NDArray[np.int32]:
    """See `Peer`."""
    onset = np.empty(frames.shape[1:], np.int32)

    def fill(rows: slice) -> None:
        onset[rows] = _onset(frames[:, rows], light[rows] if light.ndim else light, hold)

    _in_stripes(frames, _SEARCHED, fill)
    return onset


def heights(frames: NDArray[Any], travel: NDArray[np.float64], known: References, noise: float) -> Heights:
    """See `Peer`."""
    maps = Heights.empty(frames.shape[1:])

    def fill(rows: slice) -> None:
        part, references = frames[:, rows], known.of(rows)
        onset = _onset(part, references.light, 2)
        maps.put(rows, heights_of(part, onset, travel, references, noise))

    _in_stripes(frames, _ANSWERED, fill)
    return maps


def _in_stripes(frames: NDArray[Any], most: int, fill: Callable[[slice], None]) -> None:
    """Fill all rows in equal stripes of at most so many pixels, as many for each thread."""
    stripes = THREADS * -(-frames[0].size // (THREADS * most))
    count = -(-frames.shape[1] // stripes)
    list(_pool.map(fill, (slice(row, row + count) for row in range(0, frames.shape[1], count))))


def _onset(frames: NDArray[Any], light: Levels, hold: int) -> NDArray[np.int32]:
    """Count the frames that leave a pixel undecided: that is the number of its onset."""
    shape = frames.shape[1:]
    undecided, few, many = np.ones(shape, np.uint8), np.zeros(shape, np.uint8), np.zeros(shape, np.int32)
    sums = np.zeros(shape, np.float32)
    for number, (frame, dark) in enumerate(zip(frames, _dark(frames, light, hold), strict=True), start=1):
        cv2.bitwise_and(undecided, dark, dst=undecided)
        cv2.add(few, undecided, dst=few)
        if number % _COUNTABLE == 0 or number == len(frames):
            many += few
            few[:] = 0
        if frame.dtype.kind == "f":
            cv2.add(sums, frame, dst=sums)
    many[undecided != 0] = -1
    if frames.dtype.kind == "f":
        settle_suspects(frames, light, hold, ~np.isfinite(sums), many)
    return many


def _dark(frames: NDArray[Any], light: Levels, hold: int) -> Iterator[NDArray[np.uint8]]:
    """Yield for each frame 255 where no run of `hold` light frames begins, in a mask that is used again."""
    level: Any = light if light.ndim else float(light)
    dark, after = np.empty(frames.shape[1:], np.uint8), np.empty(frames.shape[1:], np.uint8)
    cv2.compare(frames[0], level, cv2.CMP_LT, dst=dark)
    for frame in frames[1:]:
        cv2.compare(frame, level, cv2.CMP_LT, dst=after)
        if hold == 2:
            cv2.bitwise_or(dark, after, dst=dark)
        yield dark
        dark, after = after, dark
    yield dark


PEER = Peer("OpenCV", first_light, heights)
