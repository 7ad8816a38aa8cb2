"""One thread at a time inside an object: the base class of operations."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cached_property, wraps
from types import FunctionType
from typing import Any, Self


class ThreadSafe:
    """Base of classes whose objects may be used by several threads at once.

    One thread at a time runs an object's public methods and properties; others wait until it is done. So a
    display may call ``result()`` while another thread pushes: it gets the maps of all pushes that were over
    before, and of no half of one. A method may call others of the same object. A subclass adds nothing; its
    public methods are wrapped when the class is made. Plain attributes are not guarded.

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
        """Make an object with a lock of its own, whatever ``__init__`` does."""
        made = super().__new__(cls)
        made._thread_lock = threading.RLock()
        return made

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name, member in list(vars(cls).items()):
            if not name.startswith("_"):
                setattr(cls, name, _guarded(member))


def _guarded(member: Any) -> Any:
    """Return a method or property that runs under the object's lock; anything else as it is."""
    if isinstance(member, FunctionType):
        return _locked(member)
    if isinstance(member, property):
        read, write = (end and _locked(end) for end in (member.fget, member.fset))
        return property(read, write, doc=member.__doc__)
    if isinstance(member, cached_property):
        return property(_locked(member.__get__), doc=member.__doc__)
    return member


def _locked(function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def locked(self: ThreadSafe, /, *args: Any, **kwargs: Any) -> Any:
        with self._thread_lock:
            return function(self, *args, **kwargs)

    return locked
