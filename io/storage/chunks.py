"""Datasets in chunks, which are decoded by several threads.

Chunks are decoded outside HDF5's lock, with zlib and the C libraries of hdf5plugin and h5py. Unlike HDF5's
own filters, they are limited to the size of a chunk.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import math
import os
import struct
import zlib
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.selection import Span
from mirrorskin.io.base.system import translate_os_errors

Bytes = NDArray[np.uint8]
Codec = Callable[[Bytes, Bytes], None]
"""Function that unpacks the first bytes and fills the second; ValueError if the size differs."""

_SIZE, _POINTER = ctypes.c_size_t, ctypes.c_void_p
_WORD, _HEAD = struct.Struct(">I"), struct.Struct(">QI")


class Chunks:
    """A chunked dataset that several threads read and unpack, one chunk after the other.

    A chunk that is needed completely and is contiguous in the output is unpacked directly into it; otherwise
    the needed part is copied. ``name`` returns the name of some rows of the dataset for messages.
    """

    def __init__(
        self, dataset: h5py.h5d.DatasetID, codecs: list[Codec], name: Callable[[int, int], str], threads: int
    ) -> None:
        self._dataset, self._codecs, self._name, self._threads = dataset, codecs, name, threads
        self.shape: tuple[int, ...] = dataset.get_create_plist().get_chunk()
        self._whole, self._dtype = dataset.shape, dataset.dtype
        self._size = math.prod(self.shape) * self._dtype.itemsize
        self.chunk, self.length = self.shape, self.shape[0]
        self.scratch_bytes: int = threads * self._size
        by = "one thread" if threads == 1 else f"{threads} threads"
        self.how: str = f"chunks {'decoded' if codecs else 'read'} by {by}"
        self._pools: dict[int, ThreadPoolExecutor] = {}  # by process, because threads do not survive a fork
        self._buffers: list[Bytes] = []  # scratch buffers, each used by one thread at a time

    def fetch(self, spans: Sequence[Span], out: NDArray[Any]) -> None:
        """Write a part, one span for each axis, into ``out``; every chunk of it is decoded once."""
        ranges = [range(a // c, -(-b // c)) for (a, b), c in zip(spans, self.shape, strict=True)]
        work = deque(itertools.product(*ranges))

        def take_chunks() -> None:
            try:
                with suppress(IndexError):  # no chunk is left
                    while True:
                        self._fetch_chunk(work.popleft(), spans, out)
            finally:
                work.clear()  # after an error, so that the other threads stop, too

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
        """End the threads."""
        pool = self._pools.pop(os.getpid(), None)
        if pool is not None:
            pool.shutdown()

    def _fetch_chunk(self, position: tuple[int, ...], spans: Sequence[Span], out: NDArray[Any]) -> None:
        """Write the part of a chunk that is in these spans."""
        source, target = [], []
        for p, c, (start, stop) in zip(position, self.shape, spans, strict=True):
            first, last = max(p * c, start), min((p + 1) * c, stop)
            source.append(slice(first - p * c, last - p * c))
            target.append(slice(first - start, last - start))
        target_part = out[*target]
        first = position[0] * self.length
        with translate_os_errors(lambda: self._name(first, min(first + self.length, spans[0][1]))):
            if (
                target_part.shape == self.shape
                and target_part.flags.c_contiguous
                and target_part.dtype == self._dtype
            ):
                self._decode(position, target_part.reshape(-1).view(np.uint8))
                return
            buffer = self._buffers.pop() if self._buffers else np.empty(self._size, np.uint8)
            self._decode(position, buffer)
            target_part[...] = buffer.view(self._dtype).reshape(self.shape)[*source]
            self._buffers.append(buffer)

    def _decode(self, position: tuple[int, ...], out: Bytes) -> None:
        corner = tuple(p * c for p, c in zip(position, self.shape, strict=True))
        mask, stored = self._dataset.read_direct_chunk(corner)
        packed = np.frombuffer(stored, np.uint8)
        try:
            decode(self._codecs, mask, packed, out)
        except ValueError:
            # HDF5 may store chunks that are partly outside the dataset without filters, and does not report
            # it.
            at_edge = any(a + c > n for a, c, n in zip(corner, self.shape, self._whole, strict=True))
            if not at_edge or mask or packed.size != out.size:
                raise
            out[...] = packed


def find_codecs(dataset: h5py.h5d.DatasetID) -> list[Codec] | str:
    """Return the functions that invert the filters, in the order of writing, or why there are none."""
    plist = dataset.get_create_plist()
    filters = [plist.get_filter(index) for index in range(plist.get_nfilters())]
    codecs: list[Codec] = []
    for code, _, values, name in filters:
        try:
            codecs.append(_MAKERS[code](values))
        except (
            ImportError,
            OSError,
            AttributeError,
            LookupError,
        ):  # no such library or filter
            return name.decode(errors="replace").split(";")[0].strip() or str(code)
    codes = [code for code, *_ in filters]
    if codes and codes[-1] == h5py.h5z.FILTER_FLETCHER32:
        codes.pop()
    if any(code != h5py.h5z.FILTER_SHUFFLE for code in codes[:-1]):
        return "packed twice"  # the size between the two is unknown
    is_partial = plist.get_layout() == h5py.h5d.CHUNKED and np.any(np.mod(dataset.shape, plist.get_chunk()))
    if is_partial and len(codecs) == 1 and codes == [h5py.h5z.FILTER_SHUFFLE]:
        return "perhaps raw at the edge"  # nothing in such a chunk shows whether it was shuffled
    return codecs


def decode(codecs: list[Codec], filter_mask: int, packed: Bytes, out: Bytes) -> None:
    """Unpack a chunk."""
    steps = [codec for bit, codec in enumerate(codecs) if not filter_mask >> bit & 1]
    if steps and steps[-1] is _check_sum:
        steps.pop()
        packed, stored = packed[:-4], packed[-4:]
        _check_sum(packed, stored)
    steps = steps or [_shuffle((1,))]
    for codec in steps[:0:-1]:
        between = np.empty_like(out)
        codec(packed, between)
        packed = between
    steps[0](packed, out)


def _check_sum(packed: Bytes, stored: Bytes) -> None:
    """Raise ValueError if data differ from the checksum stored by HDF5, Fletcher's of 32 bits."""
    words = np.append(packed, np.zeros(packed.size % 2, np.uint8)).view(">u2").astype(np.int64)
    sums = words.sum(), (np.arange(words.size, 0, -1) % 65535 * words).sum()
    low, high = (int(value - 1) % 65535 + 1 if value else 0 for value in sums)
    if stored.tobytes() != (high << 16 | low).to_bytes(4, "little"):
        raise ValueError("(the checksum of a chunk is wrong)")


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
            raise ValueError(f"({error})") from None
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
    h5py.h5z.FILTER_FLETCHER32: lambda _values: _check_sum,
    32008: _bitshuffle,
    32001: _blosc,
}


def _check(status: int, needed: int) -> None:
    if status != needed:
        raise ValueError(f"(a chunk gives {status} bytes where {needed} are needed)")


def _plugin(name: str) -> str:
    import hdf5plugin

    return str(Path(hdf5plugin.PLUGIN_PATH) / f"libh5{name}.so")


@functools.cache
def _function(library: str, name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of a C library; calls release the interpreter's lock."""
    function = getattr(ctypes.CDLL(library), name)
    function.restype, function.argtypes = result, arguments
    return function
