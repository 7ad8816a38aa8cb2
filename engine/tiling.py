"""A picture's maps and some frames on a device: in one piece if they fit, else in bands of rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.kernels.array import Array, BorrowedBuffer, Operand
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.device import free_memory as free_memory
from mirrorskin.kernels.errors import DeviceError, DeviceMemoryError

MEMORY_LIMIT = 256_000_000
"""Bytes of host memory for frames on the move, by default."""

_MOST_PIXELS = 2**30  # kernels number those of two planes with an int
_LINE = 64  # bytes of the longest word that a kernel loads at once


@dataclass(frozen=True, slots=True)
class Planes:
    """Several maps in one array, each padded to full words of the frames' samples."""

    count: int
    dtype: DTypeLike


@dataclass(frozen=True, slots=True)
class Staged:
    """Frames that are on a device, or on their way there, for the next kernels.

    Attributes
    ----------
    array : Array or BorrowedBuffer, (n, rows, W)
    frames : slice
        Which of the frames these are.
    aligned : bool
        Whether each begins at a multiple of a word.
    """

    array: Operand
    frames: slice
    aligned: bool

    @property
    def count(self) -> int:
        """Number of these frames."""
        return int(self.frames.stop - self.frames.start)


class Band:
    """Some rows of a picture on a device: named maps, and room for some frames.

    Attributes
    ----------
    rows : slice
        The rows of the picture that it holds.
    pixels : int
    stride : int
        Pixels from plane to plane.
    maps : dict of Array, (rows, W), or (count, stride) for `Planes`
    frames : Array, (n, rows, W)
    """

    def __init__(
        self,
        device: Device,
        rows: slice,
        columns: int,
        dtype: np.dtype[Any],
        maps: Mapping[str, DTypeLike | Planes],
        length: int,
        least: int,
    ) -> None:
        self._shape = shape = (rows.stop - rows.start, columns)
        self._device, self._kinds = device, maps
        self.rows, self.pixels = rows, shape[0] * shape[1]
        word = _LINE // dtype.itemsize
        self.stride = -(-self.pixels // word) * word
        if self.stride > _MOST_PIXELS:
            raise DeviceMemoryError(
                f"kernels number pixels to {_MOST_PIXELS}; {self.pixels} are too many at once"
            )
        self.maps = {name: self._make(name) for name in maps}
        self.frames = _longest(device, length, least, shape, dtype)
        self._other = _second(device, self.frames)
        self._borrowed: BorrowedBuffer | None = None
        self._only = True  # band of the picture
        self._resident = False

    def share_device(self) -> None:
        """Leave the device to other bands whenever this one is not at work."""
        self._only = False
        self._park()

    def write(self, name: str, values: ArrayLike, plane: int | None = None) -> None:
        """Fill a map, or one of several planes, from the host."""
        array = self.maps[name]
        if plane is not None and self._resident:
            array.download()  # the other planes
        array.claim()
        target = array.host if plane is None else self.plane(name, plane)
        target[:] = values
        if self._resident:
            array.upload()

    def plane(self, name: str, plane: int) -> NDArray[Any]:
        """Return one of several planes, (rows, W), as the host sees it."""
        found: NDArray[Any] = self.maps[name].host[plane, : self.pixels].reshape(self._shape)
        return found

    def detach(self, name: str) -> NDArray[Any]:
        """Give away what a map holds, (count, stride) or (rows, W), without a copy, and make a new one."""
        given = self.maps[name].detach()
        self.maps[name] = self._make(name)
        return given

    @contextmanager
    def resident(self) -> Iterator[None]:
        """Have the maps on the device for a while."""
        if not self._resident:
            for array in self.maps.values():
                array.upload()
            self._resident = True
        yield
        if not self._only:
            self._park()

    def stage(self, frames: NDArray[Any], lent: bool = False) -> Iterator[Staged]:
        """Bring frames, (n, H, W), to the device, piece by piece; give each to its kernels before the next.

        Nothing is copied where the device shares the host's memory and the frames are lent (nobody writes to
        them as long as they are referred to), or lie in the room already. A device of its own memory takes
        them beside the kernels on those before. When all are through, the frames' memory may be written anew,
        unless it is lent.
        """
        if len(frames) == 0:
            return
        frames = frames[:, self.rows]
        contiguous, shared = frames.flags.c_contiguous, self._device.info.shares_memory
        borrowed = self._device.borrow("frames", frames) if lent and contiguous and shared else None
        if borrowed is not None:
            yield from self._borrow(borrowed)
        elif contiguous and not shared:
            yield from self._bring(frames)
        else:
            yield from self._copy(frames)

    def _borrow(self, borrowed: BorrowedBuffer) -> Iterator[Staged]:
        """Work on frames where they lie."""
        before, self._borrowed = self._borrowed, borrowed
        address = borrowed.host.ctypes.data
        aligned = self._full_words and address % (4 * self._device.layout.lanes) == 0
        yield Staged(borrowed, slice(0, len(borrowed.host)), aligned)
        # It waits for its kernels: when more frames are read, only these here can still be under way.
        del before

    def _bring(self, frames: NDArray[Any]) -> Iterator[Staged]:
        """Copy frames in turns to two places on the device, one while kernels work on the other."""
        step = len(self.frames.host)
        for start in range(0, len(frames), step):
            if self._other is not None:
                self.frames, self._other = self._other, self.frames
            part = frames[start : start + step]
            self.frames.upload_async(part)
            yield Staged(self.frames, slice(start, start + len(part)), self._full_words)
            self.frames.wait()

    def _copy(self, frames: NDArray[Any]) -> Iterator[Staged]:
        """Copy frames to the room, unless they are there."""
        room = self.frames.host
        there = frames.ctypes.data == room.ctypes.data and frames.flags.c_contiguous
        step = max(1, len(frames) if there and len(frames) <= len(room) else len(room))
        for start in range(0, len(frames), step):
            part = frames[start : start + step]
            if not there:
                room[: len(part)] = part
            self.frames.upload(len(part))
            yield Staged(self.frames, slice(start, start + len(part)), self._full_words)
            self.frames.claim()

    @property
    def _full_words(self) -> bool:
        """Whether each frame is as long as some words."""
        return bool(self.pixels * self.frames.host.itemsize % (4 * self._device.layout.lanes) == 0)

    def _make(self, name: str) -> Array:
        kind = self._kinds[name]
        if isinstance(kind, Planes):
            return self._device.array(name, (kind.count, self.stride), kind.dtype, zeroed=False)
        return self._device.array(name, self._shape, kind, zeroed=False)

    def _park(self) -> None:
        for array in self.maps.values():
            array.evict()
        for room in (self.frames, self._other):
            if room is not None:
                room.discard()
        self._resident = False


def cut_into_bands(
    device: Device,
    shape: tuple[int, int],
    dtype: np.dtype[Any],
    maps: Mapping[str, DTypeLike | Planes],
    length: int,
    least: int = 1,
) -> list[Band]:
    """Make room for a picture: one band where the device has the memory, else as few as it takes.

    Shape is rows and columns of the picture, dtype a sample's, ``maps`` what is needed of each pixel. A band
    holds ``length`` frames, fewer where they do not fit, but at least ``least``; DeviceError if not even one
    row fits.
    """

    def cut(start: int, stop: int) -> list[Band]:
        try:
            return [Band(device, slice(start, stop), shape[1], dtype, maps, length, least)]
        except DeviceMemoryError as error:
            if stop - start == 1:
                message = f"one row of {shape[1]} pixels does not fit: {error}; use another device"
                raise DeviceError(message) from error
        middle, bands = (start + stop) // 2, []
        for half in ((start, middle), (middle, stop)):
            bands += cut(*half)
            for band in bands:
                band.share_device()
        return bands

    return cut(0, shape[0])


def room_of(bands: Sequence[Band], length: int) -> NDArray[Any]:
    """Return where frames may be written: a single band's room, or host memory for so many frames."""
    frames = bands[0].frames.host
    if len(bands) == 1:
        return frames
    return np.empty((length, bands[-1].rows.stop, frames.shape[2]), frames.dtype)


def join_rows(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Put a map together from those of the bands; that of a single one is taken as it is."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _second(device: Device, first: Array) -> Array | None:
    """Make as much room again on a device of its own memory, if it has that."""
    if device.info.shares_memory:
        return None
    try:
        return device.array(first.name, first.host.shape, first.host.dtype, zeroed=False)
    except DeviceMemoryError:
        return None


def _longest(device: Device, length: int, least: int, shape: tuple[int, int], dtype: np.dtype[Any]) -> Array:
    """Make room for as many frames as fit, up to a length."""
    while True:
        try:
            return device.array("frames", (length, *shape), dtype, zeroed=False)
        except DeviceMemoryError:
            if length <= least:
                raise
            length = max(least, length // 2)
