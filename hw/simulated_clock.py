"""A clock that jumps from event to event: hours of waiting take no time, and always go the same way."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType

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

    def _end(self, ident: int) -> None:
        """Let a thread that runs take part no more."""
        del self._tasks[ident]
        if self._waiting:
            self._choose().gate.release()


class SimulatedEvent:
    """A `mirrorskin.hw.clock.Event` of a simulated clock."""

    def __init__(self, clock: SimulatedClock) -> None:
        self._clock, self._set = clock, False

    def is_set(self) -> bool:
        """Return whether it was set."""
        return self._set

    def set(self) -> None:
        """Set it."""
        self._set = True

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, for some seconds at most; return whether it is."""
        if not self._set:
            self._clock._wait(self.is_set, timeout, "an event")
        return self._set


class SimulatedCondition:
    """A `mirrorskin.hw.clock.Condition` of a simulated clock."""

    def __init__(self, clock: SimulatedClock) -> None:
        self._clock = clock
        self._owner: int | None = None
        self._depth = 0
        self._waiters: deque[SimulatedEvent] = deque()

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
        waiter, depth = SimulatedEvent(self._clock), self._depth
        self._waiters.append(waiter)
        self._owner, self._depth = None, 0
        try:
            self._clock._wait(waiter.is_set, timeout, "a notification")
        finally:
            if not waiter.is_set():
                self._waiters.remove(waiter)
            self._take(depth)
        return waiter.is_set()

    def notify(self, n: int = 1) -> None:
        """Wake some of those that wait, in the order in which they began to."""
        for waiter in [self._waiters.popleft() for _ in range(min(n, len(self._waiters)))]:
            waiter.set()

    def notify_all(self) -> None:
        """Wake all that wait."""
        self.notify(len(self._waiters))

    def _take(self, depth: int) -> None:
        me = threading.get_ident()
        if self._owner not in (None, me):
            self._clock._wait(lambda: self._owner is None, None, "a lock")
        self._owner = me
        self._depth += depth


class SimulatedThread:
    """A `mirrorskin.hw.clock.Thread` of a simulated clock: a thread that runs when it is its turn."""

    def __init__(self, clock: SimulatedClock, work: Callable[[], object], name: str) -> None:
        self._clock, self._work, self._task = clock, work, _Task(name)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._ended = SimulatedEvent(clock)

    def start(self) -> None:
        """Begin to work, when the others wait."""
        self._thread.start()
        self._clock._begin(self._task, self._thread.ident)

    def join(self, timeout: float | None = None) -> None:
        """Wait until it has ended, for some seconds at most."""
        if self._ended.wait(timeout):
            self._thread.join()

    def is_alive(self) -> bool:
        """Return whether it has begun and not ended."""
        return self._thread.ident is not None and not self._ended.is_set()

    def _run(self) -> None:
        self._task.gate.acquire()
        try:
            self._work()
        finally:
            self._ended.set()
            self._clock._end(threading.get_ident())
