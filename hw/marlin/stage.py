"""A stage behind a Marlin controller, such as a printer's; it goes in steps."""

from __future__ import annotations

import functools
import itertools
import math
import operator
import re
import statistics
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, NoReturn

from mirrorskin.hw.clock import SYSTEM, Clock
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.grbl.link import close_port, open_port
from mirrorskin.hw.grbl.moves import Axes
from mirrorskin.hw.grbl.replies import Noise, Splitter
from mirrorskin.hw.rig.plans import Trapezoid
from mirrorskin.hw.rig_file import StageSettings
from mirrorskin.hw.stage import Limits, Position, Report
from mirrorskin.io import InputError
from mirrorskin.io.types import Closing

if TYPE_CHECKING:
    import serial

_BOOT = 12.0  # seconds that a controller may take to start; many do so when the port is opened
_KNOCK = 1.0  # seconds after which it is asked again who it is
_QUIET = 0.3  # seconds without an answer, after which none is still to come
_PREPARE = ("G21", "G90", "M84 S0")  # millimetres, absolute places, motors that are never let go at rest
_WATCH = 0.1  # seconds from one sign of life to the next in motion
_TICK = 0.01
_HUSH = 0.3  # seconds in motion that an answer may take at least: it draws on its display between two
_BUSY = 10.0  # seconds that it may be busy without saying so; it says so every two
_HOMING = 180.0  # seconds
_TRIPS = 4  # usual round trips at least, that an answer may take in motion
_ARRIVED = 0.02  # mm or degrees: places are told to 0.01
_SAME_STEPS = 1e-3  # relative, as M92 tells them
_REPORTS_MAX = 1 << 17
_STOP, _KILL = b"\nM410\n", b"\nM112\n"
_PLACE = re.compile(r"([A-Z]):(-?\d+\.?\d*)")
_WORD = re.compile(r"([A-Z])(\d+\.?\d*)")
_FAULTS = re.compile(r"Error:|!!|Resend:|echo:Unknown command|echo:Home |//action:(cancel|disconnect|kill)")


