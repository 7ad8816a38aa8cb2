"""An emulated GRBL 1.1 controller with its stage, right in time, and a serial port in front of it."""

from __future__ import annotations

import contextlib
import math
import os
import random
import select
import threading
import time
import tty
from collections.abc import Callable, Mapping

from mirrorskin.hw.emulator.controller import Controller
from mirrorskin.io.types import Closing

_CHUNK = 4096  # bytes read or written at once
_BACKLOG = 65536  # bytes of replies that nobody reads, before more are lost
_NOISE = 256  # random bytes that are sent without a break
_IDLE = 0.5  # seconds after which the thread looks round even if nothing is due


class GrblMachine:
    """A controller by a clock: bytes go in, replies come out, and the axes move meanwhile.

    Nothing runs in the background: whenever something is asked for, all that has become due is done first,
    each at its own time. Every method may be called from any thread. `settings` are the ``$`` settings that
    differ from the defaults; `start` is where the axes truly are, in the coordinates that homing brings about
    (0 where it says nothing), which the controller takes for 0; `memory` is how many seconds ``position``
    goes back.
    """

    def __init__(
        self,
        settings: Mapping[int, float] | None = None,
        *,
        axes: str = "XYZ",
        start: Mapping[str, float] | None = None,
        clock: Callable[[], float] = time.monotonic,
        memory: float = 600.0,
    ) -> None:
        self.axes = axes
        place = tuple(float((start or {}).get(letter, 0.0)) for letter in axes)
        self._clock = clock
        self._lock = threading.RLock()
        self._controller = Controller(axes, settings or {}, place, clock(), memory)

    def receive(self, data: bytes) -> None:
        """Take bytes from the host, now."""
        with self._lock:
            self._current().receive(data)

    def take(self) -> bytes:
        """Return what has been replied since the last call."""
        with self._lock:
            return self._current().take()

    def next_event(self) -> float:
        """Return when something may happen next by itself, on the clock; inf for never."""
        with self._lock:
            return self._current().next_event()

    def position(self, at: float | None = None) -> dict[str, float]:
        """Return where the axes truly are at a time on the clock, by default now: mm or degrees, as homed."""
        with self._lock:
            planner = self._current().planner
            place = planner.place(self._clock() if at is None else at)
        return dict(zip(self.axes, place, strict=True))

    def moving(self, at: float | None = None) -> bool:
        """Return whether the axes move at a time on the clock, by default now."""
        with self._lock:
            planner = self._current().planner
            return planner.moving(self._clock() if at is None else at)

    def speed(self, at: float | None = None) -> float:
        """Return the speed along the path at a time on the clock, by default now; units/s."""
        with self._lock:
            planner = self._current().planner
            return planner.speed(self._clock() if at is None else at)

    def switched(self, line: str) -> list[float]:
        """Return when coolant or spindle went on, off, on, ... on the clock; it is off at first."""
        with self._lock:
            return [*self._current().switched[line]]

    @property
    def state(self) -> str:
        """The state as a report has it: Idle, Run, Hold:0, Hold:1, Alarm or Home."""
        with self._lock:
            return self._current().state

    def alarm(self, code: int) -> None:
        """Raise an alarm: 1 and 2 as limits do, others as what aborts a cycle does (with a reset)."""
        with self._lock:
            self._current().alarm(code)

    def cut_power(self) -> None:
        """Let the controller die: the axes stop dead, and nothing is answered any more."""
        with self._lock:
            self._current().die()

    def _current(self) -> Controller:
        self._controller.advance(self._clock())
        return self._controller


class GrblPort(Closing):
    """A pseudo-terminal that a controller answers on, right in time; a context manager.

    Open ``url`` as any serial port. A thread moves the bytes; it sleeps until some come or the machine has
    something to say. The port stays there when a host closes it, and there is no reset when one opens it, as
    on boards without that line. The machine's clock must be ``time.monotonic``.

    Every fault may be called from any thread, also in the middle of a move. The machine outlives the port.
    """

    def __init__(self, machine: GrblMachine) -> None:
        self.machine = machine
        self._lock = threading.Lock()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.url: str = os.ttyname(self._slave)
        self._pipe = [*os.pipe()]  # wakes the thread
        os.set_blocking(self._pipe[1], False)
        self._sending, self._noise = bytearray(), bytearray()
        self._silent = self._closing = False
        self._thread = threading.Thread(target=self._run, name="emulated controller", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Take the port away; the machine goes on with its commands."""
        self._closing = True
        self._wake()
        self._thread.join()
        with self._lock:
            for end in self._pipe:
                os.close(end)
            self._pipe = []

    def silence(self) -> None:
        """Answer nothing any more; the machine goes on, and still hears."""
        self._silent = True
        self._wake()

    def garble(self, count: int, seed: int = 0) -> None:
        """Send random bytes as fast as they are taken; replies come among them."""
        with self._lock:
            self._noise += random.Random(seed).randbytes(count)
        self._wake()

    def alarm(self, code: int) -> None:
        """Raise an alarm in the machine."""
        self.machine.alarm(code)
        self._wake()

    def unplug(self) -> None:
        """Pull the cable that feeds the board, too: the port vanishes, and the axes stop dead."""
        self.machine.cut_power()
        self._closing = True
        self._wake()
        self._thread.join()

    def _wake(self) -> None:
        with self._lock, contextlib.suppress(BlockingIOError):
            if self._pipe:
                os.write(self._pipe[1], b"!")

    def _run(self) -> None:
        try:
            while not self._closing:
                self._step()
        finally:
            os.close(self._master)
            os.close(self._slave)

    def _step(self) -> None:
        """Send what has been said, wait until there is something to do, and hear."""
        due = self.machine.next_event()  # before collecting: what becomes due meanwhile is not slept over
        said = self.machine.take()
        if not self._silent and len(self._sending) + len(said) <= _BACKLOG:
            self._sending += said
        with self._lock:  # replies first, then a little of the noise
            for waiting, most in ((self._sending, _CHUNK), (self._noise, _NOISE)):
                with contextlib.suppress(BlockingIOError):
                    if waiting:
                        del waiting[: os.write(self._master, bytes(waiting[:most]))]
            writers = [self._master] if self._sending or self._noise else []
        wait = due - time.monotonic()
        wait = min(max(wait, 0.0), _IDLE) if math.isfinite(wait) else _IDLE
        readable, _, _ = select.select([self._master, self._pipe[0]], writers, [], wait)
        if self._pipe[0] in readable:
            os.read(self._pipe[0], _CHUNK)
        if self._master in readable:
            with contextlib.suppress(BlockingIOError):
                self.machine.receive(os.read(self._master, _CHUNK))
