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

from mirrorskin.engine.tiling import (
    Band,
    Planes,
    Staged,
    cut_into_bands,
    for_each_band,
    join_rows,
    staging_buffer_of,
)
from mirrorskin.kernels.device import C_TYPES

if TYPE_CHECKING:
    from mirrorskin.engine.device_arrays import AnyArray
    from mirrorskin.engine.operation import Operation

Part: TypeAlias = "str | tuple[str, int]"
"""A map, or one of its planes."""


@dataclass(frozen=True, slots=True)
class PerFrame:
    """An argument of a kernel with a number, or some, for each of the frames, (n, ...)."""

    values: ArrayLike


@dataclass(frozen=True, slots=True)
class PerPixel:
    """An argument of a kernel with a value for each pixel, (H, W), or with one number."""

    values: NDArray[Any]


class Picture:
    """Maps of a picture on the devices of an operation, and kernels that compute them from frames.

    A picture that does not fit on a device is divided into bands of rows, as is one on several devices.

    Each work-item of a kernel processes ``TILE`` pixels, and ``FRAME`` is the type of a sample. A kernel gets
    its arguments by name, and without being asked those of these that it has: all maps; ``pixels``, ``rows``
    and ``columns``; ``stride``, the pixels from plane to plane of a map; and in a scan ``frames``, ``count``
    and ``first``, the number of the first frame. Arrays are copied to the device, floats as float32.

    Parameters
    ----------
    operation : Operation
        It has started: shape and type of its frames are known.
    source : str or Path
        The kernels; see `mirrorskin.kernels.device.Device.kernel`.
    maps : mapping of dtype or Planes
        The maps by name, (H, W), uninitialised; such as ``("f4", 3)`` for vectors, (H, W, 3).
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
        around: int = 0,
        tile: int = 0,
        **macros: str | int,
    ) -> None:
        self._operation: Operation = proxy(operation)  # which owns it: memory is free with the last reference
        self._source, self._kinds, self._tile = source, maps, tile
        self._shape, self._length = operation.shape, operation.frames_at_once
        self._macros: dict[str, str | int] = {"FRAME": C_TYPES[operation.dtype.name], **macros}
        devices, dtype, self._itemsize = operation.devices, operation.dtype, operation.dtype.itemsize
        self.bands = cut_into_bands(devices, self._shape, dtype, maps, self._length, around=around)
        operation._picture = self  # frames are read into its staging buffer

    @cached_property
    def staging_buffer(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return staging_buffer_of(self.bands, self._length)

    def fill(self, name: str, values: ArrayLike, plane: int | None = None) -> None:
        """Set a map, or one of its planes, to a number or to a map, (H, W)."""
        for band in self.bands:
            band.write(name, np.broadcast_to(values, self._shape)[band.rows], plane)

    def run(self, kernel: str, **arguments: Any) -> None:
        """Launch a kernel for all pixels."""

        def launch(band: Band) -> None:
            with band.resident():
                self._launch(band, kernel, arguments)

        for_each_band(self.bands, launch)

    def scan(self, kernel: str, frames: AnyArray, *, first: int | None = None, **arguments: Any) -> None:
        """Launch a kernel for all pixels of the pushed frames, possibly in parts, one after the other.

        ``first`` is the number of the first of them, by default in the pass.
        """
        before = self._operation.count if first is None else first

        def launch(band: Band) -> None:
            with band.resident():
                for staged in band.stage(frames, self._operation._stay_valid):
                    self._launch(band, kernel, arguments, staged, before)

        for_each_band(self.bands, launch)

    def take(self, *parts: Part, on_host: bool = False) -> list[Any]:
        """Return maps, or planes of them, for a result: on the device if the frames are, unless ``on_host``.

        When the operation has ended, they may not be copies, and are uninitialised afterwards.
        """
        if on_host or not self._operation._on_device:
            return self._fetch(parts, keep=not self._operation.ended)
        (band,) = self.bands
        return [band.cut(*_named(part)) for part in parts]

    def read(self, *parts: Part) -> list[NDArray[Any]]:
        """Return copies of maps, or of planes of them, on the host."""
        return self._fetch(parts, keep=True)

    def _fetch(self, parts: Sequence[Part], keep: bool) -> list[NDArray[Any]]:
        chosen, planes, spans = [_named(part) for part in parts], dict[str, list[int]](), dict[str, slice]()
        for name, plane in chosen:
            planes.setdefault(name, []).append(plane)
            padded = isinstance(self._kinds[name], Planes)
            spans[name] = slice(min(planes[name]), max(planes[name]) + 1) if padded else slice(None)

        def fetch(band: Band) -> list[NDArray[Any]]:
            values = dict(zip(spans, band.fetch(spans, keep=spans if keep else ()), strict=True))
            return [band.own_rows(values[name], plane - (spans[name].start or 0)) for name, plane in chosen]

        return [join_rows(each) for each in zip(*for_each_band(self.bands, fetch), strict=True)]

    def _launch(
        self, band: Band, name: str, given: Mapping[str, Any], staged: Staged | None = None, first: int = 0
    ) -> None:
        """Launch a kernel for the pixels of a band, with what it needs of its arguments."""
        tile = self._tile if self._tile and band.device.layout.tile > 1 else band.device.layout.tile
        kernel = band.device.kernel(self._source, name, **self._macros, TILE=tile)
        known: dict[str, Any] = {name: band.maps[name] for name in self._kinds if name in kernel.arguments}
        moved = sum(array.nbytes for array in known.values())
        rows = band.rows.stop - band.rows.start
        known |= {"pixels": band.pixels, "rows": rows, "columns": self._shape[1], "stride": band.stride}
        if staged is not None:
            known |= {"frames": staged.array, "count": staged.count, "first": first + staged.frames.start}
            moved = staged.count * band.pixels * self._itemsize
        known = {name: value for name, value in known.items() if name in kernel.arguments}
        known |= {name: _on(band, name, value, staged) for name, value in given.items()}
        kernel(-(-band.pixels // tile), moved=moved, **known)


def _named(part: Part) -> tuple[str, int]:
    return (part, 0) if isinstance(part, str) else part


def _on(band: Band, name: str, value: Any, staged: Staged | None) -> Any:
    """Return an argument for the pixels and the frames of a launch, on the device if it is an array."""
    if isinstance(value, PerPixel):
        rows = value.values[band.rows] if value.values.ndim else value.values.reshape(1)
        return band.device.share(name, np.ascontiguousarray(rows))
    if isinstance(value, PerFrame):
        assert staged is not None
        value = np.asarray(value.values, np.float64)[staged.frames]
    if not isinstance(value, np.ndarray):
        return value
    return band.device.from_host(name, value, np.float32 if value.dtype.kind == "f" else value.dtype)
