"""Chunks read without HDF5: the same values as by HDF5, and every chunk is unpacked once."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from fetching import ONLY_HDF5, PACKINGS, compressible, count_unpacked, ours, theirs, write
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mirrorskin import io
from mirrorskin.io.base.selection import Region

SHAPE = (11, 13, 17)
REGION = Region((3, 11), (4, 12))


@pytest.mark.parametrize("packing", PACKINGS)
def test_every_packing_is_unpacked_past_hdf5(tmp_path, packing):
    for chunks, shape, dtype in (((1, 13, 17), SHAPE, "u2"), ((4, 5, 6), (12, 15, 18), "f4")):
        path = write(tmp_path / "a.h5", compressible(shape, dtype), chunks, PACKINGS[packing])
        frames, how = ours(path, 4, threads=2)
        np.testing.assert_array_equal(frames, theirs(path))
        assert how == f"chunks {'read' if packing == 'raw' else 'decoded'} by 2 threads"


@pytest.mark.parametrize("columns", [8, 72])
def test_a_last_block_of_eight_samples_is_unpacked(tmp_path, columns):
    """Of blocks of 64 samples, the last one has the fewest samples whose bits are sorted."""
    frames = compressible((3, 1, columns), "u2")
    path = write(tmp_path / "a.h5", frames, (1, 1, columns), PACKINGS["small blocks"])
    np.testing.assert_array_equal(ours(path, 3)[0], frames)


@pytest.mark.parametrize("packing", ONLY_HDF5)
def test_what_we_cannot_unpack_goes_through_hdf5(tmp_path, packing):
    path = write(tmp_path / "a.h5", compressible(SHAPE, "u2"), (3, 13, 17), ONLY_HDF5[packing])
    frames, how = ours(path, 3)
    np.testing.assert_array_equal(frames, theirs(path))
    assert how.startswith("through HDF5 (")


@pytest.mark.parametrize("left_out", [0, 1, 2, 3])
def test_chunks_may_have_been_left_out_by_filters(tmp_path, left_out):
    frames = compressible(SHAPE, "u2")
    path = write(tmp_path / "a.h5", frames, (1, 13, 17), {"compression": "gzip", "shuffle": True})
    shuffled = frames[4].reshape(-1, 1).view("u1").T.copy()
    data = (frames[4] if left_out & 1 else shuffled).tobytes()
    with h5py.File(path, "r+") as file:
        packed = data if left_out & 2 else zlib.compress(data)
        file["x"].id.write_direct_chunk((4, 0, 0), packed, filter_mask=left_out)
    np.testing.assert_array_equal(theirs(path), frames)
    actual, how = ours(path, 3)
    np.testing.assert_array_equal(actual, frames)
    assert how.startswith("chunks decoded")


@pytest.mark.parametrize("packing", ["gzip", "shuffle"])
def test_chunks_at_the_edge_may_be_raw(tmp_path, packing):
    library = next(Path(h5py.__file__).parent.with_name("h5py.libs").glob("libhdf5-*"), None)
    if library is None:
        pytest.skip("this h5py does not bring its HDF5")
    set_options = ctypes.CDLL(str(library)).H5Pset_chunk_opts
    set_options.argtypes = [ctypes.c_int64, ctypes.c_uint]
    frames, settings = compressible(SHAPE, "u2"), h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    settings.set_chunk((2, 5, 17))
    settings.set_shuffle()
    if packing == "gzip":
        settings.set_deflate(1)
    assert set_options(settings.id, 2) == 0  # H5D_CHUNK_DONT_FILTER_PARTIAL_CHUNKS
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        space = h5py.h5s.create_simple(SHAPE)
        h5py.Dataset(h5py.h5d.create(file.id, b"x", h5py.h5t.NATIVE_UINT16, space, settings))[...] = frames
    actual, how = ours(tmp_path / "a.h5", 4, threads=2)
    np.testing.assert_array_equal(actual, frames)
    alone = "through HDF5 (perhaps raw at the edge)"  # nothing in such a chunk shows whether it was shuffled
    assert how == (alone if packing == "shuffle" else "chunks decoded by 2 threads")


@pytest.mark.parametrize(
    ("maxshape", "libver"),
    [(SHAPE, "earliest"), (SHAPE, "latest"), ((None, 13, 17), "latest"), ((None, None, 17), "latest")],
)
def test_every_kind_of_index_is_read(tmp_path, libver, maxshape):
    frames = compressible(SHAPE, "u1")
    for chunks in ((1, 13, 17), (3, 4, 5), (20, 20, 20) if maxshape[1] is None else (11, 13, 17)):
        with h5py.File(tmp_path / "a.h5", "w", libver=libver) as file:
            file.create_dataset(
                "x", data=frames, chunks=(*chunks[:2], 17), maxshape=maxshape, compression="lzf"
            )
        np.testing.assert_array_equal(ours(tmp_path / "a.h5", 4)[0], frames)


@st.composite
def stacks(draw):
    shape = tuple(draw(st.integers(lowest, 12)) for lowest in (2, 1, 1))
    chunks = tuple(draw(st.integers(1, n)) for n in shape)
    start = draw(st.integers(0, shape[0] - 2))
    frames = (start, draw(st.integers(start + 2, shape[0])))
    spans = []
    for n in shape[1:]:
        first = draw(st.integers(0, n - 1))
        spans.append((first, draw(st.integers(first + 1, n))))
    return shape, chunks, frames, Region(*spans)


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    stacks(),
    st.sampled_from(sorted(PACKINGS | ONLY_HDF5)),
    st.sampled_from(["<u1", "<u2", "<f4", ">u2", ">f4"]),
    st.integers(1, 14),
    st.sampled_from([None, 200, 2000]),
)
def test_any_part_of_any_stack_is_what_hdf5_gives(tmp_path_factory, what, packing, dtype, buffer, limit):
    shape, chunks, frames, region = what
    packing = {} if packing == "scaleoffset" and "f" in dtype else (PACKINGS | ONLY_HDF5)[packing]
    path = tmp_path_factory.mktemp("any") / "a.h5"
    write(path, compressible(shape, dtype[1:]).astype(dtype), chunks, packing)
    size = int(np.prod(chunks)) * np.dtype(dtype).itemsize
    with pytest.MonkeyPatch.context() as patch:
        counts = count_unpacked(patch)
        actual, _ = ours(path, buffer, frames=frames, region=region, memory_limit=limit and max(limit, size))
    np.testing.assert_array_equal(actual, theirs(path, frames, region))
    assert set(counts.values()) == {1}
    needed = [
        -(-stop // c) - start // c
        for (start, stop), c in zip((frames, region.rows, region.columns), chunks, strict=True)
    ]
    if packing:
        assert len(counts) == np.prod(needed)


def test_a_file_that_is_cut_while_it_is_read_is_reported(tmp_path):
    path = write(tmp_path / "a.h5", compressible((9, 50, 70), "u2"), (1, 50, 70), PACKINGS["bitshuffle"])
    with io.open_recording(path, motion="horizontal") as recording:
        recording.read()
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size // 2)
        line = "frames? .* of /x cannot be read: it is truncated: copy it again"
        with pytest.raises(io.InputError, match=line):
            recording.read(np.empty((9, 50, 70), "u2"))


def test_an_interrupt_leaves_no_thread_writing(tmp_path, monkeypatch):
    from mirrorskin.io.storage.chunks import Chunks

    path = write(tmp_path / "a.h5", compressible((30, 50, 70), "u2"), (1, 50, 70), PACKINGS["bitshuffle"])
    decode = Chunks._decode

    def interrupted(self, position, out):
        if position[0] == 20:
            raise KeyboardInterrupt
        decode(self, position, out)

    monkeypatch.setattr(Chunks, "_decode", interrupted)
    with io.open_recording(path, motion="horizontal", threads=3) as recording:
        out = np.zeros((30, 50, 70), "u2")
        with pytest.raises(KeyboardInterrupt):
            recording.read(out)
        out[:] = 0
        assert not out.any()
    assert not out.any()


LONG = (24, 13, 17)
FRAME = 13 * 17 * 2
BITSHUFFLE = PACKINGS["bitshuffle"]


@pytest.mark.parametrize("limit", [60 * FRAME, 30 * FRAME, 8 * FRAME])
@pytest.mark.parametrize(
    ("chunks", "packing"),
    [((8, 13, 17), "bitshuffle"), ((8, 5, 6), "blosc2"), ((24, 4, 4), "bitshuffle")],
)
def test_long_chunks_are_unpacked_once(tmp_path, monkeypatch, chunks, packing, limit):
    path = write(tmp_path / "a.h5", compressible(LONG, "u2"), chunks, (PACKINGS | ONLY_HDF5)[packing])
    counts = count_unpacked(monkeypatch)
    for part in ({}, {"region": Region((2, 11), (3, 12))}, {"frames": (3, 22)}):
        counts.clear()
        frames, how = ours(path, 3, memory_limit=limit, threads=2, **part)
        np.testing.assert_array_equal(frames, theirs(path, **part))
        assert set(counts.values()) == {1}
        kept = min(chunks[0], len(frames)) * frames[0].nbytes
        chunk = 2 * int(np.prod(chunks))
        threads = 1 if packing == "blosc2" or limit < 8 * chunk else 2
        assert how == ("unpacked into memory" if kept + threads * chunk <= limit else "unpacked to disk")


def test_a_full_disk_is_reported(tmp_path, monkeypatch):
    path = write(tmp_path / "a.h5", compressible(LONG, "u2"), (8, 13, 17), BITSHUFFLE)

    def full(file, start, size):
        raise OSError(28, "full")

    monkeypatch.setattr(os, "posix_fallocate", full)
    line = (
        r"a\.h5: /x is unpacked to disk, 1\.06e-05 GB: No space left on device; name a folder with more room"
    )
    with pytest.raises(io.InputError, match=line):
        ours(path, 3, memory_limit=8 * FRAME)


def test_damage_is_reported_with_the_frames_on_every_way(tmp_path):
    path = write(tmp_path / "a.h5", compressible(LONG, "u2"), (8, 13, 17), BITSHUFFLE)
    with h5py.File(path) as file:
        chunk = file["x"].id.get_chunk_info(1)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset + 12] ^= 0xFF
    path.write_bytes(data)
    for count, limit in ((24, 60 * FRAME), (3, 60 * FRAME), (3, 8 * FRAME)):
        with pytest.raises(io.InputError, match="frames 8 to 15 of /x cannot be read: it is damaged"):
            ours(path, count, memory_limit=limit)


FORKED = """
import os, signal, sys, numpy as np
from mirrorskin import io
with io.open_recording(sys.argv[1], motion="horizontal", threads=2) as recording:
    room = np.empty(recording.shape, recording.dtype)
    recording.read(room[:8])
    if not os.fork():
        signal.alarm(20)
        print(recording.read(room[8:]).frames.sum(), flush=True)
        os._exit(0)
    os.wait()
"""


def test_a_forked_process_unpacks_with_threads_of_its_own(tmp_path):
    stack = np.ones((16, 5, 7), np.uint8)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", data=stack, chunks=(1, 5, 7), compression="gzip")
    command = [sys.executable, "-c", FORKED, str(tmp_path / "a.h5")]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ended.stdout.split() == [str(stack[8:].sum())]
