from __future__ import annotations

import re
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import pytest

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import CameraSettings
from mirrorskin.hw.cameras import video
from mirrorskin.hw.cameras.camera_thread import FrameCounter
from mirrorskin.hw.cameras.video import VideoCamera, to_grey
from mirrorskin.io import InputError
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

SHAPE = (480, 640)
SMALL = (24, 32)
BYTE = np.dtype(np.uint8)
SOON = 60.0  # seconds, that nothing here takes


def settings(source, shape=SHAPE, dtype=BYTE, **more) -> CameraSettings:
    return CameraSettings(source=source, size=shape[::-1], dtype=np.dtype(dtype).name, **more)


def noise(count: int, shape=SMALL, dtype=np.uint8) -> np.ndarray:
    top = np.iinfo(dtype).max
    return np.random.default_rng(7).integers(0, top, (count, *shape), dtype=dtype, endpoint=True)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def take(opened: VideoCamera, count: int) -> tuple[np.ndarray, np.ndarray]:
    pixels: list[np.ndarray] = []
    numbers: list[int] = []
    while len(pixels) < count:
        frames = opened.take(count - len(pixels), SOON)
        pixels += [frame.copy() for frame in frames.pixels]
        numbers += frames.number.tolist()
    return np.array(pixels), np.array(numbers)


def play_out(opened: VideoCamera, timeout: float) -> None:
    """Take frames until there is an error."""
    while True:
        opened.take(10, timeout)


@pytest.fixture
def open_camera(clock):
    """Open cameras and films on simulated time, and close them in the end."""
    opened = []

    def open_it(source=0, shape=SMALL, dtype=BYTE, **more) -> VideoCamera:
        opened.append(VideoCamera(settings(str(source), shape, dtype, **more), 50, clock))
        return opened[-1]

    yield open_it
    for camera in opened:
        camera.close()


def wait_until(clock: Clock, holds: Callable[[], bool]) -> None:
    deadline = clock.now() + SOON
    while not holds():
        assert clock.now() < deadline
        clock.sleep(0.01)


def test_without_a_sender_there_is_no_camera() -> None:
    with pytest.raises(InputError, match=r"^camera tcp://127\.0\.0\.1:\d+ cannot be opened"):
        VideoCamera(settings(f"tcp://127.0.0.1:{free_port()}"))


def write_y4m(path, frames: np.ndarray, rate: int) -> None:
    rows, columns = frames.shape[1:]
    kind = "mono" if frames.dtype == np.uint8 else "mono16"
    with path.open("wb") as file:
        file.write(f"YUV4MPEG2 W{columns} H{rows} F{rate}:1 Ip A1:1 C{kind}\n".encode())
        for frame in frames:
            file.write(b"FRAME\n" + frame.tobytes())


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_grey_file_is_exact_to_its_end(open_camera, tmp_path, dtype) -> None:
    frames = noise(40, dtype=dtype)
    write_y4m(tmp_path / "film.y4m", frames, 400)
    opened = open_camera(tmp_path / "film.y4m", dtype=dtype)
    pixels, numbers = take(opened, 40)
    with pytest.raises(HardwareError, match=r"film.y4m has ended after 40 frames$"):
        opened.take(1, SOON)
    assert "has ended" in str(opened.error)
    counts = opened.counts
    np.testing.assert_array_equal(pixels, frames)
    assert numbers.tolist() == list(range(40))
    assert (counts.frames, counts.dropped, counts.reconnects) == (40, 0, 0)


def test_a_file_plays_at_its_own_rate(open_camera, clock, tmp_path) -> None:
    write_y4m(tmp_path / "film.y4m", noise(20), 50)
    begun = clock.now()
    opened = open_camera(tmp_path / "film.y4m")
    with pytest.raises(HardwareError, match="has ended"):
        play_out(opened, SOON)
    assert opened.latest - begun == pytest.approx(19 / 50)


def test_a_file_of_another_size_is_refused(open_camera, tmp_path) -> None:
    write_y4m(tmp_path / "film.y4m", noise(2), 50)
    with pytest.raises(InputError, match="32 x 24, but 640 x 480 was requested"):
        open_camera(tmp_path / "film.y4m", SHAPE)


