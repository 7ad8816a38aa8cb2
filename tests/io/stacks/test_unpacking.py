"""Chunks of more frames than are read at a time: unpacked once, kept in memory or on disk, and lent."""

from __future__ import annotations

import gc

import h5py
import numpy as np
import pytest
from fetching import GIVEN, ONLY_HDF5, PACKINGS, compressible, count_unpacked, ours, theirs, write

from mirrorskin import io
from mirrorskin.io import chunked_stack as unpacking
from mirrorskin.io.selection import Region

SHAPE = (24, 13, 17)
FRAME = 13 * 17 * 2
BITSHUFFLE = PACKINGS["bitshuffle"]


@pytest.mark.parametrize("chunks", [(8, 13, 17), (8, 5, 17), (8, 5, 6), (24, 4, 4)])
@pytest.mark.parametrize("packing", ["bitshuffle", "blosc2"])
@pytest.mark.parametrize("limit", [60 * FRAME, 30 * FRAME, 8 * FRAME])
def test_long_chunks_are_unpacked_once(tmp_path, monkeypatch, chunks, packing, limit):
    path = write(tmp_path / "a.h5", compressible(SHAPE, "u2"), chunks, (PACKINGS | ONLY_HDF5)[packing])
    counts = count_unpacked(monkeypatch)
    for given in ({}, {"region": Region((2, 11), (3, 12))}, {"frames": (3, 22)}):
        counts.clear()
        frames, how = ours(path, 3, memory_limit=limit, threads=2, **given)
        np.testing.assert_array_equal(frames, theirs(path, **given))
        assert set(counts.values()) == {1}
        alive = 1 if chunks[0] == 24 else 2
        kept = alive * (min(chunks[0], len(frames)) * frames[0].nbytes + 64)
        chunk = 2 * int(np.prod(chunks))
        threads = 1 if packing == "blosc2" or limit < 8 * chunk else 2
        assert how == ("unpacked into memory" if kept + threads * chunk <= limit else "unpacked to disk")


@pytest.mark.parametrize("limit", [60 * FRAME, 8 * FRAME])
def test_kept_frames_may_be_held_on_to(tmp_path, limit):
    path = write(tmp_path / "a.h5", compressible(SHAPE, "u2"), (8, 13, 17), BITSHUFFLE)
    held = []
    with io.open_recording(path, **GIVEN, memory_limit=limit) as recording:
        out = np.empty((3, 13, 17), "u2")
        while (block := recording.read(out)) is not None:
            assert block.lent
            held.append(block.frames)
    del recording
    gc.collect()
    np.testing.assert_array_equal(np.concatenate(held), theirs(path))


def test_memory_is_used_again_when_nobody_looks_at_it(tmp_path):
    path = write(tmp_path / "a.h5", compressible(SHAPE, "u2"), (8, 13, 17), BITSHUFFLE)
    with io.open_recording(path, **GIVEN) as recording:
        out, places = np.empty((4, 13, 17), "u2"), []
        while (block := recording.read(out)) is not None:
            places.append(block.frames.ctypes.data)
            del block
    step = 4 * FRAME
    assert places == [places[0], places[0] + step] * 3


def test_whole_chunks_go_where_they_are_wanted(tmp_path):
    path = write(tmp_path / "a.h5", compressible(SHAPE, "u2"), (8, 13, 17), BITSHUFFLE)
    with io.open_recording(path, **GIVEN, threads=2) as recording:
        out, sizes = np.empty((19, 13, 17), "u2"), []
        while (block := recording.read(out)) is not None:
            assert not block.lent
            sizes.append(len(block.frames))
        assert sizes == [16, 8]
        assert recording.how == "chunks decoded by 2 threads"


def test_a_full_disk_is_told(tmp_path, monkeypatch):
    path = write(tmp_path / "a.h5", compressible(SHAPE, "u2"), (8, 13, 17), BITSHUFFLE)

    def full(file, start, size):
        raise OSError(28, "full")

    monkeypatch.setattr(unpacking.os, "posix_fallocate", full)
    line = (
        r"a\.h5: /x is unpacked to disk, 1\.06e-05 GB: No space left on device; name a folder with more room"
    )
    with pytest.raises(io.InputError, match=line):
        ours(path, 3, memory_limit=8 * FRAME)


def test_damage_is_told_with_the_frames_on_every_way(tmp_path):
    path = write(tmp_path / "a.h5", compressible(SHAPE, "u2"), (8, 13, 17), BITSHUFFLE)
    with h5py.File(path) as file:
        chunk = file["x"].id.get_chunk_info(1)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset + 12] ^= 0xFF
    path.write_bytes(data)
    for room, limit in ((24, 60 * FRAME), (3, 60 * FRAME), (3, 8 * FRAME)):
        with pytest.raises(io.InputError, match="frames 8 to 15 of /x cannot be read: it is damaged"):
            ours(path, room, memory_limit=limit)
