"""With h5py and Numba: the same loop with a kernel; and all frames read at once and searched in tiles."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401  the filters that it brings
import numba
import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers.onset.numba_ import first_light
from mirrorskin.bench.peers.onset.peer import Floats

_TRAVEL = "/entry/instrument/stage/travel"


def reconstruct(path: Path, dataset: str, dark: Floats, bright: Floats, target: Path) -> Floats:
    """See `Lab`: in each frame, all pixels on all cores."""
    look, level = _look(), _level(dark, bright)
    with h5py.File(path) as file:
        stack, travel = file[dataset], file[_TRAVEL][()]
        frame, was_light = np.empty(stack.shape[1:], stack.dtype), np.zeros(level.shape, bool)
        onset = np.full(level.shape, -1, np.int32)
        for number in range(len(stack)):
            stack.read_direct(frame, np.s_[number])
            look(frame.reshape(-1), level.reshape(-1), number, was_light.reshape(-1), onset.reshape(-1))
    onset[(onset < 0) & was_light] = len(travel) - 1
    return _save(onset, travel, target)


def reconstruct_in_tiles(path: Path, dataset: str, dark: Floats, bright: Floats, target: Path) -> Floats:
    """See `Lab`: as one who knows Numba well does it, with as much memory as the frames take."""
    with h5py.File(path) as file:
        frames, travel = file[dataset][()], file[_TRAVEL][()]
    return _save(first_light(frames, _level(dark, bright), 2), travel, target)


def _level(dark: Floats, bright: Floats) -> NDArray[np.uint8]:
    """Return the least count that is light; a dead pixel is dark."""
    level = np.ceil(dark + (bright - dark) / 2)
    return np.where(np.isnan(level), 255, level).astype(np.uint8)


def _save(onset: NDArray[np.int32], travel: NDArray[np.float64], target: Path) -> Floats:
    height = np.where(onset > 0, -travel[onset], np.nan).astype(np.float32)
    np.save(target, height)
    return height


@functools.cache
def _look() -> Any:
    def look(frame, level, number, was_light, onset):  # type: ignore[no-untyped-def]
        for p in numba.prange(len(frame)):
            light = frame[p] >= level[p]
            onset[p] = number - 1 if (onset[p] < 0) & light & was_light[p] else onset[p]
            was_light[p] = light

    return numba.njit(parallel=True)(look)