@pytest.mark.parametrize("pixels", ["gray16be", "rgb48be", "yuv420p10le", "gray12le"])
def test_a_file_of_more_bits_than_are_read_is_refused(open_camera, tmp_path, pixels) -> None:
    codec, suffix = ("png", ".mov") if pixels.endswith("be") else ("ffv1", ".mkv")
    with av.open(str(tmp_path / f"film{suffix}"), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width, stream.pix_fmt = *SMALL, pixels
        for picture in noise(3, dtype=np.uint16):
            container.mux(
                stream.encode(av.VideoFrame.from_ndarray(picture, "gray16le").reformat(format=pixels))
            )
        container.mux(stream.encode(None))
    with pytest.raises(InputError, match="bits per sample, but OpenCV would read only 8"):
        open_camera(tmp_path / f"film{suffix}")


def test_no_file_no_device_and_no_video_are_refused(open_camera, tmp_path, monkeypatch) -> None:
    with pytest.raises(InputError, match="there is no such file"):
        open_camera(tmp_path / "none.avi")
    (tmp_path / "text.avi").write_text("no film")
    with pytest.raises(InputError, match="cannot be opened: it is damaged, or not a video"):
        open_camera(tmp_path / "text.avi")
    monkeypatch.setattr(video, "_DEVICES", tmp_path)
    with pytest.raises(InputError, match="there is no such device; Linux reports no camera"):
        open_camera(3)
    (tmp_path / "video0").touch()
    with pytest.raises(InputError, match=r"there is no such device; available: .*video0$"):
        open_camera("3")


class Driver:
    """A V4L2 camera without hardware, in the place of OpenCV's VideoCapture."""

    def __init__(self, clock: SimulatedClock) -> None:
        self.clock, self._change = clock, clock.condition()
        self._pictures: list[np.ndarray | None] = []
        self.refuses: set[int] = set()
        self.there = True
        self.opened = 0
        self.begins = clock.event()
        self.begins.set()
        self.values: dict[int, float] = {}
        self.stamp = 0.0
        self._picture: np.ndarray | None = None

    def give(self, *pictures: np.ndarray | None) -> None:
        """Let the next pictures come; None is a loss."""
        with self._change:
            self._pictures += pictures
            self._change.notify_all()

    def __call__(self, target, backend, parameters) -> Driver:
        assert backend == cv2.CAP_V4L2
        self.begins.wait()
        self.opened += 1
        return self

    def isOpened(self) -> bool:  # noqa: N802
        return self.there

    def set(self, code: int, value: float) -> bool:
        if code not in self.refuses:
            self.values[code] = value
        return code not in self.refuses

    def get(self, code: int) -> float:
        if code == cv2.CAP_PROP_POS_MSEC:
            return 1000 * self.stamp
        return self.values.get(code, 0.0)

    def grab(self) -> bool:
        with self._change:
            while not self._pictures:
                self._change.wait()
            self._picture = self._pictures.pop(0)
        return self._picture is not None

    def retrieve(self, _out) -> tuple[bool, np.ndarray | None]:
        return True, self._picture

    def release(self) -> None:
        pass


@pytest.fixture
def driver(clock, tmp_path, monkeypatch):
    driver = Driver(clock)
    (tmp_path / "video0").touch()
    monkeypatch.setattr(video, "_DEVICES", tmp_path)
    monkeypatch.setattr(video.cv2, "VideoCapture", driver)
    yield driver
    driver.begins.set()
    driver.give(None)
    clock.sleep(1.0)


def test_a_camera_is_given_what_is_asked_for(driver, open_camera, caplog) -> None:
    driver.give(noise(1)[0])
    open_camera(fourcc="Y16", exposure=0.004, gain=3.0, rate=60.0)
    assert driver.values == {
        cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"Y16 "),
        cv2.CAP_PROP_FRAME_WIDTH: 32,
        cv2.CAP_PROP_FRAME_HEIGHT: 24,
        cv2.CAP_PROP_FPS: 60.0,
        cv2.CAP_PROP_AUTO_EXPOSURE: 1,
        cv2.CAP_PROP_EXPOSURE: 40.0,  # of 100 us
        cv2.CAP_PROP_GAIN: 3.0,
        cv2.CAP_PROP_CONVERT_RGB: 0,
    }
    assert not caplog.records


def test_the_exposure_can_be_changed_while_it_runs(driver, open_camera) -> None:
    driver.give(noise(1)[0])
    opened = open_camera(exposure=0.004)
    later = driver.clock.thread(lambda: driver.give(*noise(2)), "gives pictures")
    later.start()
    assert opened.set_exposure(0.00213) == pytest.approx(0.00213)
    assert driver.values[cv2.CAP_PROP_EXPOSURE] == pytest.approx(21.3)
    later.join()


