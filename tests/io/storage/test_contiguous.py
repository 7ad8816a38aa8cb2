"""Contiguous frames: read directly, from files that other programs may shorten."""

from __future__ import annotations

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
from mirrorskin.io.base.selection import Region

SHAPE = (9, 50, 70)


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "a.h5", compressible(SHAPE, "u2"))


@pytest.mark.parametrize(
    ("shape", "dtype"), [(SHAPE, "u2"), ((2, 1, 1), "u1"), ((3, 1, 5), "u2"), ((7, 13, 1), "f4")]
)
def test_what_is_lent_is_what_hdf5_gives(tmp_path, shape, dtype):
    path = write(tmp_path / "a.h5", compressible(shape, dtype))
    for count in (1, 2, 4, 20):
        frames, how = ours(path, count)
        np.testing.assert_array_equal(frames, theirs(path))
        assert how == "directly"


def test_many_bytes_are_read_by_several_threads(tmp_path, monkeypatch):
    monkeypatch.setattr("mirrorskin.io.storage.stack._MANY", 10_000)
    path = write(tmp_path / "a.h5", compressible(SHAPE, "u2"))
    for count in (1, 2, 4, 9):
        np.testing.assert_array_equal(ours(path, count)[0], theirs(path))


def test_a_part_is_what_hdf5_gives(path):
    for region, options in ((None, {"frames": (1, 8)}), (Region((3, 40), (5, 60)), {"frames": (2, 8)})):
        actual, how = ours(path, 4, region=region, **options)
        np.testing.assert_array_equal(actual, theirs(path, region=region, **options))
        assert how == "directly"


@pytest.mark.parametrize("dtype", [">u2", ">f4"])
def test_another_byte_order_is_converted(tmp_path, dtype):
    path = write(tmp_path / "a.h5", compressible(SHAPE, dtype[1:]).astype(dtype))
    for region in (None, Region((3, 40), (5, 60)), Region((3, 40), (0, 70))):
        actual, how = ours(path, 4, region=region)
        np.testing.assert_array_equal(actual, theirs(path, region=region))
        assert how == "directly"


def test_no_page_of_a_file_is_mapped(path):
    """A program that cuts a mapped file ends the process that reads it."""
    with io.open_recording(path, **GIVEN) as recording:
        recording.read(np.empty(SHAPE, "u2"))
        assert str(path) not in Path("/proc/self/maps").read_text()


@pytest.mark.parametrize("rest", [0, 1000, 20_000, -1])
def test_a_file_that_becomes_shorter_is_reported_before_it_is_touched(path, rest):
    with io.open_recording(path, **GIVEN) as recording:
        recording.read()
        with h5py.File(path) as file:
            end = file["x"].id.get_offset() + file["x"].nbytes
        os.truncate(path, rest if rest >= 0 else end - 1)
        line = r"a\.h5: frames 1 to 8 of /x cannot be read: it is truncated: copy it again"
        with pytest.raises(io.InputError, match=line):
            recording.read(np.empty((8, 50, 70), "u2"))


CUT = """
import os, sys
from mirrorskin import io
from mirrorskin.cli.main import program
read = io.Recording.read
def cut(self, out=None):
    block = read(self, out)
    if self.path.name != "c.h5":
        os.truncate(self.path, self.path.stat().st_size // 4)
    return block
io.Recording.read = cut
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
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1, ended
    for path in paths[:2]:
        assert f"{path} was changed while it was open: start again" in ended.stdout + ended.stderr
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
    ended = subprocess.run(
        [sys.executable, "-c", CHILD, str(path), "16"], capture_output=True, text=True, check=True
    )
    total, more = map(int, ended.stdout.split())
    assert total == 304 * 256 * 1024
    assert more < 4 * frames[:16].nbytes
