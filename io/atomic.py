"""Files that exist whole or not at all: of bytes, or HDF5 of some groups and datasets each."""

from __future__ import annotations

import errno
import fcntl
import functools
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.existing import Replaces, check_replaced
from mirrorskin.io.os_errors import as_input_error, legible
from mirrorskin.io.types import Closing, InputError, ProcessValue
from mirrorskin.io.url import ZARR_SUFFIX, is_zarr

MAKE_ROOM = "make room, or choose another place with -o"
"""What to do where a disk did not take all."""

_PREFIX, _SUFFIX = ".mirrorskin-", ".part"

# Files for HDF5 1.10 and later: the first whose own structures have checksums, and that could read what is
# being written.
VERSIONS = ("v110", "v110")

_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)  # of a file system

_LARGE = 4096  # bytes of a dataset that is not kept in memory with a file's structure
_MOST_LAYOUTS = 16  # that are remembered

_TEXT, _ONE = h5py.string_dtype(), h5py.h5s.create(h5py.h5s.SCALAR)
_STORED_TEXT = h5py.h5t.py_create(_TEXT, logical=True)
_UNDATED, _WITH_GROUPS = h5py.h5p.create(h5py.h5p.DATASET_CREATE), h5py.h5p.create(h5py.h5p.LINK_CREATE)
_UNDATED.set_obj_track_times(False)
_WITH_GROUPS.set_create_intermediate_group(True)
_WITH_GROUPS.set_char_encoding(h5py.h5t.CSET_UTF8)

# Frames begin with a page, so that they can be worked on where they lie.
_ALIGNED = {"alignment_threshold": 1 << 20, "alignment_interval": 4096}


def check_output(
    path: Path, *keep: Path | None, or_zarr: bool = False, replaces: Replaces = "derived"
) -> None:
    """Refuse an output that could not be written, before any work is done for it.

    Parameters
    ----------
    path : Path
        File to write.
    *keep : Path or None
        Inputs, files or folders of files, which must not be overwritten.
    or_zarr : bool
        Whether it may be a Zarr store, too, which must be a new one.
    replaces : {"nothing", "derived", "calibration", "anything"}
        Which existing file may be replaced; see `mirrorskin.io.existing.Replaces`.

    Raises
    ------
    InputError
        Its folder does not exist or cannot be written to, it is a folder itself, it is the input, a file that
        is being written, or one that may not be replaced.

    Examples
    --------
    >>> check_output(Path("result.h5"), Path("press.h5"))  # doctest: +SKIP
    """
    with as_input_error(f"{path} cannot be written", "choose another place with -o"):
        if or_zarr and is_zarr(path) and path.suffix.lower() == ZARR_SUFFIX:
            from mirrorskin.io.zarr_export import check_store

            check_store(path)
            return
        if is_zarr(path):
            raise InputError(f"{path}: this is written as HDF5: name a local file, .h5, with -o")
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
            _check_existing(path, replaces)
        with tempfile.TemporaryFile(dir=path.parent):
            pass


def _check_existing(path: Path, replaces: Replaces) -> None:
    """Raise InputError if a file is being written, or may not be replaced."""
    if is_locked(path) and not _readable(path):
        raise InputError(f"{path} is being written by another program: name another output with -o")
    check_replaced(path, replaces)


def is_locked(path: Path) -> bool:
    """Tell whether a program has a file open and keeps others from writing, as all do that write HDF5."""
    with suppress(OSError), path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # or the file system does not tell
            return True
    return False


class NewHdf5(Closing):
    """An HDF5 file in the making, in a file that is open and will be ``path``."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path = path
        self._disk = _Disk(descriptor, "w+b", closefd=False)
        self.root: Any = h5py.File(self._disk, "w", libver=VERSIONS, **_ALIGNED)

    def check(self) -> None:
        """Raise InputError if the disk did not take all that was written so far."""
        if self._disk.error is not None:
            with as_input_error(f"{self._path} could not be written", MAKE_ROOM):
                raise self._disk.error

    def close(self) -> None:
        """Write what is left."""
        self.root.close()
        self._disk.close()
        self.check()


@contextmanager
def new_file(path: Path, replaces: Replaces = "derived") -> Iterator[int]:
    """Make a file under a temporary name next to ``path``, and rename it when all went well.

    It is on the disk before it has its name. Files that killed programs left half-written in that folder are
    removed, once per process. If ``path`` is a link, its target is replaced. Whether an existing file may be
    replaced is checked at the start, and again just before that.
    """
    check_output(path, replaces=replaces)
    with new_part(path) as (part, descriptor):
        yield descriptor
        with as_input_error(f"{path} could not be written", MAKE_ROOM):
            complete_part(part, descriptor)
            _rename(part, path, replaces)


@contextmanager
def new_part(path: Path) -> Iterator[tuple[Path, int]]:
    """Make a locked file in the folder of ``path``, under a temporary name that is removed at the end."""
    folder = Path(os.path.realpath(path)).parent
    _tidy(folder)
    # Its name is known before there is a file: whenever the program is ended, it is removed.
    part, descriptor = folder / f"{_PREFIX}{secrets.token_hex(8)}{_SUFFIX}", -1
    try:
        with as_input_error(f"{path} could not be written"):
            descriptor = _make(part)
        yield part, descriptor
    finally:
        part.unlink(missing_ok=True)
        with suppress(OSError):
            os.close(descriptor)  # it was locked until it had its name


def complete_part(part: Path, descriptor: int) -> None:
    """Put a file on the disk, and let others read it as the process's mask says."""
    os.fsync(descriptor)
    os.close(os.dup(descriptor))  # some disks report only then that they did not take all
    mask = os.umask(0)
    os.umask(mask)
    part.chmod(0o666 & ~mask)


