"""A stage with a Marlin controller, for example of a 3D printer; it moves in steps."""

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

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.drivers import Driver
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import StageSettings
from mirrorskin.hw.base.stage import Limits, Position, Report
from mirrorskin.hw.stages.link import close_port, open_port
from mirrorskin.hw.stages.moves import Axes
from mirrorskin.hw.stages.replies import Noise, Splitter
from mirrorskin.hw.stages.trajectory import Trapezoid
from mirrorskin.io import InputError
from mirrorskin.io.base.types import Closing

if TYPE_CHECKING:
    import serial

MARLIN = Driver(
    name="marlin",
    title="Marlin",
    help="Marlin, the firmware of 3D printers",
    loads="MarlinStage",
    takes=("clock",),
    motion="steps",
    outputs=False,
)

_BOOT = 12.0  # seconds that a controller may take to start; many restart when the port is opened
_KNOCK = 1.0  # seconds after which the identification is queried again
_QUIET = 0.3  # seconds without an answer after which none is expected
_PREPARE = ("G21", "G90", "M84 S0")  # millimetres, absolute coordinates, motors never released at rest
_WATCH = 0.1  # interval of queries in motion, seconds
_TICK = 0.01
_HUSH = 0.3  # minimum tolerance for an answer in motion, seconds; the controller also updates its display
_BUSY = 10.0  # seconds that it may be busy without reporting this; it normally reports it every 2 s
_HOMING = 180.0  # seconds
_TRIPS = 4  # minimum tolerance for an answer in motion, in usual round trips
_ARRIVED = 0.02  # mm or degrees; positions are reported to 0.01
_SAME_STEPS = 1e-3  # relative tolerance of M92
_REPORTS_MAX = 1 << 17
_STOP, _KILL = b"\nM410\n", b"\nM112\n"
_PLACE = re.compile(r"([A-Z]):(-?\d+\.?\d*)")
_WORD = re.compile(r"([A-Z])(\d+\.?\d*)")
_FAULTS = re.compile(r"Error:|!!|Resend:|echo:Unknown command|echo:Home |//action:(cancel|disconnect|kill)")


