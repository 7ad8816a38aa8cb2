"""Frames of the user's own camera: maps equal those of a recording, and faults reach the pushing thread."""

import math
import threading

import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.engine.live import Stream

TRAVEL = 0.05 * np.arange(40)
LEVELS = {"dark": 30.0, "bright": 200.0, "noise": 1.0}
SHAPE = (24, 32)


@pytest.fixture(scope="module")
def frames():
    onset = np.random.default_rng(2).uniform(0.2, 1.8, SHAPE)
    light = np.clip((TRAVEL[:, None, None] - onset) / 0.08 + 0.5, 0, 1)
    return np.rint(30 + 170 * light).astype(np.uint8)


def stream(operation=None, **more):
    return Stream(operation or engine.Onset(**LEVELS), SHAPE, latency=math.inf, **more)


def test_the_result_is_that_of_the_function_on_arrays(frames):
    with stream() as pushed:
        for frame, travel in zip(frames, TRAVEL, strict=True):
            pushed.push(frame, travel=travel)
        found = pushed.result()
    expected = engine.find_onset(frames, TRAVEL, **LEVELS)
    np.testing.assert_array_equal(found.height, expected.height)
    np.testing.assert_array_equal(found.height_sigma, expected.height_sigma)


def test_several_frames_are_pushed_at_once(frames):
    with stream() as pushed:
        pushed.push(frames[:25], travel=TRAVEL[:25])
        pushed.push(frames[25:], travel=TRAVEL[25:])
        found = pushed.result()
    np.testing.assert_array_equal(found.height, engine.find_onset(frames, TRAVEL, **LEVELS).height)


def test_frames_may_be_overwritten_after_they_were_pushed(frames):
    room = np.empty(SHAPE, np.uint8)
    with stream() as pushed:
        for frame, travel in zip(frames, TRAVEL, strict=True):
            room[...] = frame
            pushed.push(room, travel=travel)
            room[...] = 0
        found = pushed.result()
    np.testing.assert_array_equal(found.height, engine.find_onset(frames, TRAVEL, **LEVELS).height)


def test_frames_are_pushed_from_any_thread(frames):
    with stream() as pushed:
        thread = threading.Thread(target=pushed.push, args=(frames,), kwargs={"travel": TRAVEL})
        thread.start()
        thread.join()
        assert pushed.result().process["frames"] == len(frames)


def test_the_newest_maps_can_be_looked_at(frames):
    with stream(engine.Press(**LEVELS)) as pushed:
        assert pushed.latest() is None
        pushed.push(frames, travel=TRAVEL)
        pushed.result()
    newest = pushed.latest()
    assert newest.frames == len(frames)
    np.testing.assert_array_equal(newest.picture, frames[-1])
    assert np.isfinite(newest.height).any()


def test_every_frame_is_counted(frames):
    with stream() as pushed:
        pushed.push(frames, travel=TRAVEL)
        pushed.result()
        status = pushed.status
    assert (status.used, status.skipped, status.dropped) == (len(frames), 0, 0)


def test_a_result_before_there_are_enough_frames_says_how_many_are_missing(frames):
    with stream() as pushed:
        pushed.push(frames[0], travel=0.0)
        with pytest.raises(io.InputError, match="needs at least 2 frames; 1 has been pushed so far"):
            pushed.result()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"frames": np.zeros((3, 4), np.uint8)}, r"frames are uint8 \(3, 4\): uint8 \(24, 32\) are expected"),
        ({"frames": np.zeros(SHAPE, np.uint16)}, "frames are uint16"),
        ({"travel": None}, r"travel is needed of each frame: push\(frame, travel=\.\.\.\)"),
        ({"travel": [0.1, 0.2]}, "travel is needed of each frame"),
    ],
)
def test_what_does_not_fit_is_refused_at_once(frames, change, line):
    given = {"frames": frames[:1], "travel": [0.0], **change}
    given = {name: value for name, value in given.items() if value is not None}
    with stream() as pushed, pytest.raises(io.InputError, match=line):
        pushed.push(**given)


def test_what_the_operation_refuses_is_raised_where_frames_are_pushed(frames):
    with stream() as pushed:
        pushed.push(frames[:2], travel=[1.0, 0.5])  # a press does not go up
        with pytest.raises(io.InputError, match="travel"):
            pushed.result()
        with pytest.raises(io.InputError, match="travel"):
            pushed.push(frames[2], travel=1.0)


def test_a_closed_stream_takes_no_frames(frames):
    with stream() as pushed:
        pass
    with pytest.raises(io.InputError, match="the stream is closed"):
        pushed.push(frames[0], travel=0.0)


def test_the_motion_is_that_of_the_operation_or_given():
    with pytest.raises(io.InputError, match="Correlate applies to several motions: give motion"):
        Stream(engine.Correlate(), SHAPE)
    with stream(engine.Correlate(), motion="axial") as pushed, pytest.raises(io.InputError, match="phase is"):
        pushed.push(np.zeros(SHAPE, np.uint8))


def test_a_header_has_what_is_known(frames):
    header = io.Header("vertical", pixel_size=(0.1, 0.2))
    with stream(engine.Press(**LEVELS), header=header) as pushed:
        pushed.push(frames, travel=TRAVEL)
        assert pushed.result().x[1] - pushed.result().x[0] == pytest.approx(0.1)
    with pytest.raises(io.InputError, match="contradicts the header's"):
        stream(engine.Press(**LEVELS), header=header, motion="axial")


def test_operations_that_need_all_frames_twice_are_refused():
    with pytest.raises(io.InputError, match="needs all frames twice, so it cannot run live"):
        Stream(engine.ChangePoint(), SHAPE)
