"""Recordings and results in HDF5 copied to Zarr; see ``mirrorskin.io.storage.zarr``."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mirrorskin.io.base.system import translate_os_errors
from mirrorskin.io.base.types import InputError, Source
from mirrorskin.io.base.url import ZARR_SUFFIX, Url, path_of
from mirrorskin.io.files.opening import is_recording, open_recording
from mirrorskin.io.storage.atomic import new_folder
from mirrorskin.io.storage.hdf5 import Hdf5File, Node, first_value
from mirrorskin.io.storage.layout import STACK
from mirrorskin.io.storage.zarr import AT_ONCE, ZarrFile, errors_named, open_file
from mirrorskin.io.storage.zarr_metadata import names_in

_WHOLE: Any = {"write_empty_chunks": True}
_CLAIM = ".mirrorskin-writer-"  # prefix of the object with which a writer claims a store
_CHUNK, _BLOCK = 4 << 20, 64 << 20  # unpacked bytes of frames in a chunk, and written at a time


def save_zarr(
    source: str | Path,
    path: str | Path,
    progress: Callable[[int], None] | None = None,
    *,
    verify: bool = True,
) -> str:
    """Copy a recording or a result in HDF5 to Zarr, version 3; a folder appears complete or not at all.

    Parameters
    ----------
    source : str or Path
        A recording or a result.
    path : str or Path
        Output: ``NAME.zarr``, or an address such as ``s3://bucket/NAME.zarr``.
    progress : callable, optional
        Called with the number of frames written so far.
    verify : bool, optional
        Whether frames are compared with their checksums; see `open_recording`.

    Returns
    -------
    str
        Description of what was written.

    Raises
    ------
    InputError
        The file is neither a recording nor a result, or is damaged; or the output exists, or cannot be
        written.

    Examples
    --------
    >>> from mirrorskin import io
    >>> io.save_zarr("press.h5", "press.zarr")  # doctest: +SKIP
    'Zarr, chunks (13, 480, 640), Blosc'
    """
    target = path_of(path)
    with open_file(source) as file:
        if not any(file.marked(f"mirrorskin_{kind}") for kind in ("recording", "result")):
            raise InputError(
                f"{source} is not a recording or a result of mirrorskin: 'mirrorskin import' makes recordings"
            )
        with _new_store(target) as store:
            _write_nodes(file, store)
            if is_recording(source):
                with open_recording(source, memory_limit=_BLOCK, verify=verify) as recording:
                    _write_frames(recording, store, progress or (lambda count: None))
            _finish(file, store)
    with ZarrFile(target) as written:
        stack = written.find(STACK)
        return written.storage(stack) if isinstance(stack, h5py.Dataset) else "Zarr"


def check_store(target: Path) -> None:
    """Raise InputError for a store that could not be written, before any work is done."""
    if target.suffix.lower() != ZARR_SUFFIX:
        raise InputError(f"{target}: Zarr is written as NAME{ZARR_SUFFIX}: name it so with -o")
    taken = f"{target} exists: remove it, or name another output with -o"
    if isinstance(target, Url):
        with errors_named(f"{target} cannot be written"):
            from zarr.core.sync import sync

            from mirrorskin.io.storage.zarr_store import opened_store

            with opened_store(target, read_only=False) as store:
                if not sync(store.is_empty("")):
                    raise InputError(taken)
        return
    if target.exists():
        raise InputError(taken)
    if not target.parent.is_dir():
        raise InputError(f"{target}: there is no folder {target.parent}: make it first")
    with errors_named(f"{target} cannot be written"):
        import zarr  # noqa: F401


@contextmanager
def _new_store(target: Path) -> Iterator[Any]:
    """Create a store; after an error, everything written is removed."""
    check_store(target)
    with errors_named(f"{target} cannot be written"):
        from zarr.core.sync import sync

        from mirrorskin.io.storage.zarr_store import opened_store

        if not isinstance(target, Url):
            with new_folder(target) as part, opened_store(part, read_only=False) as store:
                yield store
            return
        with opened_store(target, read_only=False) as store:
            claim = _claim(store, target)
            try:
                yield store
            except BaseException:
                sync(store.delete_dir(""))
                raise
            sync(store.delete(claim))


def _claim(store: Any, target: Url) -> str:
    """Write an object that shows other writers that the store is in use, and return its name.

    Objects in stores cannot be renamed. If two writers start at the same time, both may detect the object of
    the other one and fail, but they never both write.
    """
    from zarr.core.buffer import default_buffer_prototype
    from zarr.core.sync import sync

    claim = f"{_CLAIM}{os.urandom(8).hex()}"
    sync(store.set(claim, default_buffer_prototype().buffer.from_bytes(b"1")))
    if any(name.startswith(_CLAIM) and name != claim for name in sync(names_in(store, ""))):
        sync(store.delete(claim))
        raise InputError(f"{target} is being written by another program: name another output with -o")
    return claim


def _write_nodes(file: Hdf5File, store: Any) -> None:
    """Write all datasets but the frames, several at once; links are omitted."""
    import zarr

    nodes = [node for _, node in file.objects() if isinstance(node, h5py.Dataset) and node.name != STACK]

    def write(node: h5py.Dataset) -> None:
        about: dict[str, Any] = {"name": node.name, "attributes": _attributes(file, node), "config": _WHOLE}
        if node.dtype.kind in "biuf":
            values = file.read(node, node.shape)
            chunks = values.shape if values.size else "auto"
            zarr.create_array(store, data=values, chunks=chunks, **about)
        else:
            texts = file.texts(node, "copy it again") if node.ndim else file.value(node)
            array = zarr.create_array(store, shape=node.shape, dtype=str, **about)
            array[...] = np.array(texts, np.dtypes.StringDType())

    with ThreadPoolExecutor(AT_ONCE, "mirrorskin-zarr") as pool:
        list(pool.map(write, nodes))


def _attributes(file: Hdf5File, node: Node) -> dict[str, Any]:
    """Return the attributes of an object that are numbers or texts."""
    with translate_os_errors(f"{file.path}: {node.name}"):
        # By index: to find names, h5py opens the object again, which fails if its values are in raw files.
        opened = [h5py.h5a.open(node.id, index=index) for index in range(h5py.h5a.get_num_attrs(node.id))]
    attributes: dict[str, Any] = {}
    for attribute in opened:
        if attribute.dtype.kind in "biuf" or h5py.check_string_dtype(attribute.dtype) is not None:
            name = attribute.name.decode(errors="replace")
            values = np.asarray(file.attribute_values(node, name))
            plain = np.array([first_value(value) for value in values.reshape(-1)], object)
            attributes[name] = plain.reshape(values.shape).tolist()
    return attributes


def _write_frames(recording: Source, store: Any, progress: Callable[[int], None]) -> None:
    import zarr
    from zarr.codecs import BloscCodec

    frame = math.prod(recording.shape[1:]) * recording.dtype.itemsize
    length = min(max(1, _CHUNK // frame), recording.shape[0])
    array = zarr.create_array(
        store,
        name=STACK,
        shape=recording.shape,
        dtype=recording.dtype,
        chunks=(length, *recording.shape[1:]),
        compressors=BloscCodec(cname="lz4", shuffle="bitshuffle"),
        attributes={"interpretation": "image", "units": "counts"},
        config=_WHOLE,
    )
    buffer = np.empty((length * max(1, _BLOCK // (length * frame)), *recording.shape[1:]), recording.dtype)
    while (block := recording.read(buffer)) is not None:
        array[block.index : block.index + len(block.frames)] = block.frames
        progress(block.index + len(block.frames))


def _finish(file: Hdf5File, store: Any) -> None:
    """Write the attributes of the groups, which mark the store as ours, and the consolidated metadata."""
    import zarr

    groups = [node for _, node in file.objects() if isinstance(node, h5py.Group)]
    root = zarr.open_group(store, mode="a")
    for group in groups:
        root.require_group(str(group.name)).attrs.update(_attributes(file, group))
    root.attrs.update(_attributes(file, file.root))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the specification does not include it yet; other programs ignore it
        zarr.consolidate_metadata(store)
