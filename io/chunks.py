"""Frames in chunks: their offsets in a file, reading without HDF5, and decoding by several threads.

Chunks are decoded outside HDF5's lock, with the C libraries of hdf5plugin and h5py, and zlib.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import math
import os
import struct
import weakref
import zlib
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.hdf5 import chunks_of
from mirrorskin.io.selection import Place, Region, Span

Bytes = NDArray[np.uint8]
Codec = Callable[[Bytes, Bytes], None]
"""Function that unpacks the first bytes into the whole of the second; ValueError if they do not fit."""

_SIZE, _POINTER = ctypes.c_size_t, ctypes.c_void_p
_WORD, _HEAD = struct.Struct(">I"), struct.Struct(">QI")


class ChunkIndex(NamedTuple):
    """The chunks of a dataset: their shape, and their positions in arrays with one element per chunk."""

    shape: tuple[int, int, int]  # samples
    offsets: NDArray[np.int64]  # bytes, in the file
    sizes: NDArray[np.int64]  # bytes, as stored
    filter_masks: NDArray[np.int64]  # bits of the filters that were not applied to a chunk

    def contiguous_offset(self, shape: tuple[int, int, int]) -> int | None:
        """Return the offset of raw chunks of whole frames if they are stored contiguously, else None."""
        offsets, sizes = self.offsets.ravel(), self.sizes.ravel()
        if self.shape[1:] != shape[1:] or np.any(np.diff(offsets) != sizes[:-1]):
            return None
        return int(offsets[0])


def chunk_index(dataset: h5py.Dataset, shape: tuple[int, int, int], size: int) -> ChunkIndex | str:
    """Return the positions of the chunks of the first frames in a file of ``size`` bytes, or why not.

    OSError or ValueError: chunks are missing, or outside the file.
    """
    if dataset.file.userblock_size:
        return "user block"  # versions of HDF5 disagree about the origin of offsets
    chunks = chunks_of(dataset)
    grid = tuple(-(-n // c) for n, c in zip(shape, dataset.chunks, strict=True))
    places = np.array([chunk.chunk_offset for chunk in chunks], np.int64) // dataset.chunks
    values = np.array([(chunk.byte_offset, chunk.size, chunk.filter_mask) for chunk in chunks], np.int64)
    wanted = np.all(places < grid, axis=1)
    index = np.full((3, *grid), -1, np.int64)
    index[:, *places[wanted].T] = values[wanted].T
    offsets, sizes, masks = index
    if np.any(offsets < 0):
        raise ValueError("(chunks are missing)")
    if np.any(offsets + sizes > size):
        raise OSError("truncated: a chunk lies behind the end")
    # Chunks that are partly outside the dataset may have skipped its filters, which HDF5 does not report.
    # Such chunks have the size of raw ones.
    edge = np.zeros(grid, bool)
    for axis, (n, c) in enumerate(zip(shape, dataset.chunks, strict=True)):
        if n % c:
            np.moveaxis(edge, axis, 0)[-1] = True
    raw = math.prod(dataset.chunks) * dataset.dtype.itemsize
    if dataset.id.get_create_plist().get_nfilters() and np.any(edge & (sizes == raw) & (masks == 0)):
        return "raw chunks at the edge"
    return ChunkIndex(dataset.chunks, offsets, sizes, masks)


class Chunks:
    """A chunked dataset that several threads read and unpack, one chunk after the other.

    A chunk of whole frames that are all needed is unpacked directly into the output; of other chunks the
    needed part is copied. The file descriptor is closed at the latest with the last reference to this object.
    """

    length: int

    def __init__(
        self,
        file: int,
        place: Place,
        frames: int,
        dtype: np.dtype[Any],
        index: ChunkIndex,
        codecs: list[Codec],
        threads: int,
    ) -> None:
        self.length, self._shape, self._dtype = index.shape[0], index.shape, dtype
        self._size = math.prod(index.shape) * dtype.itemsize
        self.scratch_bytes: int = threads * self._size
        by = "one thread" if threads == 1 else f"{threads} threads"
        self.how: str = f"chunks {'decoded' if codecs else 'read'} by {by}"
        self._frames, self._file, self._place = frames, file, place
        self._index, self._codecs, self._threads = index, codecs, threads
        self._close_file = weakref.finalize(self, os.close, file)
        self._pools: dict[int, ThreadPoolExecutor] = {}  # by process, because threads do not survive a fork
        self._buffers: list[dict[str, Bytes]] = []  # scratch buffers, reused by one thread at a time

    def lend(self, start: int, stop: int) -> None:
        """Return None: chunks have to be read."""

    def fetch(self, frames: Span, region: Region, out: NDArray[Any]) -> None:
        """Write a part into ``out``; every chunk of it is decoded once."""
        spans = frames, region.rows, region.columns
        ranges = [range(a // c, -(-b // c)) for (a, b), c in zip(spans, self._shape, strict=True)]
        work = deque(itertools.product(*ranges))

        def take_chunks() -> None:
            buffers: dict[str, Bytes] = self._buffers.pop() if self._buffers else {}
            try:
                with suppress(IndexError):  # no chunk is left
                    while True:
                        self._fetch_chunk(work.popleft(), spans, out, buffers)
            finally:
                work.clear()  # after an error, so that the other threads stop, too
                self._buffers.append(buffers)

        helpers: list[Future[None]] = []
        try:
            if len(work) > 1 < self._threads:
                pool = self._pools.setdefault(os.getpid(), ThreadPoolExecutor(self._threads - 1, "chunks"))
                while len(helpers) < min(self._threads - 1, len(work) - 1):
                    helpers.append(pool.submit(take_chunks))
            take_chunks()
        finally:
            work.clear()
            wait(helpers)  # afterwards no thread writes to out
        for helper in helpers:
            helper.result()

    def close(self) -> None:
        """Close the file."""
        pool = self._pools.pop(os.getpid(), None)
        if pool is not None:
            pool.shutdown()
        self._file = -1  # the number may be reused for another file
        self._close_file()

    def _fetch_chunk(
        self, position: tuple[int, ...], spans: tuple[Span, ...], out: NDArray[Any], buffers: dict[str, Bytes]
    ) -> None:
        """Write the part of a chunk that is in these spans."""
        source, target = [], []
        for p, c, (start, stop) in zip(position, self._shape, spans, strict=True):
            first, last = max(p * c, start), min((p + 1) * c, stop)
            source.append(slice(first - p * c, last - p * c))
            target.append(slice(first - start, last - start))
        wanted = out[*target]
        first = position[0] * self.length
        with self._place.reading(first, min(first + self.length, self._frames)):
            if wanted.shape == self._shape and wanted.flags.c_contiguous:
                self._decode(position, wanted.reshape(-1).view(np.uint8), buffers)
            else:
                unpacked = _buffer(buffers, "unpacked", self._size)
                self._decode(position, unpacked, buffers)
                wanted[...] = unpacked.view(self._dtype).reshape(self._shape)[*source]

    def _decode(self, position: tuple[int, ...], out: Bytes, buffers: dict[str, Bytes]) -> None:
        offset, size = int(self._index.offsets[position]), int(self._index.sizes[position])
        if not self._codecs:
            _read(self._file, offset, out)
            return
        packed = _buffer(buffers, "packed", size)
        _read(self._file, offset, packed)
        decode(self._codecs, int(self._index.filter_masks[position]), packed, out)


def _buffer(buffers: dict[str, Bytes], name: str, size: int) -> Bytes:
    if name not in buffers or buffers[name].size < size:
        buffers[name] = np.empty(size + size // 8, np.uint8)
    return buffers[name][:size]


def _read(file: int, offset: int, out: Bytes) -> None:
    done = 0
    while done < out.size:
        count = os.preadv(file, [out[done:].data], offset + done)
        if not count:
            raise OSError("truncated: the file became shorter")
        done += count


def find_codecs(dataset: h5py.Dataset) -> list[Codec] | str:
    """Return the functions that undo a dataset's filters, in the order of writing, or an unknown name."""
    plist = dataset.id.get_create_plist()
    codecs, count = [], plist.get_nfilters()
    for index, (code, _, values, name) in enumerate(map(plist.get_filter, range(count))):
        try:
            codecs.append(_MAKERS[code](values))
        except (OSError, AttributeError, LookupError):  # a missing or different library, or an unknown filter
            return name.decode(errors="replace").split(";")[0].strip() or str(code)
        if code != h5py.h5z.FILTER_SHUFFLE and index < count - 1:
            return "packed twice"  # the size between the two is unknown
    return codecs


