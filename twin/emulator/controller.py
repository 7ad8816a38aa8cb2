"""An emulated GRBL 1.1 controller: its reaction to lines, realtime bytes and alarms, as a function of time.

It behaves like the firmware: lines wait in a receive buffer of 128 bytes, beyond which bytes are lost; moves
wait in a planner of 15, and a line is answered when its move is in the planner; realtime bytes are executed
at once. Machine coordinates are 0 at the homing switches and negative elsewhere.

It supports what the driver uses: moves (``gcode.py``), the outputs coolant and spindle, ``$$``, ``$I``,
``$X``, ``$H``, hold, resume and reset; and what another program may send: the door, and work offsets. Soft
limits are checked for a whole arc before it starts; homing moves one axis at a time and slows down before the
switch; reading any line takes a millisecond.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Generator, Mapping

from mirrorskin.twin.emulator.gcode import GrblError, Interpreter
from mirrorskin.twin.emulator.motion import BLOCKS, Line, Move, Path, Place, Planner, shifted, stays_inside

BANNER = "Grbl 1.1h ['$' for help]"
BUILD = "[VER:1.1h.20190830:]"
RX_BUFFER = 128  # size of the receive buffer, bytes
LINE_TIME = 1e-3  # time to read a line, seconds
HARD_LIMIT, SOFT_LIMIT, ABORTED, HOMING_ABORTED, NO_SWITCH = 1, 2, 3, 6, 9

_RESET, _QUERY, _HOLD, _RESUME, _DOOR = 0x18, ord("?"), ord("!"), ord("~"), 0x84
_SWITCHES: Mapping[str, tuple[str, bool]] = {
    "M8": ("coolant", True),
    "M9": ("coolant", False),
    "M3S999999": ("spindle", True),
    "M5": ("spindle", False),
}
_LINE_MAX = 79  # maximum length of a line without spaces
_WCO_EVERY = 10  # one report in this many contains the work offset
_SEEK_TRAVELS = 1.5  # homing fails after this many lengths of the axis
_FIRST_AXIS = 2  # the firmware homes Z first

# Settings of a small, fast stage: report in inches, soft limits, homing (on, slow and fast rate per minute,
# debounce in ms, pull-off); and for each axis: steps per unit, rate per minute, acceleration, travel.
_SETTINGS: Mapping[int, float] = {10: 1, 13: 0, 20: 0, 22: 0, 24: 25.0, 25: 500.0, 26: 250, 27: 1.0}
_PER_AXIS: Mapping[int, float] = {100: 1000.0, 110: 1800.0, 120: 500.0, 130: 200.0}

# The main loop waits for a time, or for a condition.
_Wait = float | Callable[[], bool]
_Steps = Generator[_Wait, None, None]


class Controller:
    """A GRBL 1.1 controller; times must not decrease from call to call.

    `settings` are the ``$`` settings that differ from the defaults. `place` is the true position of the axes;
    until it has homed, the controller counts from there. Its `planner` uses true coordinates.
    """

    def __init__(
        self, axes: str, settings: Mapping[int, float], place: Place, now: float, memory: float
    ) -> None:
        numbers = range(len(axes))
        axis_settings = {base + axis: value for base, value in _PER_AXIS.items() for axis in numbers}
        self._settings = {**_SETTINGS, **axis_settings, **settings}
        self._axes = len(axes)
        self._now = now
        self.planner: Planner = Planner(place, memory)
        self._offset = place  # true coordinates minus the controller's coordinates
        self._program = Interpreter(axes, self._own_place())
        self._received: deque[int] = deque()
        self._out = bytearray()
        self._powered_off = False
        self._locked = bool(self._settings[22])
        self.switched: dict[str, list[float]] = {
            line: [] for line, _ in _SWITCHES.values()
        }  # times at which it was switched on, off, on, ...
        self._boot()

    def _boot(self) -> None:
        """Restart as after a reset; an alarm remains."""
        self._switch_off()
        self._received.clear()
        self._program.reset(self._own_place())
        self._homing = self._needs_reset = self._limit_reached = self._executing = False
        self._report_due = self._hold_pending = self._door_opened = False
        self._reports = 0
        self._steps = self._loop()
        self._wait: _Wait = -math.inf
        self._say("")
        self._say(BANNER)
        if self._locked:
            self._say("[MSG:'$H'|'$X' to unlock]")
        self._run_steps()

    @property
    def state(self) -> str:
        """State as in a report."""
        for name, holds in (
            ("Home", self._homing),
            ("Alarm", self._locked),
            ("Door:0", self._door_opened and self.planner.held(self._now)),
            ("Door:2", self._door_opened),
            ("Hold:0", self.planner.held(self._now)),
            ("Hold:1", self.planner.holding),
            ("Run", self.planner.busy),
        ):
            if holds:
                return name
        return "Idle"

    def take(self) -> bytes:
        """Return the output since the last call."""
        out = bytes(self._out)
        self._out.clear()
        return out

    def next_event(self) -> float:
        """Return the time of the next event, inf if there is none."""
        if self._powered_off:
            return math.inf
        due = math.inf if self._suspended or callable(self._wait) else self._wait
        return min(self.planner.next_event(), due)

    def advance(self, now: float) -> None:
        """Process all events up to a time."""
        while (due := self.next_event()) <= now:
            self._now = max(self._now, due)
            self._react()
        self._now = max(self._now, now)

    def receive(self, data: bytes) -> None:
        """Receive bytes now; several queries at once get one report."""
        if self._powered_off:
            return
        for byte in data:
            if byte in (_RESET, _QUERY, _HOLD, _RESUME, _DOOR):
                self._on_realtime(byte)
            elif byte < 0x80 and len(self._received) < RX_BUFFER:
                self._received.append(byte)
        self._react()
        if not self._needs_reset:
            self._report()

    def alarm(self, code: int) -> None:
        """Raise an alarm: 1 and 2 wait for a reset, others include one."""
        if self._powered_off:
            return
        if code in (HARD_LIMIT, SOFT_LIMIT):
            self._lock_until_reset(code)
        else:
            self._abort(code)

    def die(self) -> None:
        """Stop permanently, without deceleration."""
        self.planner.halt(self._now)
        self._switch_off()
        self._powered_off = True
        self._out.clear()

    @property
    def _suspended(self) -> bool:
        """Whether lines are not read: on hold, or after an alarm that requires a reset."""
        return self._powered_off or self._needs_reset or self.planner.held(self._now)

    def _own_place(self) -> Place:
        """Return the position of the axes in the controller's coordinates."""
        return tuple(a - b for a, b in zip(self.planner.place(self._now), self._offset, strict=True))

    def _say(self, line: str) -> None:
        self._out += line.encode("ascii") + b"\r\n"

    def _per_axis(self, base: int) -> tuple[float, ...]:
        return tuple(self._settings[base + axis] for axis in range(self._axes))

    # Realtime bytes and their effects

    def _on_realtime(self, byte: int) -> None:
        if byte == _RESET:
            running = self.planner.busy and not self.planner.held(self._now)
            self._abort(HOMING_ABORTED if self._homing else ABORTED if running else None)
        elif byte == _QUERY:
            self._report_due = True
        elif self._needs_reset:
            return
        elif byte in (_HOLD, _DOOR) and self._homing:
            self._hold_pending = True
        elif byte in (_HOLD, _DOOR) and not self._locked:
            self.planner.hold(self._now)
            self._door_opened |= byte == _DOOR
        elif byte == _RESUME and self.planner.held(self._now) and not self._limit_reached:
            self._door_opened = False
            self.planner.resume(self._now)

    def _react(self) -> None:
        """Process what is due now."""
        self.planner.advance(self._now)
        if self._limit_reached and self.planner.held(self._now):
            self._lock_until_reset(SOFT_LIMIT)
        self._run_steps()

    def _abort(self, code: int | None) -> None:
        """Stop without deceleration and restart, with or without an alarm."""
        self.planner.halt(self._now)
        if code is not None:
            self._say(f"ALARM:{code}")
            self._locked = True
        if self._executing:  # an interrupted line counts as done
            self._say("ok")
        self._boot()

    def _lock_until_reset(self, code: int) -> None:
        self.planner.halt(self._now)
        self._switch_off()
        self._needs_reset = self._locked = True
        self._limit_reached = self._homing = False
        self._say(f"ALARM:{code}")
        self._say("[MSG:Reset to continue]")

    def _report(self) -> None:
        """Send a report if one was queried; not while homing."""
        if not self._report_due or self._homing:
            return
        self._report_due = False
        # Adding 0 converts -0 to 0.
        place = ",".join(f"{round(value, 3) + 0.0:.3f}" for value in self._own_place())
        fields = [self.state, f"MPos:{place}", f"FS:{self.planner.speed(self._now) * 60:.0f},0"]
        if self._reports % _WCO_EVERY == 0:
            fields.append("WCO:" + ",".join(f"{offset:.3f}" for offset in self._program.offset))
        self._reports += 1
        self._say(f"<{'|'.join(fields)}>")

    # The main loop: one line after the other, waiting where the firmware waits

    def _run_steps(self) -> None:
        """Continue until something must be waited for."""
        while not self._suspended:
            steps, wait = self._steps, self._wait
            if not (wait() if callable(wait) else self._now >= wait):
                return
            wait = next(steps)
            if steps is self._steps:  # otherwise there was a reset
                self._wait = wait

    def _loop(self) -> _Steps:
        line = bytearray()
        while True:
            yield lambda: bool(self._received)
            byte = self._received.popleft()
            if byte not in b"\r\n":
                line.append(byte)
                continue
            self._executing = True
            yield self._now + LINE_TIME
            yield from self._execute(re.sub(r"\s", "", line.decode("ascii")).upper())
            self._executing = False
            line.clear()

    def _execute(self, line: str) -> _Steps:
        try:
            if len(line) > _LINE_MAX:
                raise GrblError(11)
            if line.startswith("$"):
                yield from self._command(line[1:])
            elif line:
                if self._locked:
                    raise GrblError(9)
                if line in _SWITCHES:
                    yield lambda: not self.planner.busy
                    self._switch(*_SWITCHES[line])
                elif line.startswith(("G92", "G10")):
                    yield from self._set_offset(line)
                elif (drive := self._program.run(line)) is not None:
                    yield from self._drive(*drive)
        except GrblError as error:
            self._say(str(error))
        else:
            self._say("ok")

    def _set_offset(self, line: str) -> _Steps:
        """Change the work offset, by ``G92`` before moves end, by ``G10`` afterwards; then it is reported."""
        waits = line.startswith("G10")
        yield lambda: not (waits and self.planner.busy)
        if not self._program.set_offset(line):
            raise GrblError(20)
        yield lambda: not self.planner.busy
        self._reports = 0

    def _switch(self, line: str, on: bool) -> None:
        if on != len(self.switched[line]) % 2:
            self.switched[line].append(self._now)

    def _switch_off(self) -> None:
        for line in self.switched:
            self._switch(line, False)

    def _drive(self, path: Path, feed: float) -> _Steps:
        """Wait until the planner has room, and add a move; refuse it beyond active soft limits."""
        low = tuple(-travel for travel in self._per_axis(130))
        if self._settings[20] and not stays_inside(path, low, (0.0,) * self._axes):
            self._limit_reached = True
            self.planner.hold(self._now)
            if self.planner.held(self._now):
                self._lock_until_reset(SOFT_LIMIT)
            yield lambda: False
        yield lambda: self.planner.free > 0
        path = shifted(path, self._offset)
        rates = [rate / 60 for rate in self._per_axis(110)]
        self.planner.add(Move(path, *path.limits(feed, rates, self._per_axis(120))), self._now)

    def _command(self, text: str) -> _Steps:
        """Execute a command that follows a ``$``."""
        if text == "X":
            if self._locked:
                self._locked = False
                self._say("[MSG:Caution: Unlocked]")
        elif self.state not in ("Idle", "Alarm"):
            raise GrblError(8)
        elif text == "$":
            for number, value in sorted(self._settings.items()):
                self._say(f"${number}={value:.3f}" if number >= 100 else f"${number}={value:g}")
        elif text == "I":
            self._say(BUILD)
            self._say(f"[OPT:V,{BLOCKS},{RX_BUFFER}]")
        elif text == "H":
            yield from self._home()
        else:
            raise GrblError(2)  # like a setting without a number

    def _home(self) -> _Steps:
        """Home one axis after the other: to the switch, off it, slowly to it again, and off it."""
        if not self._settings[22]:
            raise GrblError(5)
        self._homing = True
        off = -self._settings[27]
        quick, slow = self._settings[25] / 60, self._settings[24] / 60
        for axis in sorted(range(self._axes), key=lambda axis: (axis != _FIRST_AXIS, axis)):
            here, farthest = self.planner.place(self._now)[axis], _SEEK_TRAVELS * self._settings[130 + axis]
            if -here > farthest:
                yield from self._seek(axis, here + farthest, quick)
                self._abort(NO_SWITCH)
                yield lambda: False
            for goal, speed in ((0.0, quick), (off, quick), (0.0, slow), (off, quick)):
                yield from self._seek(axis, goal, speed)
        self._offset = (0.0,) * self._axes
        self._program.place = self._own_place()
        self._homing = self._locked = False
        self._report()
        if self._hold_pending:
            self._hold_pending = False
            self.planner.hold(self._now)

    def _seek(self, axis: int, goal: float, speed: float) -> _Steps:
        """Move one axis, and wait for the switch to settle."""
        start = self.planner.place(self._now)
        end = (*start[:axis], goal, *start[axis + 1 :])
        if start != end:
            self.planner.add(Move(Line(start, end), speed, self._settings[120 + axis]), self._now)
            yield lambda: not self.planner.busy
        yield self._now + self._settings[26] / 1000
