"""Fingerprints of recordings: hashes of a sample of the bytes, which is faster than reading all."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.system import translate_os_errors
from mirrorskin.io.base.types import InputError
from mirrorskin.io.storage.hdf5 import Hdf5File, chunks_of, virtual_source

Spans = NDArray[np.int64]

_HASH_INTERVAL, _HASH_LENGTH = 4 << 20, 4 << 10
_READ_BYTES = 1 << 20


State = tuple[int, int, int, int]
"""State of a file: device, number, size, and time of the last change in nanoseconds."""


def origins(file: Hdf5File, dataset: h5py.Dataset) -> dict[Path, State]:
    """Return the files that contain frames, starting with the recording, and their state when opened."""
    with translate_os_errors(f"{file.path}: {dataset.name}"):
        root = os.fstat(file.root.id.get_vfd_handle())
        states = {Path(file.root.filename): state_of(root)}
        for path, part, _ in _parts(file, dataset):
            opened = path.stat() if part is None else os.fstat(part.file.id.get_vfd_handle())
            states.setdefault(path, state_of(opened))
    return states


def fingerprint(file: Hdf5File, dataset: h5py.Dataset, origins: Mapping[Path, State], frames: int) -> str:
    """Return a SHA-256, in hexadecimal, of a file: its size, all data but the frames, and some frames.

    The frames are joined in the order of storage, and the first 4 KiB of each 4 MiB are hashed. If they are
    stored in other files (virtual and external datasets), these files follow in the order of the dataset.

    For a file that is being written, or whose writer was killed, the hash covers the first ``frames`` frames,
    in their order, and the values of all other datasets.
    """
    if file.root.swmr_mode:
        with translate_os_errors(f"{file.path}: {dataset.name}"):
            return _of_growing(file, dataset, frames)
    spans: dict[Path, list[Spans]] = {path: [] for path in origins}
    with translate_os_errors(f"{file.path}: {dataset.name}"):
        for path, part, span in _parts(file, dataset):
            spans[path].append(span if part is None else _stored(part))
    digest = hashlib.sha256()
    for path, parts in spans.items():
        with translate_os_errors(str(path)), path.open("rb", buffering=0) as opened:
            state = os.fstat(opened.fileno())
            _compare(path, state, origins[path])
            digest.update(state.st_size.to_bytes(8, "little"))
            for start, stop in _chosen(_joined(parts), state.st_size):
                for place in range(start, stop, _READ_BYTES):
                    digest.update(os.pread(opened.fileno(), min(_READ_BYTES, stop - place), place))
    return digest.hexdigest()


def fingerprint_of_files(origins: Mapping[Path, State], digest: hashlib._Hash) -> str:
    """Add the size and the first 4 KiB of each 4 MiB of files to a hash; return it in hexadecimal."""
    for path in origins:
        with translate_os_errors(str(path)), path.open("rb", buffering=0) as opened:
            size = os.fstat(opened.fileno()).st_size
            digest.update(size.to_bytes(8, "little"))
            for place in range(0, size, _HASH_INTERVAL):
                digest.update(os.pread(opened.fileno(), _HASH_LENGTH, place))
    return digest.hexdigest()


def check_unchanged(origins: Mapping[Path, State]) -> None:
    """Raise InputError if a file has changed since it was opened."""
    for path, state in origins.items():
        with translate_os_errors(str(path)):
            _compare(path, path.stat(), state)


def _compare(path: Path, status: os.stat_result, state: State) -> None:
    if state_of(status) != state:
        raise InputError(f"{path} was changed while it was open: start again")


def _of_growing(file: Hdf5File, dataset: h5py.Dataset, frames: int) -> str:
    """Return a SHA-256 that does not change while the file grows."""
    digest = hashlib.sha256()
    for _, node in file.objects():
        if isinstance(node, h5py.Dataset) and node != dataset:
            grows = node.ndim and node.maxshape[0] is None
            value = np.asarray(file.load(node, min(frames, node.shape[0]) if grows else None)[()])
            digest.update(str(node.name).encode())
            digest.update(value.tobytes() if value.dtype.kind != "O" else str(value).encode())
    before = 0
    for chunk in sorted(chunks_of(dataset), key=lambda place: place.chunk_offset):
        if chunk.chunk_offset[0] < frames:
            stop = chunk.byte_offset + chunk.size
            for taken in range(chunk.byte_offset + -before % _HASH_INTERVAL, stop, _HASH_INTERVAL):
                size = min(_HASH_LENGTH, stop - taken)
                digest.update(os.pread(file.root.id.get_vfd_handle(), size, taken))
            before += chunk.size
    return digest.hexdigest()


def modified(origins: Mapping[Path, State]) -> str:
    """Return when the most recently changed file was written: ISO 8601, UTC, to the nanosecond."""
    seconds, rest = divmod(max(changed for *_, changed in origins.values()), 10**9)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"


def state_of(status: os.stat_result) -> State:
    """Return the state of a file, which differs after a change."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _parts(file: Hdf5File, dataset: h5py.Dataset) -> Iterator[tuple[Path, h5py.Dataset | None, Spans]]:
    """Yield the files that contain samples, with their dataset, or the first byte and the end of raw data."""
    for source in dataset.virtual_sources() if dataset.is_virtual else ():
        yield from _parts(file, virtual_source(file, dataset, source))
    for name, offset, size in dataset.external or ():
        raw = file.sibling(dataset, name, f"the raw storage of {dataset.name}")
        yield raw, None, np.array([[offset, min(offset + size, raw.stat().st_size)]], np.int64)
    yield Path(dataset.file.filename), dataset, np.empty((0, 2), np.int64)


def _stored(dataset: h5py.Dataset) -> Spans:
    """Return the first byte and the end of the samples stored in a dataset's own file."""
    start = dataset.id.get_offset()
    if dataset.chunks and not dataset.is_virtual:
        chunks = [(chunk.byte_offset, chunk.size) for chunk in chunks_of(dataset)]
        return np.cumsum(np.array(chunks, np.int64).reshape(-1, 2), axis=1)
    if start is None:  # in the object header, or in other files
        return np.empty((0, 2), np.int64)
    return np.array([[start, start + dataset.id.get_storage_size()]], np.int64)


def _joined(parts: list[Spans]) -> Spans:
    """Sort spans, and merge those that touch or overlap."""
    spans = np.concatenate([np.empty((0, 2), np.int64), *parts])
    spans = spans[np.argsort(spans[:, 0], kind="stable")]
    reach = np.maximum.accumulate(spans[:, 1])
    first = np.flatnonzero(np.append(True, spans[1:, 0] > reach[:-1])[: len(spans)])
    return np.stack([spans[first, 0], np.maximum.reduceat(spans[:, 1], first)], 1) if len(spans) else spans


def _chosen(frames: Spans, size: int) -> Iterator[tuple[int, int]]:
    """Yield the bytes of a file to hash: all between the frames, and some of the frames."""
    place = before = 0
    for start, stop in np.minimum(frames, size).tolist():
        yield place, start
        for taken in range(start + -before % _HASH_INTERVAL, stop, _HASH_INTERVAL):
            yield taken, min(taken + _HASH_LENGTH, stop)
        before, place = before + stop - start, stop
    yield place, size
