"""Unpacking of single chunks: correct bytes, and no damage by wrong ones."""

from __future__ import annotations

import h5py
import hdf5plugin
import numpy as np
import pytest
from fetching import ONLY_HDF5, PACKINGS, compressible, write

from mirrorskin.io.storage import chunks

CHECKED = [name for name in PACKINGS if name not in ("raw", "shuffle")]


def packed_chunk(path, packing, dtype="u2", shape=(2, 31, 37)):
    """A chunk as it is stored, what is in it, and what unpacks it."""
    frames = compressible(shape, dtype) // 5 * 5
    write(path, frames, shape, packing)
    with h5py.File(path) as file:
        actual = chunks.find_codecs(file["x"].id)
        mask, data = file["x"].id.read_direct_chunk((0, 0, 0))
    assert mask == 0
    return np.frombuffer(data, "u1").copy(), frames, actual


@pytest.mark.parametrize(
    ("shape", "dtype"), [((1, 1, 1), "u2"), ((1, 1, 5), "f4"), ((3, 50, 50), "u1"), ((2, 127, 129), "u2")]
)
@pytest.mark.parametrize("cname", ["lz4", "zstd"])
def test_bitshuffle_s_odd_ends_are_unpacked(tmp_path, cname, shape, dtype):
    data, frames, actual = packed_chunk(tmp_path / "a.h5", hdf5plugin.Bitshuffle(cname=cname), dtype, shape)
    out = np.zeros(frames.nbytes, "u1")
    chunks.decode(actual, 0, data, out)
    assert out.tobytes() == frames.tobytes()


@pytest.mark.parametrize(
    ("cname", "shuffle"), [("blosclz", 0), ("lz4", 1), ("lz4hc", 2), ("zlib", 0), ("zstd", 1)]
)
def test_every_packer_of_blosc_is_known(tmp_path, cname, shuffle):
    data, frames, actual = packed_chunk(
        tmp_path / "a.h5", hdf5plugin.Blosc(cname=cname, shuffle=shuffle), "f4"
    )
    out = np.zeros(frames.nbytes, "u1")
    chunks.decode(actual, 0, data, out)
    assert out.tobytes() == frames.tobytes()


@pytest.mark.parametrize("packing", CHECKED)
def test_a_chunk_of_another_size_is_refused(tmp_path, packing):
    data, frames, actual = packed_chunk(tmp_path / "a.h5", PACKINGS[packing])
    for size in (frames.nbytes - 2, frames.nbytes + 2, frames.nbytes // 2, 2 * frames.nbytes):
        with pytest.raises(ValueError, match=r"^\("):
            chunks.decode(actual, 0, data, np.zeros(size, "u1"))
    for length in (0, 1, 3, 8, 12, 15, len(data) // 2, len(data) - 1):
        with pytest.raises(ValueError, match=r"^\("):
            chunks.decode(actual, 0, data[:length].copy(), np.zeros(frames.nbytes, "u1"))


@pytest.mark.parametrize("packing", ["bitshuffle", "small blocks", "bitshuffle zstd"])
def test_a_block_beyond_the_end_of_its_chunk_does_not_reach_the_library(tmp_path, monkeypatch, packing):
    load, reached = chunks._function, []

    def watched(library, name, *types):
        function = load(library, name, *types)
        if not name.startswith("bshuf_decompress"):
            return function
        return lambda *values: reached.append(name) or function(*values)

    monkeypatch.setattr(chunks, "_function", watched)
    data, frames, actual = packed_chunk(tmp_path / "a.h5", PACKINGS[packing])
    with pytest.raises(ValueError, match="a chunk gives"):
        chunks.decode(actual, 0, data[:-16].copy(), np.zeros(frames.nbytes, "u1"))
    assert not reached


@pytest.mark.parametrize("packing", CHECKED)
def test_damage_and_noise_are_refused_or_give_something(tmp_path, packing):
    data, frames, actual = packed_chunk(tmp_path / "a.h5", PACKINGS[packing])
    generator = np.random.default_rng(0)
    refused = 0
    for trial in range(600):
        bad = data.copy()
        if trial < 300:
            place = trial // 2 if trial < 64 else generator.integers(len(bad))
            bad[place] ^= (0xFF, 0x01)[trial % 2]
        else:
            keep = (0, 4, 12, 16, 20)[trial % 5]
            bad[keep:] = generator.integers(0, 256, len(bad) - keep)
        out = np.zeros(frames.nbytes + 64, "u1")
        try:
            chunks.decode(actual, 0, bad, out[:-64])
        except ValueError as error:
            assert str(error).startswith("(")  # noqa: PT017
            refused += 1
        assert not out[-64:].any()
    assert refused > 250


@pytest.mark.parametrize("packing", ONLY_HDF5)
def test_what_is_not_known_is_named(tmp_path, packing):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        stack = file.create_dataset("x", (4, 5, 7), "u2", chunks=(1, 5, 7), **ONLY_HDF5[packing])
        assert isinstance(chunks.find_codecs(stack.id), str)


def test_a_library_that_is_not_there_leaves_it_to_hdf5(tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "_plugin", lambda name: str(tmp_path / name))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        stack = file.create_dataset("x", (4, 5, 7), "u2", chunks=(1, 5, 7), **hdf5plugin.Bitshuffle())
        assert chunks.find_codecs(stack.id) == "bitshuffle"
