"""The time of hardware: what reads a clock, waits, or starts a thread does so through a `Clock`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Protocol


class Event(Protocol):
    """As ``threading.Event``."""

    def is_set(self) -> bool:
        """Return whether it was set."""

    def set(self) -> None:
        """Set it, and wake who waits."""

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, for some seconds at most; return whether it is."""


class Condition(Protocol):
    """As ``threading.Condition`` with its lock, which the thread that has it may take again."""

    def __enter__(self) -> bool: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for a notification without the lock, for some seconds at most; return whether one came."""

    def notify(self, n: int = 1) -> None:
        """Wake some of those that wait."""

    def notify_all(self) -> None:
        """Wake all that wait."""


class Thread(Protocol):
    """As ``threading.Thread``."""

    def start(self) -> None:
        """Begin to work."""

    def join(self, timeout: float | None = None) -> None:
        """Wait until it has ended, for some seconds at most."""

    def is_alive(self) -> bool:
        """Return whether it has begun and not ended."""


class Clock(Protocol):
    """What time it is, and the means to wait.

    A lock that is held while its thread waits must be a condition of the clock. Locks for a few statements
    may be those of ``threading``.
    """

    def now(self) -> float:
        """Return the time: seconds that never decrease."""

    def sleep(self, seconds: float, /) -> None:
        """Let some seconds pass."""

    def event(self) -> Event:
        """Make an event."""

    def condition(self) -> Condition:
        """Make a condition, which is also a lock."""

    def thread(self, work: Callable[[], object], name: str, daemon: bool = False) -> Thread:
        """Make a thread, which may wait with this clock's means; it is yet to be started."""


class SystemClock:
    """The clock of the computer, ``time.monotonic``, and plain threads."""

    now = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)
    event = staticmethod(threading.Event)
    condition = staticmethod(threading.Condition)

    def thread(self, work: Callable[[], object], name: str, daemon: bool = False) -> Thread:
        """Make a thread; see `Clock.thread`."""
        return threading.Thread(target=work, name=name, daemon=daemon)


SYSTEM: Clock = SystemClock()
"""The clock of all hardware that is not given another."""
