"""What unpacks a chunk outside HDF5's lock: the C libraries that hdf5plugin and h5py bring, and zlib."""

from __future__ import annotations

import ctypes
import functools
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Codec = Callable[[Bytes, Bytes], None]
"""Unpack the first bytes into the whole of the second; ValueError if they do not fit."""

_SHUFFLE, _DEFLATE, _LZF = h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_LZF
_BLOSC, _BITSHUFFLE = 32001, 32008

# A library is not there or made otherwise, a filter is unknown.
_ABSENT = (OSError, AttributeError, LookupError)

_SIZE, _POINTER = ctypes.c_size_t, ctypes.c_void_p
_WORD, _HEAD = struct.Struct(">I"), struct.Struct(">QI")


def find_codecs(dataset: h5py.Dataset) -> list[Codec] | str:
    """Return what undoes each filter of a dataset, in the order of writing, or the name of an unknown one."""
    plist = dataset.id.get_create_plist()
    codecs, count = [], plist.get_nfilters()
    for index, (code, _, values, name) in enumerate(map(plist.get_filter, range(count))):
        try:
            codecs.append(_MAKERS[code](values))
        except _ABSENT:
            return name.decode(errors="replace").split(";")[0].strip() or str(code)
        if code != _SHUFFLE and index < count - 1:
            return "packed twice"  # nobody knows how much is in between
    return codecs


def decode(codecs: list[Codec], filter_mask: int, packed: Bytes, out: Bytes) -> None:
    """Unpack a chunk."""
    steps = [codec for bit, codec in enumerate(codecs) if not filter_mask >> bit & 1] or [_copy]
    for codec in steps[:0:-1]:
        between = np.empty_like(out)
        codec(packed, between)
        packed = between
    steps[0](packed, out)


def _copy(packed: Bytes, out: Bytes) -> None:
    _check(packed.size, out.size)
    out[...] = packed


def _shuffle(values: tuple[int, ...]) -> Codec:
    """HDF5's shuffle: the first bytes of all samples come first, and so on."""
    itemsize = values[0]

    def decode(packed: Bytes, out: Bytes) -> None:
        _check(packed.size, out.size)
        out.reshape(-1, itemsize)[...] = packed.reshape(itemsize, -1).T

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
    function = _function(
        h5py.h5z.__file__, "lzf_decompress", unsigned, _POINTER, unsigned, _POINTER, unsigned
    )

    def decode(packed: Bytes, out: Bytes) -> None:
        _check(function(packed.ctypes.data, packed.size, out.ctypes.data, out.size), out.size)

    return decode


def _bitshuffle(values: tuple[int, ...]) -> Codec:
    """Bitshuffle: blocks of which the bits are sorted by their place; LZ4 or Zstandard packs them.

    Chunks begin with their unpacked size and that of a block; each block begins with its packed size.
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
    """Hold that all blocks of bitshuffle lie in the chunk: the library trusts what they say of themselves."""
    group = 8 * itemsize  # bits are sorted among eight samples; what is left over is stored as it is
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
    validate = _function(_plugin("blosc"), "blosc_cbuffer_validate", ctypes.c_int, _POINTER, _SIZE, _POINTER)
    function = _function(
        _plugin("blosc"), "blosc_decompress_ctx", ctypes.c_int, _POINTER, _POINTER, _SIZE, ctypes.c_int
    )

    def decode(packed: Bytes, out: Bytes) -> None:
        size = _SIZE()
        if validate(packed.ctypes.data, packed.size, ctypes.byref(size)) < 0:
            raise ValueError("(no chunk of Blosc)")
        _check(size.value, out.size)
        _check(function(packed.ctypes.data, out.ctypes.data, out.size, 1), out.size)

    return decode


_MAKERS: dict[int, Callable[[tuple[int, ...]], Codec]] = {
    _SHUFFLE: _shuffle,
    _DEFLATE: _deflate,
    _LZF: _lzf,
    _BITSHUFFLE: _bitshuffle,
    _BLOSC: _blosc,
}


def _check(found: int, needed: int) -> None:
    if found != needed:
        raise ValueError(f"(a chunk gives {found} bytes where {needed} are needed)")


def _plugin(name: str) -> str:
    import hdf5plugin

    return str(Path(hdf5plugin.PLUGIN_PATH) / f"libh5{name}.so")


@functools.cache
def _function(library: str, name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of a C library; calls of it leave the interpreter's lock."""
    function = getattr(ctypes.CDLL(library), name)
    function.restype, function.argtypes = result, arguments
    return function