def test_a_camera_that_comes_back_has_the_changed_exposure(driver, open_camera, caplog) -> None:
    driver.give(*noise(2))
    opened = open_camera(exposure=0.004)
    later = driver.clock.thread(lambda: driver.give(*noise(2)), "gives pictures")
    later.start()
    opened.set_exposure(0.002)
    later.join()
    driver.values.clear()
    driver.give(None)
    wait_until(driver.clock, lambda: cv2.CAP_PROP_EXPOSURE in driver.values)
    assert driver.values[cv2.CAP_PROP_EXPOSURE] == pytest.approx(20.0)


def test_the_exposure_of_a_film_cannot_be_changed(open_camera, tmp_path) -> None:
    write_y4m(tmp_path / "film.y4m", noise(2), 50)
    opened = open_camera(tmp_path / "film.y4m")
    with pytest.raises(InputError, match=r"film\.y4m: the exposure can only be set at the sender$"):
        opened.set_exposure(0.002)


def test_what_a_camera_does_not_take_is_reported(driver, open_camera, caplog) -> None:
    driver.refuses = {cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_GAIN, cv2.CAP_PROP_FPS}
    driver.values[cv2.CAP_PROP_FPS] = 30.0
    driver.values[cv2.CAP_PROP_FOURCC] = cv2.VideoWriter.fourcc(*"MJPG")
    driver.give(noise(1)[0])
    open_camera(fourcc="GREY", exposure=0.004, gain=3.0, rate=60.0)
    text = " / ".join(record.getMessage() for record in caplog.records)
    assert "rate 60 Hz was requested, but the camera set 30" in text
    assert "exposure 0.004 s was requested, but the camera set 0" in text
    assert "gain 3 was requested, but the camera set 0" in text
    assert "fourcc GREY was requested, but the camera set MJPG" in text


@pytest.mark.parametrize(
    ("picture", "what"),
    [(np.zeros((24, 30), np.uint8), "30 x 24 uint8"), (np.zeros(SMALL, np.uint16), "32 x 24 uint16")],
)
def test_a_first_frame_of_another_size_or_type_is_refused(driver, open_camera, picture, what) -> None:
    driver.give(picture)
    with pytest.raises(InputError, match=f"{what}, but 32 x 24 uint8 was requested"):
        open_camera()


def test_a_camera_that_opens_and_gives_nothing_is_refused(driver, open_camera) -> None:
    driver.give(None)
    with pytest.raises(InputError, match=r"video0 delivers no picture$"):
        open_camera()


def test_the_drivers_time_is_taken_if_it_is_of_this_clock(driver, open_camera) -> None:
    driver.stamp = driver.clock.now()
    driver.give(noise(1)[0])
    opened = open_camera()
    assert opened.take(1, SOON).time[0] == pytest.approx(driver.stamp, abs=1e-9)


@pytest.mark.parametrize("ahead", [-3600.0, 5.0])
def test_a_drivers_time_of_another_clock_is_not_taken(driver, open_camera, ahead) -> None:
    begun = driver.clock.now()
    driver.stamp = begun + ahead
    driver.give(noise(1)[0])
    opened = open_camera()
    assert opened.take(1, SOON).time[0] == begun


def test_a_camera_that_is_lost_comes_back(driver, open_camera, caplog) -> None:
    first, second = noise(2)
    driver.give(first)
    opened = open_camera()
    opened.take(1, SOON)
    driver.there = False
    driver.give(None)
    wait_until(driver.clock, lambda: "lost after frame 1" in caplog.text)
    with pytest.raises(HardwareError, match="was lost"):
        opened.take(1, 0.0)
    assert opened.error is None
    driver.there = True
    driver.give(second)
    frames = opened.take(1, SOON)
    np.testing.assert_array_equal(frames.pixels[0], second)
    assert (frames.number.tolist(), frames.dropped) == ([2], 1)
    assert opened.counts.reconnects == 1
    assert opened.counts.dropped == 1
    warnings = [record.getMessage() for record in caplog.records]
    assert ["lost after frame 1" in warnings[0], "is back after" in warnings[1]] == [True, True]


