"""Differences between operating systems: locks of files, space on a disk, processor cores."""

from __future__ import annotations

import errno
import os
import sys
from typing import Protocol

from mirrorskin.io.types import InputError


class _HasDescriptor(Protocol):
    def fileno(self) -> int: ...


def usable_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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
