"""Calls in which a thread waits inside OpenCL, and the end of the interpreter.

During such a call, pyopencl lets other threads run. Before version 3.14, Python ends a daemon thread that
returns from it after the interpreter has started to finalize. It does so below the frames of pyopencl's C++
code, and the C++ runtime then aborts the process. Here the interpreter waits for these calls first.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import os
import threading
from typing import Any

_LONGEST_WAIT = 60.0  # maximum wait of the interpreter for a device that may hang, seconds

_idle = threading.Condition()
_main = threading.main_thread().ident


class _Waiting:
    """The calls that wait, of all threads except the main one, which ends the interpreter itself."""

    def __init__(self) -> None:
        self._calls, self._closed = 0, False

    def __enter__(self) -> None:
        if threading.get_ident() == _main:
            return
        with _idle:
            if self._closed:
                raise SystemExit  # ends the thread without a message, as Python ends daemon threads
            self._calls += 1

    def __exit__(self, *_: object) -> None:
        if threading.get_ident() == _main:
            return
        with _idle:
            self._calls -= 1
            if self._calls == 0:
                _idle.notify_all()

    def close(self, process: int) -> None:
        """Prevent new calls, and wait for those in progress, unless this is a fork of ``process``."""
        if process == os.getpid():
            with _idle:
                self._closed = True
                _idle.wait_for(lambda: self._calls == 0, _LONGEST_WAIT)


waiting = _Waiting()
"""The context for OpenCL calls that may wait.

Raises SystemExit in other threads than the main one when the interpreter ends.
"""


@functools.cache
def close_at_exit() -> None:
    """Make the end of the interpreter wait for calls in the context ``waiting``."""
    atexit.register(waiting.close, os.getpid())


def keep_for_ever(thing: Any) -> None:
    """Never destroy an object whose destruction would end the process."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))
