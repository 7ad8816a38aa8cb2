"""Turns to measure on: a lattice of balls under an axial rotation, as equation 10 has it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

TILT = float(np.radians(2.5))
STEPS = 8  # frames of one turn

_STEEPEST = np.radians(60)  # zenith at a ball's rim
_RIM = 0.97  # share of a ball's radius from which contact is lost on one side
_SAG = np.radians(15)  # by which a sheet that lost contact leans less
_LOST = 0.3  # cosine of lean against azimuth from which it is lost
_NAN = 1_000_000  # one sample in so many is no number, where the type allows it


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


def noise_of(dtype: np.dtype[Any]) -> float:
    """Return the standard deviation of a sample in counts, with what rounding adds."""
    noise = SCALES[dtype.name].noise
    return noise if dtype.kind == "f" else float(np.hypot(noise, 1 / np.sqrt(12)))


def phases(count: int) -> NDArray[np.float64]:
    """Return the phases of so many frames, radians: whole turns of 8 even steps."""
    return np.arange(count, dtype=np.float64) * (2 * np.pi / STEPS)


def fill(frames: NDArray[Any]) -> None:
    """Fill a stack in place with turns; the same shape and type give the same samples.

    Between the balls the sheet is flat, which is where a turn's brightness is least like a cosine. At the
    rims it loses contact in the frames in which the body leans away.

    Parameters
    ----------
    frames : ndarray, (N, H, W), uint8, uint16 or float32
    """
    generator = np.random.default_rng(0)
    offset, gain, noise = SCALES[frames.dtype.name]
    zenith, azimuth, rim = _balls(frames.shape[1:])
    grain = generator.normal(0, noise, frames[0].size + 65_536).astype(np.float32)
    for phase, frame in zip(phases(len(frames)), frames, strict=True):
        start = generator.integers(65_536)
        lean = np.cos(azimuth - np.float32(phase))
        seen = zenith - np.float32(_SAG) * (rim & (lean > _LOST))
        counts = np.float32(offset) + np.float32(gain) * _angle(seen, lean)
        counts += grain[start : start + counts.size].reshape(counts.shape)
        _store(counts, frame)
    if frames.dtype.kind == "f":
        frames.flat[generator.integers(0, frames.size, frames.size // _NAN)] = np.nan


def lost(shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return where contact is lost in some frames, (H, W)."""
    return _balls(shape)[2]


def _balls(shape: tuple[int, ...]) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return zenith and azimuth of the sheet, and where it loses contact; eight balls in a row."""
    across = shape[1] / 8
    y, x = (((np.arange(n) + 0.5) / across % 1 * 2 - 1).astype(np.float32) for n in shape)
    radius = np.sqrt(x * x + (y * y)[:, np.newaxis])
    zenith = np.arcsin(np.float32(np.sin(_STEEPEST)) * np.where(radius <= 1, radius, np.float32(0)))
    azimuth = np.arctan2(-y[:, np.newaxis], x)
    return zenith, azimuth, (radius > _RIM) & (radius <= 1)


def _angle(zenith: Floats, lean: Floats) -> Floats:
    """Return the angle between normal and leaning axis: equation 10, by the half angle, exact near 0 too."""
    # hav(theta') = hav(theta + d) - sin(theta) sin(d) (1 - cos(phi - alpha)) / 2, with hav(x) = sin(x / 2)^2.
    half = np.square(np.sin((zenith + np.float32(TILT)) / 2))
    half -= np.sin(zenith) * np.float32(np.sin(TILT) / 2) * (1 - lean)
    found: Floats = 2 * np.arcsin(np.sqrt(np.maximum(half, 0)))
    return found


def _store(counts: Floats, frame: NDArray[Any]) -> None:
    if frame.dtype.kind != "f":
        np.rint(counts, out=counts)
        np.clip(counts, 0, np.iinfo(frame.dtype).max, out=counts)
    frame[:] = counts
