"""An emulated GRBL 1.1 controller with its stage in real time, behind a serial port."""

from __future__ import annotations

import contextlib
import math
import os
import random
import select
import threading
from collections.abc import Callable, Mapping
from typing import Any

import serial

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.stages.link import open_port
from mirrorskin.hw.stages.report_times import SLICE
from mirrorskin.io.base.types import Closing
from mirrorskin.twin.emulator.controller import Controller

_CHUNK = 4096  # bytes read or written at once
_BACKLOG = 65536  # maximum of unread reply bytes, beyond which replies are lost
_LOOK = 0.05  # interval at which the threads of a port check whether it was closed, seconds


class GrblMachine:
    """A controller with a clock: bytes go in, replies come out, and the axes move meanwhile.

    Nothing runs in the background: each call first processes all events that are due, at their own times. All
    methods are thread-safe. `settings` are the ``$`` settings that differ from the defaults. `start` is the
    true position of the axes in the coordinates after homing (0 where not given), which the controller
    assumes to be 0. `memory` is the length of the history of ``position``, seconds.
    """

    def __init__(
        self,
        settings: Mapping[int, float] | None = None,
        *,
        axes: str = "XYZ",
        start: Mapping[str, float] | None = None,
        clock: Clock = SYSTEM,
        memory: float = 600.0,
    ) -> None:
        self.axes = axes
        place = tuple(float((start or {}).get(letter, 0.0)) for letter in axes)
        self.clock = clock
        self._lock = threading.RLock()
        self._controller = Controller(axes, settings or {}, place, clock.now(), memory)

    def receive(self, data: bytes) -> None:
        """Receive bytes from the host, now."""
        with self._lock:
            self._current().receive(data)

    def take(self) -> bytes:
        """Return the replies since the last call."""
        with self._lock:
            return self._current().take()

    def next_event(self) -> float:
        """Return the time of the next event on the clock; inf if there is none."""
        with self._lock:
            return self._current().next_event()

    def position(self, at: float | None = None) -> dict[str, float]:
        """Return the true position of the axes at a time, by default now: mm or degrees, as homed."""
        with self._lock:
            planner = self._current().planner
            place = planner.place(self.clock.now() if at is None else at)
        return dict(zip(self.axes, place, strict=True))

    def moving(self, at: float | None = None) -> bool:
        """Return whether the axes move at a time on the clock, by default now."""
        with self._lock:
            planner = self._current().planner
            return planner.moving(self.clock.now() if at is None else at)

    def speed(self, at: float | None = None) -> float:
        """Return the speed along the path at a time on the clock, by default now; units/s."""
        with self._lock:
            planner = self._current().planner
            return planner.speed(self.clock.now() if at is None else at)

    def switched(self, line: str) -> list[float]:
        """Return the times at which coolant or spindle was switched on, off, on, ...; it is off initially."""
        with self._lock:
            return [*self._current().switched[line]]

    @property
    def state(self) -> str:
        """State as in a report: Idle, Run, Hold:0, Hold:1, Alarm or Home."""
        with self._lock:
            return self._current().state

    def alarm(self, code: int) -> None:
        """Raise an alarm: 1 and 2 as limits do, others with a reset, as errors that abort a cycle do."""
        with self._lock:
            self._current().alarm(code)

    def cut_power(self) -> None:
        """Cut the power: the axes stop without deceleration, and nothing is answered any more."""
        with self._lock:
            self._current().die()

    def _current(self) -> Controller:
        self._controller.advance(self.clock.now())
        return self._controller


