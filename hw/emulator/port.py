"""A serial port with an emulated controller behind it, and what can go wrong with one."""

from __future__ import annotations

import contextlib
import math
import os
import random
import select
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Mapping
from types import TracebackType

from mirrorskin.hw.emulator.controller import Controller, Settings

_CHUNK = 4096  # bytes read or written at once
_BACKLOG = 65536  # bytes of replies that nobody reads, before more are lost
_NOISE = 256  # random bytes that are sent without a break
_IDLE = 0.5  # seconds after which the thread looks round even if nothing is due


class GrblPort:
    """A pseudo-terminal that a controller answers on, right in time; a context manager.

    Open ``url`` as any serial port. A thread moves the bytes; it sleeps until some come or the machine has
    something to say. The port stays there when a host closes it, and there is no reset when one opens it, as
    on boards without that line. The machine's clock must be ``time.monotonic``.

    Every fault may be called from any thread, also in the middle of a move.

    Parameters
    ----------
    machine : GrblMachine
        It outlives the port, so that one can ask where the axes were.

    Attributes
    ----------
    machine
        As given.
    url : str
        The terminal's path.
    """

    def __init__(self, machine: GrblMachine) -> None:
        self.machine = machine
        self._lock = threading.Lock()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.url = os.ttyname(self._slave)
        self._pipe = [*os.pipe()]  # wakes the thread
        os.set_blocking(self._pipe[1], False)
        self._replies: deque[tuple[float, bytes]] = deque()  # when to send what
        self._sending = bytearray()
        self._noise = bytearray()
        self._silent = self._cut = False
        self._delay = 0.0
        self._plugged, self._closing = True, False
        self._thread = threading.Thread(target=self._run, name="emulated controller", daemon=True)
        self._thread.start()

    def __enter__(self) -> GrblPort:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Take the port away; the machine goes on with what it has been told."""
        with self._lock:
            self._closing = True
        self._wake()
        self._thread.join()
        with self._lock:
            for end in self._pipe:
                os.close(end)
            self._pipe = []

    def silence(self) -> None:
        """Answer nothing any more; the machine goes on, and still hears."""
        self._set(silent=True)

    def garble(self, count: int, seed: int = 0) -> None:
        """Send random bytes as fast as they are taken; replies come among them."""
        noise = random.Random(seed).randbytes(count)
        with self._lock:
            self._noise += noise
        self._wake()

    def half_line(self) -> None:
        """Cut the next reply in the middle: the rest of that line never comes, the next one does."""
        self._set(cut=True)

    def delay(self, seconds: float) -> None:
        """Hold every reply back for some time."""
        self._set(delay=seconds)

    def alarm(self, code: int) -> None:
        """Raise an alarm in the machine."""
        self.machine.alarm(code)
        self._wake()

    def unplug(self, powered: bool = False) -> None:
        """Pull the cable: the port vanishes for good, and readers meet the end of it.

        Parameters
        ----------
        powered : bool
            Whether the controller has a supply of its own. Without, as on boards that are fed by the cable,
            the axes stop dead. With one it goes on with the moves that it has been given, and nobody can
            stop it.
        """
        if not powered:
            self.machine.cut_power()
        with self._lock:
            self._plugged = False
        self._wake()
        self._thread.join()

    def mend(self) -> None:
        """End silence, noise, delay and a cut that is still to come; a pulled cable stays out."""
        with self._lock:
            self._noise.clear()
        self._set(silent=False, cut=False, delay=0.0)

    def _set(self, silent: bool | None = None, cut: bool | None = None, delay: float | None = None) -> None:
        with self._lock:
            self._silent = self._silent if silent is None else silent
            self._cut = self._cut if cut is None else cut
            self._delay = self._delay if delay is None else delay
        self._wake()

    def _wake(self) -> None:
        with self._lock, contextlib.suppress(BlockingIOError):
            if self._pipe:
                os.write(self._pipe[1], b"!")

    def _run(self) -> None:
        try:
            while self._plugged and not self._closing:
                self._turn()
        finally:
            os.close(self._master)
            os.close(self._slave)

    def _turn(self) -> None:
        """Send what has been said, wait until there is something to do, and hear."""
        due = self.machine.next_event()  # before collecting: what becomes due meanwhile is not slept over
        self._collect()
        if self._pending():
            self._send()
        writers = [self._master] if self._pending() else []
        readable, _, _ = select.select([self._master, self._pipe[0]], writers, [], self._timeout(due))
        if self._pipe[0] in readable:
            os.read(self._pipe[0], _CHUNK)
        if self._master in readable:
            with contextlib.suppress(BlockingIOError):
                self.machine.receive(os.read(self._master, _CHUNK))

    def _timeout(self, due: float) -> float:
        with self._lock:
            if self._replies:
                due = min(due, self._replies[0][0])
        wait = due - time.monotonic()
        return min(max(wait, 0.0), _IDLE) if math.isfinite(wait) else _IDLE

    def _pending(self) -> bool:
        with self._lock:
            return bool(self._sending or self._noise)

    def _collect(self) -> None:
        """Take what the machine says, and let that pass which is due."""
        said = self.machine.take()
        now = time.monotonic()
        with self._lock:
            for line in said.splitlines(keepends=True):
                self._replies.append((now + self._delay, line))
            while self._replies and self._replies[0][0] <= now:
                self._pass(self._replies.popleft()[1])

    def _pass(self, line: bytes) -> None:
        if self._silent:
            return
        if self._cut and line.strip():
            line = line[: len(line.strip()) // 2]
            self._cut = False
        if len(self._sending) + len(line) <= _BACKLOG:
            self._sending += line

    def _send(self) -> None:
        """Write replies first, then a little of the noise."""
        with self._lock:
            for waiting, most in ((self._sending, _CHUNK), (self._noise, _NOISE)):
                with contextlib.suppress(BlockingIOError):
                    if waiting:
                        del waiting[: os.write(self._master, bytes(waiting[:most]))]


class GrblMachine:
    """A controller by a clock: bytes go in, replies come out, and the axes move meanwhile.

    Nothing runs in the background: whenever something is asked for, all that has become due is done first,
    each at its own time. Every method may be called from any thread.

    Parameters
    ----------
    settings : mapping of int to float, optional
        The ``$`` settings that differ from the defaults, by their numbers.
    axes : str
        The axes' letters; the first three take part in arcs, and there must be three or more.
    start : mapping of str to float, optional
        Where the axes truly are at power-on, in the coordinates that homing brings about; 0 otherwise. The
        controller does not know it: it begins at 0 there.
    clock : callable
        Tells the seconds.
    memory : float
        For how many seconds ``position`` remembers.

    Raises
    ------
    GrblError
        A setting cannot be.
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
        self._controller = Controller(axes, Settings(len(axes), settings or {}), place, clock(), memory)

    def receive(self, data: bytes) -> None:
        """Take bytes from the host, now."""
        with self._lock:
            self._catch_up().receive(data)

    def take(self) -> bytes:
        """Return what has been replied since the last call."""
        with self._lock:
            return self._catch_up().take()

    def next_event(self) -> float:
        """Return when something may happen next by itself, on the clock; inf for never."""
        with self._lock:
            return self._catch_up().next_event()

    def position(self, at: float | None = None) -> dict[str, float]:
        """Return where the axes truly are: mm or degrees in the coordinates that homing brings about.

        Parameters
        ----------
        at : float, optional
            A time on the clock, by default now. What was longer ago than the memory is not known: the oldest
            place is returned. What is to come is as planned by now.
        """
        with self._lock:
            planner = self._catch_up().planner
            place = planner.place(self._clock() if at is None else at)
        return dict(zip(self.axes, place, strict=True))

    def moving(self, at: float | None = None) -> bool:
        """Tell whether the axes move at a time on the clock, by default now."""
        with self._lock:
            planner = self._catch_up().planner
            return planner.moving(self._clock() if at is None else at)

    def speed(self, at: float | None = None) -> float:
        """Return the speed along the path at a time on the clock, by default now; units/s."""
        with self._lock:
            planner = self._catch_up().planner
            return planner.speed(self._clock() if at is None else at)

    @property
    def state(self) -> str:
        """The state as a report tells it: Idle, Run, Hold:0, Hold:1, Jog, Alarm, Home, Check or Sleep."""
        with self._lock:
            return self._catch_up().state

    def alarm(self, code: int) -> None:
        """Raise an alarm: 1 and 2 as limits do, others as what aborts a cycle does (with a reset)."""
        with self._lock:
            self._catch_up().alarm(code)

    def cut_power(self) -> None:
        """Let the controller die: the axes stop dead, and nothing is answered any more."""
        with self._lock:
            self._catch_up().die()

    def _catch_up(self) -> Controller:
        self._controller.advance(self._clock())
        return self._controller
