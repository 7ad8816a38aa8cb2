"""A stage behind a GRBL 1.1 or grblHAL controller."""

from __future__ import annotations

import itertools
import math
import re
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.hw.base.drivers import Driver
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import Line, StageSettings
from mirrorskin.hw.base.stage import Limits, Position, Report
from mirrorskin.hw.stages.link import HOLDING, RESET, Link, TimedStatus, open_port
from mirrorskin.hw.stages.moves import Axes, Command
from mirrorskin.hw.stages.replies import BUFFER, Message, Setting, Status
from mirrorskin.io import InputError
from mirrorskin.io.base.types import Closing

if TYPE_CHECKING:
    import serial

GRBL = Driver(
    name="grbl",
    title="GRBL",
    help="GRBL 1.1 or grblHAL",
    loads="GrblStage",
    takes=("unlock", "clock"),
    motion="continuous",
)

_SWITCHES: dict[tuple[Line, bool], str] = {
    ("coolant", True): "M8",
    ("coolant", False): "M9",
    ("spindle", True): "M3S999999",  # dimmable outputs are fully on at the maximum speed ($30) and above
    ("spindle", False): "M5",
}
_PREPARE = "G21G90G94"  # millimetres, absolute coordinates, feed per minute
_OLDEST = (1, 1)
_LACKING = 40  # number of reports among which one must contain the work offset
_OFFSET_TIMEOUT = 10.0  # seconds to receive them, even on a busy computer
_REPORTS_MAX = 1 << 17  # number of reports that are kept: an hour of motion
_ARRIVED = 0.01  # machine units from the target, in addition to the rounding to steps, that count as arrived
_RESTS = 3  # reports of rest elsewhere after which the body is not expected to move on
_MARGIN = 0.05  # mm or degrees by which a report may exceed the limits
_HOMING = 60.0  # seconds, if the settings do not determine the time of homing
_SLOWING = 1.25  # maximum duration of a hold, in times of the longest ramp
_SAME_STEPS = 1e-4  # relative tolerance of $100 to $105
_LETTERS = "XYZABC"
_ROTARY = 701  # setting of grblHAL: how feeds are interpreted if axes in degrees move as well
_UNLOCK = "release it with 'mirrorskin rig unlock'"


@dataclass(frozen=True, slots=True)
class Controller:
    """Identity and settings of a controller."""

    firmware: str  # name and version
    axes: str  # letters of the axes, if reported
    settings: dict[int, float]  # numeric ``$`` settings

    def on(self, number: int) -> bool:
        """Return whether a setting is on: the first bit of its value."""
        return bool(int(self.settings.get(number, 0)) & 1)


