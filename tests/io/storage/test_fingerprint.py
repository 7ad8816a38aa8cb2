"""Fingerprints distinguish recordings without reading them completely."""

from __future__ import annotations

import hashlib
import os

import h5py
import hdf5plugin
import numpy as np
import pytest
from fetching import GIVEN, compressible, write

from mirrorskin import io

SHAPE = (9, 50, 70)
EVERY, TAKEN = 4 << 20, 4 << 10


def fingerprint(path, **options):
    with io.open_recording(path, **GIVEN, **options) as recording:
        return recording.fingerprint()


def expected(data, spans):
    """Byte by byte: all that is not in a span, and of what is, 4 KiB of each 4 MiB."""
    taken, inside = np.ones(len(data), bool), 0
    for start, stop in sorted(spans):
        places = np.arange(inside, inside + stop - start)
        taken[start:stop] = places % EVERY < TAKEN
        if start:  # a piece that was begun ends with its span
            first = np.flatnonzero(places % EVERY == 0)
            taken[start : start + (first[0] if len(first) else stop - start)] = False
        inside += stop - start
    digest = hashlib.sha256(len(data).to_bytes(8, "little"))
    digest.update(np.frombuffer(data, "u1")[taken].tobytes())
    return digest.hexdigest()


def test_of_frames_in_one_piece_a_thousandth_is_taken(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (16, 700, 900), np.uint8)
    path = write(tmp_path / "a.h5", frames)
    with h5py.File(path) as file:
        start = file["x"].id.get_offset()
    assert fingerprint(path) == expected(path.read_bytes(), [(start, start + frames.nbytes)])


def test_of_chunks_too(tmp_path):
    frames = np.random.default_rng(0).integers(0, 90, (16, 700, 900), np.uint8)
    path = write(tmp_path / "a.h5", frames, (3, 300, 900), hdf5plugin.Bitshuffle())
    spans = []
    with h5py.File(path) as file:
        file["x"].id.chunk_iter(lambda c: spans.append((c.byte_offset, c.byte_offset + c.size)))
    spans.sort()
    joined = [spans[0]]
    for start, stop in spans[1:]:
        if start == joined[-1][1]:
            joined[-1] = (joined[-1][0], stop)
        else:
            joined.append((start, stop))
    assert fingerprint(path) == expected(path.read_bytes(), joined)


@pytest.mark.parametrize("packing", [{}, {"chunks": (1, 50, 70), "compression": "gzip"}])
def test_any_byte_next_to_the_frames_counts(tmp_path, packing):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=compressible(SHAPE, "u1"), **packing)
        file["note"] = np.arange(100)
        where = file["note"].id.get_offset()
    before = fingerprint(path)
    assert fingerprint(path) == before
    data = bytearray(path.read_bytes())
    data[where + 50] ^= 1
    path.write_bytes(data)
    assert fingerprint(path) != before
    path.write_bytes(path.read_bytes() + b"x")
    assert fingerprint(path) != before


def test_what_is_read_of_it_does_not_count(tmp_path):
    path = write(tmp_path / "a.h5", compressible(SHAPE, "u1"))
    assert fingerprint(path) == fingerprint(path, frames=(2, 5), region=io.Region((1, 5), (2, 9)))
    (tmp_path / "b.h5").write_bytes(path.read_bytes())
    assert fingerprint(path) == fingerprint(tmp_path / "b.h5")


def test_files_that_frames_are_taken_from_count(tmp_path, monkeypatch):
    frames = compressible(SHAPE, "u1")
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "part.h5", frames)
    (tmp_path / "raw.bin").write_bytes(bytes(10) + frames.tobytes() + bytes(10))
    layout = h5py.VirtualLayout(SHAPE, "u1")
    layout[...] = h5py.VirtualSource("part.h5", "x", SHAPE)
    with h5py.File("virtual.h5", "w", libver="latest") as file:
        file.create_virtual_dataset("x", layout)
    with h5py.File("external.h5", "w") as file:
        file.create_dataset("x", SHAPE, "u1", external=[("raw.bin", 10, frames.nbytes)])
    with h5py.File("linked.h5", "w") as file:
        file["x"] = h5py.ExternalLink("part.h5", "x")
    for name, other in (("virtual.h5", "part.h5"), ("external.h5", "raw.bin"), ("linked.h5", "part.h5")):
        options = {"dataset": "x"}
        before = fingerprint(tmp_path / name, **options)
        assert fingerprint(tmp_path / name, **options) == before
        data = (tmp_path / other).read_bytes()
        (tmp_path / other).write_bytes(data + b"x")
        assert fingerprint(tmp_path / name, **options) != before
        (tmp_path / other).write_bytes(data)
        assert fingerprint(tmp_path / name, **options) == before


@pytest.mark.parametrize("packing", [{}, {"chunks": (1, 50, 70), "compression": "gzip"}])
@pytest.mark.parametrize("places", ["renamed", "written"])
def test_a_file_that_is_replaced_while_it_is_open_is_reported(tmp_path, packing, places):
    path = tmp_path / "a.h5"
    frames = compressible(SHAPE, "u1")
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=frames, **packing)
    with io.open_recording(path, **GIVEN) as recording:
        before = recording.fingerprint(), recording.modified
        if places == "renamed":
            write(tmp_path / "b.h5", compressible(SHAPE, "u1", seed=1))
            (tmp_path / "b.h5").replace(path)
            np.testing.assert_array_equal(recording.read(np.empty_like(frames)).frames, frames)
        else:
            os.utime(path, ns=(0, 1))
        with pytest.raises(io.InputError, match=r"a\.h5 was changed while it was open: start again"):
            recording.fingerprint()
        assert recording.modified == before[1]
