"""Memory: arrays on host and device, and buffers that belong to another owner."""

from __future__ import annotations

import ctypes
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cached_property, wraps
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar, cast

import numpy as np
import pyopencl as cl
from numpy.typing import DTypeLike, NDArray

from mirrorskin.kernels import memory
from mirrorskin.kernels.errors import DeviceError, DeviceMemoryError
from mirrorskin.kernels.mapping import Mapping
from mirrorskin.kernels.transfer import Piece
from mirrorskin.kernels.waiting import keep_for_ever, waiting

if TYPE_CHECKING:
    import pyopencl.array

    from mirrorskin.kernels.device import Device

SLACK = 64
"""Readable bytes after an array, which a kernel may load with its last word."""

POCL = "Portable Computing Language"
"""A platform whose processors work in the host's memory, which need not be mapped: waiting is enough.

A map or a copy is a command, which waits for those of other queues; a wait for a kernel does not.
"""

ZERO = 0
"""Fill values that are valid for all types."""

_NO_ROOM = {
    cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE,
    cl.status_code.OUT_OF_HOST_MEMORY,
    cl.status_code.OUT_OF_RESOURCES,
    cl.status_code.INVALID_BUFFER_SIZE,
}

_Given = ParamSpec("_Given")
_Made = TypeVar("_Made")


def device_error(device: Device, what: str, error: cl.Error) -> DeviceError:
    """Return an error that names the failed operation, the reason and the remedy."""
    return DeviceError(
        f"{device.info.title} cannot {what}: {error}; if this persists, choose another ('mirrorskin devices')"
    )


def _wrap_cl_errors(
    work: Callable[Concatenate[Any, _Given], _Made],
) -> Callable[Concatenate[Any, _Given], _Made]:
    """Run a method of an array in one thread at a time, and add device and array to OpenCL's errors."""

    @wraps(work)
    def locked(array: Array | BorrowedBuffer, /, *args: _Given.args, **kwargs: _Given.kwargs) -> _Made:
        with array._lock:
            try:
                with waiting:
                    return work(array, *args, **kwargs)
            except cl.Error as error:
                raise device_error(array.device, f"hold or copy {array.name}", error) from None

    return locked


