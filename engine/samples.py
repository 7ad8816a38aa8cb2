"""What every search needs of the frames it is given: their type, their noise, where the body was."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.noise import estimate_noise, thin_out
from mirrorskin.io import FRAME_DTYPES, InputError
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device


class Noise:
    """The standard deviation of a sample: given, or told from the first two frames that are seen.

    Parameters
    ----------
    given : float, optional
        Counts.
    integer : bool
        Whether counts are whole numbers.
    """

    def __init__(self, given: float | None, integer: bool) -> None:
        if given is not None and not 0 <= given < np.inf:
            raise InputError(f"noise {given}: a standard deviation in counts is needed, such as 1.5")
        self._given = given
        self._integer = integer
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far."""
        self._seen: list[NDArray[np.float64]] = []
        self.value = self._given

    def look(self, frames: NDArray[Any]) -> None:
        """See the next frames, (n, H, W); only the first two of all count."""
        if self.value is not None:
            return
        self._seen += [thin_out(frame) for frame in frames[: 2 - len(self._seen)]]
        if len(self._seen) == 2:
            self.value = estimate_noise(self._seen[0], self._seen[1], self._integer)


def check_dtype(dtype: np.dtype[Any]) -> None:
    """Raise InputError unless samples are of a type that kernels take."""
    if dtype not in FRAME_DTYPES:
        raise InputError(f"frames of type {dtype}: uint8, uint16 or float32 are needed")


def check_frames(frames: NDArray[Any], dtype: np.dtype[Any], shape: tuple[int, int]) -> None:
    """Raise InputError unless frames are one or more of a type and size, (n, *shape)."""
    if frames.dtype != dtype or frames.shape[1:] != shape or len(frames) == 0:
        raise InputError(f"frames of {frames.dtype} {frames.shape}: expected {dtype} (n, *{shape})")


def travel_pairs(device: Device, travel: ArrayLike) -> Array:
    """Hand travel, (T,), mm, to a device as (T, 2) floats, whose sums are as good as float64."""
    exact = np.asarray(travel, np.float64)
    pairs = device.array("travel", (len(exact), 2), np.float32)
    pairs.host[:, 0] = exact
    pairs.host[:, 1] = exact - pairs.host[:, 0]
    pairs.upload()
    return pairs
