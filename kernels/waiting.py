"""Calls in which a thread waits inside OpenCL, and the end of the interpreter.

While such a call waits, pyopencl lets other threads run. Before version 3.14, Python ends a daemon thread
that returns from it after the interpreter has begun to finalize. It does so below the frames of pyopencl's
C++ code, and the C++ runtime then aborts the process. Here the interpreter waits for these calls first.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import os
import threading
from typing import Any

_LONGEST_WAIT = 60.0  # seconds that the end of the interpreter waits for a device that may hang

_idle = threading.Condition()
_main = threading.main_thread().ident


class _Waiting:
    """The calls that wait, of all threads but the main one, which ends the interpreter itself."""

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
        """Let no call begin any more, and wait for those under way, unless this is a fork of ``process``."""
        if process == os.getpid():
            with _idle:
                self._closed = True
                _idle.wait_for(lambda: self._calls == 0, _LONGEST_WAIT)


waiting = _Waiting()
"""The context in which OpenCL is called where the call may wait.

SystemExit: the interpreter ends, and this is another thread than the main one.
"""


@functools.cache
def close_at_exit() -> None:
    """Have the end of the interpreter wait for calls in the context ``waiting``."""
    atexit.register(waiting.close, os.getpid())


def keep_for_ever(thing: Any) -> None:
    """Never destroy an object: one whose destruction would end the process."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))
