"""Files that appear complete or not at all: plain bytes, or HDF5 files of a few groups and datasets."""

from __future__ import annotations

import errno
import functools
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from io import FileIO
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.system import check_writable_system, lock, translate_os_errors
from mirrorskin.io.base.text import legible
from mirrorskin.io.base.types import Closing, InputError, ProcessValue
from mirrorskin.io.base.url import is_zarr
from mirrorskin.io.storage.existing import Replaces, check_replaced

MAKE_ROOM = "make room, or choose another place with -o"
"""Remedy for a disk that did not accept all data."""

_PREFIX, _SUFFIX = ".mirrorskin-", ".part"

# Files for HDF5 1.10 and later: the first version that stores checksums of its own structures, and reads
# files while they are written.
VERSIONS = ("v110", "v110")

_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)  # a file system without hard links


_TEXT = h5py.string_dtype()
_UNDATED, _WITH_GROUPS = h5py.h5p.create(h5py.h5p.DATASET_CREATE), h5py.h5p.create(h5py.h5p.LINK_CREATE)
_UNDATED.set_obj_track_times(False)
_WITH_GROUPS.set_create_intermediate_group(True)
_WITH_GROUPS.set_char_encoding(h5py.h5t.CSET_UTF8)


def check_output(path: Path, *keep: Path | None, replaces: Replaces = "derived") -> None:
    """Raise InputError for an output that could not be written, before any work is done.

    Parameters
    ----------
    path : Path
        File to write.
    *keep : Path or None
        Inputs, files or folders of files, that must not be overwritten.
    replaces : {"nothing", "unused", "derived", "calibration", "anything"}
        Which existing file may be replaced; see `mirrorskin.io.storage.existing.Replaces`.

    Raises
    ------
    InputError
        Its folder does not exist or is not writable; or it is a folder, an input, a file that is being
        written, or a file that may not be replaced.

    Examples
    --------
    >>> check_output(Path("result.h5"), Path("press.h5"))  # doctest: +SKIP
    """
    check_writable_system()
    if replaces == "calibration":
        check_hdf5_name(path)
    with translate_os_errors(f"{path} cannot be written", "choose another place with -o"):
        if is_zarr(path):
            raise InputError(f"{path}: this is written as HDF5: name a local file, .h5, with -o")
        if path.is_dir():
            raise InputError(f"{path} is a folder: name a file in it")
        if not path.parent.is_dir():
            raise InputError(f"{path}: there is no folder {path.parent}: make it first")
        if path.exists():
            if not path.is_file():
                raise InputError(f"{path} is not a regular file: choose another place with -o")
            inputs = [file for file in keep if file is not None and file.exists()]
            if any(path.samefile(file) or path.parent.samefile(file) for file in inputs):
                raise InputError(f"{path} is the input, or part of it: name another output with -o")
            _check_existing(path, replaces)
        with tempfile.TemporaryFile(dir=path.parent):
            pass


def check_hdf5_name(path: Path) -> None:
    """Raise InputError if the suffix of a file to be written as HDF5 is that of another kind of file.

    Examples
    --------
    >>> check_hdf5_name(Path("press.h5")), check_hdf5_name(Path("press.2026-05-01"))
    (None, None)
    """
    suffix = path.suffix.lower()
    if _ENDING.fullmatch(suffix) and suffix not in _HDF5:
        raise InputError(f"{path}: this is written as HDF5. Name it {path.stem}.h5")


def _check_existing(path: Path, replaces: Replaces) -> None:
    """Raise InputError if a file is being written, or may not be replaced."""
    if is_locked(path) and not _readable(path):
        raise InputError(f"{path} is being written by another program: name another output with -o")
    check_replaced(path, replaces)


def is_locked(path: Path) -> bool:
    """Return whether a program has locked a file; every program that writes HDF5 does."""
    with suppress(OSError), path.open("rb") as file:
        try:
            lock(file, wait=False)
        except OSError:  # or the file system does not support locks
            return True
    return False


_HDF5 = (".h5", ".hdf5", ".hdf", ".he5", ".nxs", ".cxi")
_ENDING = re.compile(r"\.[a-z]{1,5}[0-9]?")  # what names of files usually end in


