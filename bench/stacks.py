"""Stacks to measure on: a press as a sensor sees it, and the worst that a search can meet."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

StackName = Literal["press", "random"]
Floats = NDArray[np.float32]

LEVELS = {
    "uint8": (16, 224),
    "uint16": (256, 3584),
    "float32": (16, 224),
}  # counts in the dark and in the light
_NOISE = 1.5 / 208  # share of the way from dark to light
_DEAD = 10_000  # one pixel in so many has no bright reference
_NAN = 1_000_000  # one sample in so many is no number, where the type allows it


def noise_of(dtype: np.dtype[Any]) -> float:
    """Return the standard deviation of a sample, counts."""
    dark, bright = LEVELS[dtype.name]
    return _NOISE * (bright - dark)


def references(shape: tuple[int, int], dtype: np.dtype[Any]) -> tuple[Floats, Floats]:
    """Return dark and bright references, counts, as the mean of 8 reference frames has them.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    dtype : dtype
        Type of a sample.

    Returns
    -------
    dark, bright : ndarray, (H, W), float32
        Each pixel's own, multiples of 1/8; a few bright ones are NaN: dead pixels.
    """
    generator = np.random.default_rng(1)
    low, high = LEVELS[dtype.name]
    dark = _eighths(low * generator.uniform(0.8, 1.2, shape))
    bright = _eighths(high * generator.uniform(0.9, 1.1, shape))
    bright.flat[generator.integers(0, bright.size, -(-bright.size // _DEAD))] = np.nan
    return dark, bright


def fill(frames: NDArray[Any], stack: StackName) -> None:
    """Fill a stack in place; the same shape and type give the same samples.

    ``press``: the contact of a ball runs outwards from its hole at the level top, each pixel takes one to
    four frames to turn light, and the corners stay dark. ``random``: each pixel turns light at once at a time
    of its own, an eighth never, so that neighbours differ and no part of the picture is done early.

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
    stack : {"press", "random"}
    """
    shape = (frames.shape[1], frames.shape[2])
    generator = np.random.default_rng(0)
    dark, bright = references(shape, frames.dtype)
    span = np.nan_to_num(bright - dark)
    start, speed = (_front if stack == "press" else _scatter)(len(frames), shape, generator)
    spread = noise_of(frames.dtype)
    grain = generator.normal(0, spread, frames[0].size + 65_536).astype(np.float32)
    for number, frame in enumerate(frames):
        offset = generator.integers(65_536)
        counts = (np.float32(number) - start) * speed
        np.clip(counts, 0, 1, out=counts)
        counts *= span
        counts += dark
        counts += grain[offset : offset + counts.size].reshape(shape)
        _store(counts, frame)
    if frames.dtype.kind == "f":
        frames.flat[generator.integers(0, frames.size, -(-frames.size // _NAN))] = np.nan


def _front(count: int, shape: tuple[int, int], generator: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the frame at which each pixel begins to turn light, and the share that it gains a frame."""
    y, x = np.meshgrid(*(np.linspace(-1.05, 1.05, n) for n in shape), indexing="ij")
    radius = np.hypot(x, y)  # 1 is where the ball leans by 45 degrees
    drop = np.sqrt(2) - np.sqrt(np.maximum(2 - radius**2, 1))
    start = 1 + 0.9 * count * drop / (np.sqrt(2) - 1)
    start[(radius < 0.3) | (radius > 1)] = np.inf
    return start.astype(np.float32), (1 / (2.5 + 1.5 * x / 1.05)).astype(np.float32)


def _scatter(count: int, shape: tuple[int, int], generator: np.random.Generator) -> tuple[Floats, Floats]:
    onset = generator.integers(1, count + count // 8 + 1, shape)
    return (onset - 0.5).astype(np.float32), np.full(shape, 2, np.float32)


def _store(counts: Floats, frame: NDArray[Any]) -> None:
    if frame.dtype.kind == "f":
        # Fractions that float32 sums hold exactly: no answer hangs on how a sum is rounded.
        np.divide(np.rint(64 * counts), 64, out=frame)
    else:
        np.rint(counts, out=counts)
        np.clip(counts, 0, np.iinfo(frame.dtype).max, out=counts)
        frame[:] = counts


def _eighths(counts: NDArray[np.float64]) -> Floats:
    return (np.rint(8 * counts) / 8).astype(np.float32)
