"""The controller's main loop: it takes one line after the other, and waits where the firmware waits."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING

from mirrorskin.hw.emulator.grbl_errors import GrblError, SoftLimitError
from mirrorskin.hw.emulator.grbl_gcode import Action, Drive, Dwell, Pause
from mirrorskin.hw.emulator.grbl_homing import home
from mirrorskin.hw.emulator.grbl_paths import Path, Place, inside, leaving, shifted
from mirrorskin.hw.emulator.grbl_report import HELP, build, modes, parameters
from mirrorskin.hw.emulator.grbl_words import NUMBER, clean
from mirrorskin.hw.emulator.planner import BLOCKS, Move

if TYPE_CHECKING:
    from mirrorskin.hw.emulator.grbl_controller import Controller

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