class NewHdf5(Closing):
    """An HDF5 file that is being written to an open file, which will be renamed to ``path``."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path = path
        self._disk = _Disk(descriptor, "w+b", closefd=False)
        self.root: Any = h5py.File(self._disk, "w", libver=VERSIONS)

    def check(self) -> None:
        """Raise InputError if the disk did not accept everything written so far."""
        if self._disk.error is not None:
            with translate_os_errors(f"{self._path} could not be written", MAKE_ROOM):
                raise self._disk.error

    def close(self) -> None:
        """Write what remains in buffers."""
        self.root.close()
        self._disk.close()
        self.check()


@contextmanager
def new_file(path: Path, replaces: Replaces = "derived") -> Iterator[int]:
    """Create a file under a temporary name next to ``path``, and rename it after success.

    The file is synchronised to the disk before it is renamed, and the folder afterwards. Incomplete files of
    killed programs in that folder are removed, once per process. If ``path`` is a link, its target is
    replaced. Whether an existing file may be replaced is checked at the start, and again before renaming.
    """
    check_output(path, replaces=replaces)
    with new_part(path) as (part, descriptor):
        yield descriptor
        with translate_os_errors(f"{path} could not be written", MAKE_ROOM):
            synchronise(descriptor)
            _rename(part, path, replaces)


@contextmanager
def new_part(path: Path) -> Iterator[tuple[Path, int]]:
    """Create a locked file in the folder of ``path``, under a temporary name that is removed at the end."""
    folder = Path(os.path.realpath(path)).parent
    _remove_leftovers_once(folder)
    # The name is chosen before the file exists, so that it is removed even if the program ends now.
    part, descriptor = folder / f"{_PREFIX}{os.urandom(8).hex()}{_SUFFIX}", -1
    try:
        with translate_os_errors(f"{path} could not be written"):
            descriptor = _make(part)
        yield part, descriptor
    finally:
        with suppress(OSError):  # the next file in this folder removes it
            part.unlink(missing_ok=True)
        with suppress(OSError):
            os.close(descriptor)  # releases the lock, after the renaming


def synchronise(descriptor: int) -> None:
    """Synchronise a file to the disk."""
    os.fsync(descriptor)
    os.close(os.dup(descriptor))  # some file systems report a full disk only on closing


def _synchronise_path(path: Path) -> None:
    """Synchronise a file to the disk, or the names in a folder if the file system can do that."""
    with suppress(OSError) if path.is_dir() else nullcontext():
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def link_new(part: Path, target: Path) -> None:
    """Create an additional name of a file; FileExistsError if it exists, also if created simultaneously."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        if os.path.lexists(target):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target)) from None
        part.rename(target)
    _synchronise_path(target.parent)


def replace_file(part: Path, target: Path) -> None:
    """Rename a file, which replaces another."""
    part.replace(target)
    _synchronise_path(target.parent)


