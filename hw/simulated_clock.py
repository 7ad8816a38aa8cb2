"""A clock that jumps from event to event: hours of waiting take no time, and always go the same way."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import TypeVar

T = TypeVar("T")

_POLLS = 1_000_000  # looks at the time without a wait, after which nobody will ever wait


class DeadlockError(RuntimeError):
    """All threads of a simulated clock wait for each other, and no time ends that."""


def _always() -> bool:
    return True


def _never() -> bool:
    return False


@dataclass(eq=False, slots=True)
class _Task:
    """A thread that takes part: while it waits, what for and until when."""

    name: str
    gate: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))  # opened for its turn
    ready: Callable[[], bool] = _always
    deadline: float = math.inf
    what: str = "its turn"
    error: BaseException | None = None  # raised in it when its turn comes


class SimulatedClock:
    """A `mirrorskin.hw.clock.Clock` whose time passes only while all of its threads wait.

    The thread that makes the clock takes part, and those that ``thread`` makes. One of them runs at a time,
    until it waits; then the one runs that has waited longest of those whose waiting is over. If there is
    none, the time jumps to the earliest at which one's is. What happens depends on nothing but the program.
    What takes no simulated time, such as computing, takes none however long it lasts.

    Parameters
    ----------
    now : float
        The time at first, seconds.

    Examples
    --------
    >>> clock = SimulatedClock()
    >>> began = clock.now()
    >>> clock.sleep(3600)
    >>> clock.now() - began
    3600.0
    """

    def __init__(self, now: float = 1000.0) -> None:
        self._now = now
        self._polls = 0
        self._main = _Task(threading.current_thread().name)
        self._tasks = {threading.get_ident(): self._main}
        self._waiting: list[_Task] = []  # in the order in which they began to

    @property
    def threads(self) -> list[str]:
        """Names of the threads that were started and have not ended."""
        return [task.name for task in self._tasks.values() if task is not self._main]

    def now(self) -> float:
        """Return the time, seconds."""
        self._polls += 1
        if self._polls > _POLLS:
            self._polls = 0
            raise DeadlockError(f"{threading.current_thread().name} looks at the clock and never waits")
        return self._now

    def sleep(self, seconds: float, /) -> None:
        """Let some seconds pass."""
        self._wait(_never, max(0.0, seconds), "the time")

    def event(self) -> SimulatedEvent:
        """Make an event."""
        return SimulatedEvent(self)

    def condition(self) -> SimulatedCondition:
        """Make a condition, which is also a lock."""
        return SimulatedCondition(self)

    def thread(self, work: Callable[[], object], name: str, daemon: bool = False) -> SimulatedThread:
        """Make a thread; it never keeps the program from ending."""
        return SimulatedThread(self, work, name)

    def later(self, seconds: float, action: Callable[[], object], name: str = "later") -> SimulatedThread:
        """Do something in a thread of its own once some seconds have passed."""

        def work() -> None:
            self.sleep(seconds)
            action()

        thread = self.thread(work, name)
        thread.start()
        return thread

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt in the thread that made the clock, where it waits, as Ctrl-C does."""
        if self._tasks.get(threading.get_ident()) is self._main:
            raise KeyboardInterrupt
        self._main.error = KeyboardInterrupt()

    def _wait(self, ready: Callable[[], bool], timeout: float | None, what: str) -> None:
        """Let others run until something is so, or the time is up."""
        task = self._tasks.get(threading.get_ident())
        if task is None:
            name = threading.current_thread().name
            raise RuntimeError(f"{name} cannot wait on a simulated clock that did not make it")
        task.ready, task.what, task.deadline = ready, what, math.inf
        if timeout is not None and timeout < math.inf:
            # Rounding must not keep the time from passing.
            task.deadline = max(self._now + timeout, math.nextafter(self._now, math.inf) if timeout else 0.0)
        self._waiting.append(task)
        chosen = self._choose()
        if chosen is not task:
            chosen.gate.release()
            try:
                task.gate.acquire()
            except BaseException:  # Ctrl-C; another thread runs
                task.ready = _always
                task.gate.acquire()
                raise
        if task.error is not None:
            error, task.error = task.error, None
            raise error

    def _choose(self) -> _Task:
        """Choose who runs next, and let the time pass until then."""
        self._polls = 0
        chosen = next((task for task in self._waiting if task.error is not None or task.ready()), None)
        if chosen is None:
            chosen = min(self._waiting, key=lambda task: task.deadline)
            if chosen.deadline == math.inf:
                who = "; ".join(f"{task.name} for {task.what}" for task in self._waiting)
                chosen = self._main if self._main in self._waiting else self._waiting[-1]
                chosen.error = DeadlockError(f"all threads wait, and none for a time: {who}")
            else:
                self._now = max(self._now, chosen.deadline)
        self._waiting.remove(chosen)
        return chosen

    def _begin(self, task: _Task, ident: int | None) -> None:
        """Let a thread that was started take part; it waits for its turn."""
        assert ident is not None
        self._tasks[ident] = task
        self._waiting.append(task)

    def _end(self) -> None:
        """Let the thread that runs take part no more."""
        del self._tasks[threading.get_ident()]
        if self._waiting:
            self._choose().gate.release()


