"""Zarr arrays whose chunks are unpacked to at most the size stated in their metadata.

The codecs of zarr-python have no limit: a few kilobytes may become gigabytes.
"""

from __future__ import annotations

import asyncio
import copy
import gzip
import math
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any, TypeAlias

import zarr
from numcodecs import blosc, lz4, zstd
from numcodecs.abc import Codec
from zarr.abc.codec import BytesBytesCodec
from zarr.codecs import ShardingCodec, VLenUTF8Codec
from zarr.core.metadata import ArrayV2Metadata, ArrayV3Metadata
from zarr.storage import StorePath

from mirrorskin.io.zarr_metadata import COMPRESSORS, ArrayMetadata, check_codecs

Array: TypeAlias = "zarr.Array[Any]"

LONGEST_TEXTS = 1 << 20
"""Limit of the texts in one chunk, in bytes."""

_SLACK = 1 << 10  # additional bytes of a chunk between codecs: checksums, the index of a shard
_INDEXED = 16  # bytes of the index of a shard per chunk
_BLOCK = 128 << 10  # maximum unpacked size of a Zstandard block
_FRAME = 0xFD2FB528
_UNPACKED = 8  # limit of the size of a chunk's Zstandard blocks, relative to the chunk: not all are full


def open_array(store: Any, array: ArrayMetadata, where: str) -> Array:
    """Return an array of zarr-python whose chunks are unpacked within limits.

    InputError where a codec is not allowed; see ``zarr_metadata.check_codecs``.
    """
    check_codecs(array, where)
    document, version_3 = copy.deepcopy(array.document), array.document["zarr_format"] == 3
    if version_3:
        metadata = ArrayV3Metadata.from_dict(document)
        codecs = _bounded_codecs(metadata.codecs, array, array.chunks)
        metadata = replace(metadata, codecs=codecs)
    else:
        document["filters"] = document.get("filters") or None
        metadata = _bounded_version_2(ArrayV2Metadata.from_dict(document), array)
    return zarr.Array(zarr.AsyncArray(metadata, StorePath(store, array.path)))


def _bytes_of(array: ArrayMetadata, piece: Sequence[int]) -> int:
    """Return the maximum size in bytes of a piece between any two of its codecs."""
    if array.is_text:
        return LONGEST_TEXTS
    return math.prod(piece) * int(array.dtype.itemsize) + _SLACK


def _bounded_codecs(codecs: Sequence[Any], array: ArrayMetadata, piece: Sequence[int]) -> tuple[Any, ...]:
    """Replace the version 3 codecs that unpack, also inside shards, by limited ones."""
    most, count, bounded = _bytes_of(array, piece), math.prod(piece), []
    for one in codecs:
        if isinstance(one, ShardingCodec):
            inside = _bounded_codecs(one.codecs, array, one.chunk_shape)
            most = 2 * most + _INDEXED * (count // math.prod(one.chunk_shape))
            bounded.append(replace(one, codecs=inside))
        elif (name := one.to_dict()["name"]) in COMPRESSORS:
            bounded.append(_Unpacking(_UNPACK[name], most))
        else:
            bounded.append(one)
            if isinstance(one, VLenUTF8Codec):
                bounded.append(_Unpacking(_check_texts, count))
    return tuple(bounded)


def _bounded_version_2(metadata: Any, array: ArrayMetadata) -> Any:
    most, count, text = _bytes_of(array, array.chunks), math.prod(array.chunks), array.is_text
    unpack = None if metadata.compressor is None else _UNPACK[metadata.compressor.codec_id]

    def decode(packed: bytes) -> bytes:
        unpacked = packed if unpack is None else unpack(packed, most)
        return _check_texts(unpacked, count) if text else unpacked

    return replace(metadata, compressor=_Compressor(decode)) if text or unpack else metadata


@dataclass(frozen=True)
class _Unpacking(BytesBytesCodec):  # type: ignore[misc]  # where Zarr is not installed
    """A version 3 codec that unpacks to at most ``most`` bytes."""

    unpack: Callable[[bytes, int], bytes]
    most: int
    is_fixed_size = False

    async def _decode_single(self, chunk_data: Any, chunk_spec: Any) -> Any:
        unpacked = await asyncio.to_thread(self.unpack, chunk_data.to_bytes(), self.most)
        return chunk_spec.prototype.buffer.from_bytes(unpacked)

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: Any) -> int:
        raise NotImplementedError


