"""Base class of objects that run one thread at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import wraps
from types import FunctionType
from typing import Any, Self

from mirrorskin.io.base.interpreter_end import computation


class ThreadSafe:
    """Base of classes whose objects may be used by several threads at once.

    One thread at a time runs the public methods and properties of an object; others wait. A display may
    therefore call ``result()`` while another thread pushes, and gets the maps of all completed pushes.
    Methods may call other methods of the same object. Public methods of subclasses are wrapped when the
    class is created. Plain attributes are not locked. Methods are computations of
    `mirrorskin.io.base.interpreter_end`.

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
        return _locked(member)
    if isinstance(member, property) and member.fget is not None:
        return property(_locked(member.fget), doc=member.__doc__)
    return member


def _locked(function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def locked(self: ThreadSafe, /, *args: Any, **kwargs: Any) -> Any:
        with computation(), self._thread_lock:
            return function(self, *args, **kwargs)

    return locked
