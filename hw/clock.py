"""The time of hardware: what reads a clock, waits, or starts a thread does so through a `Clock`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """What time it is, and the means to wait.

    A lock that is held while its thread waits must be a condition of the clock. Other locks, for a few
    statements, may be plain ones.
    """

    def now(self) -> float:
        """Return the time: seconds that never decrease."""

    def sleep(self, seconds: float, /) -> None:
        """Let some seconds pass."""

    def event(self) -> threading.Event:
        """Make an event."""

    def condition(self) -> threading.Condition:
        """Make a condition, which is also a lock that its thread may take again."""

    def thread(self, work: Callable[[], object], name: str, daemon: bool = False) -> threading.Thread:
        """Make a thread, which may wait with this clock's means; it is yet to be started."""


class SystemClock:
    """The clock of the computer, ``time.monotonic``, and plain threads."""

    now = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)
    event = staticmethod(threading.Event)
    condition = staticmethod(threading.Condition)

    def thread(self, work: Callable[[], object], name: str, daemon: bool = False) -> threading.Thread:
        """Make a thread; see `Clock.thread`."""
        return threading.Thread(target=work, name=name, daemon=daemon)


SYSTEM: Clock = SystemClock()
"""The clock of all hardware that is not given another."""