class SimulatedEvent(threading.Event):
    """An event of a simulated clock."""

    def __init__(self, clock: SimulatedClock, what: str = "an event") -> None:
        super().__init__()
        self._clock, self._what = clock, what

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, for some seconds at most; return whether it is."""
        if not self.is_set():
            self._clock._wait(self.is_set, timeout, self._what)
        return self.is_set()


class SimulatedCondition(threading.Condition):
    """A condition of a simulated clock; notifications wake in the order of waiting."""

    def __init__(self, clock: SimulatedClock) -> None:
        super().__init__()
        self._clock = clock
        self._owner: int | None = None
        self._depth = 0
        self._sleepers: deque[SimulatedEvent] = deque()

    def __enter__(self) -> bool:
        self._take(1)
        return True

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._depth -= 1
        if not self._depth:
            self._owner = None

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for a notification without the lock, for some seconds at most; return whether one came."""
        if self._owner != threading.get_ident():
            raise RuntimeError("who waits for a condition must have its lock")
        woken, depth = SimulatedEvent(self._clock, "a notification"), self._depth
        self._sleepers.append(woken)
        self._owner, self._depth = None, 0
        try:
            return woken.wait(timeout)
        finally:
            if not woken.is_set():
                self._sleepers.remove(woken)
            self._take(depth)

    def wait_for(self, predicate: Callable[[], T], timeout: float | None = None) -> T:
        """Wait until something is so, for some seconds at most; return what it is then."""
        end = math.inf if timeout is None else self._clock.now() + timeout
        while not (found := predicate()) and (left := end - self._clock.now()) > 0:
            self.wait(left)
        return found

    def notify(self, n: int = 1) -> None:
        """Wake some of those that wait."""
        for woken in [self._sleepers.popleft() for _ in range(min(n, len(self._sleepers)))]:
            woken.set()

    def notify_all(self) -> None:
        """Wake all that wait."""
        self.notify(len(self._sleepers))

    def _take(self, depth: int) -> None:
        me = threading.get_ident()
        if self._owner not in (None, me):
            self._clock._wait(lambda: self._owner is None, None, "a lock")
        self._owner = me
        self._depth += depth


class SimulatedThread(threading.Thread):
    """A thread of a simulated clock, which runs when it is its turn, and keeps no program from ending."""

    def __init__(self, clock: SimulatedClock, work: Callable[[], object], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._clock, self._work, self._task = clock, work, _Task(name)
        self._over = SimulatedEvent(clock, f"the end of {name}")

    def start(self) -> None:
        """Begin to work, when the others wait."""
        super().start()
        self._clock._begin(self._task, self.ident)

    def run(self) -> None:
        """Work, in turns with the others."""
        self._task.gate.acquire()
        try:
            self._work()
        finally:
            self._over.set()
            self._clock._end()

    def join(self, timeout: float | None = None) -> None:
        """Wait until it has ended, for some seconds at most."""
        if self._over.wait(timeout):
            super().join()

    def is_alive(self) -> bool:
        """Return whether it has begun and not ended."""
        return super().is_alive() and not self._over.is_set()
