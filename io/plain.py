"""What HDF5 and the system say of a file, in words that can be read."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager

from mirrorskin.io.types import InputError

# A damaged file shows itself in h5py by any of these.
_ERRORS = (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError)
_LONGEST = 100


@contextmanager
def plainly(what: str, remedy: str = "") -> Iterator[None]:
    """Turn what goes wrong with a file into an InputError of one line.

    Parameters
    ----------
    what : str
        The line's beginning: the file, and what was to be done with it.
    remedy : str, optional
        The line's end: what to do about it.
    """
    try:
        yield
    except _ERRORS as error:
        raise InputError(f"{what}: {reason(error)}{remedy and f'; {remedy}'}") from error


def reason(error: Exception) -> str:
    """Return what went wrong: a few words instead of HDF5's many."""
    number = getattr(error, "errno", None)
    text = str(error.args[-1]) if error.args else type(error).__name__
    if number == errno.EAGAIN or "already open for write" in text:
        return "another program is writing it: wait until it is done ('h5clear -s' if it died)"
    if number:
        return os.strerror(number)
    if "truncated" in text:
        return "it is truncated: copy it again"
    inner = text.partition("(")[2].removesuffix(")") or text
    return f"it is damaged ({' '.join(inner.split())[:_LONGEST]}): copy it again"


def legible(text: str) -> str:
    """Return a text without what is no text: a file's name may be any bytes."""
    return text.encode(errors="surrogateescape").decode(errors="replace")
