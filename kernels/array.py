"""Memory: arrays that host and device both see, and buffers borrowed from another owner."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property, wraps
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import pyopencl as cl
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from mirrorskin.kernels import memory
from mirrorskin.kernels.errors import DeviceError, DeviceMemoryError
from mirrorskin.kernels.waiting import keep_for_ever, waiting

if TYPE_CHECKING:
    from mirrorskin.kernels.device import Device

SLACK = 64
"""Bytes behind an array that a kernel may load with its last word."""

_READ_WRITE = cl.map_flags.READ | cl.map_flags.WRITE
_NO_ROOM = {
    cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE,
    cl.status_code.OUT_OF_HOST_MEMORY,
    cl.status_code.OUT_OF_RESOURCES,
    cl.status_code.INVALID_BUFFER_SIZE,
}

_Given = ParamSpec("_Given")
_Made = TypeVar("_Made")


def failed(device: Device, what: str, error: cl.Error) -> DeviceError:
    """Return an error that says what a device could not do, why, and what to do."""
    return DeviceError(
        f"{device.info.title} cannot {what}: {error}; if that goes on, choose another ('mirrorskin devices')"
    )


def _told(work: Callable[Concatenate[Any, _Given], _Made]) -> Callable[Concatenate[Any, _Given], _Made]:
    """Run a method of an array in one thread at a time, and name device and array where OpenCL fails."""

    @wraps(work)
    def told(array: Array | BorrowedBuffer, /, *given: _Given.args, **named: _Given.kwargs) -> _Made:
        with array._lock:
            try:
                with waiting:
                    return work(array, *given, **named)
            except cl.Error as error:
                raise failed(array._device, f"hold or copy {array.name}", error) from error

    return told


class _Mapping:
    """A device's buffer, mapped into the host's memory until ``release``; an array for ``np.asarray``.

    A `pyopencl.MemoryMap` unmaps the buffer when it is destroyed. If that fails, because the device is lost
    or the buffer is unmapped already, pyopencl aborts the process. So the buffer is unmapped here, once, and
    a map that cannot be unmapped is never destroyed.
    """

    def __init__(
        self,
        queue: cl.CommandQueue,
        buffer: cl.Buffer,
        like: NDArray[Any],
        flags: Any,
        after: Sequence[cl.Event] = (),
    ) -> None:
        """Map a buffer with the shape and dtype of an array, once some events are over."""
        self._maps: list[cl.MemoryMap] = []  # none after the release
        view, _ = cl.enqueue_map_buffer(
            queue, buffer, flags, 0, like.shape, like.dtype, wait_for=after, is_blocking=True
        )
        self._maps.append(view.base)
        self.__array_interface__ = view.__array_interface__

    def __del__(self) -> None:
        with suppress(cl.Error):
            self.release()

    def release(self, queue: cl.CommandQueue | None = None) -> None:
        """Unmap the buffer, unless that was done before; by default on the queue that mapped it."""
        try:
            mapped = self._maps.pop()  # at once, so that no two threads have it
        except IndexError:
            return
        try:
            mapped.release(queue)
        except cl.Error:
            keep_for_ever(mapped)
            raise


class Array:
    """An array that host and device both see: one memory where they share it, a copy each otherwise.

    It is filled with zeros, unless what it holds at first does not matter.
    The host writes it at first; ``upload`` hands it to the device and ``download`` brings it back, which
    moves nothing on a device that shares the host's memory.

    Attributes
    ----------
    name : str
    shape : tuple of int
    nbytes : int
    arrived : pyopencl.Event or None
        A copy under way that kernels have to wait for.
    last_use : pyopencl.Event or None
        The last kernel that took it as an argument.
    """

    shape: tuple[int, ...]

    def __init__(
        self, device: Device, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], zeroed: bool
    ) -> None:
        self.name = name
        self.arrived: cl.Event | None = None
        self.last_use: cl.Event | None = None
        self._arriving = 0  # bytes
        self._device = device
        self._shared = device.info.shares_memory
        self._lock = threading.RLock()
        self._mapped: _Mapping | None = None
        self._buffer: cl.Buffer | None = None
        self.shape, self._dtype, self._zeroed = shape, dtype, zeroed
        self.nbytes: int = math.prod(shape) * dtype.itemsize
        if self.nbytes > device.max_allocation:
            raise DeviceMemoryError(_no_room(device, name, self.nbytes))
        # A device that shares memory sees it from its first kernel on, with what the host wrote before.
        if not self._shared:
            self._allocate()
        else:
            try:
                _ = self.host
            except MemoryError as error:
                raise DeviceMemoryError(_no_room(device, name, self.nbytes)) from error

    @cached_property
    def host(self) -> NDArray[Any]:
        """The host's side."""
        return self._memory[: self.nbytes].view(self._dtype).reshape(self.shape)

    @cached_property
    def _memory(self) -> NDArray[np.uint8]:
        return memory.take(self.nbytes + SLACK, self._zeroed)

    def __del__(self) -> None:
        # A kernel may still use this memory, which another array gets next. On a lost device none does.
        if self._shared and self.last_use is not None:
            _wait_before_end(self.last_use, self._memory)

    @_told
    def claim(self) -> None:
        """Let the host write anew, whatever the device holds."""
        if self._shared and self._mapped is None and self._buffer is not None:
            if self.last_use is not None:
                self.last_use.wait()
            self._buffer = None  # a new one sees what the host wrote, without a turn of the queue

    @_told
    def upload(self, rows: int | None = None) -> None:
        """Let the device see what the host wrote; ``rows`` limits it to the first so many."""
        if not self._shared:
            self.reserve()
            part = self.host[:rows]
            event = cl.enqueue_copy(self._device.queue, self.buffer, part)
            self._device.profile.wait("upload", self.name, event, part.nbytes)

    @_told
    def put(self, row: int, values: NDArray[Any]) -> None:
        """Write one row where the device holds it; the others stay as they are."""
        if self._shared:
            self.claim()
            self.host[row].reshape(-1)[: values.size].reshape(values.shape)[...] = values
        else:
            part = np.ascontiguousarray(values, self.host.dtype)
            place = row * self.host[row].nbytes
            event = cl.enqueue_copy(self._device.queue, self.buffer, part, dst_offset=place)
            self._device.profile.wait("upload", self.name, event, part.nbytes)

    @_told
    def upload_async(self, values: NDArray[Any]) -> None:
        """Begin to copy values from elsewhere on the host; kernels that take this array wait for it.

        The device has memory of its own, and the values stay as they are until ``wait``.
        """
        self.reserve()
        self._arriving = values.nbytes
        after = [] if self.last_use is None else [self.last_use]
        self._device.queue.flush()  # where that kernel waits
        self.arrived = cl.enqueue_copy(
            self._device.copies, self.buffer, values, is_blocking=False, wait_for=after
        )
        self._device.copies.flush()

    @_told
    def wait(self) -> None:
        """Wait until a copy under way has arrived."""
        if self.arrived is not None:
            self._device.profile.wait("upload", self.name, self.arrived, self._arriving)
            self.arrived = None

    @_told
    def download(self) -> NDArray[Any]:
        """Wait for the device and return what it wrote, in the host's array."""
        if self._shared:
            if self._mapped is None and self._buffer is not None:
                self._mapped = _Mapping(self._device.queue, self._buffer, self.host, _READ_WRITE)
        else:
            event = cl.enqueue_copy(self._device.queue, self.host, self.buffer)
            self._device.profile.wait("download", self.name, event, self.host.nbytes)
        return self.host

    @_told
    def snapshot(self, kernel: cl.Event | None) -> NDArray[Any]:
        """Wait for one kernel, while others that only read may run, and return a copy of what it wrote."""
        queue, after = self._device.copies, [] if kernel is None else [kernel]
        self._device.queue.flush()
        if not self._shared:
            event = cl.enqueue_copy(queue, self.host, self.buffer, wait_for=after)
            self._device.profile.wait("download", self.name, event, self.host.nbytes)
            return self.host.copy()
        mapping = _Mapping(queue, self.buffer, self.host, cl.map_flags.READ, after)
        copied: NDArray[Any] = np.array(mapping)
        mapping.release(queue)
        return copied

    @_told
    def detach(self) -> NDArray[Any]:
        """Wait for the device and return what it wrote, without a copy; the array is no longer of use."""
        host = self.download()
        if self._mapped is not None:
            self._mapped.release()
            self._mapped = None
            self._device.finish()
        self._buffer = None
        return host

    def evict(self) -> None:
        """Make room on the device: keep the content on the host until the next upload."""
        if not self._shared and self._buffer is not None:
            self.download()
            self.discard()

    @_told
    def discard(self) -> None:
        """Make room on the device, and forget what the device held."""
        if not self._shared:
            self._buffer = None

    @_told
    def reserve(self) -> None:
        """Have room on the device, which holds anything if there was none."""
        if self._buffer is None:
            self._allocate()

    @property
    def buffer(self) -> cl.Buffer:
        """The device's side, for kernels; the host must not write while they run."""
        buffer = self._buffer
        return self._unmapped() if buffer is None or self._mapped is not None else buffer

    @_told
    def _unmapped(self) -> cl.Buffer:
        """Return the device's side, allocated and unmapped."""
        if self._buffer is None:
            if not self._shared:
                raise RuntimeError(f"{self.name} was evicted: upload it first")
            self._allocate()
            assert self._buffer is not None
        if self._mapped is not None:
            self._mapped.release()
            self._mapped = None
        return self._buffer

    def _allocate(self) -> None:
        flags = cl.mem_flags.READ_WRITE
        with _naming(self._device, self.name, self.nbytes), waiting:
            if self._shared:
                self._buffer = cl.Buffer(
                    self._device.context, flags | cl.mem_flags.USE_HOST_PTR, hostbuf=self._memory
                )
            else:
                self._buffer = cl.Buffer(self._device.context, flags, size=self.nbytes + SLACK)
                # Drivers allocate at first use; a migration makes a lack of memory show here.
                undefined = cl.mem_migration_flags.CONTENT_UNDEFINED
                cl.enqueue_migrate_mem_objects(self._device.queue, [self._buffer], flags=undefined).wait()