def decode(codecs: list[Codec], filter_mask: int, packed: Bytes, out: Bytes) -> None:
    """Unpack a chunk."""
    steps = [codec for bit, codec in enumerate(codecs) if not filter_mask >> bit & 1] or [_shuffle((1,))]
    for codec in steps[:0:-1]:
        between = np.empty_like(out)
        codec(packed, between)
        packed = between
    steps[0](packed, out)


def _shuffle(values: tuple[int, ...]) -> Codec:
    """HDF5's shuffle: the first bytes of all samples, then the second bytes, and so on."""

    def decode(packed: Bytes, out: Bytes) -> None:
        _check(packed.size, out.size)
        out.reshape(-1, values[0])[...] = packed.reshape(values[0], -1).T

    return decode


def _deflate(_values: tuple[int, ...]) -> Codec:
    def decode(packed: Bytes, out: Bytes) -> None:
        stream = zlib.decompressobj()
        try:
            unpacked = stream.decompress(packed.data, out.size + 1)
        except zlib.error as error:
            raise ValueError(f"({error})") from error
        if not stream.eof:
            raise ValueError("(the chunk is too short, or too long)")
        _check(len(unpacked), out.size)
        out[...] = np.frombuffer(unpacked, np.uint8)

    return decode


def _lzf(_values: tuple[int, ...]) -> Codec:
    unsigned = ctypes.c_uint
    types = unsigned, _POINTER, unsigned, _POINTER, unsigned
    function = _function(h5py.h5z.__file__, "lzf_decompress", *types)

    def decode(packed: Bytes, out: Bytes) -> None:
        _check(function(packed.ctypes.data, packed.size, out.ctypes.data, out.size), out.size)

    return decode


