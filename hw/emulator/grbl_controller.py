"""The controller itself: what it does on realtime bytes, events and alarms, by a time that it is told.

It obeys and answers as the firmware does: lines wait in a receive buffer of 128 bytes, beyond which bytes
are lost; moves wait in a planner of 15, and the answer to a line comes once its move has found room there;
realtime bytes are obeyed at once. Machine coordinates are 0 at the homing switches and negative elsewhere
(for an axis with its bit in ``$23``, which homes the other way: minus the travel at the switch, and rising).

What is simpler than in the firmware: see ``planner.py`` for the motion, ``grbl_gcode.py`` for the language.
Soft limits are looked at for a whole arc before it begins; homing moves one axis at a time and slows down
before the switch; overrides, the safety door, ``$RST``, ``$I=`` and startup lines (``$N0=``) are not there;
a line takes a millisecond to be read, whatever it says.
"""

from __future__ import annotations

import math
from collections import deque

from mirrorskin.hw.emulator.grbl_gcode import Interpreter
from mirrorskin.hw.emulator.grbl_lines import Lines
from mirrorskin.hw.emulator.grbl_paths import Place
from mirrorskin.hw.emulator.grbl_report import BANNER, Reporter, Status
from mirrorskin.hw.emulator.grbl_settings import Settings
from mirrorskin.hw.emulator.planner import Planner

ROOM = 128  # bytes that the receive buffer holds
HARD_LIMIT, SOFT_LIMIT, ABORTED, HOMING_ABORTED = 1, 2, 3, 6
_RESET, _ASK, _HOLD, _RESUME, _CANCEL_JOG = 0x18, ord("?"), ord("!"), ord("~"), 0x85


