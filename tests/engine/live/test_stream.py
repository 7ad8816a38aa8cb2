"""Frames of the user's own camera: maps equal those of a recording, and faults reach the pushing thread."""

import asyncio
import gc
import math
import subprocess
import sys
import threading
import tracemalloc

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


def test_frames_may_be_overwritten_after_they_were_pushed(frames):
    buffer = np.empty(SHAPE, np.uint8)
    with stream() as pushed:
        for frame, travel in zip(frames, TRAVEL, strict=True):
            buffer[...] = frame
            pushed.push(buffer, travel=travel)
            buffer[...] = 0
        result = pushed.result()
    np.testing.assert_array_equal(result.height, engine.find_onset(frames, TRAVEL, **LEVELS).height)


def test_frames_are_pushed_from_any_thread(frames):
    with stream() as pushed:
        thread = threading.Thread(target=pushed.push, args=(frames,), kwargs={"travel": TRAVEL})
        thread.start()
        thread.join()
        assert pushed.result().process["frames"] == len(frames)


def test_each_update_is_told_with_its_latency(frames):
    told = []
    with stream(engine.Press(**LEVELS), on_update=lambda update, status: told.append(update)) as pushed:
        for frame, travel in zip(frames, TRAVEL, strict=True):
            pushed.push(frame, travel=travel, time=pushed.now() - 1.0)  # exposed a second ago
        pushed.result()
    assert told[-1].frames == len(frames)
    assert all(update.latency > 1.0 for update in told)


def test_an_error_of_the_function_that_is_told_is_raised_by_the_next_call(frames):
    def fail(update, status):
        raise ValueError("no room")

    pushed = stream(engine.Press(**LEVELS), on_update=fail)
    pushed.push(frames[0], travel=0.0)
    with pytest.raises(ValueError, match="no room"):
        pushed.result()


def test_updates_are_awaited_until_the_stream_is_closed(frames):
    async def watch(pushed):
        return [update async for update in pushed.updates()]

    with stream(engine.Press(**LEVELS)) as pushed:

        def play():
            pushed.push(frames, travel=TRAVEL)
            pushed.close()

        thread = threading.Thread(target=play)
        thread.start()
        seen = asyncio.run(watch(pushed))
        thread.join()
    assert seen[-1].frames == len(frames)
    assert len({update.frames for update in seen}) == len(seen)


def test_what_the_operation_refused_is_raised_to_who_awaits_updates():
    async def watch(pushed):
        async for _ in pushed.updates():
            pass

    def fail(update, status):
        raise ValueError("no room")

    pushed = stream(engine.Press(**LEVELS), on_update=fail)
    pushed.push(np.zeros(SHAPE, np.uint8), travel=0.0)
    with pytest.raises(ValueError, match="no room"):
        asyncio.run(watch(pushed))


def test_the_newest_maps_can_be_looked_at(frames):
    with stream(engine.Press(**LEVELS)) as pushed:
        assert pushed.latest() is None
        pushed.push(frames, travel=TRAVEL)
        pushed.result()
    newest = pushed.latest()
    assert newest.frames == len(frames)
    np.testing.assert_array_equal(newest.picture, frames[-1])
    assert np.isfinite(newest.height).any()


def test_a_picture_that_is_referred_to_is_not_changed():
    kept, frames = [], np.arange(40, dtype=np.uint8)[:, np.newaxis, np.newaxis] * np.ones(SHAPE, np.uint8)

    def keep(update, status):
        kept.append(update.picture[2:, 1:] if update.frames % 3 else update.picture)

    with Stream(engine.live.Frames(), SHAPE, latency=math.inf, trackers={}, on_update=keep) as pushed:
        pushed.push(frames)
    assert [int(part.min()) for part in kept] == [int(part.max()) for part in kept] == list(range(40))


@pytest.mark.parametrize("latency", [0.0, math.inf])
def test_in_the_steady_state_there_are_no_new_arrays_of_the_size_of_a_frame(latency):
    shape = (480, 640)
    frame = np.zeros(shape, np.uint8)
    brightness = {"brightness": lambda update: int(update.picture[::8, ::8].max())}
    updated = threading.Semaphore(0)
    with Stream(
        engine.live.Frames(),
        shape,
        latency=latency,
        trackers=brightness,
        on_update=lambda update, status: updated.release(),
    ) as pushed:
        for number in range(40):
            if number == 20:
                tracemalloc.start()
            pushed.push(frame, time=0.0)
            assert updated.acquire(timeout=60)
            assert pushed.latest().tracked["brightness"] == 0
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < 0.5 * frame.nbytes


