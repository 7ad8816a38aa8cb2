"""What HDF5 and the system say of a file, in words that can be read."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from mirrorskin.io.types import InputError

# A damaged file shows itself in h5py by any of these.
_ERRORS = (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError)
_LONGEST = 100


class as_input_error(AbstractContextManager[None]):  # noqa: N801  # as contextlib names its own
    """Turn what goes wrong with a file into an InputError of one line.

    A class, because files are opened with many of these and a generator takes several times as long.
    """

    def __init__(self, what: str | Callable[[], str], remedy: str = "", kinds: Any = _ERRORS) -> None:
        self._what, self._remedy, self._kinds = what, remedy, kinds

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any, /) -> None:
        if isinstance(error, self._kinds) and not isinstance(error, InputError):
            what = self._what if isinstance(self._what, str) else self._what()
            remedy = self._remedy and f"; {self._remedy}"
            raise InputError(f"{what}: {reason(error)}{remedy}") from error


def reason(error: Exception) -> str:
    """Return what went wrong: a few words instead of HDF5's many."""
    number = getattr(error, "errno", None)
    text = str(error.args[-1]) if error.args else type(error).__name__
    if number == errno.EAGAIN or is_flagged(error):
        return "another program is writing it: wait until it is done ('h5clear -s' if it died)"
    if number:
        return os.strerror(number)
    if "truncated" in text:
        return "it is truncated: copy it again"
    inner = text.partition("(")[2].removesuffix(")") or text
    return f"it is damaged ({' '.join(inner.split())[:_LONGEST]}): copy it again"


def is_flagged(error: Exception) -> bool:
    """Tell whether HDF5 refused a file because a writer left its mark in it, or this process writes it."""
    return any(said in str(error) for said in ("already open for write", "locking flag values don't match"))


def legible(text: str) -> str:
    """Return a text without what is no text: a file's name may be any bytes."""
    return text.encode(errors="surrogateescape").decode(errors="replace")
