"""The camera's stream for other processes, read by OpenCV and by hand."""

from __future__ import annotations

import errno
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mirrorskin.hw.base.rig_file import CameraSettings
from mirrorskin.hw.cameras.camera_thread import ThreadedCamera
from mirrorskin.hw.cameras.video import VideoCamera
from mirrorskin.io import InputError
from mirrorskin.twin.emulator.server import FrameServer

PATIENCE = 60.0  # seconds, for a busy machine


class Tape(ThreadedCamera):
    """A camera of random pictures, each marked with its number, that runs as fast as it is told."""

    def __init__(self, shape: tuple[int, int], dtype: Any, period: float) -> None:
        super().__init__("tape", shape, dtype, slots=64)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(period,))
        self._thread.start()

    def lose(self) -> None:
        self._ended.set()
        self._fail("the tape tore")

    def close(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self, period: float) -> None:
        number = 0
        while not self._ended.wait(period):
            self._slot()[:] = picture(number, self.shape, self.dtype)
            self._put(time.monotonic())
            number += 1


def picture(number: int, shape: tuple[int, int], dtype: Any) -> NDArray[Any]:
    """Return random counts that begin with the number."""
    values = np.random.default_rng(number).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    values[0, :2] = number % 200, number // 200
    return values


def number_of(pixels: NDArray[Any]) -> int:
    return int(pixels[0, 0]) + 200 * int(pixels[0, 1])


@contextmanager
def streaming(
    shape: tuple[int, int] = (60, 80), dtype: Any = np.uint8, period: float = 0.005
) -> Iterator[tuple[Tape, FrameServer]]:
    before = threading.active_count()
    tape = Tape(shape, dtype, period)
    try:
        with FrameServer(tape, 200.0) as server:
            yield tape, server
    finally:
        tape.close()
    assert threading.active_count() == before


def watch(url: str, count: int) -> list[NDArray[Any]]:
    viewer = cv2.VideoCapture(url, cv2.CAP_FFMPEG)
    try:
        viewer.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        read = [viewer.read() for _ in range(count)]
    finally:
        viewer.release()
    assert all(target for target, _ in read)
    return [pixels for _, pixels in read]


def connect(server: FrameServer) -> socket.socket:
    host, port = server.url.removeprefix("tcp://").split(":")
    return socket.create_connection((host, int(port)), PATIENCE)


def read_exactly(line: socket.socket, count: int) -> bytes:
    held = b""
    while len(held) < count:
        part = line.recv(count - len(held))
        if not part:
            raise EOFError
        held += part
    return held


@pytest.mark.parametrize(
    ("shape", "dtype"), [((60, 80), np.uint8), ((33, 47), np.uint8), ((60, 80), np.uint16)]
)
def test_opencv_reads_every_frame_bit_by_bit(shape: tuple[int, int], dtype: Any) -> None:
    with streaming(shape, dtype) as (_, server):
        frames = watch(server.url, 40)
    numbers = [number_of(pixels) for pixels in frames]
    assert len(set(numbers)) == 40
    for number, pixels in zip(numbers, frames, strict=True):
        assert pixels.dtype == dtype
        np.testing.assert_array_equal(pixels, picture(number, shape, dtype))


class Exposed(Tape):
    """A tape whose exposure can be set, up to 10 ms."""

    def set_exposure(self, seconds: float) -> float:
        return min(seconds, 0.01)


@pytest.mark.parametrize(("seconds", "expected"), [(0.004, 0.004), (0.5, 0.01)])
def test_the_exposure_can_be_set_through_the_stream(seconds: float, expected: float) -> None:
    with closing(Exposed((60, 80), np.uint8, 0.005)) as tape, FrameServer(tape, 200.0) as server:
        camera = CameraSettings(source=server.controlled_url, size=(80, 60))
        with VideoCamera(camera) as opened:
            assert opened.set_exposure(seconds) == expected


def test_the_exposure_of_another_stream_cannot_be_set() -> None:
    with (
        streaming() as (_, server),
        VideoCamera(CameraSettings(source=server.url, size=(80, 60))) as opened,
        pytest.raises(InputError, match="can only be set at the sender"),
    ):
        opened.set_exposure(0.004)


def test_an_impossible_request_is_not_answered() -> None:
    with closing(Exposed((60, 80), np.uint8, 0.005)) as tape, FrameServer(tape, 200.0) as server:
        port = int(server.controlled_url.rpartition("=")[2])
        with socket.create_connection(("127.0.0.1", port), PATIENCE) as line:
            line.sendall(b"a second\n")
            assert line.recv(1) == b""


def test_viewers_may_come_one_after_another_and_together() -> None:
    with streaming() as (_, server):
        first = [number_of(pixels) for pixels in watch(server.url, 3)]
        with connect(server) as beside:
            second = [number_of(pixels) for pixels in watch(server.url, 3)]
            assert read_exactly(beside, 9) == b"YUV4MPEG2"
        third = [number_of(pixels) for pixels in watch(server.url, 3)]
    assert first == sorted(first)
    assert first[-1] < second[0]
    assert second[-1] < third[0]


def test_a_slow_viewer_gets_whole_frames_with_some_missing() -> None:
    shape, header = (400, 500), b"YUV4MPEG2 W500 H400 F200:1 Ip A1:1 Cmono\n"
    with streaming(shape, period=0.001) as (_, server), connect(server) as slow:
        read_exactly(slow, len(header))
        numbers: list[int] = []
        until = time.monotonic() + PATIENCE
        # What is under way in the sockets comes first, without a gap.
        while time.monotonic() < until and (len(numbers) < 2 or numbers[-1] - numbers[0] == len(numbers) - 1):
            frame = read_exactly(slow, 6 + shape[0] * shape[1])
            assert frame[:6] == b"FRAME\n"
            pixels = np.frombuffer(frame, np.uint8, offset=6).reshape(shape)
            np.testing.assert_array_equal(pixels, picture(number_of(pixels), shape, np.uint8))
            numbers.append(number_of(pixels))
            time.sleep(0.05)
    assert numbers == sorted(numbers)
    assert numbers[-1] - numbers[0] > len(numbers) - 1


def test_the_connection_ends_with_the_camera() -> None:
    with streaming() as (tape, server), connect(server) as line:
        read_exactly(line, 1000)
        tape.lose()
        with pytest.raises((EOFError, ConnectionResetError)):
            read_exactly(line, 10**9)


def test_closing_ends_a_viewer_that_does_not_read() -> None:
    with streaming((400, 500), period=0.001) as (_, server), connect(server) as line:
        read_exactly(line, 10)
        time.sleep(0.2)  # until the line is full
        began = time.monotonic()
        server.close()
        server.close()
        assert time.monotonic() - began < PATIENCE


def test_what_cannot_be_streamed_is_refused() -> None:
    tape = Tape((3, 4), np.float32, 1000.0)
    try:
        with pytest.raises(InputError, match="float32"):
            FrameServer(tape, 30.0)
    finally:
        tape.close()


def test_running_out_of_descriptors_for_a_while_ends_nothing() -> None:
    with streaming() as (_, server):
        door, refused = server._door, threading.Event()

        class Full:
            def accept(self) -> Any:
                refused.set()
                raise OSError(errno.EMFILE, "Too many open files")

        server._door = Full()  # type: ignore[assignment]
        assert refused.wait(PATIENCE)
        server._door = door
        assert len(watch(server.url, 2)) == 2
