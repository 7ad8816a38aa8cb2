"""A picture's maps and staged frames on devices: in one piece if they fit, otherwise in bands of rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from threading import Event
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.base.device_arrays import AnyArray
from mirrorskin.kernels import memory
from mirrorskin.kernels.array import SLACK, Array, BorrowedBuffer, Operand, fetch
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.device import free_memory as free_memory
from mirrorskin.kernels.errors import DeviceError, DeviceMemoryError

T = TypeVar("T")

MEMORY_LIMIT = 256_000_000
"""Default number of bytes of host memory for staged frames."""

_MOST_PIXELS = 2**30  # kernels index the pixels of two planes with an int
_LINE = 64  # bytes of the longest word that a kernel loads at once
_RESERVED = 64_000_000  # bytes of frames with reserved discrete memory: enough for the full transfer rate
_PIECE = 512_000_000  # most bytes of frames in discrete memory: each launch also moves the pixels' state
_STEP = 16  # frames: long pieces are multiples of it


@dataclass(frozen=True, slots=True)
class Planes:
    """Several maps in one array, each padded to full words; ``("f4", 3)`` is the type of maps of vectors."""

    count: int
    dtype: DTypeLike


@dataclass(frozen=True, slots=True)
class Staged:
    """Frames on a device, or being copied there, for the next kernels.

    Attributes
    ----------
    array : Array or BorrowedBuffer, (n, rows, W)
    frames : slice
        Positions among the pushed frames.
    """

    array: Operand
    frames: slice

    @property
    def count(self) -> int:
        """Number of these frames."""
        return int(self.frames.stop - self.frames.start)


class _Maps(dict[str, Array]):
    """Arrays by name; one that was taken out is created again when it is used."""

    def __init__(
        self, device: Device, kinds: Mapping[str, DTypeLike | Planes], shape: tuple[int, int], stride: int
    ) -> None:
        super().__init__()
        self._device, self._kinds, self._shape, self._stride = device, kinds, shape, stride
        for name in kinds:
            self[name]

    def __missing__(self, name: str) -> Array:
        kind = self._kinds[name]
        if isinstance(kind, Planes):
            shape, dtype = (kind.count, self._stride), np.dtype(kind.dtype)
        else:
            shape, dtype = self._shape, np.dtype(kind)
        array = self[name] = self._device.array(name, (*shape, *dtype.shape), dtype.base, zeroed=False)
        return array


class Band:
    """A band of rows of a picture on a device: named maps, and memory for some frames.

    Attributes
    ----------
    device : Device
    rows : slice
        Rows of the picture.
    usable : slice
        Those of its rows that belong to no other band.
    pixels : int
    stride : int
        Pixels from plane to plane.
    maps : dict of Array, (rows, W), or (count, stride) for `Planes`
        Uninitialised at first; vectors have a third axis.
    length : int
        Number of frames that fit in the memory.
    stop : Event
        Shared by the bands of a picture: set if no more frames should be staged.
    """

    device: Device
    rows: slice
    usable: slice
    pixels: int
    stop: Event

    def __init__(
        self,
        device: Device,
        rows: slice,
        columns: int,
        dtype: np.dtype[Any],
        maps: Mapping[str, DTypeLike | Planes],
        length: int,
        min_frames: int,
        stop: Event,
    ) -> None:
        self._shape = shape = (rows.stop - rows.start, columns)
        self.device, self._dtype, self.stop = device, dtype, stop
        self.rows, self.usable, self.pixels = rows, slice(0, shape[0]), shape[0] * shape[1]
        word = _LINE // dtype.itemsize
        self.stride: int = -(-self.pixels // word) * word
        if self.stride > _MOST_PIXELS:
            raise DeviceMemoryError(
                f"kernels number pixels to {_MOST_PIXELS}; {self.pixels} are too many at once"
            )
        self.maps: dict[str, Array] = _Maps(device, maps, shape, self.stride)
        self._most = device.max_allocation // (self.pixels * dtype.itemsize)  # frames in one buffer
        if self._most < min_frames:
            raise DeviceMemoryError(f"{device.info.title} has no memory for {min_frames} frames")
        self.length: int = min(length, self._most)
        self._buffers = (
            [] if device.info.shares_memory else _frame_buffers(device, self.length, min_frames, shape, dtype)
        )
        self._longest = _PIECE // (self.pixels * dtype.itemsize) // _STEP * _STEP  # frames in one piece
        self._borrowed: BorrowedBuffer | None = None
        self._only = True  # whether the picture has no other bands
        self._blank = set(maps)  # maps that are uninitialised

    @cached_property
    def staging_buffer(self) -> NDArray[Any]:
        """Staging buffer for frames, (length, rows, W)."""
        nbytes = self.length * self.pixels * self._dtype.itemsize
        buffer = memory.take(nbytes + SLACK, zeroed=False)[:nbytes]
        return buffer.view(self._dtype).reshape(self.length, *self._shape)

    def release_frames(self) -> int:
        """Free the staging buffer; return its bytes."""
        self._borrowed = None
        buffer = vars(self).pop("staging_buffer", None)
        return 0 if buffer is None else int(buffer.nbytes)

    def share_device(self) -> None:
        """Free the device's memory for other bands while this one is not used."""
        self._only = False
        self._park()

    def write(self, name: str, values: ArrayLike, plane: int | None = None) -> None:
        """Fill a map, or one of several planes; a number, broadcast or not, is set on the device."""
        array, values = self.maps[name], np.asarray(values)
        self._blank.discard(name)
        if plane is None and not any(values.strides):
            array.fill(values.flat[0].item())
        else:
            array.write(np.broadcast_to(values, (*self._shape, *array.shape[2:])), plane or 0)
        if not self._only:
            self._park()

    def own_rows(self, values: NDArray[Any], plane: int | None) -> NDArray[Any]:
        """Return a map, (rows, W), or one of several planes, of the rows that belong to no other band."""
        if plane is not None:
            values = values[plane, : self.pixels].reshape(*self._shape, *values.shape[2:])
        return values[self.usable]

    def take_map(self, name: str, plane: int, keep: bool) -> Array:
        """Return a map, (rows, W), or one of several planes, on the device.

        It is a copy if the map is to ``keep``, or has padding or other planes. Otherwise the map is
        uninitialised afterwards.
        """
        array = self.maps[name]
        vector = array.shape[2:]
        shape = *self._shape, *vector
        if keep or math.prod(shape) != math.prod(array.shape):
            return array.copy_region(plane * self.stride * math.prod(vector), shape)
        del self.maps[name]
        array.reshape(shape)
        return array

    def fetch(self, parts: Mapping[str, int | slice], keep: Collection[str] = ()) -> list[NDArray[Any]]:
        """Wait once, and return planes or rows of maps, (count, stride) or (rows, W).

        Maps to ``keep`` are copied. The other maps are uninitialised afterwards, and their memory is returned
        without a copy if it is shared with the device.
        """
        with self.resident():
            maps = [(self.maps[name] if name in keep else self.maps.pop(name), parts[name]) for name in parts]
            return fetch(maps, [name in keep for name in parts])

    @contextmanager
    def resident(self) -> Iterator[None]:
        """Keep the maps on the device within a context."""
        self._blank.clear()
        yield
        if not self._only:
            self._park()

    def stage(self, frames: AnyArray, stay_valid: bool = False, whole: bool = False) -> Iterator[Staged]:
        """Yield frames, (n, H, W), on the device in pieces; launch the kernels for each before the next.

        Frames that are already on the device are yielded in one piece; DeviceMemoryError if there is no
        memory for the maps of the whole picture in addition.

        If the device shares the host's memory, frames are used in place if their layout allows it. On a
        device with its own memory, they are copied while kernels process the previous piece. Afterwards the
        memory of the frames may be overwritten, except if they ``stay_valid`` (it is never overwritten while
        referenced): then kernels may still read it. ``whole``: yield at most ``length`` frames in one piece.

        The iteration ends before the next piece if ``stop`` is set; see `for_each_band`.
        """
        if isinstance(frames, Array):
            if not self._only:
                raise DeviceMemoryError(
                    f"{self.device.info.title} has no memory for maps besides {len(frames)} frames: "
                    "pass the frames as a NumPy array"
                )
            yield Staged(frames, slice(0, len(frames)))
            return
        frames = frames[:, self.rows]
        start = 0
        while start < len(frames):
            if self.stop.is_set():
                raise _StoppedError
            rest = frames[start:]
            if self._buffers:
                yield (staged := self._copy(rest, start))
            else:
                yield (staged := self._share(rest[: self._most], start, whole))
                assert self._borrowed is not None
                if not (stay_valid and np.may_share_memory(self._borrowed.host, rest)):
                    self._borrowed.wait()
            start = staged.frames.stop

    def _share(self, frames: NDArray[Any], start: int, whole: bool) -> Staged:
        """Share frames with the device in place, or copies of some."""
        borrowed = self.device.borrow("frames", frames)
        if borrowed is None and not whole and frames.flags.c_contiguous and len(frames) > 1:
            borrowed = self.device.borrow("frames", frames[:-1])  # the memory may end after the last frame
        if borrowed is None:
            copied = self.staging_buffer[: len(frames)]
            copied[...] = frames[: len(copied)]
            borrowed = BorrowedBuffer(self.device, "frames", copied, copied.ctypes.data)
        # Releasing the previous buffer waits for its kernels, so at most one piece is being processed.
        self._borrowed = borrowed
        return Staged(borrowed, slice(start, start + borrowed.shape[0]))

    def _copy(self, frames: NDArray[Any], start: int) -> Staged:
        """Start to copy frames to one of two buffers on the device, while kernels process the other."""
        self._grow(min(len(frames), self._longest, self._most))
        self._buffers.reverse()
        part = frames[: self._buffers[0].shape[0]]
        self._buffers[0].write(part)
        return Staged(self._buffers[0], slice(start, start + len(part)))

    def _grow(self, length: int) -> None:
        """Replace the buffers for frames by longer ones, if this is the only band and there is memory."""
        if not self._only or length <= len(self._buffers[0]):
            return
        shape = length, *self._shape
        try:
            self._buffers = [self.device.array("frames", shape, self._dtype, zeroed=False) for _ in range(2)]
        except DeviceMemoryError:
            self._longest = len(self._buffers[0])

    def _park(self) -> None:
        for name, array in self.maps.items():
            array.park(keep=name not in self._blank)
        for place in self._buffers:
            place.park(keep=False)


