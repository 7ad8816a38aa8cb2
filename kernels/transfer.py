"""Copies between the host and a device with its own memory.

Copies use a few pinned staging buffers, so that the device transfers them at full speed while the host
continues. Several threads fill and empty the staging buffers, because one thread copies slower than the bus.
"""

from __future__ import annotations

import functools
import os
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from mirrorskin.kernels import memory
from mirrorskin.kernels.mapping import Mapping
from mirrorskin.kernels.waiting import waiting

if TYPE_CHECKING:
    from mirrorskin.kernels.device import Device

_Copy = tuple[NDArray[Any], NDArray[Any]]  # to, and from

SLOTS = 3
"""Staging buffers of a device: one is filled while another is copied from."""

SLOT = 2**24
"""Bytes of a staging buffer."""

THREADS = max(1, min(4, os.cpu_count() or 1))
"""Threads that copy between the host's memory and staging buffers."""

SMALL = 2**18
"""Maximum size of a copy on the kernels' queue, bytes: it takes less than waiting for another queue."""

_PATIENCE = 0.1  # seconds after which the slots are counted again, because some may be lost after an error
_MIN_BYTES_PER_THREAD = 2**20  # minimum number of bytes for a thread
_LINE = 256  # alignment of copies in a staging buffer, bytes


@dataclass(frozen=True, slots=True)
class Piece:
    """A part of a buffer on the device, from an offset in bytes."""

    name: str
    buffer: cl.Buffer
    offset: int