def _bitshuffle(values: tuple[int, ...]) -> Codec:
    """Bitshuffle: blocks whose bits are sorted by their position, packed by LZ4 or Zstandard.

    Chunks begin with their unpacked size and the size of a block; each block begins with its packed size.
    """
    itemsize, method = values[2], values[4] if len(values) > 4 else 0
    name = {2: "bshuf_decompress_lz4", 3: "bshuf_decompress_zstd"}[method]
    function = _function(_plugin("bshuf"), name, ctypes.c_int64, _POINTER, _POINTER, _SIZE, _SIZE, _SIZE)
    default = _function(_plugin("bshuf"), "bshuf_default_block_size", _SIZE, _SIZE)(itemsize or 1)

    def decode(packed: Bytes, out: Bytes) -> None:
        if packed.size < _HEAD.size:
            raise ValueError("(the chunk is too short)")
        total, block = _HEAD.unpack_from(packed.data)
        _check(total, out.size)
        block = block // itemsize or default
        _check_blocks(packed, out.size, block * itemsize, itemsize)
        count = out.size // itemsize
        used = function(packed.ctypes.data + _HEAD.size, out.ctypes.data, count, itemsize, block)
        _check(used, packed.size - _HEAD.size)

    return decode


def _check_blocks(packed: Bytes, size: int, block: int, itemsize: int) -> None:
    """Check that all blocks of bitshuffle are within the chunk: the library does not check their sizes."""
    group = 8 * itemsize  # bits are sorted among eight samples; the remaining samples are stored unchanged
    if block <= 0 or block % group:
        raise ValueError("(blocks of a wrong size)")
    whole, rest = divmod(size, block)
    place, end, data, word = _HEAD.size, packed.size - size % group, packed.data, _WORD.unpack_from
    try:
        for _ in range(whole + (rest >= group)):
            place += _WORD.size + word(data, place)[0]
    except struct.error as error:
        raise ValueError("(the chunk is too short)") from error
    _check(place, end)


def _blosc(_values: tuple[int, ...]) -> Codec:
    library, whole = _plugin("blosc"), ctypes.c_int
    validate = _function(library, "blosc_cbuffer_validate", whole, _POINTER, _SIZE, _POINTER)
    function = _function(library, "blosc_decompress_ctx", whole, _POINTER, _POINTER, _SIZE, whole)

    def decode(packed: Bytes, out: Bytes) -> None:
        size = _SIZE()
        if validate(packed.ctypes.data, packed.size, ctypes.byref(size)) < 0:
            raise ValueError("(no chunk of Blosc)")
        _check(size.value, out.size)
        _check(function(packed.ctypes.data, out.ctypes.data, out.size, 1), out.size)

    return decode


_MAKERS: dict[int, Callable[[tuple[int, ...]], Codec]] = {
    h5py.h5z.FILTER_SHUFFLE: _shuffle,
    h5py.h5z.FILTER_DEFLATE: _deflate,
    h5py.h5z.FILTER_LZF: _lzf,
    32008: _bitshuffle,
    32001: _blosc,
}


def _check(found: int, needed: int) -> None:
    if found != needed:
        raise ValueError(f"(a chunk gives {found} bytes where {needed} are needed)")


def _plugin(name: str) -> str:
    import hdf5plugin

    return str(Path(hdf5plugin.PLUGIN_PATH) / f"libh5{name}.so")


@functools.cache
def _function(library: str, name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of a C library; calls release the interpreter's lock."""
    function = getattr(ctypes.CDLL(library), name)
    function.restype, function.argtypes = result, arguments
    return function