def split_into_bands(
    devices: Sequence[Device],
    shape: tuple[int, int],
    dtype: np.dtype[Any],
    maps: Mapping[str, DTypeLike | Planes],
    length: int,
    min_frames: int = 1,
    around: int = 0,
) -> list[Band]:
    """Allocate the bands of a picture: one on each device if its memory is enough, else as few as possible.

    Devices get equal numbers of rows. ``shape`` is rows and columns of the picture, ``dtype`` that of
    samples, ``maps`` the arrays of pixels. A band has memory for ``length`` frames, or fewer if they do not
    fit, but at least ``min_frames``. It overlaps with others by ``around`` rows on each side. DeviceError if
    a single row does not fit.
    """
    stop = Event()

    def split(device: Device, start: int, end: int) -> list[Band]:
        try:
            rows = slice(max(0, start - around), min(shape[0], end + around))
            band = Band(device, rows, shape[1], dtype, maps, length, min_frames, stop)
            band.usable = slice(start - rows.start, end - rows.start)
            return [band]
        except DeviceMemoryError as error:
            if end - start == 1:
                message = f"one row of {shape[1]} pixels does not fit: {error}"
                raise DeviceError(message) from error
        middle, bands = (start + end) // 2, []
        for half in ((start, middle), (middle, end)):
            bands += split(device, *half)
            for band in bands:
                band.share_device()
        return bands

    used = devices[: shape[0]]
    cuts = [shape[0] * number // len(used) for number in range(len(used) + 1)]
    return [band for device, rows in zip(used, pairwise(cuts), strict=True) for band in split(device, *rows)]


def for_each_band(bands: Sequence[Band], work: Callable[[Band], T]) -> list[T]:
    """Return the results of a function for each band.

    Several devices work at the same time, in a thread each. If one fails, or the program is interrupted, the
    others stop before their next frames, and the first error is raised, with the device in its message.
    Therefore ``work`` must not use locks that the caller holds, such as the public methods of a `Run`.
    """
    by_device: dict[Device, list[Band]] = {}
    for band in bands:
        by_device.setdefault(band.device, []).append(band)
    if len(by_device) == 1:
        return [work(band) for band in bands]
    stop = bands[0].stop
    stop.clear()
    with ThreadPoolExecutor(len(by_device), "mirrorskin-device") as threads:
        try:
            running = [
                threads.submit(_run_on_device, own_bands, work, stop) for own_bands in by_device.values()
            ]
            errors = [future.exception() for future in running]
        except BaseException:  # Ctrl-C
            stop.set()
            raise
    for error in errors:
        if error is not None and not isinstance(error, _StoppedError):
            raise error
    return [value for future in running for value in future.result()]


class _StoppedError(Exception):
    """Work on a device ended early, because another device failed."""


def _run_on_device(bands: Sequence[Band], work: Callable[[Band], T], stop: Event) -> list[T]:
    """Return the results of a function for the bands of one device; stop the others if it fails."""
    values = []
    try:
        for band in bands:
            if stop.is_set():
                raise _StoppedError
            values.append(work(band))
    except DeviceError as error:
        stop.set()
        raise type(error)(f"device {bands[0].device.number}: {error}") from None
    except BaseException:
        stop.set()
        raise
    return values


def staging_buffer_of(bands: Sequence[Band], length: int) -> NDArray[Any]:
    """Return a staging buffer for frames: of the only band, or host memory for ``length`` frames."""
    buffer = bands[0].staging_buffer
    if len(bands) == 1:
        return buffer
    return np.empty((length, bands[-1].rows.stop, buffer.shape[2]), buffer.dtype)


def join_rows(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return a map joined from the maps of the bands, without a copy for a single band."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _frame_buffers(
    device: Device, length: int, min_frames: int, shape: tuple[int, int], dtype: np.dtype[Any]
) -> list[Array]:
    """Allocate two buffers for frames on a device, up to a length; one if two do not fit."""
    length = max(min_frames, min(length, _RESERVED // (math.prod(shape) * dtype.itemsize)))
    places: list[Array] = []
    while len(places) < 2:
        try:
            places.append(device.array("frames", (length, *shape), dtype, zeroed=False))
        except DeviceMemoryError:
            if places:
                break
            if length <= min_frames:
                raise
            length = max(min_frames, length // 2)
    return places
