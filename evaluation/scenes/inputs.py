"""Inputs of the cases: presses, turns of a rotation, slopes with masks and cuts. They never change."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Flags = NDArray[np.uint8]
Shape = tuple[int, int]
StackName = Literal["press", "random"]

LEVELS = {
    "uint8": (16, 224),
    "uint16": (256, 3584),
    "float32": (16, 224),
}  # counts in the dark and in the light
TILT = float(np.radians(2.5))
STEPS = 8  # frames per turn
PIXEL = 0.01  # size of a pixel of slopes, mm
NOISE = 0.02  # standard deviation of a slope

_NOISE = 1.5 / 208  # standard deviation of a sample of a press, divided by bright minus dark
_DEAD = 10_000  # one in this number of pixels has no bright reference
_NAN = 1_000_000  # one in this number of float samples is NaN
_STEEPEST = np.radians(60)  # zenith at the rim of a ball
_RIM = 0.97  # fraction of the radius beyond which contact is lost on one side
_SAG = np.radians(15)  # decrease of the zenith where contact is lost
_LOST = 0.3  # cosine between lean and azimuth above which contact is lost
_WAVES, _FINEST = 12, 12.0  # number of waves; periods of the finest wave along the longer side
_SLOPE = 0.3  # root mean square of the slopes
_BLOB, _OUTSIDE = 25, 0.35  # blobs of a mask along the shorter side, fraction of the pixels outside
_LENGTHS = (0.1, 0.4)  # range of the lengths of cuts, divided by the shorter side


class Scale(NamedTuple):
    """Brightness of a zenith: counts at 0, counts per radian, standard deviation of the light in counts."""

    offset: float
    gain: float
    noise: float


SCALES = {
    "uint8": Scale(16.0, 180.0, 1.25),
    "uint16": Scale(256.0, 2880.0, 20.0),
    "float32": Scale(16.0, 180.0, 1.25),
}


def press_noise(dtype: np.dtype[Any]) -> float:
    """Return the standard deviation of a sample of a press, counts."""
    dark, bright = LEVELS[dtype.name]
    return _NOISE * (bright - dark)


def turn_noise(dtype: np.dtype[Any]) -> float:
    """Return the standard deviation of a sample of a turn, including rounding, counts."""
    noise = SCALES[dtype.name].noise
    return noise if dtype.kind == "f" else float(np.hypot(noise, 1 / np.sqrt(12)))


def travel_of(count: int) -> NDArray[np.float64]:
    """Return the travel of `count` frames, mm."""
    return np.arange(count, dtype=np.float64) * 0.05


def phases(count: int) -> NDArray[np.float64]:
    """Return the phases of `count` frames, radians: whole turns of 8 even steps."""
    return np.arange(count, dtype=np.float64) * (2 * np.pi / STEPS)


def references(shape: Shape, dtype: np.dtype[Any]) -> tuple[Floats, Floats]:
    """Return dark and bright counts of each pixel, as the mean of 8 reference frames would be.

    They are multiples of 1/8; a few bright ones are NaN, which marks dead pixels.
    """
    generator = np.random.default_rng(1)
    low, high = LEVELS[dtype.name]
    dark = _eighths(low * generator.uniform(0.8, 1.2, shape))
    bright = _eighths(high * generator.uniform(0.9, 1.1, shape))
    bright.flat[generator.integers(0, bright.size, -(-bright.size // _DEAD))] = np.nan
    return dark, bright


def fill_press(frames: NDArray[Any], stack: StackName = "press") -> None:
    """Fill a stack, (T, H, W), in place.

    ``press``: the contact of a ball grows outwards from a hole around its apex; each pixel takes one to four
    frames to turn light, and the corners stay dark. ``random``: each pixel turns light in one frame at a
    random time, and one in eight never does, so neighbours differ and no part of the picture ends early.
    """
    shape = (frames.shape[1], frames.shape[2])
    generator = np.random.default_rng(0)
    dark, bright = references(shape, frames.dtype)
    span = np.nan_to_num(bright - dark)
    start, speed = (_front if stack == "press" else _scatter)(len(frames), shape, generator)
    grain = generator.normal(0, press_noise(frames.dtype), frames[0].size + 65_536).astype(np.float32)
    for number, frame in enumerate(frames):
        offset = generator.integers(65_536)
        counts = (np.float32(number) - start) * speed
        np.clip(counts, 0, 1, out=counts)
        counts *= span
        counts += dark
        counts += grain[offset : offset + counts.size].reshape(shape)
        if frame.dtype.kind == "f":
            # Fractions that float32 sums represent exactly, so that results do not depend on rounding.
            np.divide(np.rint(64 * counts), 64, out=frame)
        else:
            _round(counts, frame)
    if frames.dtype.kind == "f":
        frames.flat[generator.integers(0, frames.size, -(-frames.size // _NAN))] = np.nan


def _front(count: int, shape: Shape, generator: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the frame in which each pixel starts to turn light, and its increase per frame."""
    y, x = np.meshgrid(*(np.linspace(-1.05, 1.05, n) for n in shape), indexing="ij")
    radius = np.hypot(x, y)  # 1 at a zenith of 45 degrees
    drop = np.sqrt(2) - np.sqrt(np.maximum(2 - radius**2, 1))
    start = 1 + 0.9 * count * drop / (np.sqrt(2) - 1)
    start[(radius < 0.3) | (radius > 1)] = np.inf
    return start.astype(np.float32), (1 / (2.5 + 1.5 * x / 1.05)).astype(np.float32)


