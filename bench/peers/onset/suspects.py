"""Pixels of float frames with a sample that is no number: few, and settled one series at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers.onset.peer import Levels

INVALID = -2


def settle_suspects(
    frames: NDArray[Any], light: Levels, hold: int, suspect: NDArray[np.bool_], onset: NDArray[np.int32]
) -> None:
    """Correct the onsets of suspect pixels in place.

    A sample that is no number, or infinite, spoils its pixel until the onset is decided, which is when its
    run of light frames has held.

    Parameters
    ----------
    frames : ndarray, (T, H, W), float32
    light : ndarray, () or (H, W), float32
    hold : int
        1 or 2.
    suspect : ndarray, (H, W), bool
        All pixels with such a sample; a few others do no harm.
    onset : ndarray, (H, W), int32
    """
    samples = frames[:, suspect]
    broken = ~np.isfinite(samples)
    is_light = samples >= (light if light.ndim == 0 else light[suspect])
    if hold == 2:
        is_light[:-1] &= is_light[1:]
    found = is_light.any(axis=0)
    first = np.where(found, is_light.argmax(axis=0), len(frames))
    spoiled = broken.any(axis=0) & (broken.argmax(axis=0) < first + hold)
    onset[suspect] = np.where(spoiled, INVALID, np.where(found, first, -1))
