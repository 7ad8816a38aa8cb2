"""Frames, slopes and maps by plain formulas, which share no code with mirrorskin."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Map = NDArray[np.float64]

PIXEL = (0.05, 0.06)
LEVELS = {"uint8": (16.0, 224.0), "uint16": (300.0, 3500.0), "float32": (0.1, 0.9)}  # dark and bright
TILT = 0.0436
EIGHTHS = np.arange(8) * np.pi / 4
UNEVEN = np.radians([178.1, 220.8, 280.5, 316.5, 7.6, 48.0, 96.3, 136.4])


def places(shape: tuple[int, int], pixel_size: tuple[float, float] = PIXEL) -> tuple[Map, Map]:
    """Return x to the right and y up, mm from the centre, (H, W)."""
    rows, columns = shape
    x = (np.arange(columns) - (columns - 1) / 2) * pixel_size[0]
    y = ((rows - 1) / 2 - np.arange(rows)) * pixel_size[1]
    return tuple(np.meshgrid(x, y))


def dome(shape: tuple[int, int], curvature: float = 0.25) -> tuple[Map, Map, Map]:
    """Return heights of a paraboloid with a ripple, and their slopes along x and y."""
    x, y = places(shape)
    height = -curvature * ((x - 0.1) ** 2 + (y + 0.05) ** 2) + 0.02 * np.sin(3 * x) * np.cos(2 * y)
    along_x = -2 * curvature * (x - 0.1) + 0.06 * np.cos(3 * x) * np.cos(2 * y)
    along_y = -2 * curvature * (y + 0.05) - 0.04 * np.sin(3 * x) * np.sin(2 * y)
    return height, along_x, along_y


def press(
    dtype: str = "uint8",
    shape: tuple[int, int] = (37, 53),
    frames: int = 20,
    noise: float = 0.01,
    seed: int = 1,
) -> tuple[NDArray[Any], Map]:
    """Return frames of a press and its travel: ramps and steps, some too low or there from the start."""
    random = np.random.default_rng(seed)
    travel = np.cumsum(random.uniform(0.02, 0.06, frames))
    starts = -dome(shape)[0] * 2 + random.uniform(-0.03, 0.03, shape)
    ramp = random.choice([1e-3, 0.05, 0.2], shape)
    plateau = random.uniform(0.4, 1.1, shape)
    fraction = plateau * np.clip((travel[:, None, None] - starts) / ramp, 0, 1)
    return counted(fraction + random.normal(0, noise, fraction.shape), dtype), travel


def counted(fraction: Map, dtype: str) -> NDArray[Any]:
    """Return counts of shares of the way from dark to bright."""
    dark, bright = LEVELS[dtype]
    counts = dark + (bright - dark) * fraction
    if dtype == "float32":
        return counts.astype(dtype)
    return np.clip(np.rint(counts), 0, np.iinfo(dtype).max).astype(dtype)


def level_maps(dtype: str, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return dark and bright references of each pixel, one of them unknown."""
    random = np.random.default_rng(7)
    dark, bright = LEVELS[dtype]
    span = 0.02 * (bright - dark)
    low, high = (random.normal(level, span, shape).astype(np.float32) for level in (dark, bright))
    low[2, 3] = np.nan
    return low, high


def turn(
    dtype: str = "uint16",
    shape: tuple[int, int] = (37, 53),
    phase: ArrayLike = EIGHTHS,
    noise: float = 1.0,
    seed: int = 2,
    lost: bool = False,
) -> tuple[NDArray[Any], float, float]:
    """Return frames of a rotation over the dome, counts per radian of zenith, and counts at zenith 0."""
    gain, offset, fraction = {"uint8": (220, 8, 1), "uint16": (3400, 150, 20), "float32": (5, 0.5, 0.02)}[
        dtype
    ]
    _, along_x, along_y = dome(shape)
    normal = np.stack([-along_x, -along_y, np.ones(shape)]) / np.sqrt(1 + along_x**2 + along_y**2)
    alpha = np.asarray(phase, float)
    axis = np.stack(
        [-np.sin(TILT) * np.cos(alpha), -np.sin(TILT) * np.sin(alpha), np.full(len(alpha), np.cos(TILT))],
        axis=1,
    )
    zenith = np.arccos(np.clip(np.einsum("ka,ahw->khw", axis, normal), -1, 1))
    counts = offset + gain * zenith
    if lost:  # light is gone in some frames where the sheet hangs free
        x, y = places(shape)
        along = np.cos(alpha)[:, None, None] * x + np.sin(alpha)[:, None, None] * y
        counts = np.where(np.hypot(x, y) + 0.2 * along > 1.1, 0.0, counts)
    counts = counts + noise * fraction * np.random.default_rng(seed).normal(0, 1, counts.shape)
    if dtype == "float32":
        return counts.astype(dtype), float(gain), float(offset)
    ends = 0, np.iinfo(dtype).max
    return np.clip(np.rint(counts), *ends).astype(dtype), float(gain), float(offset)


def ridge(shape: tuple[int, int]) -> tuple[Map, Map]:
    """Return the slopes of a roof whose top lies at an angle, with a step of height beside it."""
    x, y = places(shape)
    side = np.where(x + 0.3 * y > 0, -1.0, 1.0)
    return 0.4 * side, 0.12 * side + 0.05 * y


def pick(shape: tuple[int, int], fraction: float, seed: int) -> NDArray[np.bool_]:
    """Return random pixels, so large a share of all."""
    return np.random.default_rng(seed).random(shape) < fraction