def test_every_frame_is_counted(frames):
    with stream() as pushed:
        pushed.push(frames, travel=TRAVEL)
        pushed.result()
        status = pushed.status
    assert (status.used, status.skipped, status.dropped) == (len(frames), 0, 0)


def test_a_result_before_there_are_enough_frames_names_the_number_missing(frames):
    with stream() as pushed:
        pushed.push(frames[0], travel=0.0)
        with pytest.raises(io.InputError, match="needs at least 2 frames; 1 has been pushed so far"):
            pushed.result()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"travel": [0.1]}, r"travel has shape \(1,\): one number is needed of each frame"),
        ({"travel": [[0.1], [0.2]]}, r"travel has shape \(2, 1\): one number is needed of each frame"),
        ({"travel": np.nan}, "travel is nan at frame 0: every frame needs a finite number"),
        ({"travel": np.inf}, "travel is inf at frame 0"),
        ({"travel": "far"}, "travel is 'far': numbers are needed"),
        ({"travel": 1j}, "travel is 1j: numbers are needed"),
        ({"travel": None}, "travel is needed of each frame"),
        ({"travel": True}, "travel is of type bool: numbers are needed"),
        ({"travl": 0.1}, r"push\(\) has no position travl: did you mean travel\?"),
        (
            {"twist": 0.1},
            "frames have travel and twist, but earlier ones had travel. Push the same with each",
        ),
        ({"time": "noon"}, "time is 'noon': a number is needed"),
        ({"time": [0.1, 0.2]}, "time is a list: a number is needed"),
        ({"time": np.nan}, "time is nan: a finite number of seconds is needed"),
        ({"time": -1.0}, "time -1 s is before that of an earlier frame, .* s. Push frames in the order"),
        ({"frames": "none"}, "frames is 'none': numbers are needed"),
        ({"frames": np.zeros((3, 4), np.uint8)}, r"frames are uint8 \(3, 4\): uint8 \(24, 32\) are expected"),
        ({"frames": np.zeros(SHAPE, np.uint16)}, "frames are uint16"),
        ({"frames": np.zeros((1, 2, *SHAPE), np.uint8)}, "frames are uint8"),
    ],
)
def test_what_cannot_be_used_is_refused_where_it_is_pushed_and_changes_nothing(frames, change, line):
    with stream() as pushed:
        pushed.push(frames[0], travel=TRAVEL[0])
        with pytest.raises(io.InputError, match=line) as caught:
            pushed.push(**{"frames": frames[1], "travel": TRAVEL[1], **change})
        assert "\n" not in str(caught.value)
        pushed.push(frames[1:], travel=TRAVEL[1:])
        result = pushed.result()
    np.testing.assert_array_equal(result.height, engine.find_onset(frames, TRAVEL, **LEVELS).height)


@pytest.mark.parametrize("place", [0.1, [0.1], [0.1, 0.2, 0.3], [[0.1, 0.2]], [0.1, np.nan]])
def test_a_displacement_that_is_not_two_numbers_is_refused_where_it_is_pushed(place):
    operation = engine.slip.SlipOnset(pixel_size=0.1)
    with stream(operation, motion="horizontal") as pushed, pytest.raises(io.InputError, match="displacement"):
        pushed.push(np.zeros(SHAPE, np.uint8), displacement=place)


def test_a_tilt_that_the_operation_needs_is_asked_for_where_frames_are_pushed():
    operation = engine.rotation.MovingNormals(zenith_gain=300.0)
    with stream(operation) as pushed, pytest.raises(io.InputError, match="tilt is needed of each frame"):
        pushed.push(np.zeros(SHAPE, np.uint8), phase=0.1)