def link_new(part: Path, target: Path) -> None:
    """Give a file a further name; FileExistsError if that is taken, even by a program that is as quick."""
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


def _rename(part: Path, path: Path, replaces: Replaces) -> None:
    """Give a file its name; refuse again to replace a file, since it may be new."""
    target = Path(os.path.realpath(path))
    if replaces == "nothing":
        try:
            link_new(part, target)
        except FileExistsError:
            _check_existing(path, replaces)
            raise
        return
    if target.exists():
        _check_existing(path, replaces)
    part.replace(target)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Make a folder under a temporary name in that of ``path``, and rename it if all goes well.

    What killed programs have left in that folder is removed, as in `new_file`. Whoever gives a folder the
    name first keeps it: InputError for anyone else.
    """
    _tidy(path.parent)
    part, descriptor = path.parent / f"{_PREFIX}{secrets.token_hex(8)}{_SUFFIX}", -1
    try:
        with as_input_error(f"{path} could not be written"):
            descriptor = _make_folder(part)
        yield part
        with as_input_error(f"{path} could not be written", "choose another place with -o"):
            if path.exists() or not _renamed(part, path):
                raise InputError(f"{path} was made by another program meanwhile: name another output with -o")
    finally:
        shutil.rmtree(part, ignore_errors=True)
        with suppress(OSError):
            os.close(descriptor)


@contextmanager
def new_hdf5(path: Path, replaces: Replaces = "derived") -> Iterator[NewHdf5]:
    """Write an HDF5 file as ``new_file`` does."""
    with new_file(path, replaces) as descriptor, NewHdf5(path, descriptor) as new:
        yield new


def remove_leftovers(folder: Path) -> list[Path]:
    """Remove the half-written files and folders of writers that are gone, such as those that were killed.

    What is being written is locked, and stays. Where a file system has no locks, all stay.
    """
    removed = []
    for part in folder.glob(f"{_PREFIX}*{_SUFFIX}"):
        with suppress(OSError):  # locked, no one's to open, or gone by now
            descriptor = os.open(part, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if part.is_dir():
                    shutil.rmtree(part)
                else:
                    part.unlink()
                removed.append(part)
            finally:
                os.close(descriptor)
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


def _renamed(part: Path, path: Path) -> bool:
    """Give a folder its name, unless something of that name is there."""
    try:
        part.rename(path)
    except OSError as error:
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
            return False
        raise
    return True


def _make_folder(part: Path) -> int:
    """Make a folder, which is locked as long as it is open, and return its descriptor."""
    while True:
        part.mkdir(mode=0o777)
        with suppress(FileNotFoundError):  # someone took it for a leftover before it was locked
            descriptor = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            with suppress(OSError):  # a file system without locks
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            if os.path.samestat(os.fstat(descriptor), part.stat()):
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


def write_new(path: Path, parts: Sequence[bytes], replaces: Replaces = "derived") -> None:
    """Write the parts of a file, which exists whole or not at all."""
    with (
        new_file(path, replaces) as descriptor,
        as_input_error(f"{path} could not be written", MAKE_ROOM),
        os.fdopen(descriptor, "wb", closefd=False) as file,
    ):
        file.writelines(parts)


class Item(NamedTuple):
    """Something to write: its full name; the values of a dataset, None of a group; its attributes.

    Text instead of values is where a soft link leads.
    """

    name: str
    values: NDArray[Any] | str | None
    attributes: Mapping[str, Any]


def write_item(root: h5py.Group, item: Item) -> int | None:
    """Write it; return where a dataset's values lie in the file, in one piece as they are in memory.

    A dataset takes a fifth of the time of h5py's own way where it is small.
    """
    if item.values is None:
        root.require_group(item.name).attrs.update(item.attributes)
        return None
    if isinstance(item.values, str):
        root[item.name] = h5py.SoftLink(item.values)
        return None
    values = np.asarray(item.values, order="C")
    kind, space = h5py.h5t.py_create(values.dtype, logical=True), h5py.h5s.create_simple(values.shape)
    node = h5py.h5d.create(root.id, item.name.encode(), kind, space, _UNDATED, _WITH_GROUPS)
    if values.size:
        node.write(h5py.h5s.ALL, h5py.h5s.ALL, values, kind)
    for name, attribute in item.attributes.items():
        if isinstance(attribute, str):
            h5py.h5a.create(node, name.encode(), _STORED_TEXT, _ONE).write(np.array(attribute, _TEXT))
        else:
            stored = np.asarray(attribute)
            kind, space = h5py.h5t.py_create(stored.dtype, logical=True), h5py.h5s.create_simple(stored.shape)
            h5py.h5a.create(node, name.encode(), kind, space).write(stored)
    place: int | None = node.get_offset()
    return place


def write_file(path: Path, items: Iterable[Item], replaces: Replaces = "derived") -> None:
    """Write a file of these items, which exists whole or not at all.

    HDF5 says once where things lie in a file of certain names, shapes, types and attributes. The next file
    that differs in values alone is the same bytes, but for these: it takes a tenth of the time.
    """
    items = list(items)
    arrays = [np.asarray(item.values, order="C") for item in items if isinstance(item.values, np.ndarray)]
    kinds = [
        (item.values.shape, item.values.dtype.str) if isinstance(item.values, np.ndarray) else item.values
        for item in items
    ]
    likeness = repr([(item.name, kind, item.attributes) for item, kind in zip(items, kinds, strict=True)])
    layout = _layouts.get(likeness)
    writing = as_input_error(f"{path} could not be written", MAKE_ROOM, OSError)
    with new_file(path, replaces) as descriptor, writing:
        if layout is not None:
            layout.write(descriptor, arrays)
            return
        with NewHdf5(path, descriptor) as new:
            places = [write_item(new.root, item) for item in items]
        own = [
            place for place, item in zip(places, items, strict=True) if isinstance(item.values, np.ndarray)
        ]
        if len(_layouts) >= _MOST_LAYOUTS:
            _layouts.clear()
        _layouts[likeness] = _Layout.of(descriptor, own, arrays)


def fixed_text(text: str | Sequence[str]) -> NDArray[Any]:
    """Return a text, or a list of texts, as UTF-8 of a fixed length: texts of variable length lie in heaps.

    HDF5 reads a heap that is damaged for ever.
    """
    if isinstance(text, str):
        encoded = legible(text).encode() or b"\0"
        return np.array(encoded, h5py.string_dtype("utf-8", len(encoded)))
    texts = [legible(one).encode() for one in text]
    return np.array(texts, h5py.string_dtype("utf-8", max(map(len, texts), default=0) or 1))


def process_items(place: str, process: Mapping[str, ProcessValue]) -> Iterator[Item]:
    """Yield what says how something came about."""
    for name, value in process.items():
        values = fixed_text(value) if isinstance(value, str) else np.asarray(value)
        yield Item(f"{place}/{name}", values, {})


class _Layout(NamedTuple):
    """How a file is laid out: its bytes but those of large datasets, and where its datasets begin."""

    pieces: list[tuple[int, bytes]]
    places: list[int | None]

    @classmethod
    def of(cls, descriptor: int, places: list[int | None], arrays: Sequence[NDArray[Any]]) -> _Layout:
        """Read how a file is laid out whose datasets begin at certain bytes."""
        known = [(at, at + one.nbytes) for at, one in zip(places, arrays, strict=True) if at is not None]
        large = sorted((start, end) for start, end in known if end - start >= _LARGE)
        starts, ends = [0, *(end for _, end in large)], [start for start, _ in large]
        gaps = zip(starts, [*ends, os.fstat(descriptor).st_size], strict=True)
        return cls([(start, os.pread(descriptor, end - start, start)) for start, end in gaps], places)

    def write(self, descriptor: int, arrays: Sequence[NDArray[Any]]) -> None:
        """Write a file of other values."""
        for start, piece in self.pieces:
            _write(descriptor, memoryview(piece), start)
        for at, values in zip(self.places, arrays, strict=True):
            if at is not None:
                _write(descriptor, values.reshape(-1).view(np.uint8).data, at)


def _write(descriptor: int, data: memoryview, place: int) -> None:
    while data:
        count = os.pwrite(descriptor, data, place)
        data, place = data[count:], place + count


_layouts: dict[str, _Layout] = {}
