"""Files that exist whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import Any

import h5py

from mirrorskin.io.plain import plainly
from mirrorskin.io.types import InputError


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
        Its folder does not exist or cannot be written to, it is a folder itself, or it is the input.
    """
    with plainly(f"{path} cannot be written", "choose another place with -o"):
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
        with tempfile.TemporaryFile(dir=path.parent):
            pass


class NewHdf5:
    """An HDF5 file in the making.

    Attributes
    ----------
    root : h5py.File
    """

    def __init__(self, path: Path, part: str) -> None:
        self._path = path
        self._disk = _Disk(part, "w+b")
        self.root = h5py.File(self._disk, "w")

    def check(self) -> None:
        """Raise InputError if the disk did not take all that was written so far."""
        if self._disk.error is not None:
            with plainly(f"{self._path} could not be written", "make room, or choose another place with -o"):
                raise self._disk.error

    def close(self) -> None:
        """Write what is left."""
        self.root.close()
        self._disk.close()


@contextmanager
def new_hdf5(path: Path) -> Iterator[NewHdf5]:
    """Write an HDF5 file under a temporary name beside ``path``, and rename it when all went well.

    Raises
    ------
    InputError
        It cannot be written; an older file of that name is left as it was.
    """
    check_output(path)
    with plainly(f"{path} could not be written"):
        handle, name = tempfile.mkstemp(prefix=".mirrorskin-", suffix=".part", dir=path.parent)
    os.close(handle)
    part = Path(name)
    try:
        new = NewHdf5(path, name)
        try:
            yield new
        finally:
            new.close()
            new.check()
        with plainly(f"{path} could not be written"):
            part.chmod(0o666 & ~_umask())
            part.replace(path)
    finally:
        part.unlink(missing_ok=True)


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
