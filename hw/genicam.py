"""Cameras that speak GigE Vision or USB3 Vision, through the library Aravis."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from mirrorskin.hw.clock import SYSTEM, Clock
from mirrorskin.hw.reopened import READ_TIMEOUT, ReopenedCamera, warn_of_other
from mirrorskin.hw.rig_file import GENICAM, CameraSettings
from mirrorskin.io import InputError

_BUFFERS = 16  # frames that Aravis may fill before they are read
_LOOK = 0.2  # seconds that one waits for a frame before it looks whether to end
_FORMATS = {"uint8": ("Mono8",), "uint16": ("Mono16", "Mono14", "Mono12", "Mono10")}  # the first is preferred
_INPUT = "Line0"  # that triggers it, unless another is given
_WRAP = 65535  # the greatest frame number of GigE Vision 1; then comes 1
_SPAN = 5.0  # seconds that the least delay is looked for in; 50 ppm of drift are 0.25 ms meanwhile
_REMEDY = (
    "Debian: apt install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev pkg-config gcc, "
    "then pip install 'mirrorskin[genicam]'"
)


class GenicamCamera(ReopenedCamera):
    """A camera by GigE Vision or USB3 Vision, as a ``mirrorskin.hw.camera.Camera``.

    It is given the size, format, rate, exposure and gain that the settings ask for; what it did not take is
    logged as a warning. Its own counter tells how many frames are lost. Times are its own, put on the clock
    of ``time.monotonic``; see ``DeviceClock``.

    A camera that is silent for 2 s is opened again; see ``ReopenedCamera``.

    Parameters
    ----------
    settings : CameraSettings
        With ``source="genicam:"`` for the first camera, or with what it is called behind the colon: its
        serial number, IP or MAC address, or Aravis' name for it.
    slots : int, optional
        Frames that may wait; see ``mirrorskin.hw.ring.usual_slots``.
    clock : Clock
        What it waits by; Aravis itself goes by the computer's.

    Raises
    ------
    InputError
        Aravis is missing, there is no such camera, it is used by others, it cannot be set as asked for, or
        gives no frame within 7 s.

    Examples
    --------
    >>> with GenicamCamera(CameraSettings(source="genicam:", size=(640, 480))) as camera:  # doctest: +SKIP
    ...     camera.take(most=8, timeout=1.0).pixels.shape
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
        why = f"{self.name} gives no picture"
        try:
            self._read(stream)
            self._was_lost(why)  # a camera that is gone takes seconds to stop
        finally:
            with suppress(self._failure):
                device.stop_acquisition()
        return why

    def _read(self, stream: Any) -> None:
        """Put frames into the ring until there are none for 2 s."""
        times, last, silent_since = DeviceClock(), None, self.clock.now()
        dtype = self.dtype.newbyteorder("<")
        patience = READ_TIMEOUT if self._settings.trigger is None else math.inf
        while not self._stop.is_set() and self.clock.now() - silent_since < patience:
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
        wanted = str(self._settings.source).removeprefix(GENICAM)
        aravis = self._aravis
        aravis.update_device_list()
        there: dict[str, set[str]] = {}
        for n in range(aravis.get_n_devices()):
            names = (aravis.get_device_serial_nbr, aravis.get_device_physical_id, aravis.get_device_address)
            device = aravis.get_device_id(n)
            there[device] = {device, *(name(n) for name in names)}
        found = [device for device, names in there.items() if not wanted or wanted in names]
        if not wanted and not found:
            raise InputError(f"{self.name}: there is none; see its cable, power and network")
        try:
            opened = aravis.Camera.new(found[0] if found else wanted)
        except self._failure as error:
            known = f"; there are {', '.join(sorted(there))}" if there else "; none is found here"
            raise InputError(f"{self.name} cannot be opened: {error.message}{known}") from error
        if opened.is_gv_device() and not opened.get_device().is_controller():
            raise InputError(f"{self.name} is used by another program: close that, and wait some seconds")
        return opened

    def _configure(self, device: Any) -> None:
        """Set what is asked for, and log what was not taken."""
        asked, off = self._settings, self._aravis.Auto.OFF
        device.set_range_check_policy(self._aravis.RangeCheckPolicy.ENABLE)
        device.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
        device.clear_triggers()
        device.set_region(-1, -1, *asked.size)  # where it begins is the camera's own
        *_, width, height = device.get_region()
        if (width, height) != tuple(asked.size):
            raise InputError(
                f"{self.name} gives {width} x {height} pixels, not {asked.size[0]} x {asked.size[1]}: set"
                " camera.size in the rig file accordingly"
            )
        there = device.dup_available_pixel_formats_as_strings()
        formats = _FORMATS.get(asked.dtype, ())
        chosen = [one for one in formats if one in there and asked.fourcc in (None, one)]
        if not chosen:
            wanted = asked.fourcc or " or ".join(formats) or "none"
            raise InputError(
                f"{self.name} has no format for dtype {asked.dtype} (wanted: {wanted}; there are "
                f"{', '.join(there)}): set camera.dtype and camera.fourcc in the rig file accordingly"
            )
        device.set_pixel_format_from_string(chosen[0])
        if asked.exposure is not None:
            if device.is_exposure_auto_available():
                device.set_exposure_time_auto(off)
            device.set_exposure_time(1e6 * asked.exposure)
            self._compare("exposure", asked.exposure, device.get_exposure_time() / 1e6, " s")
        if asked.gain is not None:
            if device.is_gain_auto_available():
                device.set_gain_auto(off)
            device.set_gain(asked.gain)
            self._compare("gain", asked.gain, device.get_gain())
        if asked.rate is not None:
            device.set_frame_rate(asked.rate)
            self._compare("rate", asked.rate, device.get_frame_rate(), " Hz")
        if asked.trigger is not None:  # last: a rate switches it off
            device.set_trigger(asked.trigger_input or _INPUT)

    def _compare(self, what: str, asked: float, got: float, unit: str = "") -> None:
        if not np.isclose(asked, got, rtol=0.01):
            warn_of_other(self.name, what, asked, got, unit)

    @contextmanager
    def _refused_in_one_line(self) -> Iterator[None]:
        try:
            yield
        except self._failure as error:
            message = f"{self.name} cannot be set as the rig file says: {error.message}"
            raise InputError(message) from error


class DeviceClock:
    """Puts a camera's times on the clock of ``time.monotonic``.

    A frame is read at its stamp, plus the difference between the clocks, plus its transfer time. The least
    (read - stamp) of the last 5 s is added to every stamp: this removes the jitter of the transfer and
    follows the drift. A stamp that does not increase means that the camera's clock was reset: all is new.
    """

    def __init__(self) -> None:
        self._least: deque[tuple[float, float]] = deque()  # when read and difference, which both increase
        self._stamp = self._last = -math.inf

    def arrival(self, stamp: float, now: float) -> float:
        """Return when a frame arrived that was stamped so and read now; never decreasing, nor after now."""
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
    """Return how many frames are missing between two of a camera's numbers."""
    if number > before:
        return number - before - 1
    if number == before or before > _WRAP:  # it does not count, or began anew
        return 0
    return number + _WRAP - before - 1


def load_aravis() -> tuple[Any, Any]:
    """Return the library Aravis and the error that it raises; InputError if it is missing."""
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        raise InputError(f"cameras by GenICam need Aravis, which is missing ({error}); {_REMEDY}") from error
    return Aravis, GLib.Error
