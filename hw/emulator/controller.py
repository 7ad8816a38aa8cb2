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
import re
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass

from mirrorskin.hw.emulator.gcode import (
    NUMBER,
    Action,
    Drive,
    Dwell,
    GrblError,
    Interpreter,
    Pause,
    SoftLimitError,
    clean,
)
from mirrorskin.hw.emulator.motion import BLOCKS, Line, Move, Path, Place, Planner, inside, leaving, shifted

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


BANNER = "Grbl 1.1h ['$' for help]"
HELP = "[HLP:$$ $# $G $I $N $x=val $J=line $SLP $C $X $H ~ ! ? ctrl-x]"
_INCH = 25.4
_AT_REST = {"Idle", "Alarm", "Check", "Sleep"}
# How often the offset and the overrides are told: every so many reports at rest, and otherwise.
_OFFSET_EVERY = (10, 30)
_OVERRIDES_EVERY = (10, 20)


@dataclass(frozen=True, slots=True)
class Status:
    """What a status report is made of.

    Attributes
    ----------
    state : str
    place, offset : tuple of float
        Machine coordinates, and where work coordinates begin in them.
    speed : float
        Units a minute.
    spindle : float
    blocks, bytes : int
        Room in the planner and in the receive buffer.
    """

    state: str
    place: Place
    offset: Place
    speed: float
    spindle: float
    blocks: int
    bytes: int


class Reporter:
    """Status reports, and what is only told in some of them."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Tell the offset in the next report, the overrides in the one after."""
        self._offset: Place | None = None
        self._until_offset = 0
        self._until_overrides = 0

    def line(self, status: Status, settings: Settings) -> str:
        """Return a status report."""
        scale, decimals = (1 / _INCH, 4) if settings[13] else (1.0, 3)
        mask = int(settings[10])
        place = status.place
        if not mask & 1:
            place = tuple(a - b for a, b in zip(place, status.offset, strict=True))
        fields = [status.state, f"{'MPos' if mask & 1 else 'WPos'}:{_numbers(place, scale, decimals)}"]
        if mask & 2:
            fields.append(f"Bf:{status.blocks},{status.bytes}")
        fields.append(f"FS:{status.speed * scale:.0f},{status.spindle:.0f}")
        fields += self._sometimes(status, scale, decimals)
        return f"<{'|'.join(fields)}>"

    def _sometimes(self, status: Status, scale: float, decimals: int) -> list[str]:
        busy = status.state not in _AT_REST
        if status.offset != self._offset:
            self._offset, self._until_offset = status.offset, 0
        if self._until_offset == 0:
            self._until_offset = _OFFSET_EVERY[busy] - 1
            self._until_overrides = max(self._until_overrides, 1)
            return [f"WCO:{_numbers(status.offset, scale, decimals)}"]
        self._until_offset -= 1
        if self._until_overrides == 0:
            self._until_overrides = _OVERRIDES_EVERY[busy] - 1
            return ["Ov:100,100,100"]
        self._until_overrides -= 1
        return []


def parameters(program: Interpreter) -> Iterable[str]:
    """Yield what ``$#`` prints."""
    none = _numbers((0.0,) * len(program.axes))
    for number, offset in enumerate(program.systems):
        yield f"[G{54 + number}:{_numbers(offset)}]"
    yield f"[G28:{none}]"
    yield f"[G30:{none}]"
    yield f"[G92:{_numbers(program.shift)}]"
    yield "[TLO:0.000]"
    yield f"[PRB:{none}:0]"


def modes(program: Interpreter) -> str:
    """Return what ``$G`` prints."""
    groups = (
        *("motion", "coordinates", "plane", "units", "distance", "feed mode"),
        *("spindle", "coolant"),
    )
    words = " ".join(program.modes[group] for group in groups)
    return f"[GC:{words} T{program.tool} F{program.feed:.0f} S{program.spindle:.0f}]"