@dataclass(slots=True)
class _Slot:
    """A staging buffer: the memory, the bytes in use, and the last copy on each queue."""

    memory: NDArray[np.uint8]
    mapping: Mapping | None
    used: int = 0
    under_way: dict[int, cl.Event] = field(default_factory=dict)

    def reserve(self, nbytes: int) -> NDArray[np.uint8]:
        """Return the next bytes that are not in use."""
        part = self.memory[self.used : self.used + nbytes]
        self.used += -(-nbytes // _LINE) * _LINE
        return part

    def finish(self, device: Device) -> None:
        """Wait until no copy uses the memory any more, and mark it as empty."""
        for event in self.under_way.values():
            if event.command_execution_status != cl.command_execution_status.COMPLETE:
                device.profile.wait("staging", event)
        self.under_way.clear()
        self.used = 0


class Transfers:
    """The staging buffers of a device, created on first use."""

    def __init__(self) -> None:
        self._free: SimpleQueue[_Slot] = SimpleQueue()
        self._made = 0
        self._making = threading.Lock()
        self._uploading = threading.Lock()
        self._open: _Slot | None = None  # the slot filled by uploads

    def upload(
        self,
        device: Device,
        target: Piece,
        values: NDArray[Any],
        dtype: np.dtype[Any],
        after: Sequence[cl.Event],
    ) -> cl.Event:
        """Copy values to the device as a type, and return the event of the last copy.

        The values may be overwritten at once, although copies may still be in progress.
        """
        itemsize, offset = dtype.itemsize, target.offset
        queue = device.queue if values.size * itemsize <= SMALL else device.copies
        after = _of_others(after, queue)
        with self._uploading:
            for piece in _pieces(values, SLOT // itemsize):
                nbytes = piece.size * itemsize
                slot = self._room(device, nbytes)
                staged = slot.reserve(nbytes)
                _copy([(staged.view(dtype).reshape(piece.shape), piece)])
                with device.enqueuing:
                    event = cl.enqueue_copy(
                        queue, target.buffer, staged, dst_offset=offset, wait_for=after, is_blocking=False
                    )
                slot.under_way[id(queue)] = event
                device.profile.watch("upload", target.name, event, nbytes)
                if queue is device.copies:
                    queue.flush()
                offset += nbytes
        return event

    def download(
        self,
        device: Device,
        reads: Sequence[tuple[Piece, NDArray[Any]]],
        queue: cl.CommandQueue,
        after: Sequence[cl.Event],
    ) -> None:
        """Copy from the device to arrays in C order: all copies are enqueued and then waited for."""
        rest = deque(_cut(reads))
        under_way: deque[tuple[_Slot, str, cl.Event, list[_Copy]]] = deque()
        try:
            while rest or under_way:
                while rest and (slot := self._take(device, wait=not under_way)) is not None:
                    under_way.append((slot, *_enqueue_reads(device, slot, rest, queue, after)))
                slot, name, event, copies = under_way[0]
                device.profile.wait(name, event)
                _copy(copies)
                under_way.popleft()
                self._free.put(slot)
        finally:  # after an error, copies may still be in progress: these slots are not used again
            with self._making:
                self._made -= len(under_way)

    def free(self, device: Device) -> None:
        """Return unused staging buffers to the system."""
        with self._uploading:
            if self._open is not None:
                self._free.put(self._open)
                self._open = None
        while True:
            try:
                slot = self._free.get_nowait()
            except Empty:
                return
            with self._making:
                self._made -= 1
            slot.finish(device)
            if slot.mapping is not None:
                slot.mapping.release()

    def _room(self, device: Device, nbytes: int) -> _Slot:
        """Return the slot filled by uploads, with room for a number of bytes."""
        slot, self._open = self._open, None
        if slot is not None and slot.used + nbytes > SLOT:
            self._free.put(slot)
            slot = None
        self._open = slot or self._take(device, wait=True)
        assert self._open is not None
        return self._open

    def _take(self, device: Device, wait: bool) -> _Slot | None:
        """Return an empty slot; None if all are in use, unless ``wait``."""
        while True:
            try:
                slot = self._free.get(timeout=_PATIENCE if wait and self._made >= SLOTS else 0)
            except Empty:
                with self._making:
                    make = self._made < SLOTS
                    self._made += make
                if make:
                    return _make_slot(device)
                if not wait:
                    return None
                continue
            try:
                slot.finish(device)
            except BaseException:
                with self._making:
                    self._made -= 1
                raise
            return slot


def _of_others(after: Sequence[cl.Event], queue: cl.CommandQueue) -> list[cl.Event]:
    """Return the events of other queues, after submitting their commands: a queue waits for its own."""
    others = [event for event in after if event.command_queue != queue]
    for event in others:
        event.command_queue.flush()
    return others


def _enqueue_reads(
    device: Device,
    slot: _Slot,
    rest: deque[tuple[Piece, NDArray[Any]]],
    queue: cl.CommandQueue,
    after: Sequence[cl.Event],
) -> tuple[str, cl.Event, list[_Copy]]:
    """Enqueue as many copies as fit into a slot; return their names, the last event, and the host copies."""
    copies, names = [], dict[str, None]()
    after = _of_others(after, queue)
    while rest and slot.used + rest[0][1].nbytes <= SLOT:
        source, out = rest.popleft()
        staged = slot.reserve(out.nbytes)
        with device.enqueuing:
            event = cl.enqueue_copy(
                queue, staged, source.buffer, src_offset=source.offset, wait_for=after, is_blocking=False
            )
        slot.under_way[id(queue)] = event
        device.profile.watch("download", source.name, event, out.nbytes)
        copies.append((out, staged.view(out.dtype).reshape(out.shape)))
        names[source.name] = None
    return ", ".join(names), event, copies


def _make_slot(device: Device) -> _Slot:
    """Return pinned memory, or unpinned memory if there is none."""
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
    try:
        with waiting:
            buffer = cl.Buffer(device.context, flags, size=SLOT)
            mapping = Mapping(device.copies, buffer, (SLOT,), np.dtype(np.uint8))
    except cl.Error:
        return _Slot(memory.take(SLOT, zeroed=False), None)
    return _Slot(np.asarray(mapping), mapping)


def _cut(reads: Iterable[tuple[Piece, NDArray[Any]]]) -> Iterator[tuple[Piece, NDArray[Any]]]:
    """Divide the rows to be read into pieces that fit into a slot."""
    for source, out in reads:
        offset = source.offset
        for piece in _pieces(out, SLOT // out.itemsize):
            yield Piece(source.name, source.buffer, offset), piece
            offset += piece.nbytes


def _pieces(values: NDArray[Any], length: int, flat: bool | None = None) -> Iterator[NDArray[Any]]:
    """Yield parts of an array, of at most ``length`` elements, in C order: anywhere if ``flat``, or rows."""
    if values.size <= length:
        yield values
        return
    if values.flags.c_contiguous if flat is None else flat:
        values = values.reshape(-1)
    row = values.size // len(values)
    if row > length:
        for part in values:
            yield from _pieces(part, length, flat)
    else:
        step = length // row
        for start in range(0, len(values), step):
            yield values[start : start + step]


def _copy(copies: Sequence[_Copy]) -> None:
    """Copy each second array to the first, in several threads if worthwhile."""
    total = sum(target.nbytes for target, _ in copies)
    part_bytes = max(_MIN_BYTES_PER_THREAD, -(-total // THREADS))
    work: deque[_Copy] = deque()
    for pair in copies:
        flat = all(array.flags.c_contiguous for array in pair)
        length = part_bytes // pair[0].itemsize
        work.extend(zip(*(_pieces(array, length, flat) for array in pair), strict=True))
    helpers: list[Future[None]] = []
    with suppress(RuntimeError):  # the interpreter ends and starts no more threads
        while len(helpers) < min(THREADS, len(work)) - 1 and total > _MIN_BYTES_PER_THREAD:
            helpers.append(_threads().submit(_copy_all, work))
    _copy_all(work)
    for helper in helpers:
        helper.result()


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(THREADS - 1, "mirrorskin-copy")


def _copy_all(work: deque[tuple[NDArray[Any], NDArray[Any]]]) -> None:
    """Copy arrays until none is left."""
    while True:
        try:
            target, source = work.popleft()
        except IndexError:
            return
        np.copyto(target, source, casting="unsafe")