def test_a_camera_that_waits_for_a_trigger_is_not_lost(driver, open_camera) -> None:
    opened = open_camera(trigger="coolant")
    assert opened.latest == -np.inf
    driver.clock.sleep(2.0)  # what OpenCV waits, without a picture
    driver.give(None)
    driver.give(noise(1)[0])
    assert opened.take(1, SOON).number.tolist() == [0]
    assert (driver.opened, opened.counts.reconnects) == (1, 0)


def test_a_film_cannot_be_triggered(open_camera, tmp_path) -> None:
    write_y4m(tmp_path / "film.y4m", noise(2), 50)
    with pytest.raises(InputError, match=r"film\.y4m cannot be triggered: remove camera\.trigger$"):
        open_camera(tmp_path / "film.y4m", trigger="coolant")


def test_the_input_of_a_trigger_is_not_ours_to_set(driver, open_camera) -> None:
    with pytest.raises(
        InputError, match=r"video0: its trigger input must be set with its own tools; remove trigger_input$"
    ):
        open_camera(trigger="coolant", trigger_input="Line0")


def test_a_camera_that_does_not_come_back_is_given_up(driver, open_camera) -> None:
    driver.give(noise(1)[0])
    opened = open_camera()
    opened.take(1, SOON)
    driver.there = False
    driver.give(None)
    wait_until(driver.clock, lambda: opened.error is not None)
    with pytest.raises(HardwareError, match=r"was lost and did not come back within 10 s"):
        opened.take(1, SOON)
    assert driver.opened > 2


def feed(driver, opened, pictures) -> None:
    """Let the camera have pictures one by one, each of them taken, after a first."""
    opened.take(1, SOON)
    for picture in pictures:
        driver.give(picture)
        opened.take(1, SOON)


def test_a_camera_that_gives_one_picture_again_and_again_is_lost(driver, open_camera, caplog) -> None:
    pictures = noise(20)
    driver.give(pictures[0])
    opened = open_camera()
    feed(driver, opened, [*pictures[1:], *[pictures[-1]] * 4])
    driver.give(pictures[-1])
    with pytest.raises(HardwareError, match="was lost"):
        opened.take(1, 0.3)
    assert "repeats the same picture" in caplog.records[0].getMessage()


def test_pictures_without_noise_may_be_alike(driver, open_camera) -> None:
    pictures = noise(20)
    driver.give(pictures[0])
    opened = open_camera()
    feed(driver, opened, [pictures[0], *pictures[1:], *[pictures[-1]] * 20])
    assert opened.counts.frames == 41


def write_mjpeg(path, *pictures: np.ndarray) -> None:
    path.write_bytes(b"".join(cv2.imencode(".jpg", picture)[1].tobytes() for picture in pictures))


def test_a_stream_that_changes_its_size_is_not_scaled(open_camera, tmp_path) -> None:
    smooth = cv2.resize(noise(1)[0], (64, 48))
    write_mjpeg(tmp_path / "film.mjpg", *[smooth] * 3, cv2.resize(smooth, (128, 96)))
    opened = open_camera(tmp_path / "film.mjpg", (48, 64))
    take(opened, 3)
    with pytest.raises(HardwareError, match="128 x 96 uint8, but 64 x 48 uint8 was requested"):
        opened.take(1, SOON)


def test_a_jpeg_gives_its_luma(open_camera, tmp_path) -> None:
    colours = cv2.resize(np.random.default_rng(1).integers(0, 255, (6, 8, 3), np.uint8), (64, 48))
    write_mjpeg(tmp_path / "film.mjpg", *[colours] * 2)
    opened = open_camera(tmp_path / "film.mjpg", (48, 64))
    luma = cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY).astype(int)
    assert np.abs(take(opened, 1)[0][0] - luma).mean() < 3  # what the packing costs