def build(blocks: int, room: int) -> Iterable[str]:
    """Yield what ``$I`` prints."""
    yield "[VER:1.1h.20190825:]"
    yield f"[OPT:VM,{blocks},{room}]"


def _numbers(values: Iterable[float], scale: float = 1.0, decimals: int = 3) -> str:
    # Adding 0 makes plain zeros of negative ones.
    return ",".join(f"{round(value * scale, decimals) + 0.0:.{decimals}f}" for value in values)


_COMMON: dict[int, float] = {
    0: 10,  # step pulse, us
    1: 25,  # step idle delay, ms
    2: 0,
    3: 0,
    4: 0,
    5: 0,
    6: 0,
    10: 1,  # status report: 1 machine position, 2 buffers
    11: 0.010,  # junction deviation
    12: 0.002,  # arc tolerance
    13: 0,  # report in inches
    20: 0,  # soft limits
    21: 0,  # hard limits
    22: 0,  # homing
    23: 0,  # homing direction: bits of the axes that home downwards
    24: 25.0,  # homing: slow rate a minute
    25: 500.0,  # homing: quick rate a minute
    26: 250,  # homing: debounce, ms
    27: 1.0,  # homing: pull-off
    30: 1000,
    31: 0,
    32: 0,
}
# Of each axis: steps a unit, rate a minute, acceleration in units/s^2, travel.
_PER_AXIS: dict[int, float] = {100: 1000.0, 110: 1800.0, 120: 500.0, 130: 200.0}
_WITH_DECIMALS = {11, 12, 24, 25, 27}
_POSITIVE = {24, 25}


class Settings:
    """What ``$$`` shows and ``$N=value`` sets.

    Parameters
    ----------
    axes : int
        How many there are.
    changed : mapping of int to float
        What differs from the defaults.

    Raises
    ------
    GrblError
        A number is unknown or a value cannot be.
    """

    def __init__(self, axes: int, changed: Mapping[int, float]) -> None:
        self._axes = axes
        self._values = dict(_COMMON)
        for base, value in _PER_AXIS.items():
            self._values.update({base + axis: value for axis in range(axes)})
        for number in sorted(changed, reverse=True):  # homing ($22) before the soft limits that need it ($20)
            self.set(number, changed[number])

    def __getitem__(self, number: int) -> float:
        """Return a setting by its number."""
        return self._values[number]

    def per_axis(self, base: int) -> tuple[float, ...]:
        """Return a setting of all axes: 110 rates a minute, 120 accelerations, 130 travels."""
        return tuple(self._values[base + axis] for axis in range(self._axes))

    def set(self, number: int, value: float) -> None:
        """Change a setting, as ``$N=value`` does."""
        if number not in self._values:
            raise GrblError(3)
        if value < 0 or (value == 0 and (number >= 100 or number in _POSITIVE)):
            raise GrblError(4)
        if number == 0 and value < 3:
            raise GrblError(6)
        if number == 20 and value and not self._values[22]:
            raise GrblError(10)
        if number == 22 and not value:
            self._values[20] = 0
        self._values[number] = value

    def lines(self) -> Iterable[str]:
        """Yield what ``$$`` prints."""
        for number, value in sorted(self._values.items()):
            decimals = number >= 100 or number in _WITH_DECIMALS
            yield f"${number}={value:.3f}" if decimals else f"${number}={value:.0f}"


_SEARCH = 1.5  # travels within which the switch must be found
_NOT_FOUND = 9
_FIRST_AXIS = 2  # the firmware homes Z before the others


def home(controller: Controller) -> Generator[float | Callable[[], bool], None, None]:
    """Home one axis after the other; the alarm is off afterwards.

    Raises
    ------
    GrblError
        5: homing is disabled by ``$22``.
    """
    if not controller.settings[22]:
        raise GrblError(5)
    controller.homing = True
    count = len(controller.axes)
    for axis in sorted(range(count), key=lambda axis: (axis != _FIRST_AXIS, axis)):
        yield from _home_axis(controller, axis)
    controller.be_homed()