def _scatter(count: int, shape: Shape, generator: np.random.Generator) -> tuple[Floats, Floats]:
    onset = generator.integers(1, count + count // 8 + 1, shape)
    return (onset - 0.5).astype(np.float32), np.full(shape, 2, np.float32)


def _round(counts: Floats, frame: NDArray[Any]) -> None:
    np.rint(counts, out=counts)
    np.clip(counts, 0, np.iinfo(frame.dtype).max, out=counts)
    frame[:] = counts


def _eighths(counts: NDArray[np.float64]) -> Floats:
    return (np.rint(8 * counts) / 8).astype(np.float32)


def fill_turns(frames: NDArray[Any]) -> None:
    """Fill a stack, (N, H, W), in place with turns on a lattice of balls (equation 10).

    Between the balls the sheet is flat, where the brightness over a turn differs most from a cosine. At the
    rims it loses contact in the frames in which the body leans away.
    """
    generator = np.random.default_rng(0)
    offset, gain, noise = SCALES[frames.dtype.name]
    zenith, azimuth, rim = _balls(frames.shape[1:])
    grain = generator.normal(0, noise, frames[0].size + 65_536).astype(np.float32)
    for phase, frame in zip(phases(len(frames)), frames, strict=True):
        start = generator.integers(65_536)
        lean = np.cos(azimuth - np.float32(phase))
        shown = zenith - np.float32(_SAG) * (rim & (lean > _LOST))
        counts = np.float32(offset) + np.float32(gain) * _angle(shown, lean)
        counts += grain[start : start + counts.size].reshape(counts.shape)
        if frame.dtype.kind == "f":
            frame[:] = counts
        else:
            _round(counts, frame)
    if frames.dtype.kind == "f":
        frames.flat[generator.integers(0, frames.size, frames.size // _NAN)] = np.nan


def _balls(shape: tuple[int, ...]) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return zenith and azimuth of the sheet, and where it loses contact; eight balls in a row."""
    across = shape[1] / 8
    y, x = (((np.arange(n) + 0.5) / across % 1 * 2 - 1).astype(np.float32) for n in shape)
    radius = np.sqrt(x * x + (y * y)[:, np.newaxis])
    zenith = np.arcsin(np.float32(np.sin(_STEEPEST)) * np.where(radius <= 1, radius, np.float32(0)))
    azimuth = np.arctan2(-y[:, np.newaxis], x)
    return zenith, azimuth, (radius > _RIM) & (radius <= 1)


def _angle(zenith: Floats, lean: Floats) -> Floats:
    """Return the angle between normal and leaning axis: equation 10 in half angles, exact near 0 too."""
    # hav(theta') = hav(theta + d) - sin(theta) sin(d) (1 - cos(phi - alpha)) / 2, with hav(x) = sin(x / 2)^2.
    half = np.square(np.sin((zenith + np.float32(TILT)) / 2))
    half -= np.sin(zenith) * np.float32(np.sin(TILT) / 2) * (1 - lean)
    angle: Floats = 2 * np.arcsin(np.sqrt(np.maximum(half, 0)))
    return angle


def smooth_slopes(shape: Shape, seed: int = 0) -> Floats:
    """Return slopes dz/dx and dz/dy of a sum of waves, (2, H, W); y points up the picture."""
    generator = np.random.default_rng(seed)
    y, x = (np.arange(n, dtype=np.float32) / max(shape) for n in shape)
    slopes = np.zeros((2, *shape), np.float32)
    for count in np.geomspace(0.7, _FINEST, _WAVES):
        angle, phase = generator.uniform(0, 2 * np.pi, 2)
        direction = np.cos(angle), np.sin(angle)
        turns = np.float32(count * direction[0]) * x - np.float32(count * direction[1]) * y[:, np.newaxis]
        wave = np.sin(2 * np.pi * turns + phase).astype(np.float32)
        for slope, part in zip(slopes, direction, strict=True):
            slope += np.float32(part * _SLOPE * np.sqrt(2 / _WAVES)) * wave
    return slopes


def noisy_slopes(shape: Shape, seed: int = 0) -> Floats:
    """Return the slopes of the same surface with the noise of a camera."""
    noise = np.random.default_rng(seed).standard_normal((2, *shape), np.float32)
    return smooth_slopes(shape, seed) + np.float32(NOISE) * noise


def drifting_slopes(shape: Shape, count: int, fraction: float) -> list[Floats]:
    """Return noisy slopes of `count` frames on a circle, with equal changes between consecutive frames.

    The root mean square of a change is `fraction` times the root mean square of the slopes: half of it is in
    the surface, half in the noise.
    """
    middle = noisy_slopes(shape)
    axes = []
    for seed in (1, 2):
        surface = smooth_slopes(shape, seed)
        axis = noisy_slopes(shape, seed) - np.float32(1 - NOISE / _rms(surface)) * surface
        axes.append(np.float32(fraction * _rms(middle) / _rms(axis) / (2 * np.sin(np.pi / count))) * axis)
    angles = 2 * np.pi * np.arange(count) / count
    return [middle + np.float32(np.cos(a)) * axes[0] + np.float32(np.sin(a)) * axes[1] for a in angles]


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def blob_mask(shape: Shape) -> Flags:
    """Return an irregular shape with holes and islands, 65 % of the picture; 1 inside."""
    import cv2

    noise = np.random.default_rng(0).standard_normal(shape, np.float32)
    hills = cv2.GaussianBlur(noise, (0, 0), min(shape) / _BLOB)
    return np.asarray(hills > np.quantile(hills, _OUTSIDE), np.uint8)


def random_cuts(shape: Shape, count: int) -> Flags:
    """Return line segments of 0.1 to 0.4 of the picture's shorter side; 1 on a line."""
    import cv2

    generator = np.random.default_rng(0)
    edges = np.zeros(shape, np.uint8)
    for _ in range(count):
        length, angle = generator.uniform(*_LENGTHS) * min(shape), generator.uniform(0, np.pi)
        start = generator.uniform(0, 1, 2) * shape[::-1]
        end = start + length * np.array([np.cos(angle), np.sin(angle)])
        cv2.line(edges, np.rint(start).astype(int).tolist(), np.rint(end).astype(int).tolist(), 1)
    return edges


def roof(shape: Shape) -> tuple[Floats, Floats, Flags]:
    """Return normals, sigma and contact of a roof; its lower half is noisy, and a disc is out of contact."""
    generator = np.random.default_rng(0)
    row, column = np.indices(shape, np.float32, sparse=True)
    slope = np.where(column + 0.4 * row < shape[1] / 2, np.float32(0.1), np.float32(0.5))
    across = 0.1 * np.sin(row / 9) + 0 * column
    vectors = np.stack([slope, across, np.ones_like(slope)], axis=-1)
    sigma = np.where(row + 0 * column < shape[0] / 2, 0.005, 0.04).astype(np.float32)
    vectors += 0.7 * sigma[..., np.newaxis] * generator.standard_normal(vectors.shape, np.float32)
    vectors /= np.sqrt(np.sum(np.square(vectors), axis=-1, keepdims=True))
    contact = np.hypot(row - shape[0] / 4, column - shape[1] / 4) > shape[0] / 8
    return vectors.astype(np.float32), sigma, contact.astype(np.uint8)
