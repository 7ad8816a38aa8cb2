"""GenICam cameras: Aravis' fake ones, in the library and as packets on loopback."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import numpy as np
import pytest

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import CameraSettings
from mirrorskin.hw.cameras import genicam
from mirrorskin.hw.cameras.genicam import DeviceClock, GenicamCamera, count_lost, load_aravis
from mirrorskin.hw.rig.rig import open_camera
from mirrorskin.io import InputError

SOON = 20.0  # seconds, that nothing here takes on the slowest machine
SERVER = "arv-fake-gv-camera-0.8"


def settings(source: str, **more) -> CameraSettings:
    return CameraSettings(**{"source": source, "size": (64, 48), **more})


@pytest.fixture
def aravis():
    try:
        library, _ = load_aravis()
    except InputError as error:
        pytest.skip(str(error))
    return library


@pytest.fixture
def fake(aravis) -> Iterator[str]:
    """The camera in the library."""
    aravis.enable_interface("Fake")
    yield "genicam:Fake_1"
    aravis.disable_interface("Fake")


@contextmanager
def sending(serial: str, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a camera that speaks GigE Vision on loopback."""
    with subprocess.Popen([SERVER, "-i", "127.0.0.1", "-s", serial, *options]) as process:
        try:
            time.sleep(0.3)
            yield process
        finally:
            process.kill()


@pytest.fixture
def served(aravis):
    if shutil.which(SERVER) is None:
        pytest.skip(f"there is no {SERVER}: apt install aravis-tools")
    return sending


def take(camera: GenicamCamera, count: int) -> tuple[np.ndarray, np.ndarray]:
    numbers: list[int] = []
    times: list[float] = []
    while len(numbers) < count:
        frames = camera.take(count - len(numbers), SOON)
        numbers += frames.number.tolist()
        times += frames.time.tolist()
    return np.array(numbers), np.array(times)


def wait_until(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + SOON
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize(("dtype", "limit"), [("uint8", 255), ("uint16", 65535)])
def test_the_rig_files_source_opens_it_with_the_size_and_type_asked_for(fake, dtype, limit) -> None:
    with closing(open_camera(settings(fake, dtype=dtype, rate=200.0, exposure=0.002, gain=1.0))) as camera:
        frames = camera.take(1, SOON)
    assert (frames.pixels.shape, frames.pixels.dtype) == ((1, 48, 64), dtype)
    assert limit / 4 < frames.pixels.max() <= limit
    assert frames.number.tolist() == [0]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"size": (4096, 48)}, r"cannot be set as the rig file says: \[Width\] Value '4096' greater than"),
        ({"gain": 99.0}, r"cannot be set as the rig file says: \[GainRaw\] Value '99' greater than"),
        (
            {"dtype": "uint16", "fourcc": "Mono12"},
            r"no format for dtype uint16 \(wanted: Mono12; there are .*",
        ),
        ({"dtype": "float32"}, r"no format for dtype float32 \(wanted: none"),
        ({"source": "genicam:4711"}, "camera genicam:4711 cannot be opened: .*; there are Fake_1$"),
    ],
)
def test_what_it_has_not_is_refused_in_one_line(fake, more, message) -> None:
    with pytest.raises(InputError, match=message) as refused:
        GenicamCamera(settings(**{"source": fake, **more}))
    assert "\n" not in str(refused.value)


def test_without_a_camera_the_first_one_is_refused(aravis) -> None:
    with pytest.raises(
        InputError, match=r"^camera genicam: there is none; see its cable, power and network$"
    ):
        GenicamCamera(settings("genicam:"))


def test_packets_become_frames_without_a_gap_also_where_its_counter_wraps(served) -> None:
    with served("MS1"), GenicamCamera(settings("genicam:MS1", rate=200.0), slots=300) as camera:
        numbers, times = take(camera, 200)  # its counter begins 135 frames before its end
        assert (camera.counts.dropped, camera.counts.reconnects) == (0, 0)
    assert numbers.tolist() == list(range(200))
    assert np.median(np.diff(times)) == pytest.approx(1 / 200, rel=0.02)


def test_one_that_another_program_uses_is_refused(served) -> None:
    with (
        served("MS4"),
        GenicamCamera(settings("genicam:MS4")),
        pytest.raises(InputError, match=r"^camera genicam:MS4 is used by another program: close that"),
    ):
        GenicamCamera(settings("genicam:MS4"))


