"""Stacks read by HDF5 and by our reader, and the number of times that each chunk was unpacked."""

from __future__ import annotations

from collections import Counter

import h5py
import hdf5plugin
import numpy as np

from mirrorskin import io
from mirrorskin.io.storage.chunks import Chunks
from mirrorskin.io.storage.stack import Hdf5Frames

GIVEN = {"motion": "horizontal"}

PACKINGS = {
    "raw": {},
    "shuffle": {"shuffle": True},
    "gzip": {"compression": "gzip"},
    "shuffled gzip": {"compression": "gzip", "shuffle": True},
    "lzf": {"compression": "lzf"},
    "shuffled lzf": {"compression": "lzf", "shuffle": True},
    "fletcher32": {"fletcher32": True},
    "checked gzip": {"compression": "gzip", "fletcher32": True, "shuffle": True},
    "bitshuffle": hdf5plugin.Bitshuffle(),
    "small blocks": hdf5plugin.Bitshuffle(nelems=64),
    "bitshuffle zstd": hdf5plugin.Bitshuffle(cname="zstd"),
    "blosc": hdf5plugin.Blosc(cname="lz4", shuffle=hdf5plugin.Blosc.BITSHUFFLE),
    "blosc zstd": hdf5plugin.Blosc(cname="zstd"),
}
"""What is unpacked past HDF5."""

ONLY_HDF5 = {
    "shuffled zstd": {**hdf5plugin.Zstd(), "shuffle": True},
    "bitshuffle alone": hdf5plugin.Bitshuffle(cname="none"),
    "lz4": hdf5plugin.LZ4(nbytes=512),
    "blosc2": hdf5plugin.Blosc2(),
    "bzip2": hdf5plugin.BZip2(),
    "scaleoffset": {"scaleoffset": 0},
}


def compressible(shape, dtype, seed=0):
    """Steps and a little noise, so that packers pack, of the whole range of the type."""
    generator = np.random.default_rng(seed)
    smooth = np.cumsum(generator.integers(0, 3, shape), axis=-1) % 251
    values = (smooth + generator.integers(0, 2, shape)).astype(dtype)
    if np.dtype(dtype).kind == "f":
        values.flat[:: max(1, values.size // 5)] = np.nan
    elif np.dtype(dtype).itemsize == 2:
        values *= 257
    return values


def write(path, frames, chunks=None, packing=None):
    """Write a stack; raw chunks from the last to the first, so that they do not lie in one piece."""
    with h5py.File(path, "w") as file:
        if chunks is None or packing:
            file.create_dataset("x", data=frames, chunks=chunks, **(packing or {}))
        else:
            stack = file.create_dataset("x", frames.shape, frames.dtype, chunks=chunks, rdcc_nbytes=0)
            for start in reversed(range(0, len(frames), chunks[0])):
                stack[start : start + chunks[0]] = frames[start : start + chunks[0]]
    return path


def theirs(path, frames=(0, None), region=None):
    """What h5py reads."""
    part = (slice(*frames), *(region.slices if region else ()))
    with h5py.File(path) as file:
        stack = file["x"][part]
    return stack.astype(stack.dtype.newbyteorder("="))


def ours(path, buffer, **options):
    """What we read, so many frames at a time; and how."""
    with io.open_recording(path, **GIVEN | options) as recording:
        out = np.full((buffer, *recording.shape[1:]), 77, recording.dtype)
        parts = []
        while (block := recording.read(out)) is not None:
            assert block.index == sum(map(len, parts))
            assert len(block.frames) <= buffer
            assert np.shares_memory(block.frames, out)
            parts.append(block.frames.copy())
        assert len(parts) <= -(-recording.shape[0] // buffer) * 2 + recording.shape[0]
        return np.concatenate(parts), recording.how


def count_unpacked(monkeypatch):
    """Count how often each chunk is unpacked, or asked of HDF5."""
    counts = Counter()
    decode, fetch = Chunks._decode, Hdf5Frames.fetch

    def counted(self, position, out):
        counts[position] += 1
        decode(self, position, out)

    def asked(self, spans, out):
        chunk = self._dataset.chunks or (1, *out.shape[1:])
        ranges = [range(a // c, -(-b // c)) for (a, b), c in zip(spans, chunk, strict=True)]
        counts.update((i, j, k) for i in ranges[0] for j in ranges[1] for k in ranges[2])
        fetch(self, spans, out)

    monkeypatch.setattr(Chunks, "_decode", counted)
    monkeypatch.setattr(Hdf5Frames, "fetch", asked)
    return counts
