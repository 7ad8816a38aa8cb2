"""Slopes to measure integration on: a smooth surface and noise, a shape with holes, cuts, drift."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Flags = NDArray[np.uint8]

PIXEL = 0.01  # size of a pixel, mm
NOISE = 0.02  # standard deviation of a slope

_WAVES = 12
_SLOPE = 0.3  # root mean square of how steep the surface is
_FINEST = 12.0  # waves across the longer side of the picture
_BLOB = 25  # blobs along the shorter side of the picture
_OUTSIDE = 0.35  # share of the pixels outside a mask
_LENGTHS = (0.1, 0.4)  # of cuts, in shorter sides of the picture


def smooth_slopes(shape: tuple[int, int], seed: int = 0) -> Floats:
    """Return slopes of a sum of waves, without noise.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    seed : int
        Which surface.

    Returns
    -------
    ndarray, (2, H, W), float32
        Slopes dz/dx and dz/dy; y runs up the picture.
    """
    generator = np.random.default_rng(seed)
    y, x = (np.arange(n, dtype=np.float32) / max(shape) for n in shape)
    slopes = np.zeros((2, *shape), np.float32)
    for count in np.geomspace(0.7, _FINEST, _WAVES):
        angle, phase = generator.uniform(0, 2 * np.pi, 2)
        along, up = np.cos(angle), np.sin(angle)
        turns = np.float32(count * along) * x - np.float32(count * up) * y[:, np.newaxis]
        wave = np.sin(2 * np.pi * turns + phase).astype(np.float32)
        for slope, share in zip(slopes, (along, up), strict=True):
            slope += np.float32(share * _SLOPE * np.sqrt(2 / _WAVES)) * wave
    return slopes


def noisy_slopes(shape: tuple[int, int], seed: int = 0) -> Floats:
    """Return the slopes of the same surface as a camera's noise leaves them; see `smooth_slopes`."""
    generator = np.random.default_rng(seed)
    noise = generator.standard_normal((2, *shape), np.float32)
    return smooth_slopes(shape, seed) + np.float32(NOISE) * noise


def drifting_slopes(shape: tuple[int, int], count: int, share: float) -> list[Floats]:
    """Return noisy slopes that run in a circle: each frame differs from the next by as much.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    count : int
        Frames of a circle.
    share : float
        Root mean square of what changes from a frame to the next, of that of the slopes: half of it in the
        surface, half in the noise.
    """
    middle = noisy_slopes(shape)
    ways = []
    for seed in (1, 2):
        surface = smooth_slopes(shape, seed)
        way = noisy_slopes(shape, seed) - np.float32(1 - NOISE / _size(surface)) * surface
        radius = share * _size(middle) / _size(way) / (2 * np.sin(np.pi / count))
        ways.append(np.float32(radius) * way)
    angles = 2 * np.pi * np.arange(count) / count
    return [middle + np.float32(np.cos(a)) * ways[0] + np.float32(np.sin(a)) * ways[1] for a in angles]


def _size(slopes: Floats) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(slopes))))


def blob_mask(shape: tuple[int, int]) -> Flags:
    """Return an irregular shape with holes and islands, 65 % of the picture; 1 inside, uint8."""
    noise = np.random.default_rng(0).standard_normal(shape, np.float32)
    hills = cv2.GaussianBlur(noise, (0, 0), min(shape) / _BLOB)
    return np.asarray(hills > np.quantile(hills, _OUTSIDE), np.uint8)


def random_cuts(shape: tuple[int, int], count: int) -> Flags:
    """Return line segments of 0.1 to 0.4 of the picture's shorter side; 1 on a line, uint8."""
    generator = np.random.default_rng(0)
    edges = np.zeros(shape, np.uint8)
    for _ in range(count):
        length, angle = generator.uniform(*_LENGTHS) * min(shape), generator.uniform(0, np.pi)
        start = generator.uniform(0, 1, 2) * shape[::-1]
        end = start + length * np.array([np.cos(angle), np.sin(angle)])
        cv2.line(edges, np.rint(start).astype(int).tolist(), np.rint(end).astype(int).tolist(), 1)
    return edges
