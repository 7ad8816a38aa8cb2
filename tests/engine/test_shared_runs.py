"""Threads that run at once over one recording, operation or method: every result is that of one thread."""

from __future__ import annotations

import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import cv2
import h5py
import numpy as np
import pytest
from live_frames import press_frames, press_header, turn_header
from operations import CASES, Readable
from stacks import record

from mirrorskin import engine, io
from mirrorskin.io.files.arrays import ArrayRecording
from mirrorskin.io.files.zarr_export import save_zarr
from mirrorskin.io.model.calibration import CameraId
from mirrorskin.twin import Axial, Twin, Vertical

THREADS, RUNS = 4, 4  # runs of each thread
SHAPE = (24, 20, 28)
FRAMES = press_frames(SHAPE)
TRAVEL = 0.05 * np.arange(SHAPE[0])
LEVELS = {"dark": 16.0, "bright": 224.0}
SMALL = 4 * FRAMES[0].nbytes  # a memory limit of two frames at a time


@pytest.fixture(autouse=True)
def _threads_change_often():
    """Let threads take turns ten times as often as they do by default."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(before / 10)
    yield
    sys.setswitchinterval(before)


def content(result):
    """Return all maps of a result as bytes, by name."""
    return {name: np.asarray(values).tobytes() for name, values in result.items()}


def assert_as_alone(*calls):
    """Run each call alone, then all of them again and again in threads that start together."""
    alone = [content(call()) for call in calls]
    start = threading.Barrier(THREADS)

    def run(number):
        start.wait(60)
        places = [(number + turn) % len(calls) for turn in range(RUNS)]
        return [(place, content(calls[place]())) for place in places]

    with ThreadPoolExecutor(THREADS) as pool:
        results = [result for each in pool.map(run, range(THREADS)) for result in each]
    wrong = {name for place, maps in results for name in maps if maps[name] != alone[place][name]}
    assert not wrong


def recorded(folder, compression="raw"):
    return record(Readable(FRAMES, press_header(), travel=TRAVEL), folder / "press.h5", compression)


def pictures(folder):
    for number, frame in enumerate(FRAMES):
        cv2.imwrite(str(folder / f"frame{number:03}.png"), frame)
    return folder


def video(folder):
    settings = [cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    code, path = cv2.VideoWriter_fourcc(*"FFV1"), str(folder / "press.avi")
    writer = cv2.VideoWriter(path, cv2.CAP_FFMPEG, code, 25.0, SHAPE[:0:-1], settings)
    for frame in FRAMES:
        writer.write(frame)
    writer.release()
    return path


def zarr(folder):
    save_zarr(recorded(folder), folder / "press.zarr")
    return folder / "press.zarr"


def saved(folder):
    np.save(folder / "press.npy", FRAMES)
    return folder / "press.npy"


class Own:
    """A source of the user's own around another one."""

    def __init__(self, source):
        self.inner, self.name, self.header, self.motion = source, "own", source.header, source.motion
        self.shape, self.dtype, self.rewindable = source.shape, source.dtype, True

    def rewind(self):
        self.inner.rewind()

    def read(self, out=None, /):
        return self.inner.read(out)


def calibrated(recording):
    return io.Calibrated(recording, io.Calibration(CameraId("", SHAPE[1:], FRAMES.dtype)))


FILES = {
    "HDF5": recorded,
    "compressed HDF5": lambda folder: recorded(folder, "gzip"),
    "Zarr": zarr,
    "folder of pictures": pictures,
    "video": video,
    "NPY": saved,
}
SOURCES = {
    "array": lambda: ArrayRecording(FRAMES, {"travel": TRAVEL}, {}),
    "twin": lambda: Twin(object="sphere", shape=SHAPE[1:], pixel_size=0.26, movement=Vertical(TRAVEL)),
    "own source": lambda: Readable(FRAMES, press_header(), travel=TRAVEL),
}
DOORS = {
    "run": lambda source: engine.run(source, engine.Onset(**LEVELS, memory_limit=SMALL)),
    "reconstruct": lambda source: engine.reconstruct(source, memory_limit=SMALL),
}


def assert_one_source_serves_all_threads(door, *sources):
    assert_as_alone(*(lambda source=source: DOORS[door](source) for source in sources))


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("kind", FILES)
def test_one_open_file_gives_each_thread_what_one_thread_gets(tmp_path, kind, door):
    options = {} if kind in ("HDF5", "compressed HDF5", "Zarr") else {"travel": TRAVEL}
    with io.open_recording(FILES[kind](tmp_path), **options) as recording:
        assert_one_source_serves_all_threads(door, recording)


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("kind", SOURCES)
def test_one_source_gives_each_thread_what_one_thread_gets(kind, door):
    assert_one_source_serves_all_threads(door, SOURCES[kind]())