class GrblStage(Closing):
    """A stage with a GRBL controller.

    A position or a precession beyond ``limits`` is an `InputError`, raised before anything is sent. Later
    faults are a `HardwareError`. Any interruption of a waiting call, including Ctrl-C, stops the stage. After
    a stop or a fault, ``error`` contains the reason and every call raises it; open the stage again to
    continue.

    Parameters
    ----------
    settings : StageSettings
        Port, axes and limits.
    port : serial.Serial, optional
        Open port to use instead of ``settings.port``; it is closed with the stage.
    unlock : bool
        Whether to end an existing alarm, hold or open door, and to tolerate a pressed switch, on request of a
        person who has checked the machine.
    clock : Clock
        Clock to wait with.

    Raises
    ------
    InputError
        The port does not exist or is in use, the device is not GRBL 1.1, or the machine is moved by another
        program, is locked without being homed, or is on a limit switch.

    Examples
    --------
    >>> with GrblStage(load_rig("rig.toml").stage) as stage:  # doctest: +SKIP
    ...     stage.home()
    ...     stage.move(Position(travel=1.0), speed=0.5)
    ...     stage.wait().position.travel
    1.0
    """

    def __init__(
        self,
        settings: StageSettings,
        port: serial.Serial | None = None,
        *,
        unlock: bool = False,
        clock: Clock = SYSTEM,
    ) -> None:
        self.name: str = f"stage {settings.port}"
        self.limits: Limits = settings.limits
        self._settings = settings
        self.axes: Axes = Axes(settings, self.name)
        self._offset: Mapping[str, float] | None = None
        self._lacking = 0  # number of reports without the work offset so far
        self._reports: deque[Report] = deque(maxlen=_REPORTS_MAX)
        self._latest: Report | None = None
        self._target: Position | None = None
        self._excess = math.inf  # smallest excess over the limits since moves are executed
        self._rounding = 0.0  # half a step of the coarsest axis
        self._due = 0.0
        self._ramp = 0.0  # seconds that acceleration and deceleration add to a move
        opened = open_port(settings.port, settings.baud, self.name) if port is None else port
        self._link = Link(opened, self.name, settings, self._on_report, clock)
        try:
            self._controller = self._open(unlock)
        except BaseException:
            self._link.close()
            raise

    @property
    def error(self) -> HardwareError | None:
        """The fault of the stage, None if there is none. Thread-safe."""
        return self._link.error

    @property
    def firmware(self) -> str:
        """The controller's name and version."""
        return self._controller.firmware

    @property
    def parameters(self) -> Mapping[int, float]:
        """The controller's ``$`` settings, by number."""
        return self._controller.settings

    @property
    def homes(self) -> bool:
        """Whether homing is enabled in the controller."""
        return self._controller.on(22)

    @property
    def round_trip(self) -> float:
        """Recent time from a query to its report, seconds; NaN before the first."""
        return self._link.round_trip

    @property
    def longest_trip(self) -> float:
        """Longest recent round trip, seconds; NaN before the first."""
        return self._link.longest_trip

    @property
    def longest_silence(self) -> float:
        """Maximum time without an answer during a move, seconds."""
        return self._link.longest_silence

    def check_move(self, start: Position, place: Position, speed: float | None) -> None:
        """Refuse a straight move that is too fast, or too slow for the controller."""
        self.axes.check_move(start, place, speed)

    def check_precession(self, tilt: float, turns: float, rate: float) -> None:
        """Refuse a precession that is too fast, too slow, or in axes without arcs."""
        self.axes.check_precession(tilt, turns, rate)

    def home(self) -> None:
        """Home the axes; returns when homing is complete."""
        if not self.homes:
            raise InputError(
                f"{self.name}: homing is disabled in the controller; set $22=1, or home = false "
                "in the rig file"
            )
        timeout = self._homing_time()
        with self._guarded():
            self._link.patience = timeout
            self._link.ask("$H", timeout)
            with self._link.lock:
                self._excess = math.inf  # the switches may be beyond the limits
                self._link.patience = None  # not after a failure: a stop of homing depends on it
                self._link.locked = False
            self._link.ask(_PREPARE, self._settings.timeout)
            self._target = None
            self._target = self.wait().position

    def move(self, place: Position, speed: float | None = None) -> None:
        """Start a straight move to `place`; returns when the controller has accepted the command.

        Parameters
        ----------
        place : Position
            Target.
        speed : float, optional
            mm/s, or rad/s if only the lean changes; by default the maximum speed of the axes.
        """
        self.follow([place], speed)

    def follow(self, places: Sequence[Position], speed: float | None = None) -> None:
        """Start a sequence of straight moves; see ``move``."""
        for place in places:
            self.limits.check(place, self.name)
        moves = itertools.pairwise([self._destination(), *places])
        legs = [pieces for move in moves if (pieces := self.axes.pieces(*move, speed))]
        if legs:
            self._send([piece for pieces in legs for piece in pieces], places[-1], ramps=len(legs))
        else:
            self._target = places[-1]

    def precess(self, tilt: float, turns: float, rate: float, start: float = 0.0) -> None:
        """Start a precession at half-angle `tilt` from phase `start`, where the body must be.

        Parameters
        ----------
        tilt : float
            Half-angle, radians.
        turns : float
            Number of turns; counter-clockwise if positive.
        rate : float
            Turns per second, positive.
        start : float
            Phase at the start, radians.
        """
        before = self._destination()
        self.limits.check(Position(before.travel, tilt), self.name)
        assert self._offset is not None  # an open stage has received it
        commands = self.axes.arcs(tilt, turns, rate, start, self._offset)
        begin, end = (_leaning(before.travel, tilt, phase) for phase in (start, start + math.tau * turns))
        if self.axes.distance(before, begin) > _ARRIVED:
            raise InputError(
                f"{self.name}: a precession starts at a lean of {math.degrees(tilt):.4g} degrees "
                f"and a phase of {math.degrees(start):.4g} degrees; move there first"
            )
        self._send(commands, end)

    def switch(self, line: Line, on: bool) -> None:
        """Switch an output of the controller, at rest; a stop switches it off."""
        with self._guarded():
            self._link.ask(_SWITCHES[line, on], self._settings.timeout)

    def wait(self, timeout: float | None = None) -> Report:
        """Wait until the body is at rest and every command is done, and return that report.

        The timeout, seconds, is by default the expected duration of the commands, plus a margin.
        """
        self._destination()
        if timeout is None:
            timeout = 1.25 * max(0.0, self._due - self._link.clock.now()) + self._settings.timeout
        with self._guarded():
            return self._link.until(self._arrived, timeout, "come to rest")

    def report(self) -> Report:
        """Return the newest report; reports are queried continuously."""
        if self._link.error is not None:
            raise self._link.error.with_traceback(None)
        assert self._latest is not None  # an open stage has received a report
        return self._latest

    def history(self, since: float = -math.inf) -> list[Report]:
        """Return the reports later than `since`, oldest first; about an hour of them is kept."""
        replies = []
        with self._link.lock:
            for report in reversed(self._reports):
                if report.time <= since:
                    break
                replies.append(report)
        return replies[::-1]

    def stop(self) -> None:
        """Stop the body at once. Thread-safe; may be called repeatedly, and raises nothing."""
        self._link.halt("the stage was stopped; open it again to continue")

    def close(self) -> None:
        """Stop the body if it moves, and close the port."""
        self._link.close()

    def _open(self, unlock: bool) -> Controller:
        link, timeout = self._link, self._settings.timeout
        try:
            controller = _greet(link, self.name, timeout, unlock)
            self._check(controller)
            if not self._settings.home:  # there are no switches for homing
                self._release(unlock)
            link.locked = self._in_state("alarm")
            self._await_offset()
            if not link.locked:
                link.ask(_PREPARE, timeout)
            link.until(lambda: link.rests or link.locked or None, timeout, "report")
        except HardwareError as error:
            raise InputError(str(error)) from None
        link.begin()
        return controller

    def _release(self, unlock: bool) -> None:
        """End an alarm if requested; otherwise refuse it, as well as a pressed switch."""
        link, timeout = self._link, self._settings.timeout
        pins = link.seen.status.pins if link.seen is not None else ""
        pressed = sorted(set(pins) & set(self.axes.letters.values()))
        if pressed and not unlock:
            raise InputError(
                f"{self.name}: a limit switch of {' and '.join(pressed)} is pressed: check the "
                f"position of the machine, and {_UNLOCK}"
            )
        if not self._in_state("alarm"):
            return
        if not unlock:
            raise InputError(
                f"{self.name}: it is locked after power-on or an alarm, and may have lost its "
                f"position: check it, and {_UNLOCK}, or set home = true if it has switches"
            )
        link.ask("$X", timeout)
        link.until(lambda: self._in_state("idle") or None, timeout, "unlock")

    def _in_state(self, state: str) -> bool:
        return self._link.seen is not None and self._link.seen.status.state == state

    def _await_offset(self) -> None:
        """Wait until a report contains the origin of the work coordinates."""
        self._link.until(
            lambda: self._offset is not None or self._lacking > _LACKING or None,
            max(self._settings.timeout, _OFFSET_TIMEOUT),
            "report its work offset",
        )
        if self._offset is None:
            raise InputError(f"{self.name}: its reports lack the work offset (WCO); enable it in $10")

    def _check(self, controller: Controller) -> None:
        """Refuse a controller that lacks an axis; adopt its limits of speed and travel."""
        status = self._link.seen.status if self._link.seen else None
        letters = controller.axes or (status and (status.machine or status.work))
        for motion, letter in self.axes.letters.items():
            if letters and letter not in letters:
                raise InputError(f"{self.name}: the controller has no axis {letter}; correct the rig file")
            steps, rate, acceleration = (
                controller.settings.get(number + _LETTERS.index(letter), 0.0) for number in (100, 110, 120)
            )
            rate /= 60
            expected = getattr(self._settings, motion).steps
            if steps > 0 and expected is not None and abs(steps / expected - 1) > _SAME_STEPS:
                raise InputError(
                    f"{self.name}: ${100 + _LETTERS.index(letter)} is {steps:g} steps, but "
                    f"{expected:g} in the rig file: moves would be {steps / expected:.3g} times "
                    "as long; correct one of them"
                )
            if steps > 0:
                self._rounding = max(self._rounding, 0.5 / steps)
                if not controller.firmware.lower().startswith("grblhal"):
                    self.axes.limit_steps(motion, steps)
            if rate > 0:
                self.axes.limit(motion, rate)
            if acceleration > 0:
                self._ramp = max(self._ramp, rate / acceleration)
                self.axes.limit_acceleration(motion, acceleration)
        self._link.stopping.holding = max(HOLDING, _SLOWING * self._ramp)
        if controller.on(20):
            self.limits = _within_soft_limits(self._settings, controller, self.name).limits

    def _on_report(self, timed: TimedStatus) -> None:
        """Process a report; the link's lock is held."""
        if timed.status.offset is not None:
            self._take_offset(timed.status.offset, timed.working)
        elif self._offset is None:
            self._lacking += 1
        place = self._place(timed.status)
        if place is None:
            return
        self._check_limits(place, timed.working)
        self._latest = Report(timed.answer.time, place, timed.status.state)
        if timed.answer.sure:
            self._reports.append(self._latest)

    def _take_offset(self, offset: Mapping[str, float], working: bool) -> None:
        """Store the origin of the work coordinates, which must not change while moves are executed."""
        if working and offset != self._offset:
            self._link.halt("the work offset was changed; do not use G54 and G92, and check the cable")
        else:
            self._offset = offset

    def _place(self, status: Status) -> Position | None:
        machine = status.machine
        if machine is None and status.work is not None and self._offset is not None:
            machine = {letter: value + self._offset[letter] for letter, value in status.work.items()}
        try:
            return None if machine is None else self.axes.place(machine)
        except KeyError:  # the controller has fewer axes; opening the stage refuses this
            return None

    def _check_limits(self, place: Position, working: bool) -> None:
        """Stop the stage beyond its limits; if it started there, it may only return."""
        excess = self.limits.excess(place)
        self._excess = min(self._excess, excess) if working else excess
        if excess > self._excess + _MARGIN:
            self._link.halt(
                f"the controller reports a position {excess:.3g} mm or degrees beyond the limits, "
                "to which it was not sent; check the cable and the switches, and home the stage"
            )

    def _destination(self) -> Position:
        """Return the position of the body after all commands."""
        if self._link.error is not None:
            raise self._link.error.with_traceback(None)
        if self._link.locked:
            raise HardwareError(f"{self.name}: it is locked until it is homed; home it first")
        return self.report().position if self._target is None else self._target

    def _send(self, commands: list[Command], target: Position, ramps: int = 1) -> None:
        """Send lines that end at a target, and wait until the controller has accepted the first move."""
        duration = sum(command.duration for command in commands) + ramps * self._ramp
        with self._guarded():
            with self._link.lock:
                number = self._link.enqueue(*commands) + int(not commands[0].duration)
                self._target = target
            self._due = max(self._due, self._link.clock.now()) + duration
            remaining = self._due - self._link.clock.now()
            self._link.until(
                lambda: self._link.window.done >= number or None,
                1.25 * remaining + self._settings.timeout,
                "take a move",
            )

    def _arrived(self) -> Report | None:
        """Return the report of rest, at the target if there is one; the link's lock is held."""
        link, latest = self._link, self._latest
        if link.window.busy or not link.rests or latest is None:
            return None
        if self._target is None:
            return latest if link.rests > 1 else None
        off = self.axes.distance(latest.position, self._target)
        if off <= _ARRIVED + self._rounding:
            return latest
        if link.rests >= _RESTS:
            link.halt(f"the stage rests {off:.3g} mm or degrees from its target; check the cable")
        return None

    def _homing_time(self) -> float:
        """Return the maximum duration of homing: each axis there and back, and once more."""
        settings = self._controller.settings
        seek = settings.get(25, 0.0)
        lengths = sum(settings.get(130 + number, 0.0) for number in range(len(_LETTERS)))
        return (3 * lengths / seek * 60 if seek > 0 and lengths > 0 else _HOMING) + self._settings.timeout

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Stop the body on any exception inside, including Ctrl-C."""
        try:
            yield
        except BaseException:
            self.stop()
            raise


def _within_soft_limits(settings: StageSettings, controller: Controller, name: str) -> StageSettings:
    """Return the settings with limits reduced to the controller's soft limits."""
    axes = {}
    for motion, axis in settings.axes.items():
        length = controller.settings.get(130 + _LETTERS.index(axis.letter), math.inf)
        ends = sorted(axis.zero + axis.direction * value for value in axis.limits)
        if ends[0] >= 0 and ends[1] <= length:  # homed at the other end, as on some machines
            continue
        inside = sorted(axis.direction * (min(max(end, -length), 0.0) - axis.zero) for end in ends)
        try:
            axes[motion] = msgspec.structs.replace(axis, limits=(inside[0], inside[1]))
        except ValueError as error:
            raise InputError(
                f"{name}: stage.{motion}.limits are {ends[0]:g} to {ends[1]:g} in machine "
                f"coordinates, but its soft limits ($20) allow {-length:g} to 0: correct the "
                "limits, or zero"
            ) from error
    return msgspec.structs.replace(settings, **axes)