class Array:
    """An array on host and device: one memory if they share it, otherwise a copy on each.

    It is initialised with zeros, or not at all. ``write``, ``fill`` and ``read`` copy values. ``release``
    ends the use, and does not copy shared memory. ``park`` frees memory on the device for other arrays.
    Kernels wait for earlier writes, and reads wait for kernels.

    ``numpy.asarray(array)`` is a copy on the host, ``array[rows]`` another array on the device, and
    ``as_pyopencl`` returns the same memory for pyopencl. If memory is shared,
    ``numpy.from_dlpack(array)`` is the array itself.

    Attributes
    ----------
    name : str
    device : Device
    shape : tuple of int
    dtype : dtype
    ndim, nbytes : int
    is_shared : bool
        Whether host and device have one memory.
    arrived : pyopencl.Event or None
        A copy under way that kernels have to wait for.
    last_use : pyopencl.Event or None
        The last kernel launched with it, unless it was written later.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    def __init__(
        self, device: Device, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], zeroed: bool
    ) -> None:
        self.name = name
        self.arrived: cl.Event | None = None
        self.last_use: cl.Event | None = None
        self.device = device
        self.is_shared: bool = device.info.shares_memory
        self._is_in_place = self.is_shared and device.info.kind == "cpu" and device.info.platform == POCL
        self._lock = threading.RLock()
        self._mapped: Mapping | None = None
        self._parked: NDArray[Any] | None = None  # values while there is no memory on the device
        self._is_parked = False
        self._is_exported = False  # whether others may still use the memory when this array is deleted
        self._buffer: cl.Buffer | None = None
        self.shape, self.dtype, self._zeroed = shape, dtype, zeroed
        self._filling: Any = ZERO if zeroed and not self.is_shared else None  # pending fill value
        self.nbytes: int = math.prod(shape) * dtype.itemsize
        if self.nbytes > device.max_allocation:
            raise DeviceMemoryError(_no_room(device, name, self.nbytes))
        # Shared memory needs no buffer yet: the first kernel sees all earlier writes of the host.
        if not self.is_shared:
            self._allocate()
        else:
            try:
                _ = self._host
            except MemoryError as error:
                raise DeviceMemoryError(_no_room(device, name, self.nbytes)) from error

    @cached_property
    def _host(self) -> NDArray[Any]:
        """The memory shared by host and device."""
        return self._memory[: self.nbytes].view(self.dtype).reshape(self.shape)

    @cached_property
    def _memory(self) -> NDArray[np.uint8]:
        return memory.take(self.nbytes + SLACK, self._zeroed)

    @property
    def latest(self) -> cl.Event | None:
        """The last command that wrote or read it on the device."""
        return self.last_use or self.arrived

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[Array]:
        return (self[row] for row in range(len(self)))

    def __getitem__(self, rows: int | slice) -> Array:
        """Return rows (an index, or a slice without a step) on the device: a copy unless all are selected."""
        start, shape = self._part(rows)
        return self if shape == self.shape else self.copy_region(start // self.dtype.itemsize, shape)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        if copy is False:
            raise ValueError(f"{self.name} is on a device and has to be copied: omit copy=False")
        return self.read().astype(self.dtype if dtype is None else dtype, copy=False)

    def __dlpack__(self, **options: Any) -> object:
        self.__dlpack_device__()
        self._map()
        return self._host.__dlpack__(**options)

    def __dlpack_device__(self) -> tuple[int, int]:
        if not self.is_shared:
            raise BufferError(
                f"{self.name} is in memory of {self.device.info.title} that other libraries cannot use:"
                " copy it with read() or numpy.asarray"
            )
        return np.empty(0).__dlpack_device__()

    def __del__(self) -> None:
        # A command may still use this memory, which another array will reuse. On a lost device none does.
        if not self.is_shared:
            self._give_back()
        elif self.latest is not None:
            _wait_before_end(self.latest, self._memory)

    @_wrap_cl_errors
    def write(self, values: NDArray[Any], row: int = 0) -> None:
        """Copy values, in C order, to the rows from ``row`` on; the caller may change them immediately."""
        row_size = math.prod(self.shape[1:])
        whole = row == 0 and values.size == row_size * self.shape[0]
        if self._is_parked:
            if self._parked is None:
                self._parked = _empty(self.shape, self.dtype)
                if self._filling is not None:
                    self._parked[...] = self._filling
            _put(self._parked, values, row * row_size)
        elif self.is_shared:
            self._let_host_write(whole)
            _put(self._host, values, row * row_size)
        else:
            self._copy_up(values, row * row_size * self.dtype.itemsize)

    @_wrap_cl_errors
    def fill(self, value: float | np.generic = ZERO) -> None:
        """Set all elements to a number."""
        if self.is_shared:
            self._let_host_write(whole=True)
            self._host[...] = value
        else:
            self._filling, self._parked = value, None

    @_wrap_cl_errors
    def read(self, rows: int | slice = slice(None), after: cl.Event | None = None) -> NDArray[Any]:
        """Wait for the device and return a copy of rows (an index, or a slice without a step).

        ``after`` is the kernel to wait for if later ones only read; by default all commands are waited for.
        """
        if after is None:
            return self._read(rows, self.device.queue, [self.latest] if self.latest else [])
        self.device.queue.flush()
        return self._read(rows, self.device.copies, [after])

    @_wrap_cl_errors
    def release(self) -> NDArray[Any]:
        """Wait for the device and return the values; the array must not be used any more.

        Shared memory is returned without a copy.
        """
        if not self.is_shared:
            values = self.read()
            self._give_back()
            return values
        self._map()
        if self._mapped is not None:
            self._mapped.release()
            self._mapped = None
            self.device.finish()
        return self._host

    @_wrap_cl_errors
    def park(self, keep: bool = True) -> None:
        """Free the memory on the device until a kernel uses the array; the host keeps its values, or none.

        Shared memory is unchanged.
        """
        if self.is_shared or self._is_parked:
            return
        if keep and self._filling is None:
            self._parked = self.read()
        self._give_back()
        self._is_parked = True

    def reshape(self, shape: tuple[int, ...]) -> None:
        """Give the same elements another shape."""
        self.shape = shape
        vars(self).pop("_host", None)

    @_wrap_cl_errors
    def copy_region(self, start: int, shape: tuple[int, ...]) -> Array:
        """Return a copy, on the device, of the elements from index ``start`` on, with another shape."""
        copied = Array(self.device, self.name, shape, self.dtype, zeroed=False)
        if copied.nbytes == 0:
            return copied
        after = [event for event in (self.latest, copied.latest) if event is not None]
        source, target = self.buffer, copied.buffer
        with self.device.enqueuing:
            event = cl.enqueue_copy(
                self.device.queue,
                target,
                source,
                src_offset=start * self.dtype.itemsize,
                byte_count=copied.nbytes,
                wait_for=after,
            )
        self.device.profile.watch("copy", self.name, event, copied.nbytes)
        self.last_use = copied.arrived = event
        copied.last_use = None
        return copied

    @_wrap_cl_errors
    def as_pyopencl(self) -> pyopencl.array.Array:
        """Return a `pyopencl.array.Array` in the same memory, on the device's queue."""
        from pyopencl.array import Array as OpenCLArray

        buffer, self._is_exported, self._is_in_place = self.buffer, True, False
        after = [] if self.latest is None else [self.latest]
        return OpenCLArray(self.device.queue, self.shape, self.dtype, data=buffer, events=after)

    @property
    def buffer(self) -> cl.Buffer:
        """The buffer on the device, for kernels."""
        buffer = self._buffer
        if buffer is not None and self._mapped is None and self._filling is None:
            return buffer
        return self._ready()

    @_wrap_cl_errors
    def _ready(self) -> cl.Buffer:
        """Return the buffer on the device, after all pending writes."""
        if self._buffer is None:
            self._allocate()
            assert self._buffer is not None
        parked, self._parked, self._is_parked = self._parked, None, False
        if self._mapped is not None:
            self._mapped.release()
            self._mapped = None
        if parked is not None:
            self._copy_up(parked, 0)
        elif self._filling is not None:
            self._fill_on_device()
        return self._buffer

    def _let_host_write(self, whole: bool) -> None:
        """Map shared memory for writing by the host: all of it, or a part outside the device's writes."""
        if not whole or self._is_in_place:
            self._map()
        elif self._mapped is None and self._buffer is not None:
            if self.last_use is not None:
                self.device.profile.wait(self.name, self.last_use)
            self._buffer = None  # a new buffer contains the host's writes without a command on the queue

    def _map(self) -> None:
        """Make the device's writes to shared memory visible to the host."""
        if self._mapped is None and self._buffer is not None:
            if self._is_in_place:
                if self.latest is not None:
                    self.device.profile.wait(self.name, self.latest)
                return
            with self.device.profile.waiting_for(self.name):
                self._mapped = Mapping(self.device.queue, self._buffer, self.shape, self.dtype)

    def _fill_on_device(self) -> None:
        value, self._filling = self._filling, None
        # Single bytes are slow, and there is padding after the last element.
        pattern = (
            np.zeros(1, np.uint32)
            if value == ZERO and not np.signbit(value)
            else np.array([value]).astype(self.dtype)
        )
        queue, size = self.device.queue, -(-self.nbytes // pattern.itemsize) * pattern.itemsize
        assert self._buffer is not None
        with self.device.enqueuing:
            event = cl.enqueue_fill_buffer(
                queue, self._buffer, pattern, 0, size, wait_for=[self.latest] if self.latest else None
            )
        self.device.profile.watch("fill", self.name, event, size)
        self.arrived, self.last_use = event, None

    def _copy_up(self, values: NDArray[Any], start: int) -> None:
        """Copy values to the device; ``start`` is an offset in bytes."""
        if values.size == 0:
            return
        if start == 0 and values.size * self.dtype.itemsize == self.nbytes:
            self._filling = None
        piece = Piece(self.name, self.buffer, start)
        after = [self.latest] if self.latest else []
        event = self.device.transfers.upload(self.device, piece, values, self.dtype, after)
        self.arrived, self.last_use = event, None

    def _read(self, rows: int | slice, queue: cl.CommandQueue, after: Sequence[cl.Event]) -> NDArray[Any]:
        """Return a copy of some rows after some commands."""
        start, shape = self._part(rows)
        if not self.is_shared:
            if self._parked is not None:
                return self._parked[rows].copy()
            out = _empty(shape, self.dtype)
            piece = Piece(self.name, self.buffer, start)
            self.device.transfers.download(self.device, [(piece, out)], queue, after)
            return out
        if self._mapped is not None or self._buffer is None:
            return self._host[rows].copy()
        out = _empty(shape, self.dtype)
        if out.nbytes:
            began = time.perf_counter()
            if self._is_in_place:
                for event in after:
                    event.wait()
                np.copyto(out, self._host[rows])
            else:
                cl.enqueue_copy(queue, out, self.buffer, src_offset=start, wait_for=after, is_blocking=True)
            self.device.profile.add("wait", self.name, time.perf_counter() - began)
        return out

    def _part(self, rows: int | slice) -> tuple[int, tuple[int, ...]]:
        """Return the offset of some rows, in bytes, and their shape."""
        chosen = range(self.shape[0])[rows]
        first, count = (chosen, ()) if isinstance(chosen, int) else (chosen.start, (len(chosen),))
        return first * (self.nbytes // self.shape[0]), (*count, *self.shape[1:])

    def _give_back(self) -> None:
        """Return the buffer to the pool; other arrays wait for commands that still use it."""
        buffer, self._buffer = self._buffer, None
        if buffer is not None and not (self.is_shared or self._is_exported):
            self.device.pool.give(buffer, self.latest)

    def _allocate(self) -> None:
        flags = cl.mem_flags.READ_WRITE
        try:
            with waiting:
                if self.is_shared:
                    self._buffer = cl.Buffer(
                        self.device.context, flags | cl.mem_flags.USE_HOST_PTR, hostbuf=self._memory
                    )
                else:
                    self._buffer, self.arrived = self.device.take_buffer(self.nbytes + SLACK)
                    self.last_use = None
        except cl.Error as error:
            raise _hold_error(self.device, self.name, self.nbytes, error) from error


def adopt(device: Device, name: str, values: pyopencl.array.Array) -> Array:
    """Return a copy, on the device, of an array of pyopencl in C order."""
    array = Array(device, name, values.shape, np.dtype(values.dtype), zeroed=False)
    try:
        after = [*values.events, *([array.latest] if array.latest else [])]
        target = array.buffer
        with device.enqueuing:
            array.arrived = cl.enqueue_copy(
                device.queue,
                target,
                cast(cl.Buffer, values.base_data),
                src_offset=values.offset,
                byte_count=array.nbytes,
                wait_for=after,
            )
    except cl.Error as error:
        raise device_error(device, f"copy {name}", error) from None
    device.profile.watch("copy", name, array.arrived, array.nbytes)
    values.add_event(array.arrived)
    array.last_use = None
    return array


def fetch(parts: Sequence[tuple[Array, int | slice]], keep: Sequence[bool] = ()) -> list[NDArray[Any]]:
    """Return rows of several arrays of a device, with a single wait.

    ``keep`` states for each whether the array can still be used; by default, none can. If memory is shared,
    rows of the others are not copies.
    """
    keep = keep or [False] * len(parts)
    device, reads, after = parts[0][0].device, [], []
    if parts[0][0].is_shared:
        return [
            array.read(rows) if kept else array.release()[rows]
            for (array, rows), kept in zip(parts, keep, strict=True)
        ]
    try:
        with waiting:
            for array, rows in parts:
                start, shape = array._part(rows)
                reads.append((Piece(array.name, array.buffer, start), _empty(shape, array.dtype)))
                if array.latest is not None:
                    after.append(array.latest)
            device.transfers.download(device, reads, device.queue, after)
    except cl.Error as error:
        raise device_error(device, f"copy {', '.join(array.name for array, _ in parts)}", error) from None
    for (array, _), kept in zip(parts, keep, strict=True):
        if not kept:
            array.park(keep=False)
    return [out for _, out in reads]


def _put(target: NDArray[Any], values: NDArray[Any], first: int) -> None:
    """Write values to the elements from index ``first`` on."""
    if values.shape == target.shape:
        np.copyto(target, values, casting="unsafe")
        return
    target.reshape(-1)[first : first + values.size].reshape(values.shape)[...] = values


def _empty(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return previously used memory on the host, if available."""
    nbytes = math.prod(shape) * dtype.itemsize
    if nbytes < memory.MIN_CACHED:
        return np.empty(shape, dtype)
    return memory.take(nbytes, zeroed=False)[:nbytes].view(dtype).reshape(shape)


class BorrowedBuffer:
    """Memory of another owner that kernels read in place; it stays alive until they have finished.

    ``name``, ``host``, ``shape``, ``nbytes``, ``buffer``, ``arrived`` and ``last_use`` are like those of an
    `Array`; nothing is copied.
    """

    name: str
    host: NDArray[Any]
    shape: tuple[int, ...]
    nbytes: int

    arrived = None

    def __init__(self, device: Device, name: str, values: NDArray[Any], address: int) -> None:
        self.device, self.name, self.host = device, name, values
        self.shape, self.nbytes = values.shape, values.nbytes
        self.last_use: cl.Event | None = None
        self._lock = threading.RLock()
        # Kernels only read it, but Intel's runtime copies read-only memory that is not aligned to 128 bytes.
        access = cl.mem_flags.READ_WRITE if values.flags.writeable else cl.mem_flags.READ_ONLY
        flags = access | cl.mem_flags.USE_HOST_PTR
        loaded = (ctypes.c_char * (values.nbytes + SLACK)).from_address(address)
        try:
            self.buffer: cl.Buffer = cl.Buffer(device.context, flags, hostbuf=loaded)
        except cl.Error as error:
            raise _hold_error(device, name, self.nbytes, error) from error

    def __del__(self) -> None:
        if self.last_use is not None:
            _wait_before_end(self.last_use, self.host)

    @_wrap_cl_errors
    def wait(self) -> None:
        """Wait until no kernel reads it."""
        if self.last_use is not None:
            self.device.profile.wait(self.name, self.last_use)


def can_be_borrowed(values: NDArray[Any], address: int) -> bool:
    """Return whether kernels can read values in place: C order, aligned, and followed by readable memory.

    Kernels load their last word as a whole. The values may be followed by other elements of their base array,
    and memory consists of whole pages.
    """
    if not (values.flags.c_contiguous and values.flags.aligned):
        return False
    whole = values
    while isinstance(whole.base, np.ndarray) and whole.base.flags.c_contiguous:
        whole = whole.base
    end = address + values.nbytes
    last = end if whole is values else whole.ctypes.data + whole.nbytes
    return bool(-(-last // memory.PAGE) * memory.PAGE - end >= SLACK)


Operand = Array | BorrowedBuffer
"""Types of a kernel's array arguments."""


def _wait_before_end(command: cl.Event, memory_in_use: NDArray[Any]) -> None:
    """Wait for the last command that uses some memory, before the memory is released."""
    with suppress(cl.Error):
        if command.command_execution_status == cl.command_execution_status.COMPLETE:
            return
    try:
        with waiting, suppress(cl.Error):
            command.wait()
    except SystemExit:  # the interpreter ends while the kernel continues
        keep_for_ever(memory_in_use)


def _hold_error(device: Device, name: str, nbytes: int, error: cl.Error) -> DeviceError:
    """Return the error of an array that a device cannot hold."""
    if error.code in _NO_ROOM:
        return DeviceMemoryError(_no_room(device, name, nbytes))
    return device_error(device, f"hold {name}", error)


def _no_room(device: Device, name: str, nbytes: int) -> str:
    return (
        f"{device.info.title} has no memory for {name} ({nbytes} bytes; one buffer holds at most "
        f"{device.max_allocation}): use a smaller region, or another device"
    )
