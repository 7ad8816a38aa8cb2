"""What the searches for an onset share: their answer, room for frames, and the check of what is pushed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.engine.bands import Planes, cut_into_bands
from mirrorskin.engine.samples import Noise, check_dtype, check_frames
from mirrorskin.io import Block, InputError, check_travel
from mirrorskin.kernels.device import Device

Event = Literal["onset", "release"]
EVENTS: tuple[Event, ...] = get_args(Event)


@dataclass(frozen=True, slots=True)
class Onset:
    """Where and when a press turned the pixels light, or a release dark again.

    Attributes
    ----------
    height, sigma : ndarray, (H, W), float32
        Millimetres, and the standard deviation of the height; NaN unless status is 1.
    status : ndarray, (H, W), uint8
        0 invalid input, 1 onset, 2 never light, 3 light at start; of a release: 0 invalid input, 1 release,
        2 dark at start, 3 light to the end.
    frame : ndarray, (H, W), int32
        Number of the first light frame, of a release of the first dark one; -1 without one.
    noise : float
        Standard deviation of a sample that was reckoned with, counts.
    """

    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    status: NDArray[np.uint8]
    frame: NDArray[np.int32]
    noise: float


class Search:
    """Room for frames on a device, and the check of what is pushed.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : dtype
        uint8, uint16 or float32.
    maps : mapping of str to dtype or Planes
        What is kept of each pixel.
    noise : float, optional
        Standard deviation of a sample in counts; by default told from the first two frames.
    event : {"onset", "release"}
    device : Device
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
        dtype: np.dtype[Any],
        maps: Mapping[str, DTypeLike | Planes],
        noise: float | None,
        event: Event,
        device: Device,
        memory_limit: int,
    ) -> None:
        check_dtype(dtype)
        if event not in EVENTS:
            raise InputError(f"unknown event {event!r}; known are {', '.join(EVENTS)}")
        self.device = device
        self._shape, self._dtype = shape, dtype
        self._release = event == "release"
        self._noise = Noise(noise, dtype.kind == "u")
        length = max(1, memory_limit // (2 * shape[0] * shape[1] * dtype.itemsize))
        self._bands = cut_into_bands(device, shape, dtype, maps, length)
        alone = len(self._bands) == 1
        self._room = self._bands[0].frames.host if alone else np.empty((length, *shape), dtype)

    @property
    def room(self) -> NDArray[Any]:
        """Where a source may write the next frames, (n, H, W), not to be copied where they fit."""
        return self._room

    def _accept(self, block: Block, so_far: Sequence[float]) -> NDArray[np.float64]:
        """Look at a block before it is taken in: return its travel, if it can follow the travel so far."""
        frames = block.frames
        check_frames(frames, self._dtype, self._shape)
        travel = check_travel(block.travel, len(frames), "travel", after=so_far[-1:], falls=self._release)
        self._noise.look(frames)
        return travel


def check_stack(frames: NDArray[Any]) -> tuple[int, int]:
    """Return rows and columns of a stack, or raise InputError if it is none."""
    if frames.ndim != 3 or len(frames) < 2 or 0 in frames.shape:
        raise InputError(f"frames have shape {frames.shape}: (T, H, W) with at least 2 frames is needed")
    return frames.shape[1], frames.shape[2]