def _greet(link: Link, name: str, timeout: float, unlock: bool) -> Controller:
    """Check that GRBL 1.1 answers and is at rest, and read its settings."""
    first = _first(link, name, timeout, unlock)
    if first.status.state not in ("idle", "alarm"):  # left in this state by a previous user
        if not unlock:
            raise InputError(
                f"{name}: it is in the state {first.status.state}, caused by another program or by "
                f"hand: wait until it ends, or {_UNLOCK}, which stops it"
            )
        link.restart(timeout)
        _first(link, name, timeout, unlock)
    controller = _identity(link, name, timeout)
    if controller.on(13):
        raise InputError(f"{name}: it reports in inches; set $13=0")
    if controller.on(_ROTARY):
        raise InputError(f"{name}: it applies feeds to linear axes only; set ${_ROTARY}=0")
    return controller


def _first(link: Link, name: str, timeout: float, unlock: bool) -> TimedStatus:
    """Wait for the first report; some locked controllers answer only after a reset."""
    try:
        try:
            return link.until(lambda: link.seen, timeout / 2, "answer")
        except HardwareError:
            if not unlock:
                raise
            link.send(RESET)
            return link.until(lambda: link.seen, timeout / 2, "answer")
    except HardwareError as error:
        if link.gone:
            raise InputError(
                f"{name}: the connection was closed at once; is anything connected to this port?"
            ) from error
        if link.banner is not None:
            raise InputError(f"{name}: {link.banner.text!r} does not send reports like GRBL 1.1") from error
        heard = link.noise.total > 0
        what = "the device is not GRBL 1.1 or grblHAL" if heard else f"no answer within {timeout:.3g} s"
        raise InputError(f"{name}: {what}; check the port, the baud rate and the power supply") from error


