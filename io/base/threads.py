"""Threads: computations at the end of the interpreter, and objects that several threads share.

Before version 3.14, Python ends a daemon thread where it returns from native code while the interpreter ends.
In C++, as in OpenCV and pyopencl, this aborts the process ("terminate called without an active exception").
"""

from __future__ import annotations

import concurrent.futures.thread  # noqa: F401  # its pools end after what is registered later
import functools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import FunctionType
from typing import Any, ParamSpec, Self, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_LONGEST_WAIT = 10.0  # seconds that the end is delayed at most
_PAUSE = 5.0  # seconds in which the interpreter ends

_changed = threading.Condition()
_computations = 0  # of daemon threads
_ending = _waited = False
_ended = set[threading.Thread]()  # threads in which SystemExit was raised


class _Inside(threading.local):
    """Whether a thread is in a computation that is counted; those in it are not, which takes less time."""

    is_counted = False


_inside = _Inside()


class _Nested:
    """A computation within one that is counted, whose thread ends here if the program ends."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None and _ending:
            _count(0)


_NESTED, _NOT_COUNTED = _Nested(), nullcontext()


def computation() -> AbstractContextManager[None]:
    """Return a context that delays the end of the interpreter while a daemon thread is in it.

    At the end, `SystemExit` is raised in daemon threads that enter or leave a context, such as between two
    blocks of frames.
    """
    if not threading.current_thread().daemon:
        return _NOT_COUNTED
    return _NESTED if _inside.is_counted and not _ending else _counted()


@contextmanager
def _counted() -> Iterator[None]:
    _register()
    _count(1)
    outside, _inside.is_counted = _inside.is_counted, True
    try:
        yield
    finally:
        _inside.is_counted = outside
        _count(-1)


def computes(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that is a computation."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        with computation():
            return function(*args, **kwargs)

    return call


def _count(change: int) -> None:
    """Count a computation of this thread that begins or has ended, and end the thread if the program ends."""
    global _computations
    with _changed:
        if change < 0 or not _ending:
            _computations += change
        if not _ending:
            return
        _changed.notify_all()
        if not _waited:
            _ended.add(threading.current_thread())
    if _waited:  # nobody waits while this thread deletes what it computed, so the interpreter ends first
        time.sleep(_PAUSE)
    raise SystemExit


@functools.cache
def _register() -> None:
    # Functions given to `atexit` are called after pools refuse work, which computations need until they end.
    try:
        threading._register_atexit(_wait)  # type: ignore[attr-defined]
    except RuntimeError:  # the interpreter ends already
        raise SystemExit from None


def _wait() -> None:
    """Wait for computations, and for the threads that ended with them."""
    global _ending, _waited
    end = time.monotonic() + _LONGEST_WAIT
    with _changed:
        _ending = True
        _changed.wait_for(lambda: not _computations, _LONGEST_WAIT)
    while not _waited:
        with _changed:
            thread = _ended.pop() if _ended else None
            _waited = thread is None
        if thread is not None:
            thread.join(max(0.0, end - time.monotonic()))


class ThreadSafe:
    """Base of classes whose objects may be used by several threads at once.

    One thread at a time runs the public methods and properties of an object; others wait. A display may
    therefore call ``result()`` while another thread pushes, and gets the maps of all completed pushes.
    Methods may call other methods of the same object. Public methods of subclasses are wrapped when the
    class is created. Plain attributes are not locked. Methods are computations of
    `mirrorskin.io.base.threads`.

    Examples
    --------
    >>> class Sum(ThreadSafe):
    ...     total = 0
    ...     def push(self, number):
    ...         self.total += number
    ...     def result(self):
    ...         return self.total
    >>> total = Sum()
    >>> threads = [threading.Thread(target=total.push, args=[2]) for _ in range(3)]
    >>> for thread in threads:
    ...     thread.start()
    >>> for thread in threads:
    ...     thread.join()
    >>> total.result()
    6
    """

    _thread_lock: AbstractContextManager[Any]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Create an object with a lock, independently of ``__init__``."""
        instance = super().__new__(cls)
        instance._thread_lock = threading.RLock()
        return instance

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name, member in list(vars(cls).items()):
            if not name.startswith("_"):
                setattr(cls, name, _guarded(member))


def _guarded(member: Any) -> Any:
    """Return a method or property that runs under the object's lock; anything else unchanged."""
    if isinstance(member, FunctionType):
        return locked(member)
    if isinstance(member, property) and member.fget is not None:
        return property(locked(member.fget), doc=member.__doc__)
    return member


def locked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a private method of a `ThreadSafe` class that is called from outside."""

    @functools.wraps(function)
    def call(self: ThreadSafe, /, *args: Any, **kwargs: Any) -> Any:
        with computation(), self._thread_lock:
            return function(self, *args, **kwargs)

    return call
