"""Frames in one piece: lent where they lie in the file, and safe to keep."""

from __future__ import annotations

import gc
import mmap
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from fetching import GIVEN, compressible, ours, theirs, write
from stacks import MadeUp

from mirrorskin import io
from mirrorskin.io.selection import Region

SHAPE = (9, 50, 70)


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "a.h5", compressible(SHAPE, "u2"))


@pytest.mark.parametrize(
    ("shape", "dtype"), [(SHAPE, "u2"), ((2, 1, 1), "u1"), ((3, 1, 5), "u2"), ((7, 13, 1), "f4")]
)
def test_what_is_lent_is_what_hdf5_gives(tmp_path, shape, dtype):
    path = write(tmp_path / "a.h5", compressible(shape, dtype))
    for room in (1, 2, 4, 20):
        frames, how = ours(path, room)
        np.testing.assert_array_equal(frames, theirs(path))
        assert how == "mapped"


def test_a_recording_lends_what_lies_in_one_piece(path, tmp_path):
    with io.open_recording(path, **GIVEN, frames=(1, 8)) as recording:
        recording.read()
        block = recording.lend(5)
        assert (block.index, len(block.frames), block.lent) == (1, 5, True)
        np.testing.assert_array_equal(block.frames, theirs(path)[2:7])
        assert recording.read(np.empty((5, 50, 70), "u2")).index == 6
        assert recording.lend(5) is None
    with io.open_recording(path, **GIVEN, memory_limit=7000) as recording:  # 4 times that are mapped at once
        assert len(recording.lend(9).frames) == 4
    with io.open_recording(path, **GIVEN, region=Region((3, 40), (5, 60))) as recording:
        assert recording.lend(5) is None


def test_lent_frames_outlive_their_recording(path):
    frames = compressible(SHAPE, "u2")
    with io.open_recording(path, **GIVEN) as recording:
        kept = [recording.read(np.empty((3, 50, 70), "u2")).frames for _ in range(3)]
    del recording
    gc.collect()
    np.testing.assert_array_equal(np.concatenate(kept), frames)


def test_pages_go_with_the_last_frame(path):
    def maps():
        return Path("/proc/self/maps").read_text().count(str(path))

    recording = io.open_recording(path, **GIVEN)
    frames = recording.read().frames[0, 3:]
    recording.close()
    assert maps() == 1
    del recording
    assert maps() == 1
    del frames
    assert maps() == 0


@pytest.mark.parametrize("spare", [0, 4, 60, 64])
@pytest.mark.parametrize("more", [0, 4, 64])
def test_frames_are_lent_where_a_longest_word_follows(tmp_path, spare, more):
    """The last frame ends ``spare`` bytes before a page does, and the file ``more`` bytes behind it."""
    start = 2048  # where HDF5 puts them, the last thing in the file
    frames = compressible((4, 1, 1024 + (-start - spare) % mmap.PAGESIZE // 4), "u1")
    path = write(tmp_path / "a.h5", frames)
    assert path.stat().st_size == start + frames.nbytes
    os.truncate(path, path.stat().st_size + more)
    with io.open_recording(path, **GIVEN) as recording:
        blocks = list(iter(lambda: recording.read(np.empty_like(frames)), None))
    np.testing.assert_array_equal(np.concatenate([block.frames for block in blocks]), frames)
    assert [block.lent for block in blocks] == ([True, False] if more <= spare < 64 else [True])


@pytest.mark.parametrize("left", [0, 1000, 20_000, -1])
def test_a_file_that_becomes_shorter_is_told_before_it_is_touched(path, left):
    with io.open_recording(path, **GIVEN) as recording:
        recording.read()
        with h5py.File(path) as file:
            end = file["x"].id.get_offset() + file["x"].nbytes
        os.truncate(path, left if left >= 0 else end - 1)
        line = r"a\.h5: frames 1 to 8 of /x cannot be read: it is truncated: copy it again"
        with pytest.raises(io.InputError, match=line):
            recording.read(np.empty((8, 50, 70), "u2"))


CUT = """
import os, sys
from mirrorskin import io
from mirrorskin.cli.main import program
lend = io.Recording.lend
def cut(self, most):
    block = lend(self, most)
    if self.path.name != "c.h5":
        os.truncate(self.path, self.path.stat().st_size // 4)
    return block
io.Recording.lend = cut
sys.argv[0] = "mirrorskin"
program()
"""


def test_a_batch_survives_files_that_are_cut_while_kernels_read_them(tmp_path):
    paths = [str(tmp_path / name) for name in ("a.h5", "b.h5", "c.h5")]
    for path in paths:
        source = MadeUp(compressible((30, 240, 320), "u1"), io.Header("vertical"), travel=np.arange(30) * 0.1)
        with io.Recorder(source, path) as recorder:
            recorder.drain(lambda count: None)
    command = [sys.executable, "-c", CUT, "batch", *paths, "-o", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done
    for path in paths[:2]:
        assert f"{path} was changed while it was open: start again" in done.stdout + done.stderr
    assert [path.name for path in tmp_path.glob("*-result.h5")] == ["c-result.h5"]


CHILD = """
import numpy as np, resource, sys
from mirrorskin import io
def peak():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1]) << 10
total = 0
with io.open_recording(sys.argv[1], motion="horizontal") as recording:
    out = np.empty((int(sys.argv[2]), *recording.shape[1:]), recording.dtype)
    recording.read(out)
    before = peak()
    while (block := recording.read(out)) is not None:
        total += int(block.frames.sum())
print(total, peak() - before)
"""


def test_pages_that_were_used_do_not_pile_up(tmp_path):
    frames = np.ones((320, 256, 1024), "u1")
    path = write(tmp_path / "a.h5", frames)
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(path), "16"], capture_output=True, text=True, check=True
    )
    total, more = map(int, done.stdout.split())
    assert total == 304 * 256 * 1024
    assert more < 4 * frames[:16].nbytes


@pytest.mark.parametrize("dtype", ["u1", "u2", "f4"])
def test_raw_chunks_that_lie_in_one_piece_are_mapped(tmp_path, dtype):
    frames = compressible(SHAPE, dtype)
    for length in (1, 2, 9):
        with h5py.File(tmp_path / "a.h5", "w", libver="latest", meta_block_size=1 << 16) as file:
            stack = file.create_dataset("x", SHAPE, dtype, chunks=(length, *SHAPE[1:]), rdcc_nbytes=0)
            for start in range(0, len(frames), length):
                stack[start : start + length] = frames[start : start + length]
        for region, given in ((None, {}), (Region((3, 40), (5, 60)), {"frames": (2, 8)})):
            found, how = ours(tmp_path / "a.h5", 4, region=region, **given)
            np.testing.assert_array_equal(found, theirs(tmp_path / "a.h5", region=region, **given))
            assert how == "mapped"
