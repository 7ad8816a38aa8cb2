"""Maps of a picture on the devices of an operation, which kernels compute from frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from weakref import proxy

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.base.device_arrays import viewed
from mirrorskin.engine.base.tiling import (
    Band,
    Planes,
    for_each_band,
    join_rows,
    split_into_bands,
    staging_buffer_of,
)
from mirrorskin.kernels import memory
from mirrorskin.kernels.device import C_TYPES, Device
from mirrorskin.kernels.embedded import vector_width

if TYPE_CHECKING:
    from mirrorskin.engine.base.device_arrays import AnyArray
    from mirrorskin.engine.base.operation import Operation
    from mirrorskin.kernels.array import Array

_FIRST_ROWS = 64  # frames for which `Appended` has room at first
_MOST_CACHED = 2**26  # bytes of frames whose memory is cached for the next run

Part: TypeAlias = "str | tuple[str, int]"
"""A map, or one of its planes."""


@dataclass(frozen=True, slots=True)
class PerFrame:
    """An argument of a kernel with a number, or some, for each of the frames, (n, ...): float32, or int32."""

    values: ArrayLike

    def of(self, frames: NDArray[np.intp]) -> NDArray[Any]:
        """Return the numbers of some frames."""
        numbers = np.asarray(self.values)
        return numbers.astype(np.int32 if numbers.dtype == np.int32 else np.float64)[frames]


@dataclass(frozen=True, slots=True)
class PerPixel:
    """An argument of a kernel with a value for each pixel, (H, W), or with one number."""

    values: NDArray[Any]


class Appended:
    """Numbers for each frame so far, (n, width), float32 if they are an argument of a kernel.

    A launch copies only those to the device that were appended since the last one.
    """

    def __init__(self, width: int, dtype: DTypeLike = np.float32) -> None:
        self._values, self._count = np.zeros((_FIRST_ROWS, width), dtype), 0
        self._copies: dict[Device, tuple[Array, int]] = {}  # and the number of rows that were copied

    @property
    def values(self) -> NDArray[Any]:
        """The numbers, which later ones do not change."""
        return self._values[: self._count]

    def append(self, rows: ArrayLike) -> None:
        """Append the numbers of the next frames, (n, width)."""
        rows = np.asarray(rows)
        first, self._count = self._count, self._count + len(rows)
        if self._count > len(self._values):  # frames may come one by one
            self._values = np.pad(self._values, ((0, 2 * self._count - len(self._values)), (0, 0)))
        self._values[first : self._count] = rows

    def clear(self) -> None:
        """Remove all numbers."""
        self._values, self._count = np.zeros_like(self._values), 0
        self._copies = {device: (array, 0) for device, (array, _) in self._copies.items()}

    def on(self, name: str, device: Device) -> Array:
        """Return the numbers on a device."""
        array, copied = self._copies.get(device, (None, 0))
        if array is None or array.shape != self._values.shape:
            array, copied = device.array(name, self._values.shape, np.float32), 0
        if copied < self._count:
            array.write(self._values[copied : self._count], copied)
        self._copies[device] = array, self._count
        return array


class Picture:
    """Maps of a picture on the devices of an operation, and kernels that compute them from frames.

    A picture that does not fit on a device is divided into bands of rows, as is one on several devices.

    Each work-item of a kernel processes ``TILE`` pixels, in vectors of ``LANES`` if it uses these;
    ``FRAME`` is the type of a sample, and ``BITS`` its width. A kernel gets its arguments by name, and
    without being asked those of these that it has: all maps; ``pixels``, ``rows`` and ``columns``;
    ``above``, the rows of the picture above the band; ``stride``, the pixels from plane to plane of a map;
    ``each``, the samples from frame to frame of ``frames``; and in a scan ``frames``, their number
    ``count``, and ``first``, the number of the first of them. Arrays are copied to the device, floats as
    float32. A map called ``frames`` holds frames of its own.

    Parameters
    ----------
    operation : Operation
        It has started: shape and type of its frames are known.
    source : str or Path
        The kernels; see `mirrorskin.kernels.device.Device.kernel`.
    maps : mapping of dtype or Planes
        The maps by name, (H, W), uninitialised; such as ``("f4", 3)`` for vectors, (H, W, 3).
    constants : mapping of ndarray
        Other arrays that kernels get by name; each is copied to a device once.
    whole : int
        Number of frames that kernels need in one piece.
    around : int
        Rows above and below a pixel that kernels read.
    tile : int
        Pixels of a work-item on a CPU; 0 for the device's.
    **macros
        More macros of the kernels.
    """

    def __init__(
        self,
        operation: Operation,
        source: str | Path,
        maps: Mapping[str, DTypeLike | Planes],
        *,
        constants: Mapping[str, NDArray[Any]] | None = None,
        whole: int = 1,
        around: int = 0,
        tile: int = 0,
        **macros: str | int,
    ) -> None:
        self._operation: Operation = proxy(operation)  # which owns it: memory is free with the last reference
        self._source, self._kinds, self._tile = source, maps, tile
        self._shape, self._length = operation.shape, max(whole, operation.frames_at_once)
        devices, dtype, self._itemsize = operation.devices, operation.dtype, operation.dtype.itemsize
        self._macros: dict[str, str | int] = {"FRAME": C_TYPES[dtype.name], "BITS": 8 * self._itemsize}
        self._macros |= macros
        self.bands = split_into_bands(devices, self._shape, dtype, maps, self._length, whole, around)
        self._constants = {
            device: {name: _copied(device, name, values) for name, values in (constants or {}).items()}
            for device in {band.device for band in self.bands}
        }
        operation._picture = self  # frames are read into its staging buffer

    @cached_property
    def staging_buffer(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return staging_buffer_of(self.bands, self._length)

    def release_frames(self) -> None:
        """Free the memory of frames, since no more follow: large buffers are not kept for the next run."""
        vars(self).pop("staging_buffer", None)
        if sum(band.release_frames() for band in self.bands) > _MOST_CACHED:
            memory.free()

    def fill(self, name: str, values: ArrayLike, plane: int | None = None) -> None:
        """Set a map, or one of its planes, to a number or to a map, (H, W), or (H, W, n) of vectors."""
        values = np.asarray(values)
        for band in self.bands:
            band.write(name, np.broadcast_to(values, (*self._shape, *values.shape[2:]))[band.rows], plane)

    def run(self, kernel: str, *, source: str | Path | None = None, **arguments: Any) -> None:
        """Launch a kernel, perhaps of another source, for all pixels."""

        def launch(band: Band) -> None:
            with band.resident():
                self._launch(band, source, kernel, arguments)

        for_each_band(self.bands, launch)

    def scan(
        self,
        kernel: str,
        frames: AnyArray,
        *,
        source: str | Path | None = None,
        first: int | None = None,
        chosen: NDArray[np.bool_] | None = None,
        whole: bool = False,
        **arguments: Any,
    ) -> None:
        """Launch a kernel for all pixels of the pushed frames, possibly in parts, one after the other.

        Parameters
        ----------
        kernel : str
        frames : ndarray or device array, (n, H, W)
        source : str or Path, optional
            Another source of the kernel.
        first : int, optional
            Number of the first frame, by default in the pass.
        chosen : ndarray, (n,), bool, optional
            The frames that are processed: ``place`` are their positions in the frames that the kernel gets,
            and ``count`` and ``first`` count these alone. By default all are.
        whole : bool
            Whether all are processed at once, and may be overwritten afterwards although others stay valid.
        **arguments
            Further arguments of the kernel.
        """
        before = self._operation.count if first is None else first
        used = np.ones(len(frames), np.bool_) if chosen is None else chosen

        def launch(band: Band) -> None:
            with band.resident():
                for staged in band.stage(frames, self._operation._stay_valid and not whole, whole):
                    start, places = staged.frames.start, np.flatnonzero(used[staged.frames])
                    if not len(places):
                        continue
                    scanned = {"frames": staged.array, "count": len(places), "place": places.astype(np.int32)}
                    scanned |= {"first": before + int(np.count_nonzero(used[:start])), "each": band.pixels}
                    available = {
                        name: value.of(start + places) if isinstance(value, PerFrame) else value
                        for name, value in arguments.items()
                    }
                    self._launch(band, source, kernel, available, scanned, whole)

        for_each_band(self.bands, launch)

    def take(self, *parts: Part, on_host: bool = False) -> list[Any]:
        """Return maps, or planes of them, for a result: on the device if the frames are, unless ``on_host``.

        When the operation has ended, they may not be copies, and are uninitialised afterwards.
        """
        keep = not self._operation.ended
        if on_host or not self._operation._on_device:
            return self._fetch(parts, keep)
        (band,) = self.bands
        return [band.take_map(*_named(part), keep) for part in parts]

    def read(self, *parts: Part) -> list[NDArray[Any]]:
        """Return copies of maps, or of planes of them, on the host."""
        return self._fetch(parts, keep=True)

    def array(self, name: str) -> Array:
        """Return a map as one array on the device, which may have padding; a copy if it is in bands."""
        if len(self.bands) == 1:
            return self.bands[0].maps[name]
        (values,) = self.read(name)
        return self.bands[0].device.from_host(name, values, values.dtype)

    def view(self, name: str) -> AnyArray:
        """Return a map: on the device, on the host if they share memory, or a copy if it is in bands."""
        if len(self.bands) > 1:
            return self.read(name)[0]
        return viewed(self.array(name))

    def _fetch(self, parts: Sequence[Part], keep: bool) -> list[NDArray[Any]]:
        chosen, planes = [_named(part) for part in parts], dict[str, list[int]]()
        for name, plane in chosen:
            planes.setdefault(name, []).append(plane)
        spans = {
            name: slice(min(several), max(several) + 1)
            for name, several in planes.items()
            if isinstance(self._kinds[name], Planes)
        }

        def fetch(band: Band) -> list[NDArray[Any]]:
            rows = {name: spans.get(name, slice(None)) for name in planes}
            values = dict(zip(rows, band.fetch(rows, keep=rows if keep else ()), strict=True))
            return [
                band.own_rows(values[name], plane - spans[name].start if name in spans else None)
                for name, plane in chosen
            ]

        return [join_rows(each) for each in zip(*for_each_band(self.bands, fetch), strict=True)]

    def _launch(
        self,
        band: Band,
        source: str | Path | None,
        name: str,
        arguments: dict[str, Any],
        scanned: Mapping[str, Any] | None = None,
        whole: bool = True,
    ) -> None:
        """Launch a kernel for the pixels of a band, with what it needs of its arguments."""
        device = band.device
        tile = self._tile if self._tile and device.layout.tile > 1 else device.layout.tile
        macros = {**self._macros, "TILE": tile, "LANES": vector_lanes(device)}
        kernel = device.kernel(source or self._source, name, **macros)
        wanted = frozenset(kernel.arguments)
        available: dict[str, Any] = {name: band.maps[name] for name in self._kinds if name in wanted}
        moved = sum(array.nbytes for array in available.values()) if whole else 0
        available |= self._constants[device]
        available |= {"pixels": band.pixels, "rows": band.rows.stop - band.rows.start}
        available |= {"columns": self._shape[1], "above": band.rows.start}
        available |= {"stride": band.stride, "each": band.stride}
        if scanned is not None:
            available |= scanned
            moved += scanned["count"] * band.pixels * self._itemsize
        needed = {name: available[name] for name in wanted.intersection(available)} | arguments
        for name, value in needed.items():
            if isinstance(value, np.ndarray | PerPixel):
                needed[name] = _on(band, name, value)
            elif isinstance(value, Appended):
                needed[name] = value.on(name, band.device)
        kernel(-(-band.pixels // tile), moved=moved, **needed)


def _named(part: Part) -> tuple[str, int]:
    return (part, 0) if isinstance(part, str) else part


def _on(band: Band, name: str, value: NDArray[Any] | PerPixel) -> Any:
    """Return an array on the device, for the pixels of a launch."""
    if isinstance(value, PerPixel):
        rows = value.values[band.rows] if value.values.ndim else value.values.reshape(1)
        return band.device.share(name, np.ascontiguousarray(rows))
    return _copied(band.device, name, value)


def _copied(device: Device, name: str, values: NDArray[Any]) -> Array:
    """Return an array on a device, floats as float32."""
    return device.from_host(name, values, np.float32 if values.dtype.kind == "f" else values.dtype)


def vector_lanes(device: Device) -> int:
    """Return the number of pixels of a vector: 1 on a GPU, the width of registers on a CPU."""
    if device.layout.tile == 1:
        return 1
    return 16 if vector_width(device.queue.device) >= 16 else 8
