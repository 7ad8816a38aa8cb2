"""A picture's maps and some frames on a device: in one piece if they fit, else in bands of rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.kernels import memory
from mirrorskin.kernels.array import SLACK, Array, BorrowedBuffer, Operand
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.device import free_memory as free_memory
from mirrorskin.kernels.errors import DeviceError, DeviceMemoryError

MEMORY_LIMIT = 256_000_000
"""Bytes of host memory for frames on the move, by default."""

_MOST_PIXELS = 2**30  # kernels number those of two planes with an int
_LINE = 64  # bytes of the longest word that a kernel loads at once
_PIECE = 64_000_000  # bytes that a device of its own memory is sent at once: enough for its speed


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
    """

    array: Operand
    frames: slice

    @property
    def count(self) -> int:
        """Number of these frames."""
        return int(self.frames.stop - self.frames.start)


class _Maps(dict[str, Array]):
    """Arrays by name, each made anew when it is asked for after it was given away."""

    def __init__(self, make: Callable[[str], Array], names: Iterable[str]) -> None:
        super().__init__((name, make(name)) for name in names)
        self._make = make

    def __missing__(self, name: str) -> Array:
        made = self[name] = self._make(name)
        return made


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
        They hold anything at first.
    length : int
        Frames that there is room for.
    """

    rows: slice
    pixels: int

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
        self._device, self._kinds, self._dtype = device, maps, dtype
        self.rows, self.pixels = rows, shape[0] * shape[1]
        word = _LINE // dtype.itemsize
        self.stride: int = -(-self.pixels // word) * word
        if self.stride > _MOST_PIXELS:
            raise DeviceMemoryError(
                f"kernels number pixels to {_MOST_PIXELS}; {self.pixels} are too many at once"
            )
        self.maps: dict[str, Array] = _Maps(self._make, maps)
        self._most = device.max_allocation // (
            self.pixels * dtype.itemsize
        )  # frames that kernels see at once
        if self._most < least:
            raise DeviceMemoryError(f"{device.info.title} has no room for {least} frames")
        self.length: int = min(length, self._most)
        self._places = [] if device.info.shares_memory else _places(device, self.length, least, shape, dtype)
        self._borrowed: BorrowedBuffer | None = None
        self._only = True  # band of the picture
        self._resident = False
        self._blank = set(maps)  # maps that nothing was written to

    @cached_property
    def room(self) -> NDArray[Any]:
        """Where frames may be written, (length, rows, W)."""
        nbytes = self.length * self.pixels * self._dtype.itemsize
        place = memory.take(nbytes + SLACK, zeroed=False)[:nbytes]
        return place.view(self._dtype).reshape(self.length, *self._shape)

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
        self._blank.discard(name)
        target = array.host if plane is None else self.picture(array.host[plane])
        target[:] = values
        if self._resident:
            array.upload()

    def picture(self, plane: NDArray[Any]) -> NDArray[Any]:
        """Return a plane, (stride,), without its padding, (rows, W)."""
        return plane[: self.pixels].reshape(self._shape)

    def detach(self, name: str) -> NDArray[Any]:
        """Give away what a map holds, (count, stride) or (rows, W), without a copy; it is blank then."""
        return self.maps.pop(name).detach()

    @contextmanager
    def resident(self) -> Iterator[None]:
        """Have the maps on the device for a while."""
        if not self._resident:
            for name, array in self.maps.items():
                if name in self._blank:
                    array.reserve()
                else:
                    array.upload()
            self._blank.clear()
            self._resident = True
        yield
        if not self._only:
            self._park()

    def stage(self, frames: NDArray[Any], lent: bool = False, whole: bool = False) -> Iterator[Staged]:
        """Bring frames, (n, H, W), to the device, piece by piece; give each to its kernels before the next.

        Nothing is copied where the device shares the host's memory, as long as frames lie there as kernels
        need them. A device of its own memory takes them beside the kernels on those before. When all are
        through, the frames' memory may be written anew, unless it is lent (nobody writes to it as long as it
        is referred to): then kernels may still be at work. ``whole`` frames, at most ``length`` of them, come
        in one piece.
        """
        frames = frames[:, self.rows]
        start = 0
        while start < len(frames):
            rest = frames[start:]
            if self._places:
                yield (staged := self._bring(rest, start))
                self._places[0].wait()
            else:
                yield (staged := self._see(rest[: self._most], start, whole))
                assert self._borrowed is not None
                if not (lent and np.may_share_memory(self._borrowed.host, rest)):
                    self._borrowed.wait()
            start = staged.frames.stop

    def _see(self, frames: NDArray[Any], start: int, whole: bool) -> Staged:
        """Let the device see frames where they lie, or copies of some."""
        borrowed = self._device.borrow("frames", frames)
        if borrowed is None and not whole and frames.flags.c_contiguous and len(frames) > 1:
            borrowed = self._device.borrow("frames", frames[:-1])  # the memory may end behind the last
        if borrowed is None:
            room = self.room[: len(frames)]
            room[...] = frames[: len(room)]
            borrowed = BorrowedBuffer(self._device, "frames", room)
        # The one before waits for its kernels: when more frames are read, only these here can be under way.
        self._borrowed = borrowed
        return Staged(borrowed, slice(start, start + len(borrowed.host)))

    def _bring(self, frames: NDArray[Any], start: int) -> Staged:
        """Begin to copy frames to one of two places on the device, while kernels work on the other."""
        self._places.reverse()
        part = np.ascontiguousarray(frames[: self._places[0].shape[0]])
        self._places[0].upload_async(part)
        return Staged(self._places[0], slice(start, start + len(part)))

    def _make(self, name: str) -> Array:
        kind = self._kinds[name]
        if isinstance(kind, Planes):
            return self._device.array(name, (kind.count, self.stride), kind.dtype, zeroed=False)
        return self._device.array(name, self._shape, kind, zeroed=False)

    def _park(self) -> None:
        for name, array in self.maps.items():
            if name in self._blank:
                array.discard()
            else:
                array.evict()
        for place in self._places:
            place.discard()
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
                message = f"one row of {shape[1]} pixels does not fit: {error}"
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
    room = bands[0].room
    if len(bands) == 1:
        return room
    return np.empty((length, bands[-1].rows.stop, room.shape[2]), room.dtype)


def join_rows(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Put a map together from those of the bands; that of a single one is taken as it is."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _places(
    device: Device, length: int, least: int, shape: tuple[int, int], dtype: np.dtype[Any]
) -> list[Array]:
    """Make two places on a device for as many frames as fit, up to a length; one, where two do not."""
    length = max(least, min(length, _PIECE // (math.prod(shape) * dtype.itemsize)))
    places: list[Array] = []
    while len(places) < 2:
        try:
            places.append(device.array("frames", (length, *shape), dtype, zeroed=False))
        except DeviceMemoryError:
            if places:
                break
            if length <= least:
                raise
            length = max(least, length // 2)
    return places
