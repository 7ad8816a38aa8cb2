"""Frames and metadata of the recordings from which a calibration is computed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Block, InputError, Source

_BLOCK = 16  # frames that are read at a time, at most


def read_blocks(source: Source) -> Iterator[Block]:
    """Yield a source's blocks from the first frame; the memory of their frames is reused."""
    if source.rewindable:
        source.rewind()
    count, *shape = source.shape
    buffer = np.empty((max(1, min(count, _BLOCK)), *shape), source.dtype)
    while (block := source.read(buffer)) is not None:
        yield block


def read_turn(source: Source, max_frames: int | None = None) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Return frames of an axial recording, (T, H, W), and their phases.

    All are returned, or ``max_frames``, evenly spaced.
    """
    if source.motion != "axial":
        raise InputError(f"{source.name} is of {source.motion} motion: an axial recording is needed")
    total = source.shape[0]
    chosen = np.unique(np.linspace(0, total - 1, min(total, max_frames or total)).round().astype(np.intp))
    frames, phase, count = np.empty((len(chosen), *source.shape[1:]), source.dtype), np.zeros(len(chosen)), 0
    for block in read_blocks(source):
        if block.phase is None:
            raise InputError(f"{source.name} has no phases: give them, as in --phase-step 45deg")
        for number in range(len(block.frames)):
            if count < len(chosen) and block.index + number >= chosen[count]:
                frames[count], phase[count] = block.frames[number], block.phase[number]
                count += 1
    return frames[:count], phase[:count]


def pixel_size_of(source: Source) -> tuple[float, float]:
    """Return the size of a recording's pixels along x and y, mm."""
    if source.header.pixel_size is None:
        raise InputError(f"{source.name} has no pixel size: calibrate the scale first, or give --pixel-size")
    return source.header.pixel_size


def check_ball_radius(radius: float) -> None:
    """Raise InputError unless a ball can have this radius, mm."""
    if not 0 < radius < math.inf:
        raise InputError(f"the ball's diameter is {2 * radius:g} mm: give a length above 0, as in --ball 4mm")


def check_one_camera(sources: Sequence[Source]) -> None:
    """Raise InputError unless all sources have frames of the same size and type."""
    first = sources[0]
    for source in sources[1:]:
        if source.shape[1:] != first.shape[1:] or source.dtype != first.dtype:
            sizes = [
                f"{checked.shape[2]} x {checked.shape[1]} {checked.dtype.name}" for checked in (first, source)
            ]
            raise InputError(
                f"{source.name} is of {sizes[1]} and {first.name} of {sizes[0]}: take both with one camera"
            )