class GrblLine(Closing):
    """A serial port in memory in front of a controller, on the machine's clock; a context manager.

    It is also the host's end: it has the methods of ``serial.Serial`` that drivers use, and ``open`` returns
    it. Faults can be injected into any byte and any reply: ``heard`` is called with the number of each byte
    from the host and the byte, ``said`` with the number of each reply and the reply (a line with its end).
    Their return values replace the byte or the reply. Numbers start at 1.

    Faults may occur at any time. The machine outlives the line.
    """

    def __init__(self, machine: GrblMachine) -> None:
        self.machine, self._clock = machine, machine.clock
        self.url: str = "line in memory"
        self.timeout: float | None = SLICE
        self.heard: Callable[[int, bytes], bytes] = lambda number, byte: byte
        self.said: Callable[[int, bytes], bytes] = lambda number, reply: reply
        self._count = {"heard": 0, "said": 0}
        self._coming, self._reply = bytearray(), bytearray()
        self._silent = self._gone = False
        self._change = self._clock.condition()

    def open(self) -> Any:
        """Return the host's end; earlier bytes are discarded."""
        self._collect()
        self._coming.clear()
        return self

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read."""
        with self._change:
            self._check()
            self._collect()
            return len(self._coming)

    def read(self, size: int = 1) -> bytes:
        """Wait for bytes, at most for the timeout, and return the available ones."""
        end = self._clock.now() + (math.inf if self.timeout is None else self.timeout)
        with self._change:
            while not self.in_waiting and (remaining := end - self._clock.now()) > 0:
                self._change.wait(min(remaining, max(0.0, self.machine.next_event() - self._clock.now())))
            data = bytes(self._coming[:size])
            del self._coming[:size]
        return data

    def write(self, data: bytes) -> int:
        """Send bytes to the controller, which receives them at once."""
        self._check()
        for byte in data:
            self._count["heard"] += 1
            self.machine.receive(self.heard(self._count["heard"], bytes([byte])))
        self._wake()
        return len(data)

    def flush(self) -> None:
        """Do nothing: everything written has been sent."""

    def close(self) -> None:
        """Close the line; the machine continues with its commands."""
        self._coming.clear()

    def silence(self) -> None:
        """Send no more replies; the machine continues and still receives."""
        self._silent = True

    def garble(self, count: int, seed: int = 0) -> None:
        """Send random bytes; replies follow them."""
        self._coming += random.Random(seed).randbytes(count)
        self._wake()

    def alarm(self, code: int) -> None:
        """Raise an alarm in the machine."""
        self.machine.alarm(code)
        self._wake()

    def unplug(self) -> None:
        """Pull the cable that also powers the board: the line is gone, and the axes stop at once."""
        self.machine.cut_power()
        self._gone = True
        self._wake()

    def _check(self) -> None:
        if self._gone:
            raise serial.SerialException("device reports readiness to read but returned no data")

    def _collect(self) -> None:
        """Collect the replies of the machine."""
        self._reply += self.machine.take()
        *replies, rest = self._reply.split(b"\n")
        self._reply = rest
        for reply in replies:
            self._count["said"] += 1
            came = self.said(self._count["said"], bytes(reply) + b"\n")
            if not self._silent and len(self._coming) < _BACKLOG:
                self._coming += came

    def _wake(self) -> None:
        with self._change:
            self._change.notify_all()


class GrblPort(GrblLine):
    """A pseudo-terminal in front of a controller, in real time; a context manager.

    Open ``url`` as any serial port. Two threads transfer the bytes between the terminal and the line in
    memory. The port remains when a host closes it, and opening it causes no reset, as on boards without that
    line. The machine must use the system's clock.
    """

    def __init__(self, machine: GrblMachine) -> None:
        super().__init__(machine)
        self.timeout = _LOOK
        import tty  # not available on Windows

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.url = os.ttyname(self._slave)
        self._closing = False
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._hear, self._say)]
        for thread in self._threads:
            thread.start()

    def open(self) -> serial.Serial:
        """Open the host's end of the port."""
        return open_port(self.url, 115200, self.url)

    def close(self) -> None:
        """Remove the port; the machine continues with its commands."""
        if self._closing:
            return
        self._closing = True
        self._wake()
        for thread in self._threads:
            thread.join()
        os.close(self._master)
        os.close(self._slave)

    def unplug(self) -> None:
        """Pull the cable that also powers the board: the port disappears, and the axes stop at once."""
        super().unplug()
        self.close()

    def _hear(self) -> None:
        while not self._closing:
            if select.select([self._master], [], [], _LOOK)[0]:
                with contextlib.suppress(OSError):  # nothing to read after all, or unplugged
                    self.write(os.read(self._master, _CHUNK))

    def _say(self) -> None:
        pending = b""
        while not self._closing:
            with contextlib.suppress(OSError):
                pending = pending or self.read(_CHUNK)
                if pending and select.select([], [self._master], [], _LOOK)[1]:
                    pending = pending[os.write(self._master, pending) :]
