"""With h5py and NumPy: frame by frame, the normalised stack compared, and its first light frames asked for.

Each frame is compared when it is normalised: all frames as floats would take four times the memory.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  the filters that it brings
import numpy as np

from mirrorskin.bench.peers.onset.peer import Floats

_TRAVEL = "/entry/instrument/stage/travel"


def reconstruct(path: Path, dataset: str, dark: Floats, bright: Floats, target: Path) -> Floats:
    """See `Lab`."""
    span = bright - dark
    with h5py.File(path) as file:
        stack, travel = file[dataset], file[_TRAVEL][()]
        light = np.empty(stack.shape, bool)
        for number in range(len(stack)):
            light[number] = (stack[number] - dark) / span >= 0.5
    light[:-1] &= light[1:]  # two in a row, so that a spike of noise makes no onset
    first = light.argmax(axis=0)
    height = np.where(light.any(axis=0) & (first > 0), -travel[first], np.nan).astype(np.float32)
    np.save(target, height)
    return height
