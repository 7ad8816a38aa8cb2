"""A camera's frames for other processes: a stream that ``cv2.VideoCapture`` opens, without any loss."""

from __future__ import annotations

import socket
import threading
from collections import deque
from contextlib import suppress
from fractions import Fraction

import numpy as np

from mirrorskin.hw.camera import Camera
from mirrorskin.hw.errors import HardwareError
from mirrorskin.io.types import Closing, InputError

_COLOURS = {np.dtype(np.uint8): "mono", np.dtype(np.uint16): "mono16"}
_QUEUE = 4  # frames that wait for a slow viewer
_LOOK = 0.1  # seconds from one look at whether to end to the next
_FRACTION = 1001  # greatest denominator of the rate in the header


class FrameServer(Closing):
    """Sends a camera's frames to whoever connects, as YUV4MPEG2 of grey pictures over TCP.

    A viewer gets a header and then frames, whole ones only, from the next one on. Of those that wait for a
    slow viewer the oldest are dropped. When the camera fails the connections end; when it is silent nothing
    is sent. Only programs of this computer can connect.

    The server takes the camera's frames, and does not close it. The URL to open is ``url``; port 0 takes a
    free one.
    """

    def __init__(self, camera: Camera, rate: float, port: int = 0) -> None:
        if camera.dtype not in _COLOURS:
            raise InputError(f"{camera.name}: {camera.dtype} cannot be streamed: take uint8 or uint16")
        rows, columns = camera.shape
        ratio = Fraction(rate).limit_denominator(_FRACTION)
        self._header = (
            f"YUV4MPEG2 W{columns} H{rows} F{ratio.numerator}:{ratio.denominator} Ip A1:1"
            f" C{_COLOURS[camera.dtype]}\n"
        ).encode()
        self._camera = camera
        self._ended = threading.Event()
        self._viewers: list[_Viewer] = []
        self._lock = threading.Lock()  # of the list
        try:
            self._door = socket.create_server(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            raise InputError(f"port {port} cannot be listened on: {error}; take another, or 0") from None
        self._door.settimeout(_LOOK)
        self.url = f"tcp://127.0.0.1:{self._door.getsockname()[1]}"
        self._threads = [threading.Thread(target=work) for work in (self._admit, self._send)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End all connections and listen no more; a second time does nothing."""
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._dismiss(self._viewers)
        self._door.close()

    def _admit(self) -> None:
        while not self._ended.is_set():
            try:
                line, _ = self._door.accept()
            except TimeoutError:
                continue
            with self._lock:
                self._viewers.append(_Viewer(line, self._header))

    def _send(self) -> None:
        while not self._ended.is_set():
            try:
                frames = self._camera.take(1, _LOOK)
            except HardwareError:
                if self._camera.error is None:
                    continue  # it is only silent
                self._dismiss(self._viewers)
                self._ended.wait(_LOOK)
                continue
            pixels = frames.pixels[0]
            data = b"FRAME\n" + pixels.astype(pixels.dtype.newbyteorder("<")).tobytes()
            with self._lock:
                viewers = list(self._viewers)
            for viewer in viewers:
                viewer.offer(data)
            self._dismiss([viewer for viewer in viewers if not viewer.watches])

    def _dismiss(self, some: list[_Viewer]) -> None:
        for viewer in list(some):
            viewer.close()
            with self._lock:
                self._viewers.remove(viewer)


class _Viewer:
    """A connection, and the frames that wait for it."""

    def __init__(self, line: socket.socket, header: bytes) -> None:
        line.settimeout(None)
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._line, self._header = line, header
        self._waiting: deque[bytes] = deque()
        self._came = threading.Condition()
        self.watches = True
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def offer(self, frame: bytes) -> None:
        """Send a frame as soon as it can be, and if need be drop the oldest that waits."""
        with self._came:
            self._waiting.append(frame)
            if len(self._waiting) > _QUEUE:
                del self._waiting[0]
            self._came.notify()

    def close(self) -> None:
        """End the connection, also in the middle of a frame."""
        with self._came:
            self.watches = False
            self._came.notify()
        with suppress(OSError):  # the other end was first
            self._line.shutdown(socket.SHUT_RDWR)
        self._thread.join()

    def _work(self) -> None:
        with self._line, suppress(OSError):  # the viewer went
            self._line.sendall(self._header)
            while True:
                with self._came:
                    self._came.wait_for(lambda: self._waiting or not self.watches)
                    if not self.watches:
                        return
                    data = self._waiting.popleft()
                self._line.sendall(data)
        self.watches = False
