"""Recordings written while frames arrive: their contents, also after a failure."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import h5py
import numpy as np
import pytest
from growing import Feed, frames_of, started, stream
from stacks import plot_of, read_all

from mirrorskin import io
from mirrorskin.io.base.types import MOTIONS
from mirrorskin.io.files import streaming
from mirrorskin.io.files.recorder import COMPRESSIONS

DETECTOR, STAGE = "/entry/instrument/detector", "/entry/instrument/stage"
SUPPORT = Path(__file__).parents[2] / "support"


def held(path):
    """Read all that grows in a file, by h5py alone."""
    with h5py.File(path) as file:
        series = {
            name: node[()]
            for group in (file[DETECTOR], file[STAGE])
            for name, node in group.items()
            if node.maxshape and node.maxshape[0] is None
        }
        return series | {"state": file["/entry/state"].asstr()[()]}


@pytest.mark.parametrize(
    ("packing", "dtype"),
    [(packing, "u2") for packing in COMPRESSIONS] + [("raw", "u1"), ("bitshuffle", "f4")],
)
def test_what_comes_is_what_is_in_the_file(tmp_path, packing, dtype):
    blocks = stream(Feed(20, (1, 4, 3), dtype=dtype), tmp_path / "a.h5", packing)
    numbers = np.arange(20)
    actual = held(tmp_path / "a.h5")
    np.testing.assert_array_equal(actual["data"], frames_of(numbers, dtype=dtype))
    np.testing.assert_array_equal(actual["frame_time"], numbers)
    np.testing.assert_array_equal(actual["travel_live"], 0.01 * numbers)
    np.testing.assert_array_equal(actual["travel"], 0.01 * numbers + 0.001)
    np.testing.assert_array_equal(actual["used"], 1)
    lost = np.zeros(20)
    lost[[block.index for block in blocks]] = [block.index % 3 for block in blocks]
    np.testing.assert_array_equal(actual["dropped"], lost)
    assert actual["state"] == "complete"
    assert actual["data"].dtype == np.dtype(dtype)


@pytest.mark.parametrize(("shape", "cuts"), [((1, 1), (20,)), ((13, 1), (2, 5)), ((64, 64), (2, 5))])
def test_frames_of_any_size_in_blocks_of_any_cut_read_back(tmp_path, shape, cuts):
    stream(Feed(20, cuts, shape=shape, dtype="u2"), tmp_path / "a.h5")
    with io.open_recording(tmp_path / "a.h5") as recording:
        actual = read_all(recording, 6)
        assert recording.how.startswith("chunks read")
        assert (recording.state, recording.full_shape) == ("complete", (20, *shape))
    np.testing.assert_array_equal(actual.frames, frames_of(np.arange(20), shape, "u2"))
    np.testing.assert_array_equal(actual.travel, 0.01 * np.arange(20) + 0.001)


def test_raw_frames_are_in_one_piece_behind_little_else(tmp_path):
    stream(Feed(3000, (7,), shape=(16, 32)), tmp_path / "a.h5", period=0.001)
    with io.open_recording(tmp_path / "a.h5") as recording:
        assert recording.how.startswith("chunks read")
    assert (tmp_path / "a.h5").stat().st_size < 3000 * 16 * 32 + (1 << 18)


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_keeps_its_positions_and_its_plot(tmp_path, motion):
    stream(Feed(8, motion=motion), tmp_path / "a.h5")
    _, signal, axes = plot_of(tmp_path / "a.h5")
    np.testing.assert_array_equal(signal, frames_of(np.arange(8)))
    name = {"vertical": "travel", "axial": "phase", "horizontal": "frame_time", "twist": "twist"}[motion]
    assert axes == [name, ".", "."]
    with io.open_recording(tmp_path / "a.h5") as recording:
        actual = read_all(recording, 3)
        assert recording.header.press == (None if motion == "vertical" else 1.0)
    for series, values in Feed(motion=motion).positions_of(np.arange(8), 0.001).items():
        np.testing.assert_array_equal(getattr(actual, series), values)
    moved = {"horizontal": "displacement"}.get(motion, name)
    actual = held(tmp_path / "a.h5")
    assert {series for series in actual if series.endswith("_live")} == {f"{moved}_live"}
    with io.open_recording(tmp_path / "a.h5", live=True) as recording:
        np.testing.assert_array_equal(getattr(recording, moved), actual[f"{moved}_live"])


def test_lent_frames_are_given_back_once_they_are_written(tmp_path):
    with io.StreamRecorder(Feed(10), tmp_path / "a.h5", period=60) as recorder:
        references = [weakref.ref(recorder.read().frames) for _ in range(2)]
        until = time.monotonic() + 60
        while any(frames() is not None for frames in references):
            assert time.monotonic() < until
            time.sleep(0.001)


def test_marks_reach_frames_that_are_written_and_frames_that_are_yet_to_come(tmp_path):
    with io.StreamRecorder(Feed(12, (3,)), tmp_path / "a.h5", period=0.0) as recorder:
        recorder.read()
        recorder.mark(8, np.array([False, True]))
        recorder.read()
        recorder.read()
        recorder.mark(1, np.array([False]))
        recorder.mark(4, np.array([False, False]))
        recorder.mark(5, np.array([True]))
        recorder.read()
        recorder.mark(11, np.zeros(5, bool))
    np.testing.assert_array_equal(held(tmp_path / "a.h5")["used"], [1, 0, 1, 1, 0, 1, 1, 1, 0, 1, 1, 0])


# Where an older file has the name.


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture(params=["a.h5", "a.mcap"])
def older(request, tmp_path):
    """A recording of three frames, whose bytes are not to change."""
    stream(Feed(3), tmp_path / request.param)
    return tmp_path / request.param


def partial(path, number=1):
    return path.with_name(f"{path.stem}-partial{'' if number == 1 else f'-{number}'}{path.suffix}")


def test_an_older_file_is_refused_unless_it_may_be_replaced(older):
    before, source = older.read_bytes(), Feed()
    message = (
        f"{older} exists and is a recording: add --overwrite to replace it, or choose another name with -o"
    )
    with pytest.raises(io.InputError, match=f"^{re.escape(message)}$"):
        stream(source, older)
    assert not source.entered
    assert older.read_bytes() == before


def test_an_older_file_is_replaced_by_a_complete_recording(older):
    before = older.read_bytes()
    with io.StreamRecorder(Feed(8), older, overwrite=True, period=0.0) as recorder:
        while recorder.read() is not None:
            assert older.read_bytes() == before
    assert older.read_bytes() != before
    assert names(older.parent) == [older.name]
    assert (recorder.file, recorder.state, recorder.written) == (older, "complete", 8)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), io.InputError("the camera is lost: plug it in")])
def test_a_run_that_fails_at_its_first_frame_leaves_an_older_file_and_nothing_else(older, error):
    before = older.read_bytes()
    with pytest.raises(type(error)):
        stream(Feed(fails=(0, error)), older, overwrite=True)
    with pytest.raises(io.InputError, match="feed gave no frames: nothing was written"):
        stream(Feed(0, announced=5), older, overwrite=True)
    assert older.read_bytes() == before
    assert names(older.parent) == [older.name]


def test_what_a_run_that_was_cut_short_recorded_has_a_name_of_its_own(older):
    before = older.read_bytes()
    for number in (1, 2):
        recorder = io.StreamRecorder(Feed(fails=(4, SystemExit(1))), older, overwrite=True)
        with pytest.raises(SystemExit), recorder:
            drain(recorder)
        assert recorder.file == partial(older, number)
        assert recorder.written == 4
    assert older.read_bytes() == before
    assert names(older.parent) == sorted(path.name for path in (older, partial(older), partial(older, 2)))


def test_a_source_that_is_not_read_to_its_end_is_cut_short(older):
    before = older.read_bytes()
    with io.StreamRecorder(Feed(8), older, overwrite=True) as recorder:
        for _ in range(8):  # all frames, but the source has not said that there are no more
            recorder.read()
    assert (recorder.state, recorder.file) == ("cut short: stopped before the last frame", partial(older))
    assert older.read_bytes() == before


def test_a_recording_that_was_cut_short_has_this_state(tmp_path):
    stream(Feed(3), tmp_path / "a.h5")
    with pytest.raises(KeyboardInterrupt):
        stream(Feed(fails=(4, KeyboardInterrupt())), tmp_path / "a.h5", overwrite=True)
    actual = held(tmp_path / "a-partial.h5")
    assert actual["state"] == "cut short: stopped by the user"
    np.testing.assert_array_equal(actual["data"], frames_of(np.arange(4)))
    assert len(held(tmp_path / "a.h5")["data"]) == 3


def test_a_killed_run_leaves_an_older_file_and_what_it_recorded(tmp_path):
    stream(Feed(3), tmp_path / "a.h5")
    before = (tmp_path / "a.h5").read_bytes()
    child = started(tmp_path / "a.h5", watched=tmp_path / "a-partial.h5")
    child.kill()
    child.wait(60)
    assert (tmp_path / "a.h5").read_bytes() == before
    with h5py.File(tmp_path / "a-partial.h5", swmr=True, locking=False) as file:
        assert file["/entry/state"].asstr()[()] == "under way"
        np.testing.assert_array_equal(file[f"{DETECTOR}/data"][:1], frames_of([0]))


@pytest.mark.parametrize("overwrite", [False, True])
def test_of_two_runs_at_once_each_keeps_its_recording(tmp_path, overwrite):
    path = tmp_path / "a.h5"
    with io.StreamRecorder(Feed(6), path, overwrite=overwrite) as first:
        second = io.StreamRecorder(Feed(4), path, overwrite=overwrite)
        second.__enter__()
        drain(first)
        wait_for(path)
        drain(second)
        with pytest.raises(io.InputError, match=r"a\.h5 was made by another program meanwhile"):
            second.__exit__(None, None, None)
    assert (first.file, second.file) == (path, tmp_path / "a-partial.h5")
    assert [len(held(item.file)["data"]) for item in (first, second)] == [6, 4]
    assert [held(item.file)["state"] for item in (first, second)] == ["complete"] * 2


def test_a_recording_without_hard_links_has_its_name_all_the_same(older, monkeypatch):
    def unable(*_):
        raise OSError(errno.EPERM, "unable")

    monkeypatch.setattr(os, "link", unable)
    stream(Feed(5), older, overwrite=True)
    stream(Feed(5), older.with_stem("other"))
    assert names(older.parent) == sorted([older.name, older.with_stem("other").name])


def test_the_target_of_a_link_is_replaced_and_the_link_stays(tmp_path):
    (tmp_path / "far").mkdir()
    stream(Feed(3), tmp_path / "far" / "a.h5")
    (tmp_path / "a.h5").symlink_to(tmp_path / "far" / "a.h5")
    stream(Feed(7), tmp_path / "a.h5", overwrite=True)
    assert (tmp_path / "a.h5").is_symlink()
    assert len(held(tmp_path / "far" / "a.h5")["data"]) == 7
    assert names(tmp_path / "far") == ["a.h5"]


def drain(recorder):
    while recorder.read() is not None:
        pass


def wait_for(path):
    until = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < until
        time.sleep(0.001)


# What is left when something fails.


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (KeyboardInterrupt(), "stopped by the user"),
        (SystemExit(1), "the program was ended"),
        (io.InputError("the camera is lost: plug it in\nagain"), "the camera is lost: plug it in"),
        (RuntimeError(), "RuntimeError"),
        (ValueError("ä" * 300), "ä" * 114),
    ],
)
def test_what_was_taken_is_kept_whatever_ends_it(tmp_path, error, why):
    source = Feed(20, (3,), fails=(11, error))
    with pytest.raises(type(error)):
        stream(source, tmp_path / "a.h5")
    assert source.left
    actual = held(tmp_path / "a.h5")
    assert actual.pop("state") == f"cut short: {why}"
    assert {len(values) for values in actual.values()} == {12}
    np.testing.assert_array_equal(actual["travel"], 0.01 * np.arange(12) + 0.001)
    with io.open_recording(tmp_path / "a.h5") as recording:
        assert recording.state == f"cut short: {why}"
        np.testing.assert_array_equal(read_all(recording, 5).frames, frames_of(np.arange(12)))


def test_positions_that_cannot_be_corrected_stay_and_their_error_is_reported(tmp_path):
    class Lost(Feed):
        def positions(self):
            raise ZeroDivisionError("no reports")

    with pytest.raises(ZeroDivisionError):
        stream(Lost(5), tmp_path / "a.h5")
    actual = held(tmp_path / "a.h5")
    assert actual["state"] == "cut short: no reports"
    np.testing.assert_array_equal(actual["travel"], 0.01 * np.arange(5))
    with pytest.raises(io.InputError, match="camera"):
        stream(Lost(5, fails=(3, io.InputError("camera"))), tmp_path / "b.h5")
    assert held(tmp_path / "b.h5")["state"] == "cut short: camera"


def test_the_source_is_left_before_the_disk_is_waited_for(tmp_path, monkeypatch):
    source, append = Feed(3), streaming.GrowingRecording.append

    def waits(self, block):
        until_left.wait(60)
        append(self, block)

    until_left = threading.Event()
    source.__class__ = type("Telling", (Feed,), {"__exit__": lambda self, *error: until_left.set()})
    monkeypatch.setattr(streaming.GrowingRecording, "append", waits)
    stream(source, tmp_path / "a.h5")
    assert until_left.is_set()
    assert len(held(tmp_path / "a.h5")["data"]) == 3


def test_a_disk_that_is_too_slow_ends_it_and_nothing_waits(tmp_path, monkeypatch):
    append, released = streaming.GrowingRecording.append, threading.Event()

    def slow(self, block):
        assert released.wait(60)
        append(self, block)

    class Released(Feed):
        def __exit__(self, *error):
            released.set()

    monkeypatch.setattr(streaming.GrowingRecording, "append", slow)
    monkeypatch.setattr(streaming, "_BACKLOG", 6 * 35)
    with pytest.raises(io.InputError, match=r"a\.h5: the disk is too slow: 0 MB of frames wait for it; take"):
        stream(Released(20, (2,)), tmp_path / "a.h5")
    actual = held(tmp_path / "a.h5")
    assert actual["state"].startswith("cut short: ")
    assert "the disk is too slow" in actual["state"]
    np.testing.assert_array_equal(actual["data"], frames_of(np.arange(6)))


FULL = r"a\.h5: the disk is full \(File too large\); make room, or choose another place with -o"


def hold_full(path, limit):
    """Hold a recording that filled its disk to be sound."""
    actual = held(path)
    assert re.fullmatch(f"cut short: .*{FULL}", actual.pop("state"))
    (count,) = {len(values) for values in actual.values()}
    assert count >= 40
    np.testing.assert_array_equal(actual["data"], frames_of(np.arange(count), (100, 300)))
    np.testing.assert_array_equal(actual["travel"], 0.01 * np.arange(count) + 0.001)
    assert path.stat().st_size <= limit


def test_a_full_disk_keeps_what_it_took(tmp_path):
    limit = 5_000_000
    code = f"""
import resource
from growing import Feed, stream
from mirrorskin import io
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, resource.RLIM_INFINITY))
try:
    stream(Feed(10**6, (3, 1), shape=(100, 300), announced=200), "a.h5")
except io.InputError as error:
    print(error)
"""
    text = subprocess.run(
        [sys.executable, "-B", "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.fspath(SUPPORT)},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert re.fullmatch(FULL + "\n", text.stdout)
    assert not text.stderr
    hold_full(tmp_path / "a.h5", limit)


def test_a_disk_that_promises_nothing_is_believed(tmp_path, monkeypatch):
    def unable(*_):
        raise OSError(errno.EOPNOTSUPP, "unable")

    monkeypatch.setattr(os, "posix_fallocate", unable)
    stream(Feed(20), tmp_path / "a.h5")
    assert len(held(tmp_path / "a.h5")["data"]) == 20
