"""The operating system: opening and locking of files, messages for errors, disk space, processor cores."""

from __future__ import annotations

import errno
import os
import stat
import sys
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable
from contextlib import AbstractContextManager
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any, Protocol

from mirrorskin.io.base.types import InputError

# h5py raises any of these for damaged files.
_ERRORS = (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError)
_QUOTED_MAX = 100

MAX_UNPACKED_BYTES = 1 << 30
"""Limit of the memory that one file may require by the sizes it states: a picture, a compressed array.

A file of kilobytes can state sizes of gigabytes. They are compared with this limit before decoding.
"""

MAX_TEXT_BYTES = 64 << 20
"""Limit of the size of a text or a table that is read as a whole: settings, positions, readings."""


class translate_os_errors(AbstractContextManager[None]):  # noqa: N801  # named like contextlib's functions
    """Convert errors of a file to an InputError of one line.

    It is a class, because opening a file uses many of them, and a generator takes several times as long.
    """

    def __init__(self, what: str | Callable[[], str], remedy: str = "", kinds: Any = _ERRORS) -> None:
        self._what, self._remedy, self._kinds = what, remedy, kinds

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any, /) -> None:
        if isinstance(error, self._kinds) and not isinstance(error, InputError):
            what = self._what if isinstance(self._what, str) else self._what()
            remedy = self._remedy and f"; {self._remedy}"
            raise InputError(f"{what}: {reason(error)}{remedy}") from error


def reason(error: Exception) -> str:
    """Return the cause of an error: a few words instead of HDF5's long message."""
    number = getattr(error, "errno", None)
    text = str(error.args[-1]) if error.args else type(error).__name__
    if number == errno.EAGAIN or is_flagged(error):
        return "another program is writing it: wait until it is done ('h5clear -s' if it died)"
    if number:
        return os.strerror(number)
    if "truncated" in text:
        return "it is truncated: copy it again"
    inner = text.partition("(")[2].removesuffix(")") or text
    return f"it is damaged ({' '.join(inner.split())[:_QUOTED_MAX]}): copy it again"


def is_flagged(error: Exception) -> bool:
    """Return whether HDF5 refused a file because it is marked as being written, or this process writes it."""
    return any(text in str(error) for text in ("already open for write", "locking flag values don't match"))


def check_regular(path: Path, remedy: str = "") -> None:
    """Raise InputError unless a path leads to a regular file.

    Opening a FIFO would wait for its writer, and opening a device may have side effects.
    """
    remedy = remedy and f"; {remedy}"
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:  # ValueError: the name contains a null byte
        raise InputError(f"{path} cannot be read: {getattr(error, 'strerror', error)}{remedy}") from None
    if stat.S_ISDIR(mode):
        raise InputError(f"{path} cannot be read: {os.strerror(errno.EISDIR)}{remedy}")
    if not stat.S_ISREG(mode):
        raise InputError(f"{path} is not a regular file: save its contents in one first{remedy}")


class _BoundedReader(BufferedReader):
    """A file that reads at most ``MAX_UNPACKED_BYTES`` at once, because lengths stated in it may be wrong."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > MAX_UNPACKED_BYTES:
            raise ValueError(f"it states a length of {size} bytes")
        return super().read(size)


def open_regular(path: Path, remedy: str = "") -> BufferedReader:
    """Open a regular file for reading; InputError for anything else."""
    check_regular(path, remedy)
    try:
        return _BoundedReader(FileIO(path))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}{remedy and f'; {remedy}'}") from None


def read_regular(path: Path, remedy: str = "", limit: int = MAX_UNPACKED_BYTES) -> bytes:
    """Read a whole regular file; InputError for anything else, and for a file larger than the limit."""
    with open_regular(path, remedy) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise InputError(f"{path} has {size} bytes, and at most {limit} are read of such a file")
        try:
            return file.read(limit)
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}{remedy and f'; {remedy}'}") from None


def read_text(path: Path, remedy: str = "") -> str:
    """Read a text file: UTF-8, or UTF-16 after a byte-order mark, which is not part of the text."""
    data = read_regular(path, remedy, MAX_TEXT_BYTES)
    is_marked = data.startswith((BOM_UTF16_LE, BOM_UTF16_BE))
    end = remedy and f"; {remedy}"
    try:
        text = data.decode("utf-16" if is_marked else "utf-8-sig")
    except UnicodeDecodeError as error:
        line, byte = data.count(b"\n", 0, error.start) + 1, data[error.start]
        raise InputError(
            f"{path} is not text in UTF-8: line {line} contains the byte 0x{byte:02x}. Save it in UTF-8, as"
            f" Excel's 'CSV UTF-8' is{end}"
        ) from error
    if "\0" in text:
        raise InputError(f"{path} is not text in UTF-8: it contains bytes of 0. Save it in UTF-8{end}")
    return text


def check_unpacked(size: int, what: str, remedy: str, limit: int = MAX_UNPACKED_BYTES) -> None:
    """Raise InputError if a file states that it needs more memory than the limit."""
    if size > limit:
        raise InputError(f"{what} takes {size} bytes of memory, and at most {limit} are allowed: {remedy}")


class _HasDescriptor(Protocol):
    def fileno(self) -> int: ...


def check_writable_system() -> None:
    """Raise InputError on a system where files cannot be written safely."""
    if sys.platform == "win32":
        raise InputError(
            "mirrorskin cannot write files on Windows, which lacks the file locks it needs:"
            " use it in Python, or in the Windows Subsystem for Linux"
        )


def lock(file: int | _HasDescriptor, *, shared: bool = False, wait: bool = True) -> None:
    """Lock an open file until it is closed.

    Parameters
    ----------
    file : int or object with ``fileno``
        An open file.
    shared : bool
        Whether other programs may have a shared lock at the same time.
    wait : bool
        Whether to wait for other programs to release their locks.

    Raises
    ------
    OSError
        Another program has a lock, or the file system or the operating system has none.
    """
    if sys.platform == "win32":
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
    import fcntl

    fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))


def reserve_space(descriptor: int, start: int, size: int) -> None:
    """Extend a file for one of its parts; on Linux, also reserve the disk space.

    Raises
    ------
    OSError
        The disk is full, or the file system cannot reserve space.
    """
    if sys.platform == "linux":
        os.posix_fallocate(descriptor, start, size)
    else:
        os.ftruncate(descriptor, max(os.fstat(descriptor).st_size, start + size))
