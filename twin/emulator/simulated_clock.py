"""A simulated clock, which jumps from event to event: waiting takes no time and is deterministic."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import TypeVar

T = TypeVar("T")

_POLLS = 1_000_000  # readings of the time without a wait after which no wait is expected


class DeadlockError(RuntimeError):
    """All threads of a simulated clock wait for each other, without a deadline."""


def _always() -> bool:
    return True


def _never() -> bool:
    return False


@dataclass(eq=False, slots=True)
class _Task:
    """A participating thread: while it waits, its condition and deadline."""

    name: str
    gate: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))  # released for its turn
    ready: Callable[[], bool] = _always
    deadline: float = math.inf
    what: str = "its turn"
    error: BaseException | None = None  # raised in the thread at its turn


class SimulatedClock:
    """A `mirrorskin.hw.base.clock.Clock` whose time passes only while all of its threads wait.

    The thread that creates the clock participates, and so do those that ``thread`` creates. One of them runs
    at a time, until it waits. Then the thread runs whose wait is over and that has waited longest. If there
    is none, the time jumps to the earliest deadline. The order of events depends only on the program.
    Computations take no simulated time.

    Parameters
    ----------
    now : float
        Initial time, seconds.

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
        self._waiting: list[_Task] = []  # in the order in which they started to wait

    @property
    def threads(self) -> list[str]:
        """Names of the threads that were started and have not ended."""
        return [task.name for task in self._tasks.values() if task is not self._main]

    def now(self) -> float:
        """Return the time, seconds."""
        self._polls += 1
        if self._polls > _POLLS:
            self._polls = 0
            raise DeadlockError(f"{threading.current_thread().name} reads the clock but never waits")
        return self._now

    def sleep(self, seconds: float, /) -> None:
        """Wait for some seconds."""
        self._wait(_never, max(0.0, seconds), "the time")

    def event(self) -> SimulatedEvent:
        """Return a new event."""
        return SimulatedEvent(self)

    def condition(self) -> SimulatedCondition:
        """Return a new condition, which is also a lock."""
        return SimulatedCondition(self)

    def thread(self, work: Callable[[], object], name: str, daemon: bool = False) -> SimulatedThread:
        """Return a new thread; it never keeps the program from ending."""
        return SimulatedThread(self, work, name)

    def later(self, seconds: float, action: Callable[[], object], name: str = "later") -> SimulatedThread:
        """Call a function in its own thread after some seconds."""

        def work() -> None:
            self.sleep(seconds)
            action()

        thread = self.thread(work, name)
        thread.start()
        return thread

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt where the thread that created the clock waits, as Ctrl-C does."""
        if self._tasks.get(threading.get_ident()) is self._main:
            raise KeyboardInterrupt
        self._main.error = KeyboardInterrupt()

    def _wait(self, ready: Callable[[], bool], timeout: float | None, what: str) -> None:
        """Let other threads run until a condition is true, or the time is up."""
        task = self._tasks.get(threading.get_ident())
        if task is None:
            name = threading.current_thread().name
            raise RuntimeError(f"{name} cannot wait on a simulated clock that did not create it")
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
            except BaseException:  # Ctrl-C; another thread runs now
                task.ready = _always
                task.gate.acquire()
                raise
        if task.error is not None:
            error, task.error = task.error, None
            raise error

    def _choose(self) -> _Task:
        """Select the next thread, and advance the time to its deadline."""
        self._polls = 0
        chosen = next((task for task in self._waiting if task.error is not None or task.ready()), None)
        if chosen is None:
            chosen = min(self._waiting, key=lambda task: task.deadline)
            if chosen.deadline == math.inf:
                who = "; ".join(f"{task.name} for {task.what}" for task in self._waiting)
                chosen = self._main if self._main in self._waiting else self._waiting[-1]
                chosen.error = DeadlockError(f"all threads wait without a deadline: {who}")
            else:
                self._now = max(self._now, chosen.deadline)
        self._waiting.remove(chosen)
        return chosen

    def _begin(self, task: _Task, ident: int | None) -> None:
        """Let a started thread participate; it waits for its turn."""
        assert ident is not None
        self._tasks[ident] = task
        self._waiting.append(task)

    def _end(self) -> None:
        """End the participation of the current thread."""
        del self._tasks[threading.get_ident()]
        if self._waiting:
            self._choose().gate.release()


class SimulatedEvent(threading.Event):
    """An event of a simulated clock."""

    def __init__(self, clock: SimulatedClock, what: str = "an event") -> None:
        super().__init__()
        self._clock, self._what = clock, what

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, at most for the timeout; return whether it is."""
        if not self.is_set():
            self._clock._wait(self.is_set, timeout, self._what)
        return self.is_set()


class SimulatedCondition(threading.Condition):
    """A condition of a simulated clock; notifications wake threads in the order of waiting."""

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
        """Release the lock and wait for a notification, at most for the timeout; return whether one came."""
        if self._owner != threading.get_ident():
            raise RuntimeError("a thread must hold the lock of a condition to wait for it")
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
        """Wait until a predicate is true, at most for the timeout; return its value."""
        end = math.inf if timeout is None else self._clock.now() + timeout
        while not (satisfied := predicate()) and (remaining := end - self._clock.now()) > 0:
            self.wait(remaining)
        return satisfied

    def notify(self, n: int = 1) -> None:
        """Wake some of the waiting threads."""
        for woken in [self._sleepers.popleft() for _ in range(min(n, len(self._sleepers)))]:
            woken.set()

    def notify_all(self) -> None:
        """Wake all waiting threads."""
        self.notify(len(self._sleepers))

    def _take(self, depth: int) -> None:
        me = threading.get_ident()
        if self._owner not in (None, me):
            self._clock._wait(lambda: self._owner is None, None, "a lock")
        self._owner = me
        self._depth += depth


class SimulatedThread(threading.Thread):
    """A daemon thread of a simulated clock."""

    def __init__(self, clock: SimulatedClock, work: Callable[[], object], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._clock, self._work, self._task = clock, work, _Task(name)
        self._over = SimulatedEvent(clock, f"the end of {name}")

    def start(self) -> None:
        """Start the thread; it runs when the others wait."""
        super().start()
        self._clock._begin(self._task, self.ident)

    def run(self) -> None:
        """Run the work, alternating with the other threads."""
        self._task.gate.acquire()
        try:
            self._work()
        finally:
            self._over.set()
            self._clock._end()

    def join(self, timeout: float | None = None) -> None:
        """Wait until it has ended, at most for the timeout."""
        if self._over.wait(timeout):
            super().join()

    def is_alive(self) -> bool:
        """Return whether it was started and has not ended."""
        return super().is_alive() and not self._over.is_set()
