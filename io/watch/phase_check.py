"""Check of the phases of frames by the brightness of pixels: lost frames, and drift.

Each pixel is fitted by a sinusoid of the phase. Phases are compared by the sum of the squared residuals of
all pixels, which is computed from the products of the frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats

_PIXELS_MIN, _FRAMES_MIN, _FRAMES_MAX = 64, 6, 128  # minimum number of pixels; limits of the number of frames
_SHIFTS = -1, 1, 2, 3  # tested errors of the phase of later frames, steps
_BETTER = 0.85  # maximum ratio of the sums of squares with and without a jump
_STEADY = 0.7  # minimum share of a linear rise in the sum of squares of the mean residual of all pixels
_OUTLYING = 4.0  # pixels with larger residuals are excluded; times the median residual
_SWINGS = 0.25  # minimum amplitude of a pixel with a direction; times the median amplitude
_AS_ONE = 0.5  # mean direction above which all pixels respond alike, so that light looks like a phase


class PhaseCheck:
    """Brightness of pixels without NaN, (T, n), and the phases of its frames, (T,) radians."""

    def __init__(self, counts: NDArray[np.float32], phase: Floats) -> None:
        self._phase = phase
        self.possible = _FRAMES_MIN <= len(phase) <= _FRAMES_MAX and counts.shape[1] >= _PIXELS_MIN
        if not self.possible:
            return
        waves = np.linalg.qr(_waves(phase))[0].astype(np.float32)
        modulation = swing_of(counts, phase)[:, np.newaxis]
        size = np.abs(modulation)
        swings = size > max(_SWINGS * float(np.median(size)), 1e-6)
        self.possible = bool(swings.any()) and abs(np.mean(modulation[swings] / size[swings])) < _AS_ONE
        residual = counts - waves @ (waves.T @ counts)
        square = np.sum(residual**2, axis=0)
        used = square <= _OUTLYING**2 * np.median(square)
        self._counts, self._left = counts[:, used], residual[:, used]

    def jump(self) -> tuple[int, int, float] | None:
        """Return the first frame with a wrong phase, the error in steps, and the step; None if all fit."""
        step = float(np.median(np.diff(self._phase))) if self.possible else 0.0
        if step == 0:
            return None
        count = len(self._phase)
        frames, shifts = np.repeat(np.arange(1, count), len(_SHIFTS)), np.tile(_SHIFTS, count - 1)
        later = np.arange(count) >= frames[:, np.newaxis]
        waves = _waves(self._phase + step * shifts[:, np.newaxis] * later)
        centred = self._counts - self._counts.mean(axis=0)
        products = (centred @ centred.T).astype(np.float64)
        turned = np.swapaxes(waves, 1, 2)
        explained = np.trace(np.linalg.pinv(turned @ waves) @ (turned @ (products @ waves)), axis1=1, axis2=2)
        best = int(np.argmax(explained))
        cost = float(np.trace(products) - explained[best])
        if not cost < _BETTER * float(np.sum(self._left**2)):
            return None
        return int(frames[best]), int(shifts[best]), step

    def drift(self) -> tuple[float, float] | None:
        """Return the common rise of all pixels over the recording, and its error, counts; or None."""
        if not self.possible:
            return None
        waves = np.linalg.qr(_waves(self._phase))[0]
        ramp = np.linspace(-0.5, 0.5, len(self._phase))
        ramp -= waves @ (waves.T @ ramp)
        size = float(ramp @ ramp)
        if size < 1e-6:
            return None
        each = ramp @ self._left / size
        rise, common = float(np.mean(each)), np.mean(self._left, axis=1, dtype=np.float64)
        if rise**2 * size < _STEADY * float(np.sum(common**2)):
            return None
        return rise, float(np.std(each)) / len(each) ** 0.5


def swing_of(counts: NDArray[np.float32], phase: Floats) -> NDArray[np.complex64]:
    """Return the sum of the brightness of each pixel, (T, n), times exp(i phase)."""
    # Not as one complex product: the threads that NumPy starts for it wait for those of OpenCL.
    cosine, sine = (wave.astype(np.float32) @ counts for wave in (np.cos(phase), np.sin(phase)))
    return np.asarray(cosine + 1j * sine, np.complex64)


def _waves(phase: Floats) -> Floats:
    """Return 1, cosine and sine of phases, (..., 3)."""
    return np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=-1)
