"""A camera's frames for other processes: a lossless stream that ``cv2.VideoCapture`` opens."""

from __future__ import annotations

import socket
import threading
import time
from collections import deque
from contextlib import suppress
from fractions import Fraction

import numpy as np

from mirrorskin.hw.base.camera import Camera
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.cameras.video import EXPOSURE_PORT
from mirrorskin.io.base.types import Closing, InputError

_COLOURS = {np.dtype(np.uint8): "mono", np.dtype(np.uint16): "mono16"}
_QUEUE = 4  # frames that wait for a slow viewer
_LOOK = 0.1  # interval at which threads check whether to end, seconds
_ASKING = 1.0  # seconds to send a request
_REQUEST_SIZE_MAX = 64  # bytes
_FRACTION = 1001  # greatest denominator of the rate in the header


class FrameServer(Closing):
    """Sends a camera's frames to any number of viewers, as grey YUV4MPEG2 over TCP.

    A viewer gets a header, and then complete frames from the next one on. If it is slow, the oldest waiting
    frames are dropped. When the camera fails, the connections end; when it is silent, nothing is sent. Only
    programs on this computer can connect.

    The server takes the camera's frames, but does not close the camera. ``url`` is the address to open; port
    0 selects a free port. ``controlled_url`` is the same stream with the port at which `VideoCamera` changes
    the exposure of a camera that can: it takes a line with seconds, and answers with those set.
    """

    def __init__(self, camera: Camera, rate: float, port: int = 0) -> None:
        if camera.dtype not in _COLOURS:
            raise InputError(f"{camera.name}: {camera.dtype} cannot be streamed: use uint8 or uint16")
        rows, columns = camera.shape
        ratio = Fraction(rate).limit_denominator(_FRACTION)
        self._header = (
            f"YUV4MPEG2 W{columns} H{rows} F{ratio.numerator}:{ratio.denominator} Ip A1:1"
            f" C{_COLOURS[camera.dtype]}\n"
        ).encode()
        self._camera = camera
        self._ended = False
        self._viewers: dict[socket.socket, deque[bytes]] = {}  # frames that wait for each viewer
        self._change = threading.Condition()
        try:
            self._door = socket.create_server(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            raise InputError(f"port {port} cannot be opened: {error}; choose another one, or 0") from None
        self._control = socket.create_server(("127.0.0.1", 0))
        self.url: str = f"tcp://127.0.0.1:{self._door.getsockname()[1]}"
        self.controlled_url: str = f"{self.url}?{EXPOSURE_PORT}={self._control.getsockname()[1]}"
        for door in (self._door, self._control):
            door.settimeout(_LOOK)
        self._threads = [threading.Thread(target=work) for work in (self._admit, self._take, self._obey)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End all connections and stop listening; a second call does nothing."""
        self._ended = True
        self._dismiss()
        for thread in self._threads:  # threads of viewers are added by the first thread
            thread.join()
        self._door.close()
        self._control.close()

    def _admit(self) -> None:
        while not self._ended:
            try:
                line, _ = self._door.accept()
            except TimeoutError:
                continue
            except OSError:  # too many open files, some of which may be closed later
                time.sleep(_LOOK)
                continue
            line.settimeout(None)
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._change:
                self._viewers[line] = deque(maxlen=_QUEUE)
            self._threads.append(threading.Thread(target=self._serve, args=(line,)))
            self._threads[-1].start()
        self._dismiss()

    def _obey(self) -> None:
        """Set the exposures that are asked for, one at a time."""
        set_exposure = getattr(self._camera, "set_exposure", None)
        while set_exposure is not None and not self._ended:
            with suppress(OSError, ValueError, InputError):  # no request, or not one that can be obeyed
                line, _ = self._control.accept()
                line.settimeout(_ASKING)
                with line, line.makefile("rb") as request:
                    exposure = set_exposure(float(request.readline(_REQUEST_SIZE_MAX)))
                    line.sendall(f"{exposure!r}\n".encode())

    def _take(self) -> None:
        """Pass each frame of the camera to all viewers."""
        while not self._ended:
            try:
                frames = self._camera.take(1, _LOOK)
            except HardwareError:
                if self._camera.error is not None:  # otherwise the camera is only silent
                    self._dismiss()
                    time.sleep(_LOOK)
                continue
            pixels = frames.pixels[0]
            data = b"FRAME\n" + pixels.astype(pixels.dtype.newbyteorder("<")).tobytes()
            with self._change:
                for waiting in self._viewers.values():
                    waiting.append(data)
                self._change.notify_all()

    def _serve(self, line: socket.socket) -> None:
        with line, suppress(OSError):  # the viewer disconnected
            line.sendall(self._header)
            while True:
                with self._change:
                    self._change.wait_for(lambda: self._viewers.get(line, True))
                    if line not in self._viewers:
                        return
                    data = self._viewers[line].popleft()
                line.sendall(data)
        with self._change:
            self._viewers.pop(line, None)

    def _dismiss(self) -> None:
        """End all connections, even in the middle of a frame."""
        with self._change:
            lines, self._viewers = list(self._viewers), {}
            self._change.notify_all()
        for line in lines:
            with suppress(OSError):  # the other end was closed first
                line.shutdown(socket.SHUT_RDWR)