def _home_axis(controller: Controller, axis: int) -> Generator[float | Callable[[], bool], None, None]:
    settings = controller.settings
    sign = -1 if int(settings[23]) >> axis & 1 else 1
    travel = settings[130 + axis]
    switch = 0.0 if sign > 0 else -travel
    off = switch - sign * settings[27]
    seek, locate = settings[25] / 60, settings[24] / 60
    here = controller.planner.place(controller.now)[axis]
    if (switch - here) * sign > _SEARCH * travel:
        yield from _go(controller, axis, here + sign * _SEARCH * travel, seek)
        controller.abort(_NOT_FOUND)
        yield lambda: False
    for goal, speed in ((switch, seek), (off, seek), (switch, locate), (off, seek)):
        yield from _go(controller, axis, goal, speed)


def _go(
    controller: Controller, axis: int, goal: float, speed: float
) -> Generator[float | Callable[[], bool], None, None]:
    """Drive one axis, and wait for the switch to settle."""
    planner, settings = controller.planner, controller.settings
    start = planner.place(controller.now)
    end = (*start[:axis], goal, *start[axis + 1 :])
    if start != end:
        move = Move(Line(start, end), speed, settings[120 + axis])
        planner.add(move, controller.now, settings[11], settings.per_axis(120))
        yield lambda: not planner.busy
    yield controller.now + settings[26] / 1000


LINE_TIME = 1e-3  # seconds that a line takes to be read
_LONGEST = 79  # characters, without spaces and comments
_NAMES = "$#GCXHIRS"  # commands that take nothing behind their name

# What the main loop waits for: a time, or that something holds.
Wait = float | Callable[[], bool]
Steps = Generator[Wait, None, None]


