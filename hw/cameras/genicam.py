"""GigE Vision and USB3 Vision cameras, through the library Aravis."""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.drivers import Driver
from mirrorskin.hw.base.rig_file import CameraSettings
from mirrorskin.hw.cameras.reopened import READ_TIMEOUT, ReopenedCamera, warn_of_other
from mirrorskin.io import InputError

GENICAM = Driver(
    name="genicam",
    help="GigE Vision and USB3 Vision cameras, by Aravis",
    loads="GenicamCamera",
    takes=("clock",),
    formats=r"Mono(8|10|12|14|16)",
    formats_help="Mono8 to Mono16",
    extra="genicam",
)

_BUFFERS = 16  # buffers that Aravis may fill before they are read
_LOOK = 0.2  # interval at which the thread checks whether to end, seconds
_FORMATS = {"uint8": ("Mono8",), "uint16": ("Mono16", "Mono14", "Mono12", "Mono10")}  # the first is preferred
_INPUT = "Line0"  # default input of the trigger
_WRAP = 65535  # largest frame number of GigE Vision 1, followed by 1
_SPAN = 5.0  # seconds over which the minimum delay is computed; a drift of 50 ppm amounts to 0.25 ms
_REMEDY = (
    "Debian: apt install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev pkg-config gcc, "
    "then pip install 'mirrorskin[genicam]'"
)


class GenicamCamera(ReopenedCamera):
    """A GigE Vision or USB3 Vision camera, as a ``mirrorskin.hw.Camera``.

    Format, size, rate, exposure and gain are set according to the settings; deviations are logged as
    warnings. Lost frames are counted by the camera's own frame numbers. Times are the camera's own, converted
    to the clock of ``time.monotonic``; see ``DeviceClock``.

    A camera that is silent for 2 s is reopened; see ``ReopenedCamera``.

    Parameters
    ----------
    settings : CameraSettings
        ``source="genicam:"`` selects the first camera; otherwise the serial number, IP or MAC address, or
        Aravis' name of the camera follows the colon.
    slots : int, optional
        Number of frames that can wait; see ``mirrorskin.hw.cameras.ring.usual_slots``.
    clock : Clock
        Clock to wait with; Aravis uses the system's.

    Raises
    ------
    InputError
        Aravis is missing, the camera does not exist, is in use, does not accept the settings, or delivers no
        frame within 7 s.

    Examples
    --------
    >>> with GenicamCamera(CameraSettings(source="genicam:", size=(640, 480))) as camera:  # doctest: +SKIP
    ...     camera.take(limit=8, timeout=1.0).pixels.shape
    (1, 480, 640)
    """

    def __init__(self, settings: CameraSettings, slots: int | None = None, clock: Clock = SYSTEM) -> None:
        self._aravis, self._failure = load_aravis()
        super().__init__(f"camera {str(settings.source).rstrip(':')}", settings, slots, clock)
        self._start()

    def _read_until_lost(self, timeout: float) -> str:
        with self._refused_in_one_line():
            device = self._open()
            self._configure(device)
            stream = device.create_stream(None, None)
            size = device.get_payload()
            for _ in range(_BUFFERS):
                stream.push_buffer(self._aravis.Buffer.new_allocate(size))
            device.start_acquisition()
        self._opened()
        why = f"{self.name} delivers no picture"
        try:
            self._read(device, stream)
            self._was_lost(why)  # stopping a lost camera takes seconds
        finally:
            with suppress(self._failure):
                device.stop_acquisition()
        return why

    def _read(self, device: Any, stream: Any) -> None:
        """Put frames into the ring buffer until none arrives for 2 s."""
        times, last, silent_since = DeviceClock(), None, self.clock.now()
        dtype = self.dtype.newbyteorder("<")
        patience = READ_TIMEOUT if self._settings.trigger is None else math.inf
        while not self._stop.is_set() and self.clock.now() - silent_since < patience:
            self._change_exposure(functools.partial(self._expose, device))
            buffer = stream.timeout_pop_buffer(round(1e6 * _LOOK))
            if buffer is None:
                continue
            now = self.clock.now()
            if buffer.get_status() == self._aravis.BufferStatus.SUCCESS:
                number, pixels = buffer.get_frame_id(), self._slot()
                pixels[:] = np.frombuffer(buffer.get_data(), dtype, pixels.size).reshape(pixels.shape)
                arrival = times.arrival(buffer.get_timestamp() / 1e9, now)
                self._arrived(arrival, 0 if last is None else count_lost(last, number))
                last, silent_since = number, now
            stream.push_buffer(buffer)

    def _open(self) -> Any:
        camera_name = str(self._settings.source).partition(":")[2]
        aravis = self._aravis
        aravis.update_device_list()
        devices: dict[str, set[str]] = {}
        for n in range(aravis.get_n_devices()):
            names = (aravis.get_device_serial_nbr, aravis.get_device_physical_id, aravis.get_device_address)
            device = aravis.get_device_id(n)
            devices[device] = {device, *(name(n) for name in names)}
        matching = [device for device, names in devices.items() if not camera_name or camera_name in names]
        if not camera_name and not matching:
            raise InputError(f"{self.name}: no camera found; check its cable, power supply and network")
        try:
            opened = aravis.Camera.new(matching[0] if matching else camera_name)
        except self._failure as error:
            available = f"; available: {', '.join(sorted(devices))}" if devices else "; none was found"
            raise InputError(f"{self.name} cannot be opened: {error.message}{available}") from None
        if opened.is_gv_device() and not opened.get_device().is_controller():
            raise InputError(
                f"{self.name} is used by another program: close that program, and wait some seconds"
            )
        return opened

    def _configure(self, device: Any) -> None:
        """Apply the settings, and log deviations."""
        asked, off = self._settings, self._aravis.Auto.OFF
        device.set_range_check_policy(self._aravis.RangeCheckPolicy.ENABLE)
        device.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
        device.clear_triggers()
        device.set_region(-1, -1, *asked.size)  # the offset of the region remains the camera's own
        *_, width, height = device.get_region()
        if (width, height) != tuple(asked.size):
            raise InputError(
                f"{self.name} delivers {width} x {height} pixels, not {asked.size[0]} x "
                f"{asked.size[1]}: set camera.size in the rig file accordingly"
            )
        available = device.dup_available_pixel_formats_as_strings()
        formats = _FORMATS.get(asked.dtype, ())
        chosen = [name for name in formats if name in available and asked.fourcc in (None, name)]
        if not chosen:
            needed = asked.fourcc or " or ".join(formats) or "none"
            raise InputError(
                f"{self.name} has no format for dtype {asked.dtype} (needed: {needed}; available: "
                f"{', '.join(available)}): set camera.dtype and camera.fourcc in the rig file "
                "accordingly"
            )
        device.set_pixel_format_from_string(chosen[0])
        if asked.exposure is not None:
            self._compare("exposure", asked.exposure, self._expose(device, asked.exposure), " s")
        if asked.gain is not None:
            if device.is_gain_auto_available():
                device.set_gain_auto(off)
            device.set_gain(asked.gain)
            self._compare("gain", asked.gain, device.get_gain())
        if asked.rate is not None:
            device.set_frame_rate(asked.rate)
            self._compare("rate", asked.rate, device.get_frame_rate(), " Hz")
        if asked.trigger is not None:  # last, because setting a rate switches it off
            device.set_trigger(asked.trigger_input or _INPUT)

    def _expose(self, device: Any, seconds: float) -> float:
        """Set the exposure, and return the one that the camera has then, seconds."""
        with self._refused_in_one_line():
            if device.is_exposure_auto_available():
                device.set_exposure_time_auto(self._aravis.Auto.OFF)
            device.set_exposure_time(1e6 * seconds)
            return float(device.get_exposure_time()) / 1e6

    def _compare(self, what: str, asked: float, got: float, unit: str = "") -> None:
        if not np.isclose(asked, got, rtol=0.01):
            warn_of_other(self.name, what, asked, got, unit)

    @contextmanager
    def _refused_in_one_line(self) -> Iterator[None]:
        try:
            yield
        except self._failure as error:
            message = f"{self.name} cannot be set as in the rig file: {error.message}"
            raise InputError(message) from error


