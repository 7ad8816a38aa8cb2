"""Heights of a full rectangle: what ``rectangle.cl`` computes, in plain NumPy with float64 inside.

A u = b is solved for the heights u, with A the Laplacian of a graph that links each pixel to its neighbours:
by a weight along lines (rows or columns of the picture), by another one across, and with a screening on its
diagonal. Cosine modes part it ::

    modes of b  ->  for each mode k, across the lines:  (bend_k - d^2) u_k = b_k  ->  points of u

with 4 sinh^2(bend / 2) = (4 along sin^2(pi k / 2 length) + screening) / across. The tridiagonal matrix of a
mode is c_r / c_(r+1) above its diagonal after elimination, c_r = cosh((r + 1/2) bend): so near to 1 for slow
modes that its difference from 1 is what is kept.

The spectrum, (strips, padded, 16), has in the slots of strip s modes k = 8 s ... 8 s + 7, then length - k.
Mode ``length`` is 0; what slots with k beyond half the length hold means nothing.

The kernels take sizes besides, and go about the Fourier transforms by the tables of
``mirrorskin.engine.integration.rectangle``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

Floats = NDArray[np.floating]

_HALF = 8


def rectangle_modes(source: Floats, turns: Floats, spectrum: Floats) -> None:
    """Write twice the cosine modes of lines, by their Fourier transform (Makhoul 1980).

    ``turns``, (modes, 2), are cosine and sine of pi k / (2 length).
    """
    lines, length = source.shape
    points = np.concatenate([source[:, ::2], source[:, 1::2][:, ::-1]], axis=1).astype(np.float64)
    found = np.fft.fft(points)[:, : length // 2 + 1]
    c, s = turns[: length // 2 + 1].T.astype(np.float64)
    low = _strips(2 * (c * found.real + s * found.imag))
    high = _strips(2 * (s * found.real - c * found.imag))
    spectrum[:, :lines] = np.concatenate([low, high], axis=2)


def rectangle_columns(level: bool, reach: Array, fading: Floats, ends: Floats, spectrum: Floats) -> None:
    """Solve across the lines for each slot, in place; by elimination, and substitution backwards.

    ``level`` says that mode 0 has no level of its own: then its mean becomes 0, and that of its right side is
    taken for 0. ``reach``, (strips, 2), is where a strip begins in ``fading``, and how many lines it has
    there: all others are like the last one; ``fading``, (N, 16), is 1 - c_r / c_(r+1) of line r; ``ends``,
    (strips, 16), by what the last line goes beyond the picture. The spectrum holds right sides; then heights,
    times the weight across.
    """
    lines = spectrum.shape[1]
    for number, ((begin, depth), end) in enumerate(zip(reach, ends, strict=True)):
        kept = 1.0 - fading[begin + np.minimum(np.arange(lines), depth - 1)].astype(np.float64)
        modes = spectrum[number].astype(np.float64)
        if level and number == 0:
            modes[:, 0] -= modes[:, 0].mean()
        for line in range(1, lines):
            modes[line] += kept[line - 1] * modes[line - 1]
        beyond = end * modes[-1]
        for line in range(lines - 1, -1, -1):
            beyond = modes[line] = kept[line] * (modes[line] + beyond)
        if level and number == 0:
            modes[:, 0] -= modes[:, 0].mean()
        spectrum[number] = modes


def rectangle_heights(spectrum: Floats, turns: Floats, height: Floats) -> None:
    """Write the points of lines, given their cosine modes.

    ``turns`` are those of ``rectangle_modes``, divided by whatever the heights are to be divided by.
    """
    lines, length = height.shape
    low, high = (_modes(part, length)[:lines] for part in np.split(spectrum, 2, axis=2))
    c, s = turns[: length // 2 + 1].T.astype(np.float64)
    points = np.fft.irfft((c + 1j * s) * (low - 1j * high), length) * length
    height[:, ::2] = points[:, : (length + 1) // 2]
    height[:, 1::2] = points[:, : (length - 1) // 2 : -1]


def _strips(modes: Floats) -> Floats:
    """Cut modes, (lines, n), into strips of 8, (strips, lines, 8)."""
    lines, count = modes.shape
    padded = np.pad(modes, ((0, 0), (0, -count % _HALF)))
    return padded.reshape(lines, -1, _HALF).transpose(1, 0, 2)


def _modes(strips: Floats, length: int) -> Floats:
    """Join strips again, (lines, length // 2 + 1)."""
    joined = strips.transpose(1, 0, 2).reshape(strips.shape[1], -1).astype(np.float64)
    return joined[:, : length // 2 + 1]
