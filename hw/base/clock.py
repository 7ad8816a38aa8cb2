"""The clock of hardware: everything that reads the time, waits or starts a thread uses a `Clock`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Provides the time, and objects to wait with.

    A lock that is held while its thread waits must be a condition of the clock. Locks around a few statements
    may be plain locks.
    """

    def now(self) -> float:
        """Return the time, seconds; it never decreases."""

    def sleep(self, seconds: float, /) -> None:
        """Wait for some seconds."""

    def event(self) -> threading.Event:
        """Return a new event."""

    def condition(self) -> threading.Condition:
        """Return a new condition, which is also a reentrant lock."""

    def thread(self, work: Callable[[], object], name: str, daemon: bool = False) -> threading.Thread:
        """Return a new thread, not started, that may wait on objects of this clock."""


class SystemClock:
    """The system's clock, ``time.monotonic``, and plain threads."""

    now = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)
    event = staticmethod(threading.Event)
    condition = staticmethod(threading.Condition)

    def thread(self, work: Callable[[], object], name: str, daemon: bool = False) -> threading.Thread:
        """Return a new thread; see `Clock.thread`."""
        return threading.Thread(target=work, name=name, daemon=daemon)


SYSTEM: Clock = SystemClock()
"""The default clock of all hardware."""
