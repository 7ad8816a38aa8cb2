"""Statistics of the work on a device: durations and bytes."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, cast

import pyopencl as cl

from mirrorskin.kernels.waiting import waiting

Kind = Literal["compile", "upload", "fill", "copy", "kernel", "download", "wait"]

_TIMES = cl.profiling_info.START, cl.profiling_info.END  # event.profile takes 20 times as long
_PENDING_LIMIT = 1024  # events kept before they are read, which bounds the memory of an endless run


@dataclass(slots=True)
class Record:
    """All runs of one kernel, program or array: seconds and bytes are totals.

    The kind "wait" is the time that the host waited for the device; all other kinds are work.
    """

    kind: Kind
    name: str
    runs: int = 0
    seconds: float = 0.0
    fastest: float = float("inf")
    bytes: int = 0

    @property
    def bandwidth(self) -> float:
        """Bytes per second over all runs; 0 if no time was measured."""
        return self.bytes / self.seconds if self.seconds > 0 else 0.0


class Profile:
    """The records of a device, by kind and name."""

    def __init__(self) -> None:
        self._records: dict[tuple[Kind, str], Record] = {}
        self._pending: list[tuple[Kind, str, cl.Event, int]] = []
        self._lock = threading.Lock()

    def add(self, kind: Kind, name: str, seconds: float) -> None:
        """Count one run that took ``seconds``."""
        with self._lock:
            self._add(kind, name, seconds, 0)

    def wait(self, name: str, event: cl.Event) -> None:
        """Wait for a command, and record the time."""
        with self.waiting_for(name):
            event.wait()

    @contextmanager
    def waiting_for(self, name: str) -> Iterator[None]:
        """Record the duration of this context as a wait for the device."""
        start = time.perf_counter()
        with waiting:
            yield
        self.add("wait", name, time.perf_counter() - start)

    def watch(self, kind: Kind, name: str, event: cl.Event, nbytes: int) -> None:
        """Record the run of ``event``, once it is over."""
        with self._lock:
            self._pending.append((kind, name, event, nbytes))
            if len(self._pending) >= _PENDING_LIMIT:
                self._read_pending(_PENDING_LIMIT // 2)  # mostly completed

    def records(self) -> list[Record]:
        """Wait for pending runs and return all records, longest first."""
        with self._lock:
            self._read_pending()
            return sorted(self._records.values(), key=lambda record: -record.seconds)

    def clear(self) -> None:
        """Remove all records."""
        with self._lock:
            self._read_pending()
            self._records.clear()

    def _read_pending(self, count: int | None = None) -> None:
        """Record the oldest pending runs, by default all."""
        pending = self._pending[:count]
        del self._pending[:count]  # a failed one is not waited for again
        for kind, name, event, nbytes in pending:
            try:
                start, end = (cast(int, event.get_profiling_info(number)) for number in _TIMES)
            except cl.Error:  # it is not over
                with waiting:
                    event.wait()
                start, end = (cast(int, event.get_profiling_info(number)) for number in _TIMES)
            self._add(kind, name, (end - start) * 1e-9, nbytes)

    def _add(self, kind: Kind, name: str, seconds: float, nbytes: int) -> None:
        record = self._records.get((kind, name))
        if record is None:
            record = self._records[kind, name] = Record(kind, name)
        record.runs += 1
        record.seconds += seconds
        if seconds < record.fastest:
            record.fastest = seconds
        record.bytes += nbytes
