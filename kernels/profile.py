"""What was done on a device, how long it took and how many bytes it moved."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Literal

import pyopencl as cl

from mirrorskin.kernels.waiting import waiting

Kind = Literal["compile", "upload", "kernel", "download"]

_PENDING_LIMIT = 1024  # events held before they are read, so that an endless run stays bounded


@dataclass(slots=True)
class Record:
    """All runs of one kernel, program or array: seconds and bytes moved are those of all of them together."""

    kind: Kind
    name: str
    runs: int = 0
    seconds: float = 0.0
    fastest: float = float("inf")
    bytes: int = 0

    @property
    def bandwidth(self) -> float:
        """Bytes per second over all runs; 0 where no time was taken."""
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

    def wait(self, kind: Kind, name: str, event: cl.Event, nbytes: int) -> None:
        """Wait for the run that ``event`` ends, and count it; a pending copy would keep its array alive."""
        with waiting:
            event.wait()
        with self._lock:
            self._count(kind, name, event, nbytes)

    def watch(self, kind: Kind, name: str, event: cl.Event, nbytes: int) -> None:
        """Count the run that ``event`` ends, once it is over."""
        with self._lock:
            self._pending.append((kind, name, event, nbytes))
            if len(self._pending) >= _PENDING_LIMIT:
                self._read_pending()

    def records(self) -> list[Record]:
        """Wait for what is under way and return all records, longest first."""
        with self._lock:
            self._read_pending()
            return sorted(self._records.values(), key=lambda record: -record.seconds)

    def clear(self) -> None:
        """Forget everything so far."""
        with self._lock:
            self._read_pending()
            self._records.clear()

    def _read_pending(self) -> None:
        pending, self._pending = self._pending, []  # one that failed is not waited for again
        for kind, name, event, nbytes in pending:
            with waiting:
                event.wait()
            self._count(kind, name, event, nbytes)

    def _count(self, kind: Kind, name: str, event: cl.Event, nbytes: int) -> None:
        self._add(kind, name, (event.profile.end - event.profile.start) * 1e-9, nbytes)

    def _add(self, kind: Kind, name: str, seconds: float, nbytes: int) -> None:
        record = self._records.setdefault((kind, name), Record(kind, name))
        record.runs += 1
        record.seconds += seconds
        record.fastest = min(record.fastest, seconds)
        record.bytes += nbytes