class MarlinStage(Closing):
    """A stage that a Marlin controller moves; see `mirrorskin.hw.stage.Stage`.

    Marlin answers one line at a time, and does not tell where it is while it moves: the body goes in steps,
    and sweeps and precessions are refused. It is asked for a sign of life ten times a second meanwhile, with
    no line pending that would keep it from a stop. Lines have a number and a checksum, lest noise changes a
    place. Homing is stopped by killing the controller, which must be switched off and on then; without
    ``EMERGENCY_PARSER`` that is not certain.

    Parameters
    ----------
    settings : StageSettings
        Where it is plugged in, its axes and limits.
    port : serial.Serial, optional
        What to speak through instead of opening ``settings.port``; it is closed with the stage.
    clock : Clock
        What it waits by.

    Raises
    ------
    InputError
        No such port, one in use, one behind which there is no Marlin, or a machine that prints.

    Examples
    --------
    >>> with MarlinStage(load_rig("rig.toml").stage) as stage:  # doctest: +SKIP
    ...     stage.home()
    ...     stage.move(Position(travel=1.0))
    ...     stage.wait().position.travel
    1.0
    """

    def __init__(
        self, settings: StageSettings, port: serial.Serial | None = None, *, clock: Clock = SYSTEM
    ) -> None:
        self.name: str = f"stage {settings.port}"
        self.limits: Limits = settings.limits
        self.error: HardwareError | None = None
        self.axes: Axes = Axes(settings, self.name, "G1")
        self._settings = settings
        self._port = open_port(settings.port, settings.baud, self.name) if port is None else port
        self.clock = clock
        self._lock, self._ended = clock.condition(), clock.event()
        self._splitter, self._noise = Splitter(), Noise()
        self._number: int | None = None  # of the last line; None as long as nobody knows who is there
        self._trips: deque[float] = deque([0.0], maxlen=15)
        self._reports: deque[Report] = deque(maxlen=_REPORTS_MAX)
        self._target: Position | None = None
        self._due: float | None = None  # when a move that was begun should end
        self._homing = False
        self._acceleration = 1e6  # of the slowest axis, machine units/s^2
        try:
            self.firmware: str = self._open()
        except BaseException as error:
            close_port(self._port)
            if isinstance(error, HardwareError):
                raise InputError(str(error)) from error
            raise
        self._thread = clock.thread(self._watch, f"{self.name}: watch")
        self._thread.start()

    def check_way(self, start: Position, place: Position, speed: float | None) -> NoReturn:
        """Refuse a sweep: nobody could say where the body was in its frames."""
        raise InputError(f"{self.name}: Marlin does not tell where it is while it moves; go in steps")

    def check_turns(self, tilt: float, turns: float, rate: float) -> NoReturn:
        """Refuse a precession, as a sweep."""
        raise InputError(f"{self.name}: Marlin does not tell where it is while it turns; go in steps")

    def precess(self, tilt: float, turns: float, rate: float, start: float = 0.0) -> NoReturn:
        """Refuse a precession, as a sweep."""
        self.check_turns(tilt, turns, rate)

    def home(self) -> None:
        """Find the switches of the rig's axes; returns when they are found."""
        with self._guarded(), self._lock:
            self._homing = True  # also after a failure: the stop of homing depends on it
            self._ask(f"G28 {' '.join(sorted(self.axes.letters.values()))}", _HOMING)
            self._homing = False
            self._target = self._locate().position

    def move(self, place: Position, speed: float | None = None) -> None:
        """Begin to go to a place in a straight line; see ``Stage.move``."""
        self.follow([place], speed)

    def follow(self, places: Sequence[Position], speed: float | None = None) -> None:
        """Begin to go to some places, one after the other; see ``Stage.follow``."""
        for place in places:
            self.limits.check(place, self.name)
        ways = list(itertools.pairwise([self._target or self.report().position, *places]))
        commands = [self.axes.straight(*way, speed) for way in ways]  # all, before any is sent
        with self._guarded(), self._lock:
            for way, command in zip(ways, commands, strict=True):
                self._target = way[1]
                if command is not None:
                    length = self.axes.distance(*way)
                    path = Trapezoid(length, length / command.duration, self._acceleration)
                    self._due = max(self._due or 0.0, self.clock.now()) + path.duration
                    self._ask(command.line, self._settings.timeout + self._due - self.clock.now())
                    self._check()  # a stop that came just before the line was for nothing

    def wait(self, timeout: float | None = None) -> Report:
        """Wait until the body rests where it was sent, and return the report of it; see ``Stage.wait``."""
        began = self.clock.now()
        due = max(began, self._due or began)
        limit = 0.25 * (due - began) + self._settings.timeout if timeout is None else began + timeout - due
        with self._guarded():
            while (left := due - self.clock.now()) > 0:  # no line pends, so that a stop is heeded at once
                self._check()
                if timeout is not None and self.clock.now() - began > timeout:
                    self._fail(f"did not come to rest within {timeout:g} s")
                self.clock.sleep(min(left, _TICK))
            with self._lock:
                self._ask("M400", limit)
                self._due = None
                report = self._locate()
                self._check_place(report.position, "look at its limits (M211) and for who else moves it")
        return report

    def report(self) -> Report:
        """Return what it said last: where it rested."""
        self._check()
        return self._reports[-1]

    def history(self, since: float = -math.inf) -> list[Report]:
        """Return the reports later than a time, oldest first: of rest alone."""
        return [report for report in list(self._reports) if report.time > since]

    def stop(self) -> None:
        """Stop the body at once. Any thread may call it, as often as it likes; raises nothing."""
        if self.error is None:
            self.error = HardwareError(f"{self.name}: the stage was stopped; open it again to go on")
        with suppress(Exception):  # pyserial raises many kinds on a port that is gone
            self._port.write(_KILL if self._homing else _STOP)

    def close(self) -> None:
        """Stop the body if it moves, and let the port go."""
        if self._due is not None or self._homing:
            self.stop()
        self._ended.set()
        self._thread.join()
        if self.error is None:
            self.error = HardwareError(f"{self.name}: the stage is closed; open it again")
        with suppress(Exception):
            self._port.flush()
        close_port(self._port)

    def _open(self) -> str:
        """Find out that Marlin answers and prints nothing, learn its speeds, and return its name."""
        name = self._greet()
        self._number = 0
        self._ask("M110 N0")
        capabilities = self._ask("M115")
        self.homing_stops: bool = any(line.strip() == "Cap:EMERGENCY_PARSER:1" for line in capabilities)
        if any(line.startswith("SD printing byte") for line in self._ask("M27", lenient=True)):
            raise InputError(f"{self.name}: it prints from its card; let that end, or stop it there")
        for line in _PREPARE:
            self._ask(line)
        self._learn(self._ask("M503", lenient=True))
        self._locate()
        return name

    def _greet(self) -> str:
        """Ask who is there until it answers, and return the name of its firmware."""
        until, heard = self.clock.now() + _BOOT, False
        while self.clock.now() < until:
            self._write("M115")
            for line in self._listen(_KNOCK, lambda line: "FIRMWARE_NAME:" in line):
                heard = True
                _, found, name = line.partition("FIRMWARE_NAME:")
                if not found:
                    continue
                name = re.split(r" [A-Z_]+:", name)[0].strip()
                if "marlin" not in name.lower():
                    raise InputError(f"{self.name}: it is {name}, not Marlin; correct stage.firmware")
                while list(self._listen(_QUIET, lambda _line: True)):
                    pass
                return name
        what = "what answers is not Marlin" if heard else f"nothing answers within {_BOOT:g} s"
        raise InputError(f"{self.name}: {what}; look at firmware, port, the baud rate and the power")

    def _listen(self, seconds: float, enough: Callable[[str], bool]) -> Iterator[str]:
        """Yield the lines that come in some seconds, or until one is enough."""
        until = self.clock.now() + seconds
        while self.clock.now() < until:
            for line in self._read():
                yield line
                if enough(line):
                    return

    def _learn(self, settings: list[str]) -> None:
        """Go no faster than it does: ``M203`` has its speeds, ``M201`` and ``M204`` its accelerations."""
        told: dict[str, dict[str, float]] = {}
        for line in settings:
            code, _, words = line.removeprefix("echo:").strip().partition(" ")
            told.setdefault(code, {letter: float(number) for letter, number in _WORD.findall(words)})
        for motion, letter in self.axes.letters.items():
            rate, acceleration = (told.get(code, {}).get(letter, 0.0) for code in ("M203", "M201"))
            acceleration = min(acceleration, told.get("M204", {}).get("T", acceleration))
            if rate > 0:
                self.axes.limit(motion, rate)
            if acceleration > 0:
                self._acceleration = min(self._acceleration, acceleration)
            steps, expected = told.get("M92", {}).get(letter), self._settings.axes[motion].steps
            if steps and expected and abs(steps / expected - 1) > _SAME_STEPS:
                raise InputError(
                    f"{self.name}: M92 {letter} is {steps:g} steps where the rig file has {expected:g}:"
                    f" it goes {steps / expected:.3g} times as far; correct one of them"
                )

    def _check_place(self, place: Position, remedy: str) -> None:
        """Stop it if it rests elsewhere than it was sent."""
        off = 0.0 if self._target is None else self.axes.distance(place, self._target)
        if off > _ARRIVED:
            self._fail(f"it rests {off:.3g} mm or degrees from where it was sent; {remedy}")

    def _locate(self) -> Report:
        """Ask where it is, at rest, and keep the report."""
        asked = self.clock.now()
        said = next((line for line in self._ask("M114") if line.startswith("X:")), "")
        places = {letter: float(value) for letter, value in _PLACE.findall(said.partition("Count")[0])}
        missing = sorted(set(self.axes.letters.values()) - set(places))
        if missing:
            raise HardwareError(f"{self.name}: the controller has no axis {missing[0]}; correct the rig file")
        report = Report((asked + self.clock.now()) / 2, self.axes.place(places), "idle")
        self._reports.append(report)
        return report

    def _watch(self) -> None:
        """Ask it for a sign of life all the time; whatever goes wrong stops it."""
        while not self._ended.wait(1 / self._settings.report_rate if self._due is None else _WATCH):
            try:
                if not threading.main_thread().is_alive():  # the program ended and left us
                    raise HardwareError(f"{self.name}: the program ended")
                with self._lock:
                    if self._due is None:
                        self._check_place(self._locate().position, "let nobody else move it")
                    else:  # a line that waits for no move, unlike M114
                        usual = _TRIPS * statistics.median(self._trips)
                        self._ask(f"M110 N{self._number}", max(self._settings.silence, _HUSH, usual))
            except Exception as error:
                self.error = self.error or HardwareError(str(error))
                self.stop()
                return

    def _ask(self, line: str, timeout: float | None = None, *, lenient: bool = False) -> list[str]:
        """Send a line, and return what was said until it was taken; a busy controller may take longer."""
        with self._lock:
            self._check()
            for text in self._read() if self._has_unread() else ():
                self._judge(text, "nothing")
                if re.match(r"ok\b", text):
                    self._fail("it answered a line that nobody here sent: let no other program speak to it")
            self._write(self._numbered(line))
            asked = heard = self.clock.now()
            limit, said = self._settings.timeout if timeout is None else timeout, list[str]()
            while True:
                late = self.clock.now() - heard > limit  # before what came meanwhile is read
                for text in self._read():
                    if re.match(r"ok\b", text):
                        self._trips.append(self.clock.now() - asked)
                        return [*said, text[2:].strip()]  # some answer in the same line
                    if not lenient:
                        self._judge(text, line)
                    if lenient or "busy:" in text:  # anything else may come without end
                        heard, late = self.clock.now(), False
                    if "busy:" in text:
                        limit = _BUSY
                    said.append(text)
                self._check()
                if late or self.clock.now() - asked > max(limit, _HOMING):
                    self._fail(
                        "it no longer answers; the stage may move on: look at the plug, and switch it off"
                    )

    def _numbered(self, line: str) -> str:
        """Return a line with its number and the checksum of both; M110 begins to count from its own."""
        assert self._number is not None  # it is known who is there
        self._number += not line.startswith("M110")
        text = f"N{self._number} {line}"
        return f"{text}*{functools.reduce(operator.xor, text.encode('ascii'))}"

    def _judge(self, text: str, line: str) -> None:
        """Stop it if what it says is no good."""
        if text == "start":
            self._fail("the controller was reset; it has lost its place: home it")
        if _FAULTS.match(text):
            self._fail(f"it answers {line} with {text!r}")

    def _has_unread(self) -> bool:
        try:
            return bool(self._port.in_waiting)
        except Exception as error:  # as in _read
            self._lost(error)

    def _read(self) -> list[str]:
        """Return the lines that are there, after a short wait for the first."""
        try:
            data = self._port.read(max(1, self._port.in_waiting))
        except Exception as error:  # pyserial raises many kinds on a port that is gone
            self._lost(error)
        now, lines = self.clock.now(), []
        for line, _ in self._splitter.feed(data, now):
            text = line.decode("ascii", "replace").strip()
            if text.isascii() and text.replace("\t", " ").isprintable():
                lines.append(text)
            elif self._noise.add(len(line), now) and self._number is not None:
                self._fail("what it says is garbled; look at the cable, its shield and the baud rate")
        return lines

    def _write(self, line: str) -> None:
        try:
            self._port.write(f"{line}\n".encode("ascii"))
        except Exception as error:  # as in _read
            self._lost(error)

    def _lost(self, error: Exception) -> NoReturn:
        self._fail(f"the line is lost ({error}); the stage may move on: switch it off, and look at the plug")

    def _fail(self, why: str) -> NoReturn:
        self.error = self.error or HardwareError(f"{self.name}: {why}")
        self.stop()
        raise self.error.with_traceback(None)

    def _check(self) -> None:
        if self.error is not None:
            raise self.error.with_traceback(None)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Stop the body on whatever goes wrong inside, Ctrl-C too."""
        try:
            yield
        except BaseException:
            self.stop()
            raise