def _rename(part: Path, path: Path, replaces: Replaces) -> None:
    """Rename a file, after checking again whether an existing file may be replaced: it may be new."""
    target = Path(os.path.realpath(path))
    if replaces in ("nothing", "unused"):
        try:
            link_new(part, target)
        except FileExistsError:
            _check_existing(path, replaces)
            raise
        return
    if target.exists():
        _check_existing(path, replaces)
    replace_file(part, target)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Create a folder under a temporary name next to ``path``, and rename it after success.

    Leftovers of killed programs in that folder are removed, as in `new_file`. If several programs create the
    same folder, the first one keeps the name; the others raise InputError.
    """
    _remove_leftovers_once(path.parent)
    part, descriptor = path.parent / f"{_PREFIX}{os.urandom(8).hex()}{_SUFFIX}", -1
    try:
        with translate_os_errors(f"{path} could not be written"):
            descriptor = _make_folder(part)
        yield part
        with translate_os_errors(f"{path} could not be written", "choose another place with -o"):
            for written in (*part.rglob("*"), part):
                _synchronise_path(written)
            if path.exists() or not _renamed(part, path):
                raise InputError(f"{path} was made by another program meanwhile: name another output with -o")
    finally:
        shutil.rmtree(part, ignore_errors=True)
        with suppress(OSError):
            os.close(descriptor)


@contextmanager
def new_hdf5(path: Path, replaces: Replaces = "derived") -> Iterator[NewHdf5]:
    """Write an HDF5 file like ``new_file``; InputError for the suffix of another kind of file."""
    check_hdf5_name(path)
    with new_file(path, replaces) as descriptor:
        with translate_os_errors(f"{path} could not be written", MAKE_ROOM):
            new = NewHdf5(path, descriptor)
        with new:
            yield new


def remove_leftovers(folder: Path) -> list[Path]:
    """Remove incomplete files and folders of programs that no longer run, and return them.

    Files that are being written are locked, and kept. On a file system without locks, all are kept.
    """
    removed = []
    for part in folder.glob(f"{_PREFIX}*{_SUFFIX}"):
        with suppress(OSError):  # locked, not accessible, or removed meanwhile
            descriptor = os.open(part, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW)
            try:
                lock(descriptor, wait=False)
                if part.is_dir():
                    shutil.rmtree(part)
                else:
                    part.unlink()
                removed.append(part)
            finally:
                os.close(descriptor)
    return removed


_remove_leftovers_once = functools.cache(remove_leftovers)


def _make(part: Path) -> int:
    """Create a file that is locked while it is open, and return its descriptor."""
    while True:
        descriptor = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        with suppress(OSError):  # a file system without locks
            lock(descriptor)
        if os.fstat(descriptor).st_nlink:  # otherwise it was removed as a leftover before it was locked
            return descriptor
        os.close(descriptor)


def _renamed(part: Path, path: Path) -> bool:
    """Rename a folder, unless the name exists."""
    try:
        part.rename(path)
    except OSError as error:
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
            return False
        raise
    _synchronise_path(path.parent)
    return True


def _make_folder(part: Path) -> int:
    """Create a folder that is locked while it is open, and return its descriptor."""
    while True:
        part.mkdir(mode=0o777)
        with suppress(FileNotFoundError):  # removed as a leftover before it was locked
            descriptor = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            with suppress(OSError):  # a file system without locks
                lock(descriptor)
            if os.path.samestat(os.fstat(descriptor), part.stat()):
                return descriptor
            os.close(descriptor)


def _readable(path: Path) -> bool:
    """Return whether HDF5 can open a file; it cannot while the file is being written."""
    try:
        h5py.File(path, "r").close()
    except OSError:
        return False
    return True


class _Disk(FileIO):
    """A file that stores its first error and ignores later writes: HDF5 crashes if closing a file fails."""

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


def write_new(path: Path, parts: Sequence[bytes], replaces: Replaces = "derived") -> None:
    """Write the parts of a file, which appears complete or not at all."""
    with (
        new_file(path, replaces) as descriptor,
        translate_os_errors(f"{path} could not be written", MAKE_ROOM),
        os.fdopen(descriptor, "wb", closefd=False) as file,
    ):
        file.writelines(parts)


class Item(NamedTuple):
    """An object to write: its full name, the values of a dataset (None for a group), and its attributes.

    A text instead of values is the target of a soft link.
    """

    name: str
    values: NDArray[Any] | str | None
    attributes: Mapping[str, Any]


def write_item(root: h5py.Group, item: Item) -> None:
    """Write an object with h5py's low-level interface, five times as fast for small datasets."""
    if isinstance(item.values, str):
        root[item.name] = h5py.SoftLink(item.values)
        return
    if item.values is None:
        root.require_group(item.name).attrs.update(item.attributes)
        return
    values = np.asarray(item.values, order="C")
    kind, space = h5py.h5t.py_create(values.dtype, logical=True), h5py.h5s.create_simple(values.shape)
    node = h5py.h5d.create(root.id, item.name.encode(), kind, space, _UNDATED, _WITH_GROUPS)
    if values.size:
        node.write(h5py.h5s.ALL, h5py.h5s.ALL, values, kind)
    for name, value in item.attributes.items():
        # Variable-length texts, as expected by programs that read NeXus, such as silx.
        stored = np.asarray(value, _TEXT if isinstance(value, str) else None)
        kind, space = h5py.h5t.py_create(stored.dtype, logical=True), h5py.h5s.create_simple(stored.shape)
        h5py.h5a.create(node, name.encode(), kind, space).write(stored)


def write_file(path: Path, items: Iterable[Item], replaces: Replaces = "derived") -> None:
    """Write a file with these objects, which appears complete or not at all."""
    with (
        new_hdf5(path, replaces) as new,
        translate_os_errors(f"{path} could not be written", MAKE_ROOM, OSError),
    ):
        for item in items:
            write_item(new.root, item)


def fixed_text(text: str | Sequence[str]) -> NDArray[Any]:
    """Return a text, or a list of texts, as fixed-length UTF-8.

    HDF5 stores variable-length texts in heaps, and hangs when it reads a damaged heap.
    """
    if isinstance(text, str):
        encoded = legible(text).encode() or b"\0"
        return np.array(encoded, h5py.string_dtype("utf-8", len(encoded)))
    texts = [legible(part).encode() for part in text]
    return np.array(texts, h5py.string_dtype("utf-8", max(map(len, texts), default=0) or 1))


def process_items(place: str, process: Mapping[str, ProcessValue]) -> Iterator[Item]:
    """Yield the objects of a process: the values that describe the provenance of a file."""
    for name, value in process.items():
        values = fixed_text(value) if isinstance(value, str) else np.asarray(value)
        yield Item(f"{place}/{name}", values, {})