def test_a_rotation_without_tilts_is_processed():
    counts = np.random.default_rng(0).integers(0, 255, (8, *SHAPE)).astype(np.uint8)
    phase = np.arange(8) * np.pi / 4
    with stream(engine.Correlate(), motion="axial") as pushed:
        pushed.push(counts, phase=phase)
        result = pushed.result()
    np.testing.assert_array_equal(result.mean, engine.correlate(counts, phase).mean)


def test_times_that_run_backwards_are_refused_and_no_frame_is_lost(frames):
    with Stream(engine.Onset(**LEVELS), SHAPE) as pushed:
        pushed.push(frames[0], travel=TRAVEL[0], time=1e6)
        for number in range(1, len(frames)):
            with pytest.raises(io.InputError, match="is before that of an earlier frame, 1e\\+06 s"):
                pushed.push(frames[number], travel=TRAVEL[number], time=1e6 - number)
        pushed.push(frames[-1], travel=TRAVEL[-1], time=2e6)
        pushed.result()
        assert (pushed.status.used, pushed.status.skipped) == (2, 0)


class Brightest(engine.Operation):
    """The largest sample of each pixel."""

    brightest = io.Map("largest sample", "counts")

    def start(self, shape, dtype):
        self._most = np.zeros(shape, dtype)

    def push(self, frames):
        np.maximum(self._most, frames.max(axis=0), out=self._most)

    def result(self):
        return {"brightest": self._most.astype(np.float32)}


def test_an_operation_that_takes_no_positions_needs_neither_them_nor_a_motion():
    with Stream(Brightest(), (4, 5), latency=math.inf) as stream:
        for counts in (10, 30, 20):
            stream.push(np.full((4, 5), counts, np.uint8))
        assert (stream.result().brightest == 30).all()


class Failing(engine.Operation):
    """It fails at a frame with a count above 200."""

    motions = ("vertical",)

    def push(self, frames, *, travel):
        if frames.max() > 200:
            raise io.InputError("the lamp is too bright")

    def result(self):
        return {"height": np.zeros(self.shape)}


def failed(latency=math.inf):
    """Return a stream whose last frame cannot be processed."""
    pushed = Stream(Failing(), SHAPE, latency=latency)
    pushed.push(np.full(SHAPE, 255, np.uint8), travel=0.0)
    return pushed


@pytest.mark.parametrize("latency", [0.1, math.inf])
def test_an_error_in_the_last_frames_is_raised_by_close(latency):
    with pytest.raises(io.InputError, match="the lamp is too bright"):
        failed(latency).close()


def test_an_error_in_the_last_frames_is_raised_at_the_end_of_with():
    with pytest.raises(io.InputError, match="the lamp is too bright"), failed():
        pass


def test_close_raises_an_error_once():
    pushed = failed()
    with pytest.raises(io.InputError, match="the lamp is too bright"):
        pushed.close()
    pushed.close()


def test_close_does_not_raise_an_error_that_was_raised_before():
    pushed = failed()
    with pytest.raises(io.InputError, match="the lamp is too bright"):
        pushed.result()
    pushed.close()


def test_an_error_inside_with_is_not_hidden_by_that_of_a_frame():
    with pytest.raises(KeyError, match="first"), failed():
        raise KeyError("first")


def reader_of(pushed):
    """Return the thread of a stream."""
    before = set(threading.enumerate())
    pushed_stream = pushed()
    (thread,) = set(threading.enumerate()) - before
    return pushed_stream, thread


@pytest.mark.parametrize("latency", [0.1, math.inf])
def test_a_forgotten_stream_ends_its_thread(frames, latency):
    pushed, thread = reader_of(lambda: Stream(engine.Onset(**LEVELS), SHAPE, latency=latency))
    pushed.push(frames, travel=TRAVEL)
    del pushed
    gc.collect()
    thread.join(60)
    assert not thread.is_alive()


LEFT_OPEN = """
import math
import numpy as np
from mirrorskin import engine

streams = [engine.live.Stream(engine.Onset(), (300, 400), latency=math.inf) for _ in range(2)]
for number in range(60):
    for stream in streams:
        stream.push(np.full((300, 400), 4 * number, np.uint8), travel=float(number))
del stream, streams[0]
"""


def test_a_program_that_leaves_streams_open_ends_cleanly():
    ended = subprocess.run([sys.executable, "-c", LEFT_OPEN], capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")


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
