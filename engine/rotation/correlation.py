"""Mean, cosine and sine of the brightness over an axial rotation (paper, section 4: equations 17 to 22)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.frames import check_dtype, check_frames
from mirrorskin.engine.rotation.phases import check_phases, check_weights
from mirrorskin.engine.rotation.sums import TurnSums, WindowSums
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import Block, InputError, check_phase
from mirrorskin.kernels.correlation import WINDOW
from mirrorskin.kernels.device import Device, open_device


@dataclass(frozen=True, slots=True)
class Correlation:
    """The least-squares fit E = mean + cosine cos alpha + sine sin alpha of each pixel.

    Attributes
    ----------
    mean, cosine, sine : ndarray, (H, W), float32
        Counts; NaN where a sample was no number.
    residual : ndarray, (H, W), float32
        Counts: sqrt(SS / (N - 3)), the standard deviation of a sample of weight 1; NaN where N is 3.
    frames : int
        Number N of frames that counted: those of a weight above 0.
    """

    mean: NDArray[np.float32]
    cosine: NDArray[np.float32]
    sine: NDArray[np.float32]
    residual: NDArray[np.float32]
    frames: int

    @property
    def modulation(self) -> NDArray[np.float32]:
        """Amplitude sqrt(cosine^2 + sine^2), (H, W) float32, counts."""
        return np.hypot(self.cosine, self.sine)

    @property
    def azimuth(self) -> NDArray[np.float32]:
        """Phase at which the pixel is brightest, atan2(sine, cosine), (H, W) float32, radians, or NaN."""
        still = (self.cosine == 0) & (self.sine == 0)
        phase: NDArray[np.float32] = np.where(still, np.float32(np.nan), np.arctan2(self.sine, self.cosine))
        return phase


def correlate(
    frames: NDArray[Any],
    phase: ArrayLike,
    weights: ArrayLike | None = None,
    device: str | Device | None = None,
) -> Correlation:
    """Fit mean, cosine and sine to a stack that fits in memory.

    It minimises SS = sum_k w_k (E_k - mean - cosine cos alpha_k - sine sin alpha_k)^2. For N evenly spaced
    phases, sine and cosine are 2/N times the sums that stand for the paper's integrals S and C (equations 17
    and 20), and so gain times tilt times sine and cosine of the azimuth, as in equations 19 and 22. Uneven
    or measured phases mix the three, and least squares tells them apart.

    Parameters
    ----------
    frames : ndarray, (T, H, W), uint8, uint16 or float32
        Raw counts.
    phase : array_like, (T,)
        Radians, one a frame.
    weights : array_like, (T,), optional
        How much each frame counts; 0 for a missing one. By default, all count the same.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Raises
    ------
    mirrorskin.io.InputError
        Frames, phases or weights that cannot be used; see ``mirrorskin.engine.rotation.phases.check_phases``.
    mirrorskin.kernels.errors.DeviceError
        No device, or one that cannot hold a single row.
    """
    if frames.ndim != 3 or 0 in frames.shape:
        raise InputError(f"frames have shape {frames.shape}: (T, H, W) is needed")
    alpha = check_phase(phase, len(frames), "phase")
    check_phases(alpha, check_weights(weights, len(frames)))
    limit = min(MEMORY_LIMIT, 2 * frames.nbytes)
    correlator = Correlator(frames.shape[1:], frames.dtype, device=device, memory_limit=limit)
    correlator.push(Block(frames, index=0, phase=alpha), weights)
    return correlator.result()


class Correlator:
    """Fit mean, cosine and sine to frames that come block by block, however they are cut.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    window : int, optional
        Frames, 3 to 64, that count: the last ones of an endless rotation. By default, all of them.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.
    memory_limit : int
        Bytes of host memory for frames on the move; half of it is the room for one block.

    Raises
    ------
    mirrorskin.io.InputError
        Parameters that cannot be used.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        *,
        window: int | None = None,
        device: str | Device | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        dtype = np.dtype(dtype)
        check_dtype(dtype)
        if window is not None and not 3 <= window <= WINDOW:
            raise InputError(f"window {window}: a number of frames from 3 to {WINDOW} is needed")
        opened = open_device(device)
        length = max(1, memory_limit // (2 * shape[0] * shape[1] * dtype.itemsize))
        self.device = opened
        self._shape, self._dtype = shape, dtype
        self._sums = (
            TurnSums(opened, shape, dtype, length)
            if window is None
            else WindowSums(opened, shape, dtype, length, window, {})
        )

    @property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied where they fit."""
        return self._sums.room

    def push(self, block: Block, weights: ArrayLike | None = None) -> None:
        """Take in the next frames.

        Parameters
        ----------
        block : Block
            Frames and their phases.
        weights : array_like, (n,), optional
            How much each of them counts; 0 for a missing one. By default, each has weight 1.

        Raises
        ------
        mirrorskin.io.InputError
            Frames of another shape or type, phases or weights that cannot be used, or more frames than
            the sums hold.
        """
        frames = block.frames
        check_frames(frames, self._dtype, self._shape)
        phase = check_phase(block.phase, len(frames), "phase")
        self._sums.push(frames, phase, check_weights(weights, len(frames)), block.lent)

    def result(self) -> Correlation:
        """Return the fit of the frames so far, or of those in the window; more may follow.

        Raises
        ------
        mirrorskin.io.InputError
            Their phases do not determine a fit yet.
        """
        return tell_wave(self._sums)

    def reset(self) -> None:
        """Forget the frames so far."""
        self._sums.reset()


def tell_wave(sums: TurnSums | WindowSums) -> Correlation:
    """Return the fit that sums tell; see ``Correlator.result``."""
    phase, weight = sums.seen()
    used = weight > 0
    check_phases(phase[used], weight[used])
    mean, cosine, sine, residual = sums.solve()
    return Correlation(mean, cosine, sine, residual, int(np.count_nonzero(used)))