class _Compressor(Codec):  # type: ignore[misc]
    """A version 2 compressor that only unpacks."""

    codec_id = "mirrorskin"

    def __init__(self, function: Callable[[bytes], bytes]) -> None:
        self._function = function

    def encode(self, buf: Any) -> Any:
        raise NotImplementedError

    def decode(self, buf: Any, out: Any = None) -> Any:
        return self._function(bytes(buf))


def _check_texts(data: bytes, count: int) -> bytes:
    """Return a chunk of texts if it contains ``count``: the codec allocates memory for the stated number."""
    _check_size(len(data), LONGEST_TEXTS)
    if len(data) < 4 or int.from_bytes(data[:4], "little") != count:
        raise ValueError(f"a chunk that does not hold {count} texts")
    return data


def _check_size(size: int, most: int) -> None:
    if not 0 <= size <= most:
        raise ValueError(f"a chunk that gives {size} bytes or more, where it claims at most {most}")


def _gzip(packed: bytes, most: int) -> bytes:
    with gzip.GzipFile(fileobj=BytesIO(packed)) as file:
        unpacked = file.read(most + 1)
    _check_size(len(unpacked), most)
    return unpacked


def _zlib(packed: bytes, most: int) -> bytes:
    stream = zlib.decompressobj()
    unpacked = stream.decompress(packed, most + 1)
    _check_size(len(unpacked), most)
    if not stream.eof:
        raise ValueError("a chunk that was cut short")
    return unpacked


def _blosc(packed: bytes, most: int) -> bytes:
    _check_size(struct.unpack_from("<I", packed, 4)[0], most)
    return blosc.decompress(packed)  # type: ignore[no-any-return]


def _lz4(packed: bytes, most: int) -> bytes:
    _check_size(struct.unpack_from("<i", packed)[0], most)
    return lz4.decompress(packed)  # type: ignore[no-any-return]


def _zstd(packed: bytes, most: int) -> bytes:
    place, claims, blocks = 0, 0, 0
    unknown = False
    while place < len(packed):
        claim, checksum, place = _zstd_head(packed, place)
        size, place = _zstd_blocks(packed, place)
        place, claims, blocks = place + checksum, claims + (claim or 0), blocks + size
        unknown = unknown or claim is None
    if unknown:
        _check_size(blocks, _UNPACKED * most + _BLOCK)
    else:  # at most the stated size is unpacked
        _check_size(claims, most)
    unpacked = zstd.decompress(packed)
    _check_size(len(unpacked), most)
    return unpacked  # type: ignore[no-any-return]


def _zstd_head(packed: bytes, place: int) -> tuple[int | None, int, int]:
    """Return the unpacked size of a frame, if stated, the size of its checksum, and the start of its blocks.

    See RFC 8878, 3.1.1.1.
    """
    magic, flags = struct.unpack_from("<IB", packed, place)
    if magic != _FRAME:
        raise ValueError("not a frame of Zstandard")
    single, kind = flags >> 5 & 1, flags >> 6
    start, length = place + 6 - single + (0, 1, 2, 4)[flags & 3], (single, 2, 4, 8)[kind]
    claimed = int.from_bytes(packed[start : start + length], "little") + (256 if kind == 1 else 0)
    return claimed if length else None, 4 * (flags >> 2 & 1), start + length


def _zstd_blocks(packed: bytes, place: int) -> tuple[int, int]:
    """Return the maximum unpacked size of the blocks of a frame, and the end of the frame (3.1.1.2)."""
    total = last = 0
    while not last:
        header = int.from_bytes(packed[place : place + 3], "little")
        last, kind, size = header & 1, header >> 1 & 3, header >> 3
        if place + 3 > len(packed):
            raise ValueError("a chunk that was cut short")
        total += _BLOCK if kind == 2 else size
        place += 3 + (1 if kind == 1 else size)
    return total, place


_UNPACK: dict[str, Callable[[bytes, int], bytes]] = {
    "blosc": _blosc,
    "gzip": _gzip,
    "lz4": _lz4,
    "zlib": _zlib,
    "zstd": _zstd,
}