def _identity(link: Link, name: str, timeout: float) -> Controller:
    answers = {m.text.partition(":")[0]: m.text for m in link.ask("$I", timeout) if isinstance(m, Message)}
    version = answers.get("VER", "").removeprefix("VER:").strip(":")
    match = re.match(r"(\d+)\.(\d+)", version)
    number = (int(match[1]), int(match[2])) if match else link.banner.version if link.banner else (0, 0)
    if number < _OLDEST:
        raise InputError(f"{name}: it reports version {version or '?'}; GRBL 1.1 or later is needed")
    size = re.match(r"OPT:[^,]*,\d+,(\d+)", answers.get("OPT", ""))
    if size:
        link.window.size = min(BUFFER, int(size[1]))  # a query waits behind all lines that were sent
    settings = {}
    for reply in link.ask("$$", timeout):
        if isinstance(reply, Setting) and re.fullmatch(r"-?\d+(\.\d*)?", reply.value):
            settings[reply.number] = float(reply.value)
    kind = "grblHAL" if {"FIRMWARE", "NEWOPT"} & answers.keys() else "Grbl"
    firmware = link.banner.text.partition(" [")[0] if link.banner else f"{kind} {version}"
    axes = re.match(r"AXS:\d+:([A-Z]+)", answers.get("AXS", ""))
    return Controller(firmware, axes[1] if axes else "", settings)


def _leaning(travel: float, tilt: float, phase: float) -> Position:
    return Position(travel, tilt * math.cos(phase), tilt * math.sin(phase))
