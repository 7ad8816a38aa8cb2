"""Recordings in progress or with a killed writer, and the results of their live runs."""

from __future__ import annotations

import random
import re
import signal
import time

import h5py
import numpy as np
import pytest
from commands import run
from growing import SHAPE, Feed, frames_of, started, stream
from stacks import MadeUp, ball, read_all

from mirrorskin import engine, io
from mirrorskin.io.storage.atomic import remove_leftovers

DETECTOR, STAGE = "/entry/instrument/detector", "/entry/instrument/stage"


def kill(child):
    child.send_signal(signal.SIGKILL)
    assert child.wait(60) == -signal.SIGKILL


def opened(path, **options):
    """Open a recording as soon as it holds two frames."""
    until = time.monotonic() + 60
    while True:
        try:
            return io.open_recording(path, **options)
        except io.InputError as error:
            if "at least 2 are needed" not in str(error) or time.monotonic() > until:
                raise
        time.sleep(0.01)


def hold(recording):
    """Hold a recording of a feed to be right: every frame, and whatever is told of it."""
    count = recording.shape[0]
    actual = read_all(recording, 7)
    np.testing.assert_array_equal(actual.frames, frames_of(np.arange(count)))
    np.testing.assert_array_equal(actual.travel, 0.01 * np.arange(count))
    assert len(actual.time) == len(recording.used) == len(recording.dropped) == count
    assert recording.used.all()
    assert np.all(np.diff(actual.time) >= 0)
    return count


@pytest.mark.parametrize("packing", ["raw", "bitshuffle"])
def test_others_watch_while_it_grows_and_what_is_left_when_it_is_killed_is_sound(tmp_path, packing):
    path = tmp_path / "a.h5"
    child = started(path, packing)
    try:
        counts = []
        while len(counts) < 4 or counts[-1] == counts[0]:
            with opened(path) as recording:
                assert recording.state == "under way"
                before = recording.fingerprint()
                counts.append(hold(recording))
                assert recording.how.startswith("chunks read" if packing == "raw" else "chunks decoded")
                assert recording.fingerprint() == before
        assert sorted(counts) == counts
        facts = io.describe(path)
        assert (facts["kind"], facts["state"]) == ("recording", "under way")
        assert re.fullmatch(r"(\d+) of \1 frames", facts["used"])
        for replaces in ("nothing", "derived", "anything"):
            with pytest.raises(io.InputError, match="is being written by another program"):
                io.check_output(path, replaces=replaces)
    finally:
        kill(child)
    with io.open_recording(path) as recording:
        assert hold(recording) >= counts[-1]
        assert recording.state == "cut short: its writer was killed"
        whole = recording.fingerprint()
    with io.open_recording(path) as recording:
        assert recording.fingerprint() == whole
    with io.open_recording(path, frames=(0, 2)) as recording:
        np.testing.assert_array_equal(read_all(recording, 5).frames, frames_of([0, 1]))
    stream(Feed(4), path, overwrite=True)  # since its writer is gone
    with io.open_recording(path) as recording:
        assert recording.fingerprint() != whole


@pytest.mark.parametrize("packing", ["raw", "bitshuffle", "lzf"])
def test_kill_loses_nothing_that_a_reader_has_seen(tmp_path, packing):
    path = tmp_path / "a.h5"
    child = started(path, packing, rate=2000)
    try:
        with opened(path) as recording:
            first = recording.shape[0]
        count = first
        while count == first:  # it is written out as it grows
            assert child.poll() is None
            with opened(path) as recording:
                count = recording.shape[0]
        time.sleep(random.uniform(0.0, 0.3))  # to be killed at any moment between two writes
    finally:
        kill(child)
    with io.open_recording(path) as recording:
        assert hold(recording) >= count
    remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [path]


# What a live run used, where it thought the body was.

USED = np.array([1, 1, 0, 1, 0, 0, 1, 1, 1, 1, 0, 1], bool)


def run_live(path, packing="raw", motion="vertical"):
    with io.StreamRecorder(Feed(len(USED), motion=motion), path, packing) as recorder:
        recorder.read()
        recorder.mark(0, USED)
        while recorder.read() is not None:
            pass
    return path