@pytest.mark.parametrize("derive", [calibrated, Own], ids=["calibrated", "own"])
def test_sources_that_read_one_recording_do_not_disturb_each_other(tmp_path, derive):
    with io.open_recording(recorded(tmp_path)) as recording:
        assert_one_source_serves_all_threads("run", recording, derive(recording), derive(recording))


def test_a_check_next_to_runs_does_not_disturb_them(tmp_path):
    with io.open_recording(recorded(tmp_path)) as recording:
        run = DOORS["run"]

        def check_and_run():
            io.check(recording)
            return run(recording)

        assert_as_alone(check_and_run, lambda: run(recording))


@pytest.mark.parametrize("kind", ["chunks of several frames", "video"])
def test_single_frames_next_to_a_run_do_not_disturb_it(tmp_path, kind):
    """Both unpack chunks into the same memory, and use the same decoder."""
    path, finished = tmp_path / "chunks.h5", threading.Event()
    if kind == "video":
        path = video(tmp_path)
    else:
        with h5py.File(path, "w") as file:
            file.create_dataset("frames", data=FRAMES, chunks=(8, *SHAPE[1:]), compression="gzip")
    limit = 1 if kind == "video" else None  # decoded again, instead of kept
    with io.open_recording(path, travel=TRAVEL, motion="vertical", memory_limit=limit) as recording:

        def run():
            try:
                return [content(DOORS["run"](recording)) for _ in range(THREADS * RUNS)]
            finally:
                finished.set()

        expected = content(DOORS["run"](recording))
        with ThreadPoolExecutor(1) as pool:
            running = pool.submit(run)
            while not finished.is_set():
                for number in (0, 20, 9):
                    np.testing.assert_array_equal(recording.frame(number), FRAMES[number])
            assert all(result == expected for result in running.result())


@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_one_operation_gives_each_thread_what_one_thread_gets(name):
    case = CASES[name]
    shared, sources = case.make(), [case.source(), case.source()]
    sources[1].frames = 255 - sources[1].frames
    assert_as_alone(*(lambda source=source: engine.run(source, shared) for source in sources))


@pytest.mark.parametrize("frames", [FRAMES, list(FRAMES)], ids=["an array", "frame by frame"])
@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_one_operation_gives_each_thread_what_one_thread_gets_of_arrays(frames):
    shared = engine.Onset(**LEVELS)
    inverse = 240 - FRAMES if isinstance(frames, np.ndarray) else list(240 - FRAMES)
    assert_as_alone(
        lambda: engine.run(frames, shared, travel=TRAVEL), lambda: engine.run(inverse, shared, travel=TRAVEL)
    )


class Total(engine.Operation):
    """An operation of the user's own with a state that other runs would change."""

    total = io.Map("sum of the frames", "counts", dtype="int64")

    def start(self, shape, dtype):
        self.sum = np.zeros(shape, np.int64)

    def push(self, frames):
        for frame in frames:
            self.sum = self.sum + frame

    def result(self):
        return {"total": self.sum}


class Reused(engine.Method):
    """A method whose plans share one operation."""

    operation = Total(memory_limit=SMALL)

    def plan(self, source):
        return engine.base.method.Plan(self.operation)


def turn():
    case = CASES["Normals"]
    return Readable(case.frames, turn_header(), **case.positions)


METHODS = {
    "Press": (engine.Press(**LEVELS, memory_limit=SMALL), lambda: SOURCES["own source"]()),
    "Rotation": (engine.Rotation(memory_limit=SMALL), turn),
    "own method": (Reused(), lambda: SOURCES["own source"]()),
}


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_one_method_gives_each_thread_what_one_thread_gets(name):
    method, make = METHODS[name]
    sources = [make(), make()]
    sources[1].frames = 255 - sources[1].frames
    assert_as_alone(*(lambda source=source: method.run(source) for source in sources))


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.function])
@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_functions_on_arrays_give_each_thread_what_one_thread_gets(name):
    case = CASES[name]
    stacks = case.frames, np.ascontiguousarray(255 - case.frames)
    assert_as_alone(
        *(lambda frames=frames: case.function(frames, **case.given, **case.options) for frames in stacks)
    )


def test_fusions_that_share_recordings_give_each_thread_what_one_thread_gets():
    size, pixel = (24, 24), 0.26
    common = {"object": "sphere", "shape": size, "pixel_size": pixel}
    movement = Axial(np.pi / 4 * np.arange(8), tilt=0.05, press=1.0)
    rotation = Twin(**common, movement=movement, pattern="linear")
    press, other = (Twin(**common, movement=Vertical(step * np.arange(1, 12))) for step in (0.1, 0.11))
    assert_as_alone(
        lambda: engine.fuse(press, rotation),
        lambda: engine.fuse(other, rotation),
        lambda: engine.reconstruct(rotation),
        lambda: engine.reconstruct(press),
    )
