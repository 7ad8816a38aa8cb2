"""An emulated GRBL 1.1 controller with its stage, right in time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping

from mirrorskin.hw.emulator.grbl_controller import Controller
from mirrorskin.hw.emulator.grbl_settings import Settings


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