@pytest.mark.parametrize("motion", ["vertical", "axial"])
@pytest.mark.parametrize("packing", ["raw", "bitshuffle"])
def test_live_reads_the_used_frames_at_their_live_positions(tmp_path, motion, packing):
    path = run_live(tmp_path / "a.h5", packing, motion)
    where = "travel" if motion == "vertical" else "phase"
    numbers = np.flatnonzero(USED)
    with io.open_recording(path, live=True) as recording:
        for count in (1, 2, 40):
            actual = read_all(recording, count)
            np.testing.assert_array_equal(actual.frames, frames_of(numbers))
            np.testing.assert_array_equal(getattr(actual, where), 0.01 * numbers)
            np.testing.assert_array_equal(actual.time, numbers)
            recording.rewind()
        assert recording.shape == (len(numbers), *SHAPE)
        assert recording.full_shape == (len(USED), *SHAPE)
        assert recording.used.all()
        assert recording.which == "0:12, used live"
    with io.open_recording(path, live=True, frames=(2, 9), region=io.Region((1, 4), (2, 7))) as recording:
        part = numbers[(numbers >= 2) & (numbers < 9)]
        actual = read_all(recording, 3)
        np.testing.assert_array_equal(actual.frames, frames_of(part)[:, 1:4, 2:7])
        np.testing.assert_array_equal(getattr(actual, where), 0.01 * part)
        assert recording.which == "2:9, used live"
    with io.open_recording(path) as recording:
        assert recording.which == "0:12"


@pytest.mark.parametrize(
    ("prepare", "options", "line"),
    [
        ("mark", {}, r"a\.h5: a live run used 1 frames: at least 2 are needed; leave --live out"),
        ("used", {}, r"a\.h5 does not state which frames a live run used: leave --live out"),
        ("live", {}, r"a\.h5 contains no positions of a live run: leave --live out"),
        ("", {"travel": np.arange(9)}, r"a live run has its own positions: leave --live out, or those given"),
        ("lost", {}, r"travel_live of the frames that were used is nan at frame 3"),
    ],
)
def test_live_is_refused_where_there_was_no_live_run(tmp_path, prepare, options, line):
    stream(Feed(9), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        if prepare == "mark":
            file[f"{DETECTOR}/used"][1:] = 0
        elif prepare == "used":
            del file[f"{DETECTOR}/used"]
        elif prepare == "live":
            del file[f"{STAGE}/travel_live"]
        elif prepare == "lost":
            file[f"{STAGE}/travel_live"][3:5] = np.nan
    with pytest.raises(io.InputError, match=line):
        io.open_recording(tmp_path / "a.h5", live=True, **options)


def cut_short(path, damaged):
    """Leave the checksums of the first five frames of a run that was killed, and damage a frame."""
    stream(Feed(9), path)
    with h5py.File(path, "r+") as file:
        file["/entry/state"][()] = "under way"
        file[f"{DETECTOR}/frame_checksum"].resize(5, axis=0)
        file[f"{DETECTOR}/data"][damaged, 2, 3] ^= 1
    return io.open_recording(path)


def test_frames_whose_checksums_were_not_written_any_more_are_read(tmp_path):
    with cut_short(tmp_path / "a.h5", 7) as recording:
        assert len(read_all(recording, 4).frames) == 9


def test_a_damaged_frame_of_a_run_that_was_killed_is_refused(tmp_path):
    with cut_short(tmp_path / "a.h5", 4) as recording, pytest.raises(io.InputError, match="frame 4 differs"):
        read_all(recording, 4)


def test_only_the_frames_that_a_live_run_used_are_verified(tmp_path):
    path = run_live(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        file[f"{DETECTOR}/data"][np.flatnonzero(~USED)[1], 2, 3] ^= 1
    with io.open_recording(path, live=True) as recording:
        assert len(read_all(recording, 40).frames) == np.count_nonzero(USED)


def test_a_live_run_is_reconstructed_again_from_its_recording(tmp_path):
    travel = np.linspace(0.0, 1.0, 24)
    twin = ball((9, 11), (0.3, 0.3), travel)
    frames, used = np.concatenate([twin.read().frames.copy() for _ in travel]), np.arange(24) % 5 != 2

    class Press(Feed):
        def read(self, out=None, /):
            block = super().read(out)
            if block is None:
                return None
            part = slice(block.index, block.index + len(block.frames))
            return io.Block(frames[part], block.index, block.time, travel=travel[part], stays_valid=True)

        def positions(self):
            return {"travel": travel + 0.05}

    source = Press(24, (4,), shape=(9, 11), dtype=frames.dtype)
    with io.StreamRecorder(source, tmp_path / "a.h5") as recorder:
        while recorder.read() is not None:
            pass
        recorder.mark(0, used)
    ended = run("reconstruct", tmp_path / "a.h5", "--live", "-o", tmp_path / "r.h5")
    assert ended.code == 0, ended.said
    expected = engine.reconstruct(MadeUp(frames[used], source.header, travel=travel[used]))
    np.testing.assert_array_equal(io.open_result(tmp_path / "r.h5").height, expected.height)
    assert np.isfinite(expected.height).any()
