"""Conversion of light to counts: ``exposure.cl`` in plain NumPy with float64.

Noise is a pure function of the seed, the frame and the pixel. Random words come from Philox4x32-10 (Salmon,
Moraes, Dror and Shaw: Parallel random numbers: as easy as 1, 2, 3. SC11, 2011, doi 10.1145/2063384.2063405),
which has no state except a counter and a key, and passes TestU01's BigCrush. Box and Muller's transform
converts two words to two independent normal numbers of up to 6.6 standard deviations. The normal numbers of
the device differ by 1e-6. Its integer counts differ by one where the unrounded value is close to a half: for
5 in a million counts of 8 bits, and 1 in a thousand of 16 bits.

Shot noise is Poisson noise: in electrons, its variance is the mean. A normal number z is transformed by the
first term of Cornish and Fisher, s z + b (z^2 - 1), such that the mean and variance of read and shot noise
together are exact. The third moment is too small by 4 b^3, which is 2 % of it at one electron. With less
light the counts are not Poisson distributed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

_FACTORS = (0xD2511F53, 0xCD9E8D57)
_STEPS = (0x9E3779B9, 0xBB67AE85)  # Weyl's constants: of the golden ratio, and of sqrt(3)
_LOW = 0xFFFFFFFF

Words = NDArray[np.uint32]
Array = NDArray[Any]


def philox(counter: Words, key: tuple[int, int]) -> Words:
    """Return random words of counters, (4, n), the lowest word first, by Philox4x32 in ten rounds."""
    a, b, c, d = counter.astype(np.uint64)
    for number in range(10):
        near, far = ((word + number * step) & _LOW for word, step in zip(key, _STEPS, strict=True))
        first, second = a * np.uint64(_FACTORS[0]), c * np.uint64(_FACTORS[1])
        a, b = (second >> 32) ^ b ^ np.uint64(near), second & _LOW
        c, d = (first >> 32) ^ d ^ np.uint64(far), first & _LOW
    return np.stack([a, b, c, d]).astype(np.uint32)


def radius(word: Words) -> Doubles:
    """Return Box and Muller's radii, sqrt(-2 ln u): u in (0, 1], the float32 of a word's upper 31 bits."""
    uniform = ((word >> 1).astype(np.float32) + np.float32(0.5)) * np.float32(2.0**-31)
    return np.asarray(np.sqrt(-2 * np.log(uniform.astype(np.float64))))


def direction(word: Words) -> tuple[Doubles, Doubles]:
    """Return the points of the unit circle for words.

    The lower 30 bits, as a signed number, are the position on the quarter of the circle around the positive x
    axis. The highest bit mirrors that quarter to the other side, and the next one exchanges x and y.
    """
    angle = (word << 2).view(np.int32) * (np.pi / 2 * 2.0**-32)
    across, along = np.where(word >> 31, -1, 1) * np.cos(angle), np.sin(angle)
    upright = (word >> 30 & 1).astype(bool)
    return np.where(upright, along, across), np.where(upright, across, along)


def normals(quarter: int, frame: int, seed: int) -> Doubles:
    """Return the standard normal numbers, (4 * quarter,), of one frame.

    Counter n is used for the pixels n, n + quarter, n + 2 quarter and n + 3 quarter. Frame and seed, integers
    from 0 to 2^64 - 1, are the counter's upper half, and the key.
    """
    counter = np.zeros((4, quarter), np.uint32)
    counter[0], counter[2], counter[3] = np.arange(quarter), frame & _LOW, frame >> 32
    a, b, c, d = philox(counter, (seed & _LOW, seed >> 32))
    points = *direction(b), *direction(d)
    radii = radius(a), radius(a), radius(c), radius(c)
    return np.concatenate([r * point for r, point in zip(radii, points, strict=True)])


def noise(signal: Doubles, normal: Doubles, read: float, grain: float) -> Doubles:
    """Return the noise added to a signal, counts above dark, for standard normal numbers.

    ``read`` is the standard deviation of the read noise, counts; ``grain`` the counts of one electron, 0 for
    no shot noise. A negative signal has no shot noise.
    """
    shot = np.maximum(signal, 0) * grain
    variance = read**2 + shot
    third = shot * grain
    bend = np.divide(third, 6 * variance, out=np.zeros_like(third), where=variance > 0)
    bend = np.minimum(bend, np.sqrt(variance / 2))
    return np.asarray(np.sqrt(np.maximum(variance - 2 * bend**2, 0)) * normal + bend * (normal**2 - 1))


def expose(light: Array, offset: Array, span: Array, frame: int, seed: int, read: float, grain: float,
           top: float, counts: Array) -> None:  # fmt: skip
    """Write the counts of one frame.

    ``light`` is 0 to 1, ``offset`` the counts without light, and ``span`` the increase in full light; (P,), P
    a multiple of four. Integer types are rounded, half to even, and clipped to 0 ... ``top``.
    """
    signal = span.astype(np.float64) * light
    exact = offset + signal + noise(signal, normals(len(light) // 4, frame, seed), read, grain)
    counts[:] = np.clip(np.rint(exact), 0, top) if counts.dtype.kind == "u" else exact