class Controller:
    """A GRBL 1.1 controller; times must not run backwards from call to call.

    Parameters
    ----------
    axes : str
        The axes' letters.
    settings : Settings
    place : tuple of float
        Where the axes truly are.
    now : float
    memory : float
        See `Planner`.

    Attributes
    ----------
    axes, settings
        As given.
    planner : Planner
        The motion, in true coordinates.
    program : Interpreter
        The language, in the controller's own coordinates.
    error : tuple of float
        True coordinates less the controller's own; 0 once it is homed.
    now : float
        The time of what happens at the moment.
    received : deque of int
        The receive buffer.
    locked, checking, jogging, homing, sleeping : bool
        What the controller is in the middle of; locked by an alarm.
    cancelled : int
        How many times jogs were cancelled.
    lines : Lines
        The main loop.
    """

    capacity = ROOM

    def __init__(self, axes: str, settings: Settings, place: Place, now: float, memory: float) -> None:
        self.axes = axes
        self.settings = settings
        self.now = now
        self.planner = Planner(place, memory)
        self.error = place
        self.program = Interpreter(axes, self.own_place())
        self.received: deque[int] = deque()
        self._out = bytearray()
        self._reporter = Reporter()
        self._dead = False
        self.locked = bool(settings[22])
        self._boot()

    def _boot(self) -> None:
        """Begin anew, as after a reset; an alarm stays."""
        self.received.clear()
        self.program.reset(self.own_place())
        self._reporter.reset()
        self.jogging = self.checking = self.sleeping = self.homing = False
        self._critical = self._beyond = self._cancels = False
        self._asked = self._to_hold = False
        self.cancelled = 0
        self.lines = Lines(self)
        self.say("")
        self.say(BANNER)
        if self.locked:
            self.say("[MSG:'$H'|'$X' to unlock]")
        self.lines.pump()

    @property
    def room(self) -> int:
        """How many more bytes the receive buffer takes."""
        return ROOM - len(self.received)

    @property
    def suspended(self) -> bool:
        """Whether lines are not read: held, asleep, or after an alarm that asks for a reset."""
        return self._dead or self._critical or self.sleeping or self.planner.held(self.now)

    @property
    def state(self) -> str:
        """The state as a report tells it."""
        for name, holds in (
            ("Sleep", self.sleeping),
            ("Home", self.homing),
            ("Alarm", self.locked),
            ("Check", self.checking),
            ("Jog", self.jogging),
            ("Hold:0", self.planner.held(self.now)),
            ("Hold:1", self.planner.holding),
            ("Run", self.planner.busy),
        ):
            if holds:
                return name
        return "Idle"

    def own_place(self) -> Place:
        """Return where the axes are, as the controller believes."""
        return tuple(a - b for a, b in zip(self.planner.place(self.now), self.error, strict=True))

    def say(self, line: str) -> None:
        """Print a line."""
        self._out += line.encode("ascii") + b"\r\n"

    def take(self) -> bytes:
        """Return what has been printed since the last call."""
        out = bytes(self._out)
        self._out.clear()
        return out

    def next_event(self) -> float:
        """Return when something may happen next by itself, inf for never."""
        return math.inf if self._dead else min(self.planner.next_event(), self.lines.due())

    def advance(self, now: float) -> None:
        """Do all that becomes due until a time."""
        while (due := self.next_event()) <= now:
            self.now = max(self.now, due)
            self._react()
        self.now = max(self.now, now)

    def receive(self, data: bytes) -> None:
        """Take bytes that arrive now, all at once; of several questions for a report one is answered."""
        if self._dead:
            return
        for byte in data:
            if byte in (_RESET, _ASK, _HOLD, _RESUME, _CANCEL_JOG):
                self._obey_at_once(byte)
            elif byte < 0x80 and self.room:
                self.received.append(byte)
        self._react()
        if not self._critical:
            self._answer()

    def alarm(self, code: int) -> None:
        """Raise an alarm: 1 and 2 wait for a reset, others bring one along."""
        if self._dead:
            return
        if code in (HARD_LIMIT, SOFT_LIMIT):
            self._stop_for_reset(code)
        else:
            self.abort(code)

    def abort(self, code: int | None = None) -> None:
        """Stop dead and begin anew, with an alarm or without."""
        self.planner.halt(self.now)
        if code is not None:
            self.say(f"ALARM:{code}")
            self.locked = True
        if self.lines.at_work:  # a line that is cut short counts as done
            self.say("ok")
        self._boot()

    def stop_at_limit(self) -> None:
        """Slow down, and then raise the alarm of the soft limits."""
        self._beyond = True
        self.planner.hold(self.now)
        if self.planner.held(self.now):
            self._stop_for_reset(SOFT_LIMIT)

    def be_homed(self) -> None:
        """Take the true place for the own from now on, and do what had to wait meanwhile."""
        self.error = (0.0,) * len(self.axes)
        self.program.place = self.own_place()
        self.homing = self.locked = False
        self._answer()
        if self._to_hold:
            self._to_hold = False
            self.planner.hold(self.now)

    def die(self) -> None:
        """Stop dead for good."""
        self.planner.halt(self.now)
        self._dead = True
        self._out.clear()

    def _obey_at_once(self, byte: int) -> None:
        if byte == _RESET:
            self._reset()
        elif byte == _ASK:
            self._asked = True
        elif self._critical or self.sleeping:
            return
        elif byte == _HOLD and self.homing:
            self._to_hold = True
        elif self.jogging and byte in (_HOLD, _CANCEL_JOG):
            self._cancels = True
            self.planner.hold(self.now)
        elif byte == _HOLD and not (self.locked or self.checking):
            self.planner.hold(self.now)
        elif byte == _RESUME and self.planner.held(self.now) and not (self._beyond or self._cancels):
            self._resume()

    def _reset(self) -> None:
        self.locked |= self.sleeping
        if self.homing:
            self.abort(HOMING_ABORTED)
        elif self.planner.busy and not self.planner.held(self.now):
            self.abort(ABORTED)
        else:
            self.abort()

    def _resume(self) -> None:
        since = self.planner.rest
        if since is not None:
            self.lines.put_off(self.now - since)
        self.planner.resume(self.now)

    def _react(self) -> None:
        """Do what the time, or new bytes, ask for."""
        self.planner.advance(self.now)
        if self.planner.at_switch(self.now) and not self.homing:
            self._stop_for_reset(HARD_LIMIT)
        elif self._beyond and self.planner.held(self.now):
            self._stop_for_reset(SOFT_LIMIT)
        elif self._cancels and self.planner.held(self.now):
            self._drop_jogs()
        if not self.planner.busy:
            self.jogging = False
        self.lines.pump()

    def _stop_for_reset(self, code: int) -> None:
        self.planner.halt(self.now)
        self._critical = self.locked = True
        self._beyond = self._cancels = self.homing = self.jogging = False
        self.say(f"ALARM:{code}")
        self.say("[MSG:Reset to continue]")

    def _drop_jogs(self) -> None:
        self.planner.halt(self.now)
        self.program.place = self.own_place()
        self._cancels = False
        self.cancelled += 1

    def _answer(self) -> None:
        """Report, if that has been asked for; not while homing."""
        if not self._asked or self.homing:
            return
        self._asked = False
        status = Status(
            state=self.state,
            place=self.own_place(),
            offset=self.program.offset,
            speed=self.planner.speed(self.now) * 60,
            spindle=self.program.spindle if self.program.modes["spindle"] != "M5" else 0.0,
            blocks=self.planner.free,
            bytes=self.room,
        )
        self.say(self._reporter.line(status, self.settings))
