"""Files that exist whole or not at all."""

from __future__ import annotations

import fcntl
import functools
import os
import secrets
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any

import h5py

from mirrorskin.io.os_errors import as_input_error
from mirrorskin.io.types import InputError

MAKE_ROOM = "make room, or choose another place with -o"
"""What to do where a disk did not take all."""

_PREFIX, _SUFFIX = ".mirrorskin-", ".part"

# Files for HDF5 1.10 and later: the first whose own structures have checksums, and that could read what is
# being written.
VERSIONS = ("v110", "v110")

# Frames begin with a page, so that they can be worked on where they lie.
_ALIGNED = {"alignment_threshold": 1 << 20, "alignment_interval": 4096}


def check_output(path: Path, *keep: Path | None) -> None:
    """Refuse an output that could not be written, before any work is done for it.

    Parameters
    ----------
    path : Path
        File to write.
    *keep : Path or None
        Inputs, files or folders of files, which must not be overwritten.

    Raises
    ------
    InputError
        Its folder does not exist or cannot be written to, it is a folder itself, it is the input, or an HDF5
        file that is being written.

    Examples
    --------
    >>> check_output(Path("result.h5"), Path("press.h5"))  # doctest: +SKIP
    """
    with as_input_error(f"{path} cannot be written", "choose another place with -o"):
        if path.is_dir():
            raise InputError(f"{path} is a folder: name a file in it")
        if not path.parent.is_dir():
            raise InputError(f"{path}: there is no folder {path.parent}: make it first")
        if path.exists():
            if not path.is_file():
                raise InputError(f"{path} is no regular file: choose another place with -o")
            inputs = [one for one in keep if one is not None and one.exists()]
            if any(path.samefile(one) or path.parent.samefile(one) for one in inputs):
                raise InputError(f"{path} is the input, or part of it: name another output with -o")
            if is_locked(path) and not _readable(path):
                raise InputError(f"{path} is being written by another program: name another output with -o")
        with tempfile.TemporaryFile(dir=path.parent):
            pass


def is_locked(path: Path) -> bool:
    """Tell whether a program has a file open and keeps others from writing, as all do that write HDF5."""
    with suppress(OSError), path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # or the file system does not tell
            return True
    return False


class NewHdf5:
    """An HDF5 file in the making."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path = path
        self._disk = _Disk(descriptor, "w+b", closefd=False)
        self.root = h5py.File(self._disk, "w", libver=VERSIONS, **_ALIGNED)

    def check(self) -> None:
        """Raise InputError if the disk did not take all that was written so far."""
        if self._disk.error is not None:
            with as_input_error(f"{self._path} could not be written", MAKE_ROOM):
                raise self._disk.error

    def close(self) -> None:
        """Write what is left."""
        self.root.close()
        self._disk.close()


@contextmanager
def new_file(path: Path) -> Iterator[int]:
    """Make a file under a temporary name beside ``path``, and rename it when all went well.

    It is on the disk before it has its name. What killed programs left half-written in that folder is
    removed, once per process. Where ``path`` is a link, what the link leads to is replaced.
    """
    check_output(path)
    target = Path(os.path.realpath(path))
    _tidy(target.parent)
    # Its name is known before there is a file: whenever the program is ended, it is removed.
    part, descriptor = target.parent / f"{_PREFIX}{secrets.token_hex(8)}{_SUFFIX}", -1
    try:
        with as_input_error(f"{path} could not be written"):
            descriptor = _make(part)
        yield descriptor
        with as_input_error(f"{path} could not be written", MAKE_ROOM):
            os.fsync(descriptor)
            os.close(os.dup(descriptor))  # some disks tell only then that they did not take all
            part.chmod(0o666 & ~_umask())
            part.replace(target)
    finally:
        part.unlink(missing_ok=True)
        with suppress(OSError):
            os.close(descriptor)  # it was locked until it had its name


@contextmanager
def new_hdf5(path: Path) -> Iterator[NewHdf5]:
    """Write an HDF5 file as ``new_file`` does."""
    with new_file(path) as descriptor, hdf5_in(path, descriptor) as new:
        yield new


@contextmanager
def hdf5_in(path: Path, descriptor: int) -> Iterator[NewHdf5]:
    """Write HDF5 into a file that is open, and will be ``path``."""
    new = NewHdf5(path, descriptor)
    try:
        yield new
    finally:
        new.close()
        new.check()


def remove_leftovers(folder: Path) -> list[Path]:
    """Remove the half-written files of a folder whose writers are gone, as those that were killed.

    A file that is being written is locked, and stays. Where a file system has no locks, all stay.
    """
    removed = []
    for part in folder.glob(f"{_PREFIX}*{_SUFFIX}"):
        with suppress(OSError), part.open("r+b") as file:  # locked, no one's to open, or gone by now
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            part.unlink()
            removed.append(part)
    return removed


_tidy = functools.cache(remove_leftovers)


def _make(part: Path) -> int:
    """Make a file, which is locked as long as it is open, and return its descriptor."""
    while True:
        descriptor = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.fstat(descriptor).st_nlink:  # else someone took it for a leftover before it was locked
            return descriptor
        os.close(descriptor)


def _readable(path: Path) -> bool:
    """Tell whether HDF5 may read a file, which it may not while the file is being written."""
    try:
        h5py.File(path, "r").close()
    except OSError:
        return False
    return True


class _Disk(FileIO):
    """A file that keeps its error to itself and takes the rest: HDF5 crashes when it cannot close a file."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data)
        while rest and self.error is None:
            try:
                rest = rest[super().write(rest) :]
            except OSError as error:
                self.error = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        if self.error is None:
            try:
                return super().truncate(size)
            except OSError as error:
                self.error = error
        return size or 0


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_new(path: Path, parts: Sequence[bytes]) -> None:
    """Write the parts of a file, which exists whole or not at all."""
    with (
        new_file(path) as descriptor,
        as_input_error(f"{path} could not be written", MAKE_ROOM),
        os.fdopen(descriptor, "wb", closefd=False) as file,
    ):
        file.writelines(parts)