class Lines:
    """The main loop, from a reset to the next.

    Parameters
    ----------
    controller : Controller

    Attributes
    ----------
    at_work : bool
        Whether a line has been begun and not been answered.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._planner = controller.planner
        self._program = controller.program
        self._settings = controller.settings
        self.at_work = False
        self._steps = self._loop()
        self._wait: Wait = -math.inf

    def due(self) -> float:
        """Return until when the loop waits, inf if it waits for no time."""
        if self._controller.suspended or callable(self._wait):
            return math.inf
        return self._wait

    def put_off(self, seconds: float) -> None:
        """Lengthen a wait by what a hold has lasted."""
        if not callable(self._wait):
            self._wait += seconds

    def pump(self) -> None:
        """Go on as far as nothing has to be waited for."""
        while self._controller.lines is self and not self._controller.suspended:
            wait = self._wait
            if not (wait() if callable(wait) else self._controller.now >= wait):
                return
            self._wait = next(self._steps)

    def _loop(self) -> Steps:
        line = bytearray()
        received = self._controller.received
        while True:
            yield lambda: bool(received)
            byte = received.popleft()
            if byte not in b"\r\n":
                line.append(byte)
                continue
            self.at_work = True
            yield self._controller.now + LINE_TIME
            yield from self._execute(clean(line.decode("ascii")))
            self.at_work = False
            line.clear()

    def _execute(self, line: str) -> Steps:
        try:
            yield from self._obey(line)
        except GrblError as error:
            self._controller.say(str(error))
        except SoftLimitError:
            self._controller.stop_at_limit()
            yield _never
        else:
            self._controller.say("ok")

    def _obey(self, line: str) -> Steps:
        if len(line) > _LONGEST:
            raise GrblError(11)
        if line.startswith("$"):
            yield from self._command(line[1:])
        elif line:
            if self._controller.locked or self._controller.jogging:
                raise GrblError(9)
            for action in self._program.run(line):
                yield from self._do(action)

    def _do(self, action: Action) -> Steps:
        if isinstance(action, Drive):
            if not self._within(action.path):
                raise SoftLimitError
            yield from self.drive(action, jog=False)
            return
        yield self._at_rest
        if isinstance(action, Dwell):
            if action.seconds and not self._controller.checking:
                yield self._controller.now + action.seconds
        elif isinstance(action, Pause):
            if not self._controller.checking:
                self._planner.hold(self._controller.now)
                yield lambda: not self._planner.holding
        else:
            self._controller.say(action.text)

    def drive(self, action: Drive, *, jog: bool) -> Steps:
        """Wait for room in the planner, and put a move there."""
        if self._controller.checking:
            return
        cancelled = self._controller.cancelled
        yield lambda: self._planner.free > 0
        if self._controller.cancelled != cancelled:
            return
        accelerations = self._settings.per_axis(120)
        path = shifted(action.path, self._controller.error)
        rates = [rate / 60 for rate in self._settings.per_axis(110)]
        feed = math.inf if action.feed is None else action.feed
        speed, acceleration = path.limits(feed, rates, accelerations)
        leave = leaving(path, *self._travel()) if self._settings[21] else None
        move = Move(path, speed, acceleration, leave)
        self._planner.add(move, self._controller.now, self._settings[11], accelerations)
        self._controller.jogging = jog

    def _within(self, path: Path) -> bool:
        """Tell whether the soft limits, if they are on, allow a path."""
        if not self._settings[20]:
            return True
        low, high = self._travel()
        return inside(path.end, low, high) and leaving(path, low, high) is None

    def _travel(self) -> tuple[Place, Place]:
        travels = self._settings.per_axis(130)
        return tuple(-travel for travel in travels), (0.0,) * len(travels)

    def _at_rest(self) -> bool:
        return not self._planner.busy

    def _command(self, text: str) -> Steps:
        """Obey what stands behind a ``$``."""
        if text.startswith("J"):
            yield from self._jog(text)
        elif text in ("", "$", "G", "C", "X"):
            yield from self._any_time(text)
        elif self._controller.state not in ("Idle", "Alarm"):
            raise GrblError(8)
        elif text == "H":
            yield from home(self._controller)
        elif text == "SLP":
            self._controller.say("[MSG:Sleeping]")
            self._controller.sleeping = True
        elif text in ("#", "I", "N"):
            for line in self._print(text):
                self._controller.say(line)
        else:
            self._set(text)

    def _any_time(self, text: str) -> Steps:
        say = self._controller.say
        if text == "":
            say(HELP)
        elif text == "G":
            say(modes(self._program))
        elif text == "X":
            if self._controller.locked:
                self._controller.locked = False
                say("[MSG:Caution: Unlocked]")
        elif text == "$":
            if self._controller.state.startswith(("Run", "Hold")):
                raise GrblError(8)
            for line in self._settings.lines():
                say(line)
        else:
            yield from self._check_mode()

    def _check_mode(self) -> Steps:
        if self._controller.checking:
            self._controller.say("[MSG:Disabled]")
            self._controller.abort()
            yield _never
        if self._controller.state != "Idle":
            raise GrblError(8)
        self._controller.checking = True
        self._controller.say("[MSG:Enabled]")

    def _print(self, text: str) -> list[str]:
        if text == "#":
            return list(parameters(self._program))
        if text == "I":
            return list(build(BLOCKS, self._controller.capacity))
        return ["$N0=", "$N1="]

    def _set(self, text: str) -> None:
        number = re.match(r"\d+", text)
        if number is None:
            raise GrblError(3 if text[0] in _NAMES else 2)
        if text[number.end() : number.end() + 1] != "=":
            raise GrblError(3)
        value = NUMBER.fullmatch(text, number.end() + 1)
        if value is None:
            raise GrblError(2)
        self._settings.set(int(number.group()), float(value.group()))

    def _jog(self, text: str) -> Steps:
        if self._controller.state not in ("Idle", "Jog"):
            raise GrblError(8)
        if not text.startswith("J="):
            raise GrblError(3)
        before = self._program.place
        for action in self._program.jog(text[2:]):
            assert isinstance(action, Drive)
            if not self._within(action.path):
                self._program.place = before
                raise GrblError(15)
            yield from self.drive(action, jog=True)


def _never() -> bool:
    return False