def test_one_that_is_triggered_gives_a_frame_each_time_and_is_not_lost_meanwhile(served, monkeypatch) -> None:
    monkeypatch.setattr(genicam, "READ_TIMEOUT", 0.2)
    devices = []
    opening = GenicamCamera._open
    monkeypatch.setattr(GenicamCamera, "_open", lambda self: devices.append(opening(self)) or devices[-1])
    asked = settings("genicam:MS5", trigger="coolant", trigger_input="Software", rate=200.0)
    with served("MS5"), GenicamCamera(asked) as camera:
        for number in range(3):
            time.sleep(0.4)
            assert camera.counts.frames == number
            devices[0].software_trigger()
            assert camera.take(1, SOON).number.tolist() == [number]
        assert (camera.counts.dropped, camera.counts.reconnects) == (0, 0)
        devices.clear()


def test_the_exposure_can_be_changed_while_it_runs(fake) -> None:
    with closing(open_camera(settings(fake, exposure=0.004, rate=100.0))) as camera:
        before = camera.take(1, SOON).pixels.max()
        assert camera.set_exposure(0.001) == pytest.approx(0.001, rel=0.01)
        camera.flush()
        camera.take(3, SOON)
        assert camera.take(1, SOON).pixels.max() < before


def test_an_input_that_it_has_not_is_refused(fake) -> None:
    with pytest.raises(
        InputError, match=r"cannot be set as the rig file says: \[TriggerSource\] 'Line7' not"
    ):
        GenicamCamera(settings(fake, trigger="coolant", trigger_input="Line7"))


def test_frames_that_lose_packets_are_counted_as_lost(served) -> None:
    with served("MS2", "-r", "100"), GenicamCamera(settings("genicam:MS2", rate=200.0), slots=300) as camera:
        numbers, _ = take(camera, 50)
        counts = camera.counts
    assert counts.dropped > 0
    assert counts.frames + counts.dropped == numbers[-1] + 1


def test_a_camera_that_is_lost_comes_back_and_its_numbers_go_on(served, monkeypatch, caplog) -> None:
    monkeypatch.setattr(genicam, "READ_TIMEOUT", 0.5)
    with served("MS3") as process:
        camera = GenicamCamera(settings("genicam:MS3", rate=50.0), slots=300)
        take(camera, 60)
        process.kill()
        wait_until(lambda: "delivers no picture: it was lost after" in caplog.text)
        frames, latest = camera.counts.frames, camera.latest
        camera.flush()
        with pytest.raises(HardwareError, match=r"was lost .* s ago and is not back yet$"):
            camera.take(1, 0.1)
    with served("MS3"), camera:
        back = camera.take(1, SOON)
        assert (camera.counts.reconnects, camera.error) == (1, None)
    missing = back.number[0] - frames
    assert missing == pytest.approx(50 * (back.time[0] - latest), rel=0.25)
    assert camera.counts.dropped == missing


def test_without_the_library_the_remedy_is_reported(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "gi", None)
    with pytest.raises(
        InputError, match=r"need Aravis, which is not installed .*pip install 'mirrorskin\[genicam\]'$"
    ):
        GenicamCamera(settings("genicam:"))


@pytest.mark.parametrize(
    ("before", "number", "lost"),
    [(7, 8, 0), (7, 11, 3), (65535, 1, 0), (65534, 3, 3), (2**40, 2**40 + 2, 1), (2**40, 1, 0), (0, 0, 0)],
)
def test_lost_frames_are_what_its_numbers_leave_out(before, number, lost) -> None:
    assert count_lost(before, number) == lost


@pytest.mark.parametrize("drift", [50e-6, -50e-6])
def test_a_cameras_clock_removes_the_jitter_of_arrival_and_follows_the_drift(drift) -> None:
    random = np.random.default_rng(1)
    exposed = 1000 + np.arange(0, 120, 0.02)
    stamps = (exposed - 400) * (1 + drift)  # a clock of its own
    read = exposed + 0.003 + random.exponential(0.002, len(exposed))
    clock = DeviceClock()
    arrivals = np.array([clock.arrival(*pair) for pair in zip(stamps, read, strict=True)])
    late = arrivals - exposed - 0.003
    assert (arrivals <= read).all()
    assert (np.diff(arrivals) >= 0).all()
    assert np.abs(late[50:]).max() < 5 * 50e-6 + 0.0005


def test_a_clock_that_is_set_or_does_not_run_gives_the_time_of_reading() -> None:
    clock = DeviceClock()
    assert [clock.arrival(*pair) for pair in ((5.0, 10.0), (6.0, 11.5), (0.0, 12.0), (0.0, 13.0))] == [
        10.0,
        11.0,
        12.0,
        13.0,
    ]
