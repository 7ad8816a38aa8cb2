"""Failing calls: the n-th of a kind raises the exception of a real failure."""

from __future__ import annotations

import errno
import functools
import io as python_io
import mmap
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pyopencl as cl
import pytest

from mirrorskin.io.storage import atomic
from mirrorskin.kernels import array, device, mapping, memory, transfer

_CLOSE = os.close


class Calls:
    """Counts calls from all threads; the one of number ``failing`` fails, or that and all later ones."""

    def __init__(self, make: Callable[[], Exception], failing: int = -1, lasting: bool = False) -> None:
        self.count = 0
        self._make, self._failing, self._lasting, self._lock = make, failing, lasting, threading.Lock()

    def watch(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that is counted, and fails when it is its turn."""

        @functools.wraps(function, updated=())
        def watched(*words: Any, **named: Any) -> Any:
            with self._lock:
                number = self.count
                self.count += 1
            if number == self._failing or (self._lasting and number > self._failing >= 0):
                if function is _CLOSE:  # whatever it says, the file is closed then
                    function(*words)
                raise self._make()
            return function(*words, **named)

        return watched


def lost() -> Exception:
    """Return what OpenCL raises once a device is gone."""
    return cl.LogicError(cl._cl._ErrorRecord("", cl.status_code.INVALID_COMMAND_QUEUE, "clFault"))


def _exhausted() -> Exception:
    return cl.RuntimeError(cl._cl._ErrorRecord("", cl.status_code.OUT_OF_RESOURCES, "clFault"))


_NAMES = ("Buffer", "CommandQueue", "Context", "Kernel", "Program")
_ENQUEUE = ("enqueue_copy", "enqueue_fill_buffer", "enqueue_map_buffer", "enqueue_migrate_mem_objects")
_WAITS = [
    (cl.Event, "wait"),
    (cl.CommandQueue, "finish"),
    (cl.CommandQueue, "flush"),
    (cl.Kernel, "__call__"),
]
_ARRAYS = [(np, name) for name in ("empty", "zeros", "ones", "full", "empty_like", "zeros_like", "full_like")]
_READS = [
    *((h5py, "File"), (h5py.h5o, "open"), (h5py.h5d, "open"), (h5py.h5a, "open")),
    *((h5py.Dataset, "__getitem__"), (h5py.Dataset, "read_direct")),
    *((os, "open"), (os, "pread"), (os, "preadv"), (mmap, "mmap"), (Path, "open")),
]
_FILES = [
    *((os, "open"), (os, "pwrite"), (os, "pwritev"), (os, "fsync"), (os, "close"), (os, "pread")),
    *((Path, "replace"), (Path, "chmod"), (Path, "mkdir")),
]


def _opencl(calls: Calls, patch: pytest.MonkeyPatch) -> None:
    for module in (array, device, mapping, transfer):
        functions = {name: calls.watch(getattr(cl, name)) for name in (*_NAMES, *_ENQUEUE)}
        patch.setattr(module, "cl", SimpleNamespace(**{**vars(cl), **functions}))
    for owner, name in _WAITS:
        patch.setattr(owner, name, calls.watch(getattr(owner, name)))


def _each(places: list[tuple[Any, str]], calls: Calls, patch: pytest.MonkeyPatch) -> None:
    for owner, name in places:
        patch.setattr(owner, name, calls.watch(getattr(owner, name)))


def _memory(calls: Calls, patch: pytest.MonkeyPatch) -> None:
    _each(_ARRAYS, calls, patch)


def _reads(calls: Calls, patch: pytest.MonkeyPatch) -> None:
    _each(_READS, calls, patch)


def _writes(calls: Calls, patch: pytest.MonkeyPatch) -> None:
    class Full(python_io.FileIO):
        write = calls.watch(python_io.FileIO.write)
        truncate = calls.watch(python_io.FileIO.truncate)

    patch.setattr(atomic, "_Disk", type("FullDisk", (atomic._Disk, Full), {}))
    _each(_FILES, calls, patch)


# What happens, and to which calls; what these raise, and whether all later ones fail as well.
KINDS: dict[str, tuple[Callable[[Calls, pytest.MonkeyPatch], None], Callable[[], Exception], bool]] = {
    "device lost": (_opencl, lost, True),
    "OpenCL call": (_opencl, lost, False),
    "no resources": (_opencl, _exhausted, False),
    "allocation": (_memory, MemoryError, False),
    "read": (_reads, lambda: OSError(errno.EIO, "Input/output error"), False),
    "write": (_writes, lambda: OSError(errno.ENOSPC, "No space left on device"), True),
}


@contextmanager
def failing(kind: str, number: int = -1) -> Iterator[Calls]:
    """Let the call of that number fail; with none, calls are only counted."""
    watch, make, lasting = KINDS[kind]
    calls = Calls(make, number, lasting)
    device._open.cache_clear()  # devices are opened and kernels made anew
    memory.free()
    with pytest.MonkeyPatch.context() as patch:
        watch(calls, patch)
        yield calls
