"""Frames of a camera with known pixels, as taken for references."""

from __future__ import annotations

import numpy as np

from mirrorskin import io
from mirrorskin.evaluation.calibration.scenes import Frames

TOPS = {"uint8": 255, "uint16": 4095, "float32": None}
SCALES = {"uint8": 1.0, "uint16": 16.0, "float32": 1.0}


def source(frames, name="made up", again=False):
    """Return a source of given frames, (T, H, W)."""
    travel = 0.01 * np.arange(len(frames))
    source = Frames(frames, io.Header("vertical", camera="lab"), name, travel=travel)
    source.rewindable = again
    return source


def expose(level, noise, count, dtype="uint8", seed=0, top=None):
    """Return frames of pixels at a level, or at one of their own in each frame, with normal noise."""
    generator = np.random.default_rng(seed)
    dtype = np.dtype(dtype)
    level = np.asarray(level, np.float64)
    shape = level.shape if level.ndim == 3 else (count, *level.shape)
    counts = level + noise * generator.standard_normal(shape)
    if dtype.kind == "u":
        return np.clip(np.rint(counts), 0, top or np.iinfo(dtype).max).astype(dtype)
    return np.minimum(counts, np.inf if top is None else top).astype(dtype)


def pixels(shape=(61, 83), dtype="uint8", seed=1):
    """Return each pixel's dark level and light: 5 % of gain, 3 counts of offset, 30 % left in the corners."""
    generator = np.random.default_rng(seed)
    y, x = (np.linspace(-1, 1, size) for size in shape)
    vignetting = 1 - 0.35 * (x**2 + y[:, np.newaxis] ** 2)
    scale = SCALES[np.dtype(dtype).name]
    dark = scale * (16 + 3 * generator.standard_normal(shape))
    light = scale * 170 * vignetting * (1 + 0.05 * generator.standard_normal(shape))
    return dark, light


def rolled(dark, light, count, full, half, noise=2.0, dtype="uint8", seed=2, top=None):
    """Return frames of a ball rolled about: which shares of a pixel's samples are in full and half light."""
    generator = np.random.default_rng(seed)
    chance = generator.random((count, *dark.shape))
    fraction = np.where(
        chance < full, 1.0, np.where(chance < full + half, generator.random(chance.shape), 0.0)
    )
    return expose(dark + fraction * light, noise, count, dtype, seed + 1, top)