class DeviceClock:
    """Converts a camera's time stamps to the clock of ``time.monotonic``.

    A frame is received at its stamp, plus the difference of the clocks, plus its transfer time. The minimum
    of (received - stamp) over the last 5 s is added to every stamp. This removes the jitter of the transfer
    and follows the drift. A stamp that does not increase means that the camera's clock was reset; the minimum
    is then restarted.
    """

    def __init__(self) -> None:
        self._least: deque[tuple[float, float]] = deque()  # time of reception and difference, both increasing
        self._stamp = self._last = -math.inf

    def arrival(self, stamp: float, now: float) -> float:
        """Return the arrival of a frame from its stamp and its reception; never decreasing."""
        if stamp <= self._stamp:
            self._least.clear()
        self._stamp, difference = stamp, now - stamp
        while self._least and self._least[-1][1] >= difference:
            self._least.pop()
        self._least.append((now, difference))
        while self._least[0][0] < now - _SPAN:
            self._least.popleft()
        self._last = max(self._last, stamp + self._least[0][1])
        return self._last


def count_lost(before: int, number: int) -> int:
    """Return how many frames are missing between two frame numbers of a camera."""
    if number > before:
        return number - before - 1
    if number == before or before > _WRAP:  # no frame numbers, or restarted
        return 0
    return number + _WRAP - before - 1


def load_aravis() -> tuple[Any, Any]:
    """Return the Aravis library and its error class; InputError if it is not installed."""
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        raise InputError(
            f"GenICam cameras need Aravis, which is not installed ({error}); {_REMEDY}"
        ) from None
    return Aravis, GLib.Error