def test_a_jpeg_that_is_cut_short_is_not_made_up(open_camera, tmp_path) -> None:
    whole = cv2.imencode(".jpg", noise(1, (48, 64))[0])[1].tobytes()
    (tmp_path / "film.mjpg").write_bytes(2 * whole + whole[: len(whole) // 2])
    opened = open_camera(tmp_path / "film.mjpg", (48, 64))
    take(opened, 2)
    with pytest.raises(HardwareError, match="a picture cannot be decoded"):
        opened.take(1, SOON)


def test_a_driver_that_hangs_while_it_opens_does_not_hang_us(driver, open_camera, clock) -> None:
    driver.begins = clock.event()
    begun = clock.now()
    with pytest.raises(InputError, match=r"delivered no picture within 7 s"):
        open_camera()
    assert clock.now() - begun == pytest.approx(10.0)  # with 3 s for its end


def test_a_driver_that_hangs_does_not_hang_the_closing(driver, open_camera, clock, caplog) -> None:
    driver.give(noise(1)[0])
    opened = open_camera()
    begun = clock.now()
    opened.close()
    assert clock.now() - begun == pytest.approx(3.0)
    assert "cannot be closed" in caplog.text
    with pytest.raises(HardwareError, match="is closed"):
        play_out(opened, SOON)


def test_the_rate_is_that_of_the_newest_frames_whatever_their_jitter() -> None:
    tally = FrameCounter()
    rng = np.random.default_rng(1)
    assert np.isnan(tally.counts().rate)
    times = np.concatenate([np.arange(50) / 10, 5 + np.arange(200) / 80])
    for at in times + rng.normal(0, 0.002, 250):
        tally.add(at)
    assert tally.counts().rate == pytest.approx(80, rel=0.005)
    assert tally.latest == pytest.approx(times[-1], abs=0.01)
    assert tally.counts().frames == 250


@pytest.mark.parametrize("after", [1, 20, 64, 110, 200])
def test_a_pause_does_not_change_the_rate_and_counts_as_one_late_frame(after) -> None:
    tally = FrameCounter()
    for at in np.concatenate([np.arange(90) / 50, 30 + np.arange(after) / 50]):
        tally.add(at)
    counts = tally.counts(dropped=3, reconnects=2)
    assert (counts.late, counts.dropped, counts.reconnects) == (1, 3, 2)
    assert counts.rate == pytest.approx(50, rel=1e-6)


def test_frames_in_bursts_have_the_rate_of_all() -> None:
    tally = FrameCounter()
    for burst in range(40):
        for frame in range(8):
            tally.add(0.08 * burst + 1e-5 * frame)
    assert tally.counts().rate == pytest.approx(100, rel=0.06)


def test_colours_become_the_luma_and_equal_ones_their_value() -> None:
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    out = np.empty_like(grey)
    to_grey(np.repeat(grey[..., None], 3, axis=2), out, "it")
    np.testing.assert_array_equal(out, grey)
    colours = np.random.default_rng(2).integers(0, 256, (16, 16, 3), dtype=np.uint8)
    to_grey(colours, out, "it")
    np.testing.assert_allclose(out, colours @ [0.114, 0.587, 0.299], atol=0.51)
    to_grey(np.dstack([grey, colours[..., 0]]), out, "it")
    np.testing.assert_array_equal(out, grey)


class Vendor(ModuleType):
    """The SDK that docs/camera.md takes for granted: a camera of five frames, of which it loses two."""

    Error = RuntimeError
    height, width, frame_rate = 24, 32, 100.0

    def __init__(self, pictures: np.ndarray) -> None:
        super().__init__("vendor")
        self.opened: list[str] = []
        self.closed = 0
        self._left = [SimpleNamespace(pixels=pictures[n], counter=n) for n in (0, 1, 4)]

    def open(self, serial: str) -> Vendor:
        self.opened.append(serial)
        return self

    def wait(self, timeout: float) -> SimpleNamespace | None:
        if not self._left:
            raise RuntimeError("the cable is out")
        return self._left.pop(0)

    def close(self) -> None:
        self.closed += 1


def test_the_camera_of_the_documentation_works(monkeypatch) -> None:
    page = (Path(__file__).parents[3] / "docs" / "camera.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    pictures = noise(5)
    vendor = Vendor(pictures)
    monkeypatch.setitem(sys.modules, "vendor", vendor)
    built: dict[str, Any] = {}
    exec(example, built)
    with built["VendorCamera"](SimpleNamespace(name="40123456")) as opened:
        wait_until(SYSTEM, lambda: opened.error is not None)
        before, after = opened.take(9, SOON), opened.take(9, SOON)
        with pytest.raises(HardwareError, match=r"^camera 40123456 failed: the cable is out$"):
            opened.take(1, SOON)
        assert (opened.shape, opened.counts.frames, opened.counts.dropped) == (SMALL, 3, 2)
    assert [before.number.tolist(), after.number.tolist(), after.dropped] == [[0, 1], [4], 2]
    np.testing.assert_array_equal(after.pixels[0], pictures[4])
    assert (vendor.opened, vendor.closed) == (["40123456"], 1)