class MarlinStage(Closing):
    """A stage with a Marlin controller; see `mirrorskin.hw.Stage`.

    Marlin answers one line at a time and does not report its position while it moves. So the body moves in
    steps; sweeps and precessions are refused. In motion it is queried ten times per second with lines that do
    not wait for the move, so a stop is always possible. Lines have a number and a checksum, which prevents
    noise from changing a position. Homing is stopped by halting the controller, which must then be switched
    off and on; without ``EMERGENCY_PARSER`` this is not reliable.

    Parameters
    ----------
    settings : StageSettings
        Port, axes and limits.
    port : serial.Serial, optional
        Open port to use instead of ``settings.port``; it is closed with the stage.
    clock : Clock
        Clock to wait with.

    Raises
    ------
    InputError
        The port does not exist or is in use, the device is not Marlin, or it is printing.

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
        self._number: int | None = None  # number of the last line; None before the firmware is identified
        self._trips: deque[float] = deque([0.0], maxlen=15)
        self._reports: deque[Report] = deque(maxlen=_REPORTS_MAX)
        self._target: Position | None = None
        self._due: float | None = None  # expected end of the current move
        self._homing = False
        self._acceleration = 1e6  # acceleration of the slowest axis, machine units/s^2
        try:
            self.firmware: str = self._open()
        except BaseException as error:
            close_port(self._port)
            if isinstance(error, HardwareError):
                raise InputError(str(error)) from error
            raise
        self._thread = clock.thread(self._watch, f"{self.name}: watch")
        self._thread.start()

    def check_move(self, start: Position, place: Position, speed: float | None) -> NoReturn:
        """Refuse a sweep: the position in each frame would be unknown."""
        raise InputError(f"{self.name}: Marlin does not report its position while it moves; use steps")

    def check_precession(self, tilt: float, turns: float, rate: float) -> NoReturn:
        """Refuse a precession, for the same reason."""
        raise InputError(f"{self.name}: Marlin does not report its position while it moves; use steps")

    def precess(self, tilt: float, turns: float, rate: float, start: float = 0.0) -> NoReturn:
        """Refuse a precession, for the same reason."""
        self.check_precession(tilt, turns, rate)

    def home(self) -> None:
        """Home the axes of the rig; returns when homing is complete."""
        with self._guarded(), self._lock:
            self._homing = True  # also after a failure: the stop of homing depends on it
            self._ask(f"G28 {' '.join(sorted(self.axes.letters.values()))}", _HOMING)
            self._homing = False
            self._target = self._locate().position

    def move(self, place: Position, speed: float | None = None) -> None:
        """Start a straight move; see ``Stage.move``."""
        self.follow([place], speed)

    def follow(self, places: Sequence[Position], speed: float | None = None) -> None:
        """Start a sequence of straight moves; see ``Stage.follow``."""
        for place in places:
            self.limits.check(place, self.name)
        moves = list(itertools.pairwise([self._target or self.report().position, *places]))
        commands = [self.axes.straight(*move, speed) for move in moves]  # check all moves before any is sent
        with self._guarded(), self._lock:
            for move, command in zip(moves, commands, strict=True):
                self._target = move[1]
                if command is not None:
                    length = self.axes.distance(*move)
                    path = Trapezoid(length, length / command.duration, self._acceleration)
                    self._due = max(self._due or 0.0, self.clock.now()) + path.duration
                    self._ask(command.line, self._settings.timeout + self._due - self.clock.now())
                    self._check()  # a stop just before the line had no effect

    def wait(self, timeout: float | None = None) -> Report:
        """Wait until the body rests at its target, and return that report; see ``Stage.wait``."""
        began = self.clock.now()
        due = max(began, self._due or began)
        limit = 0.25 * (due - began) + self._settings.timeout if timeout is None else began + timeout - due
        with self._guarded():
            while (
                remaining := due - self.clock.now()
            ) > 0:  # no line is pending, so a stop takes effect at once
                self._check()
                if timeout is not None and self.clock.now() - began > timeout:
                    self._fail(f"did not come to rest within {timeout:g} s")
                self.clock.sleep(min(remaining, _TICK))
            with self._lock:
                self._ask("M400", limit)
                self._due = None
                report = self._locate()
                self._check_place(report.position, "check its limits (M211), and that nothing else moves it")
        return report

    def report(self) -> Report:
        """Return the last report of rest."""
        self._check()
        return self._reports[-1]

    def history(self, since: float = -math.inf) -> list[Report]:
        """Return the reports of rest later than a time, oldest first."""
        return [report for report in list(self._reports) if report.time > since]

    def stop(self) -> None:
        """Stop the body at once. Thread-safe; may be called repeatedly, and raises nothing."""
        if self.error is None:
            self.error = HardwareError(f"{self.name}: the stage was stopped; open it again to continue")
        with suppress(Exception):  # pyserial raises many types if the port is gone
            self._port.write(_KILL if self._homing else _STOP)

    def close(self) -> None:
        """Stop the body if it moves, and close the port."""
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
        """Check that Marlin answers and is not printing, read its speeds, and return its name."""
        name = self._greet()
        self._number = 0
        self._ask("M110 N0")
        capabilities = self._ask("M115")
        self.homing_stops: bool = any(line.strip() == "Cap:EMERGENCY_PARSER:1" for line in capabilities)
        if any(line.startswith("SD printing byte") for line in self._ask("M27", lenient=True)):
            raise InputError(
                f"{self.name}: it is printing from its card; wait until it ends, or stop it there"
            )
        for line in _PREPARE:
            self._ask(line)
        self._learn(self._ask("M503", lenient=True))
        self._locate()
        return name

    def _greet(self) -> str:
        """Query the identification until it is answered, and return the name of the firmware."""
        until, heard = self.clock.now() + _BOOT, False
        while self.clock.now() < until:
            self._write("M115")
            for line in self._listen(_KNOCK, lambda line: "FIRMWARE_NAME:" in line):
                heard = True
                _, mark, name = line.partition("FIRMWARE_NAME:")
                if not mark:
                    continue
                name = re.split(r" [A-Z_]+:", name)[0].strip()
                if "marlin" not in name.lower():
                    raise InputError(
                        f"{self.name}: its firmware is {name}, not Marlin; correct stage.firmware"
                    )
                while list(self._listen(_QUIET, lambda _line: True)):
                    pass
                return name
        what = "the device is not Marlin" if heard else f"no answer within {_BOOT:g} s"
        raise InputError(f"{self.name}: {what}; check firmware, port, baud rate and power supply")

    def _listen(self, seconds: float, enough: Callable[[str], bool]) -> Iterator[str]:
        """Yield the lines received in some seconds, or until one satisfies a condition."""
        until = self.clock.now() + seconds
        while self.clock.now() < until:
            for line in self._read():
                yield line
                if enough(line):
                    return

    def _learn(self, settings: list[str]) -> None:
        """Adopt the speeds (``M203``) and accelerations (``M201``, ``M204``) of the controller as limits."""
        values: dict[str, dict[str, float]] = {}
        for line in settings:
            code, _, words = line.removeprefix("echo:").strip().partition(" ")
            values.setdefault(code, {letter: float(number) for letter, number in _WORD.findall(words)})
        for motion, letter in self.axes.letters.items():
            rate, acceleration = (values.get(code, {}).get(letter, 0.0) for code in ("M203", "M201"))
            acceleration = min(acceleration, values.get("M204", {}).get("T", acceleration))
            if rate > 0:
                self.axes.limit(motion, rate)
            if acceleration > 0:
                self._acceleration = min(self._acceleration, acceleration)
            steps, expected = values.get("M92", {}).get(letter), self._settings.axes[motion].steps
            if steps and expected and abs(steps / expected - 1) > _SAME_STEPS:
                raise InputError(
                    f"{self.name}: M92 {letter} is {steps:g} steps, but {expected:g} in the rig "
                    f"file: moves would be {steps / expected:.3g} times as long; correct one of "
                    "them"
                )

    def _check_place(self, place: Position, remedy: str) -> None:
        """Stop the stage if it does not rest at its target."""
        off = 0.0 if self._target is None else self.axes.distance(place, self._target)
        if off > _ARRIVED:
            self._fail(f"the stage rests {off:.3g} mm or degrees from its target; {remedy}")

    def _locate(self) -> Report:
        """Query the position at rest, and store the report."""
        asked = self.clock.now()
        answer = next((line for line in self._ask("M114") if line.startswith("X:")), "")
        places = {letter: float(value) for letter, value in _PLACE.findall(answer.partition("Count")[0])}
        missing = sorted(set(self.axes.letters.values()) - set(places))
        if missing:
            raise HardwareError(f"{self.name}: the controller has no axis {missing[0]}; correct the rig file")
        report = Report((asked + self.clock.now()) / 2, self.axes.place(places), "idle")
        self._reports.append(report)
        return report

    def _watch(self) -> None:
        """Query the controller continuously; any fault stops the stage."""
        while not self._ended.wait(1 / self._settings.report_rate if self._due is None else _WATCH):
            try:
                if not threading.main_thread().is_alive():  # the program ended without closing the stage
                    raise HardwareError(f"{self.name}: the program ended")
                with self._lock:
                    if self._due is None:
                        self._check_place(self._locate().position, "check that nothing else moves it")
                    else:  # a line that does not wait for the end of a move, unlike M114
                        usual = _TRIPS * statistics.median(self._trips)
                        self._ask(f"M110 N{self._number}", max(self._settings.silence, _HUSH, usual))
            except Exception as error:
                self.error = self.error or HardwareError(str(error))
                self.stop()
                return

    def _ask(self, line: str, timeout: float | None = None, *, lenient: bool = False) -> list[str]:
        """Send a line, and return the replies until it was accepted; a busy controller may take longer."""
        with self._lock:
            self._check()
            for text in self._read() if self._has_unread() else ():
                self._judge(text, "nothing")
                if re.match(r"ok\b", text):
                    self._fail(
                        "the controller answered a line that this program did not send: let no other "
                        "program use the port"
                    )
            self._write(self._numbered(line))
            asked = heard = self.clock.now()
            limit, lines = self._settings.timeout if timeout is None else timeout, list[str]()
            while True:
                late = self.clock.now() - heard > limit  # before new replies are read
                for text in self._read():
                    if re.match(r"ok\b", text):
                        self._trips.append(self.clock.now() - asked)
                        return [*lines, text[2:].strip()]  # some replies are in the same line
                    if not lenient:
                        self._judge(text, line)
                    if lenient or "busy:" in text:  # other messages may come without end
                        heard, late = self.clock.now(), False
                    if "busy:" in text:
                        limit = _BUSY
                    lines.append(text)
                self._check()
                if late or self.clock.now() - asked > max(limit, _HOMING):
                    self._fail(
                        "the controller no longer answers; the stage may still be moving: switch "
                        "it off, and check the connector"
                    )

    def _numbered(self, line: str) -> str:
        """Return a line with its number and checksum; M110 sets the number."""
        assert self._number is not None  # the firmware is identified
        self._number += not line.startswith("M110")
        text = f"N{self._number} {line}"
        return f"{text}*{functools.reduce(operator.xor, text.encode('ascii'))}"

    def _judge(self, text: str, line: str) -> None:
        """Stop the stage on a reply that reports a fault."""
        if text == "start":
            self._fail("the controller was reset and has lost its position: home the stage")
        if _FAULTS.match(text):
            self._fail(f"it answers {line} with {text!r}")

    def _has_unread(self) -> bool:
        try:
            return bool(self._port.in_waiting)
        except Exception as error:  # as in _read
            self._lost(error)

    def _read(self) -> list[str]:
        """Return the lines that have been received, after a short wait for the first."""
        try:
            data = self._port.read(max(1, self._port.in_waiting))
        except Exception as error:  # pyserial raises many types if the port is gone
            self._lost(error)
        now, lines = self.clock.now(), []
        for line, _ in self._splitter.feed(data, now):
            text = line.decode("ascii", "replace").strip()
            if text.isascii() and text.replace("\t", " ").isprintable():
                lines.append(text)
            elif self._noise.add(len(line), now) and self._number is not None:
                self._fail(
                    "the controller sends garbled characters; check the cable, its shield and the baud rate"
                )
        return lines

    def _write(self, line: str) -> None:
        try:
            self._port.write(f"{line}\n".encode("ascii"))
        except Exception as error:  # as in _read
            self._lost(error)

    def _lost(self, error: Exception) -> NoReturn:
        self._fail(
            f"the connection is lost ({error}); the stage may still be moving: switch it off, and "
            "check the connector"
        )

    def _fail(self, why: str) -> NoReturn:
        self.error = self.error or HardwareError(f"{self.name}: {why}")
        self.stop()
        raise self.error.with_traceback(None)

    def _check(self) -> None:
        if self.error is not None:
            raise self.error.with_traceback(None)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Stop the body on any exception inside, including Ctrl-C."""
        try:
            yield
        except BaseException:
            self.stop()
            raise
