"""Room on a device for a picture's maps and some frames: in one piece if it fits, else in bands of rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.kernels.device import Array, Device
from mirrorskin.kernels.errors import DeviceError, DeviceMemoryError

MEMORY_LIMIT = 256_000_000
"""Bytes of host memory for frames on the move, where nothing else is said."""

_MOST_PIXELS = 2**30  # kernels number those of two planes with an int
_LINE = 64  # bytes of the longest word that a kernel loads at once


@dataclass(frozen=True, slots=True)
class Planes:
    """Several maps in one array, each padded to whole words of the frames' samples."""

    count: int
    dtype: DTypeLike


class Band:
    """Some rows of a picture on a device: named maps, and room for some frames.

    Attributes
    ----------
    rows : slice
        The rows of the picture that it holds.
    pixels : int
    stride : int
        Pixels from plane to plane.
    maps : dict of Array, (rows, W), or (count, stride) where planes were asked for
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
        shape = (rows.stop - rows.start, columns)
        self.rows = rows
        self.pixels = shape[0] * shape[1]
        word = _LINE // dtype.itemsize
        self.stride = -(-self.pixels // word) * word
        if self.stride > _MOST_PIXELS:
            raise DeviceMemoryError(
                f"kernels number pixels to {_MOST_PIXELS}; {self.pixels} are too many at once"
            )
        self._shape = shape
        self._device, self._kinds = device, maps
        self.maps = {name: self._make(name) for name in maps}
        self.frames = _longest(device, length, least, shape, dtype)
        self._alone = True
        self._resident = False

    def yield_room(self) -> None:
        """Leave the device to other bands whenever this one is not at work."""
        self._alone = False
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

    def hand_over(self, name: str) -> NDArray[Any]:
        """Give away what a map holds, (count, stride) or (rows, W), without a copy, and make a new one."""
        given = self.maps[name].hand_over()
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
        if not self._alone:
            self._park()

    def stage(self, frames: NDArray[Any]) -> Iterator[tuple[int, int]]:
        """Bring frames to the device piece by piece, without a copy where they lie in its room already.

        Parameters
        ----------
        frames : ndarray, (n, H, W)

        Yields
        ------
        start, count : int
            Which of the frames are there now.
        """
        room = self.frames.host
        in_place = (
            frames.ctypes.data == room.ctypes.data and frames.flags.c_contiguous and len(frames) <= len(room)
        )
        step = max(1, len(frames) if in_place else len(room))
        for start in range(0, len(frames), step):
            part = frames[start : start + step]
            if not in_place:
                room[: len(part)] = part[:, self.rows]
            self.frames.upload(len(part))
            yield start, len(part)
            self.frames.claim()

    def _make(self, name: str) -> Array:
        kind = self._kinds[name]
        if isinstance(kind, Planes):
            return self._device.array(name, (kind.count, self.stride), kind.dtype)
        return self._device.array(name, self._shape, kind)

    def _park(self) -> None:
        for array in self.maps.values():
            array.park()
        self.frames.drop()
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

    Parameters
    ----------
    device : Device
    shape : (int, int)
        Rows and columns of the picture.
    dtype : dtype
        Type of a sample.
    maps : mapping of str to dtype or Planes
        The maps that are needed of each pixel.
    length : int
        Frames that a band should hold; fewer where they do not fit.
    least : int
        Frames that it must hold.

    Raises
    ------
    DeviceError
        Not even one row fits.
    """

    def cut(rows: slice) -> list[Band]:
        try:
            return [Band(device, rows, shape[1], dtype, maps, length, least)]
        except DeviceMemoryError as error:
            if rows.stop - rows.start == 1:
                message = f"one row of {shape[1]} pixels does not fit: {error}; use another device"
                raise DeviceError(message) from error
        middle = (rows.start + rows.stop) // 2
        bands = []
        for half in (slice(rows.start, middle), slice(middle, rows.stop)):
            bands += cut(half)
            for band in bands:
                band.yield_room()
        return bands

    return cut(slice(0, shape[0]))


def _longest(device: Device, length: int, least: int, shape: tuple[int, int], dtype: np.dtype[Any]) -> Array:
    while True:
        try:
            return device.array("frames", (length, *shape), dtype)
        except DeviceMemoryError:
            if length <= least:
                raise
            length = max(least, length // 2)
