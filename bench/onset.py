"""Onset against the limit of memory and against NumPy, on the same frames in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.harness import Timing, take_turns
from mirrorskin.engine import OnsetSearch
from mirrorskin.io import Block
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.errors import DeviceError

_WORD = 64  # bytes that the limits' kernels read at once
_EACH = 4  # words that an item of theirs takes for each pixel of a tile


@dataclass(frozen=True, slots=True)
class Row:
    """One work of a case.

    Attributes
    ----------
    name : str
    timing : Timing
    bytes : int
        That it must move.
    """

    name: str
    timing: Timing
    bytes: int

    @property
    def bandwidth(self) -> float:
        """Bytes per second."""
        return self.bytes / self.timing.median


def run_onset(device: Device, shape: tuple[int, int, int], dtype: np.dtype[Any], rounds: int) -> list[Row]:
    """Time the onset scan, the limits and NumPy on one stack; their maps must be equal first.

    Parameters
    ----------
    device : Device
    shape : (int, int, int)
        Frames, rows and columns.
    dtype : dtype
        uint8 or uint16.
    rounds : int

    Returns
    -------
    list of Row
        The read limit first.
    """
    length = int(np.prod(shape)) * dtype.itemsize
    search = OnsetSearch(shape[1:], dtype, noise=1.5, device=device, memory_limit=2 * length)
    frames = search.room[: shape[0]]
    if len(frames) < shape[0]:
        raise DeviceError(f"{device.info.title} has no room for {shape[0]} frames at once: use --quick")
    _press(frames)
    limits = _Limits(device, frames)

    def scan() -> None:
        search.reset()
        search.push(Block(frames, 0, travel=np.arange(shape[0], dtype=np.float64)))
        device.finish()

    def scan_and_heights() -> None:
        scan()
        search.result()

    scan()
    if not np.array_equal(search.result().frame, _numpy_onset(frames)):
        raise RuntimeError("the kernel and NumPy do not agree: nothing to time")
    works = {
        "read limit": limits.read,
        "copy limit": limits.copy,
        "onset scan": scan,
        "onset scan and heights": scan_and_heights,
        "NumPy": lambda: _discard(_numpy_onset(frames)),
    }
    timings = take_turns(works, rounds)
    return [
        Row(name, timing, length * (2 if name == "copy limit" else 1)) for name, timing in timings.items()
    ]


class _Limits:
    """The limits' kernels on as many bytes as the frames have."""

    def __init__(self, device: Device, frames: NDArray[Any]) -> None:
        self._device = device
        words = (
            frames.reshape(-1)
            .view(np.uint8)[: frames.nbytes // _WORD * _WORD]
            .view(np.uint32)
            .reshape(-1, 16)
        )
        self._count = len(words)
        self._items = -(-self._count // (_EACH * device.tile))
        self._source = device.array("source", words.shape, np.uint32)
        self._target = device.array("target", words.shape, np.uint32)
        self._sums = device.array("sums", (self._items,), np.uint32)
        self._source.host[:] = words
        self._source.upload()

    def read(self) -> None:
        kernel = self._device.kernel("limits", "read_all")
        kernel(self._items, self._source, np.int32(self._count), self._sums, moved=_WORD * self._count)
        self._device.finish()

    def copy(self) -> None:
        kernel = self._device.kernel("limits", "copy_all")
        kernel(self._items, self._source, np.int32(self._count), self._target, moved=2 * _WORD * self._count)
        self._device.finish()


def _press(frames: NDArray[Any]) -> None:
    """Fill a stack with pixels that turn light at seeded random frames, some never."""
    generator = np.random.default_rng(0)
    count = len(frames)
    onset = generator.integers(1, count + count // 8, frames.shape[1:])
    texture = generator.integers(10, 40, frames.shape[1:]).astype(frames.dtype)
    for number, frame in enumerate(frames):
        frame[:] = texture + np.where(onset <= number, np.iinfo(frames.dtype).max // 4 * 3, 0).astype(
            frames.dtype
        )


def _numpy_onset(frames: NDArray[Any]) -> NDArray[np.int32]:
    """Find the same map as the scan with `hold` 2: the first of two light frames in a row, or the last."""
    light = frames >= (int(np.iinfo(frames.dtype).max) + 1) // 2
    light[:-1] &= light[1:]
    return np.where(light.any(axis=0), light.argmax(axis=0), -1).astype(np.int32)


def _discard(_: object) -> None:
    """Take a value and do nothing with it."""