class BorrowedBuffer:
    """Another owner's memory, which kernels read in place; it stays alive until they are done.

    ``name``, ``host``, ``buffer``, ``arrived`` and ``last_use`` are as of an `Array`; nothing is ever copied.
    """

    name: str
    host: NDArray[Any]

    arrived = None

    def __init__(self, device: Device, name: str, values: NDArray[Any]) -> None:
        self._device, self.name, self.host = device, name, values
        self.last_use: cl.Event | None = None
        self._lock = threading.RLock()
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR
        loaded = as_strided(values.reshape(-1).view(np.uint8), (values.nbytes + SLACK,))
        with _naming(device, name, values.nbytes):
            self.buffer: cl.Buffer = cl.Buffer(device.context, flags, hostbuf=loaded)

    def __del__(self) -> None:
        if self.last_use is not None:
            _wait_before_end(self.last_use, self.host)

    @_told
    def wait(self) -> None:
        """Wait until no kernel reads it."""
        if self.last_use is not None:
            self.last_use.wait()


def can_be_borrowed(values: NDArray[Any]) -> bool:
    """Whether kernels can read values where they lie: in C order, aligned, and followed by what may be read.

    Kernels load their last word whole. The array that the values are a part of may go on behind them, and
    memory is there in whole pages.
    """
    if not (values.flags.c_contiguous and values.flags.aligned):
        return False
    whole = values
    while isinstance(whole.base, np.ndarray) and whole.base.flags.c_contiguous:
        whole = whole.base
    end, last = (array.ctypes.data + array.nbytes for array in (values, whole))
    return bool(-(-last // memory.PAGE) * memory.PAGE - end >= SLACK)


Operand = Array | BorrowedBuffer
"""What a kernel takes besides numbers."""


def pinned(device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Make room on the host from where copies to a device are fastest; see ``Device.pinned``."""
    nbytes = math.prod(shape) * dtype.itemsize
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
    with _naming(device, "frames on the host", nbytes), waiting:
        buffer = cl.Buffer(device.context, flags, size=nbytes)
        like = np.broadcast_to(np.empty((), dtype), shape)
        return np.asarray(_Mapping(device.copies, buffer, like, _READ_WRITE))


def _wait_before_end(last_use: cl.Event, memory_in_use: NDArray[Any]) -> None:
    """Wait for the last kernel that uses some memory, before nobody refers to the memory any more."""
    try:
        with waiting, suppress(cl.Error):
            last_use.wait()
    except SystemExit:  # the interpreter ends, and the kernel goes on
        keep_for_ever(memory_in_use)


@contextmanager
def _naming(device: Device, name: str, nbytes: int) -> Iterator[None]:
    """Name the array for which a device has no memory."""
    try:
        yield
    except cl.Error as error:
        if error.code not in _NO_ROOM:
            raise failed(device, f"hold {name}", error) from error
        raise DeviceMemoryError(_no_room(device, name, nbytes)) from error


def _no_room(device: Device, name: str, nbytes: int) -> str:
    return (
        f"{device.info.title} has no room for {name} ({nbytes} bytes; "
        f"one buffer holds at most {device.max_allocation}): take a smaller region, or another device"
    )
