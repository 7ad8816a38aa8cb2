"""NumPy: a few rows at a time, which stay in the cache; frame by frame, one pass over bytes an operation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers.onset.peer import Heights, Levels, Peer, References
from mirrorskin.bench.peers.onset.samples import heights_of
from mirrorskin.bench.peers.onset.suspects import settle_suspects

_PIXELS = 262_144  # of a tile; more leave the cache, fewer pay more for each call
_COUNTABLE = 255  # frames that a byte counts


def first_light(frames: NDArray[Any], light: Levels, hold: int) -> NDArray[np.int32]:
    """See `Peer`."""
    onset = np.empty(frames.shape[1:], np.int32)
    for rows in _tiles(frames):
        onset[rows] = _onset(frames[:, rows], light[rows] if light.ndim else light, hold)
    return onset


def heights(frames: NDArray[Any], travel: NDArray[np.float64], known: References, noise: float) -> Heights:
    """See `Peer`."""
    maps = Heights.empty(frames.shape[1:])
    for rows in _tiles(frames):
        part, references = frames[:, rows], known.of(rows)
        onset = _onset(part, references.light, 2)
        maps.put(rows, heights_of(part, onset, travel, references, noise))
    return maps


def _tiles(frames: NDArray[Any]) -> list[slice]:
    count = max(1, _PIXELS // frames.shape[2])
    return [slice(row, row + count) for row in range(0, frames.shape[1], count)]


def _onset(frames: NDArray[Any], light: Levels, hold: int) -> NDArray[np.int32]:
    """Count the frames that leave a pixel undecided: that is the number of its onset."""
    shape = frames.shape[1:]
    undecided, few, many = np.ones(shape, bool), np.zeros(shape, np.uint8), np.zeros(shape, np.int32)
    sums = np.zeros(shape, np.float32)
    for number, (frame, dark) in enumerate(zip(frames, _dark(frames, light, hold), strict=True), start=1):
        np.logical_and(undecided, dark, out=undecided)
        np.add(few, undecided.view(np.uint8), out=few)
        if number % _COUNTABLE == 0 or number == len(frames):
            many += few
            few[:] = 0
        if frame.dtype.kind == "f":
            with np.errstate(invalid="ignore", over="ignore"):
                np.add(sums, frame, out=sums)
    many[undecided] = -1
    if frames.dtype.kind == "f":
        settle_suspects(frames, light, hold, ~np.isfinite(sums), many)
    return many


def _dark(frames: NDArray[Any], light: Levels, hold: int) -> Iterator[NDArray[np.bool_]]:
    """Yield for each frame where no run of `hold` light frames begins, in a mask that is used again."""
    dark, after = np.empty(frames.shape[1:], bool), np.empty(frames.shape[1:], bool)
    np.less(frames[0], light, out=dark)
    for frame in frames[1:]:
        np.less(frame, light, out=after)
        if hold == 2:
            np.logical_or(dark, after, out=dark)
        yield dark
        dark, after = after, dark
    yield dark


PEER = Peer("NumPy", first_light, heights)
