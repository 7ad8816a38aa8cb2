"""The serial line to the controller: one thread reads, another one queries reports and monitors."""

from __future__ import annotations

import errno
import math
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import serial

from mirrorskin.hw.base.clock import Clock
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import StageSettings
from mirrorskin.hw.stages.moves import Command
from mirrorskin.hw.stages.replies import (
    Alarm,
    Banner,
    Message,
    Noise,
    Ok,
    Refusal,
    Reply,
    Setting,
    Splitter,
    Status,
    Window,
    parse,
    salvage,
)
from mirrorskin.hw.stages.report_times import SLICE, Answer, ReportTimes
from mirrorskin.io import InputError

_WRITE = 0.25  # seconds after which a line that accepts no more bytes counts as broken
_NO_PORT = "there is no such port; connect the controller, or correct the port in the rig file"
_BUSY = "another program uses it; close that program first"
_REMEDIES = {
    **dict.fromkeys((errno.ENOENT, errno.ENODEV, errno.ENXIO), _NO_PORT),
    **dict.fromkeys((errno.EBUSY, errno.EAGAIN), _BUSY),
    errno.EACCES: "no permission to open it; join the group that owns it (dialout, uucp)",
}


def open_port(url: str, baud: int, name: str) -> serial.Serial:
    """Open a serial port or a URL of pyserial exclusively; reads wait at most `SLICE`."""
    try:
        port = serial.serial_for_url(url, baud, timeout=SLICE, do_not_open=True)
        if os.name == "posix":
            port.exclusive = True
        if not url.lower().startswith("rfc2217:"):  # it does not support this timeout
            port.write_timeout = _WRITE
        port.open()
    except (OSError, ValueError) as error:
        remedy = _REMEDIES.get(getattr(error, "errno", None) or 0)
        raise InputError(f"{name}: {remedy or f'cannot be opened ({error}); correct the rig file'}") from None
    return port


def close_port(port: serial.Serial) -> None:
    """Close a port, even one that no longer exists."""
    socket = getattr(port, "_socket", None)  # pyserial drops it if the other side has closed
    try:
        port.close()
        if socket is not None:
            socket.close()
    except Exception:  # pyserial raises many types, and nothing is left to do
        return


HOLDING = 0.3
"""Seconds that a stop waits for rest before it resets, unless the axes need longer to decelerate."""

_RESETTING = 0.3  # seconds that a reset may take to be answered


class Stopping:
    """The progress of a stop; it needs no lock, so any thread can start it at any time."""

    def __init__(self) -> None:
        self.holding = HOLDING  # seconds that it waits for rest before it resets
        self.over: bool = False
        self._began = self._reset = math.inf

    @property
    def longest(self) -> float:
        """Maximum duration of a stop, seconds."""
        return self.holding + _RESETTING

    @property
    def begun(self) -> bool:
        """Whether the hold command was sent."""
        return self._began < math.inf

    @property
    def resetting(self) -> bool:
        """Whether the reset command was sent."""
        return self._reset < math.inf

    def begin(self, now: float) -> None:
        """Record that the hold command was sent."""
        self._began = min(self._began, now)

    def reset(self, now: float, rested: float, gone: bool) -> bool:
        """Return whether to reset now: the machine is at rest, the line is gone, or the time is up.

        `rested` is the time at which the newest report was queried, if that report was of rest.
        """
        if self.resetting or not (gone or rested > self._began or now - self._began > self.holding):
            return False
        self._reset = now
        return True

    def finish(self, now: float, answered: bool) -> None:
        """Record whether the reset was answered. The stop is then complete; otherwise it is after a while."""
        self.over = self.over or answered or now - self._reset > _RESETTING


ASK, HOLD, RESET = b"?", b"!", b"\x18"

_TICK = 0.01  # interval at which the time is checked, seconds
_TRIPS = 4  # minimum tolerance for an open query in motion, in usual round trips
_OPENING_PERIOD = 0.05  # maximum interval of queries before `begin`, seconds
_MOVING_PERIOD = 0.025  # the same in motion and during a stop; it limits how soon a silence is detected
_ANSWER_LOST = 0.5  # seconds at rest after which a missing answer is considered lost
_STUCK = 1.0  # seconds after which a read that has not returned counts as hung
_SLICE = 0.05  # duration of one wait, seconds
_CHUNK = 1024  # bytes processed at a time, so that other threads get their turn
_INTERRUPTED = ("hold", "door", "sleep", "check")  # states that this program did not request

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class TimedStatus:
    """A report, the time of its query, and the time at which it was valid."""

    status: Status
    answer: Answer
    working: bool  # whether it executes moves: not before `begin`, while locked or homing, or during a stop


class Link:
    """Sends lines and realtime bytes, receives replies, and detects faults.

    Before `begin` it only listens: noise, silence and alarms are not errors.

    Each report is passed to `on_report` with `lock` held; `lock` is notified whenever something was received.
    """

    def __init__(
        self,
        port: serial.Serial,
        name: str,
        settings: StageSettings,
        on_report: Callable[[TimedStatus], None],
        clock: Clock,
    ) -> None:
        self.error: HardwareError | None = None  # the first fault
        self.clock = clock
        self.lock: threading.Condition = clock.condition()
        self.window: Window = Window()
        self.noise: Noise = Noise()
        self.seen: TimedStatus | None = None  # the newest report
        self.rests: int = 0  # consecutive reports of rest that were queried after the last line was accepted
        self.banner: Banner | None = None  # start-up message since the last reset
        self.gone: bool = False  # whether the port is lost
        self.locked = False  # whether an alarm is not an error, because the stage will be homed
        self.patience: float | None = None  # maximum silence while homing, seconds
        self._port = port
        self._name = name
        self._timeout = settings.timeout
        self._silence = settings.silence
        self._period = 1 / settings.report_rate
        self._on_report = on_report
        self._times = ReportTimes(self._period)
        self._splitter = Splitter()
        self._replies: list[Reply] = []
        self._refused: Refusal | None = None
        self._active = False
        self._heard = self.clock.now()  # time of the last read
        self._last_line = -math.inf  # time at which a line was last sent or answered
        self.stopping: Stopping = Stopping()
        self._deaf = False  # whether noise was received and reported
        self._closing = False
        self._threads = [
            clock.thread(work, f"{name} {work.__name__.strip('_')}") for work in (self._read, self._poll)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def round_trip(self) -> float:
        """Recent time from a query to its answer, seconds; NaN before the first."""
        with self.lock:
            return self._times.usual

    @property
    def longest_trip(self) -> float:
        """Longest recent round trip, seconds; NaN before the first."""
        with self.lock:
            return self._times.longest

    @property
    def longest_silence(self) -> float:
        """Maximum time without an answer during a move, seconds."""
        with self.lock:
            return max(self._silence, _TRIPS * self._times.usual)

    # Public methods

    def begin(self) -> None:
        """From now on, treat noise, silence, alarms and resets as errors."""
        with self.lock:
            self._active = True
            self.noise = Noise()

    def enqueue(self, *commands: Command) -> int:
        """Send lines, each as soon as the controller has room and its motion is due.

        Return the value of `window.done` once the first line is answered.
        """
        with self.lock:
            self._check()
            numbers = [self.window.add(command.line, command.duration, command.ramp) for command in commands]
            self.rests = 0
            self._pump()
        return numbers[0]

    def ask(self, line: str, timeout: float) -> list[Reply]:
        """Send a line, wait for its answer, and return the replies in between."""
        with self.lock:
            self._replies = []
            number = self.enqueue(Command(line))
        self.until(lambda: self.window.done >= number or None, timeout, f"take {line}")
        with self.lock:
            if self._refused is not None:
                raise HardwareError(f"{self._name}: the controller refuses {line}: {self._refused}")
            return self._replies

    def until(self, ready: Callable[[], T | None], timeout: float, what: str) -> T:
        """Wait until `ready` returns something; HardwareError on a fault or a timeout."""
        end = self.clock.now() + timeout
        with self.lock:
            while True:
                self._check()
                result = ready()
                if result is not None:
                    return result
                remaining = end - self.clock.now()
                if remaining <= 0:
                    raise HardwareError(f"{self._name}: did not {what} within {timeout:.3g} s")
                self.lock.wait(min(remaining, _SLICE))

    def restart(self, timeout: float) -> None:
        """Put the machine on hold, reset it, and discard earlier replies."""
        self.send(HOLD)
        self.clock.sleep(self.stopping.holding)
        self.banner = None
        self.send(RESET)
        self.until(lambda: self.banner, timeout, "start anew")
        self.seen = None

    def halt(self, why: str) -> None:
        """Stop the machine at once, from any thread and without waiting; the reset follows."""
        if not self.stopping.resetting:  # a hold after the reset would remain
            self.send(HOLD)
        if self.error is None:
            self.error = HardwareError(f"{self._name}: {why}")
        self.stopping.begin(self.clock.now())
        if self.patience is not None:  # homing reacts only to a reset
            self.send(RESET)

    def send(self, byte: bytes) -> None:
        """Send a realtime byte ahead of all lines; the reports show whether it arrived."""
        try:
            self._port.write(byte)
        except Exception:  # pyserial raises many types if the port is gone; the reader reports it
            return

    def close(self) -> None:
        """Stop the machine if it moves, end the threads, and close the port, within a second or two."""
        if self._closing:
            return
        if self._active and self._moving():
            self.halt("the stage was closed in motion")
        end = self.clock.now() + 2 * self.stopping.longest
        try:
            while self.stopping.begun and not self.stopping.over and self.clock.now() < end:
                self.clock.sleep(_TICK)
        finally:  # even after another Ctrl-C
            self._closing = True
            for thread in self._threads:
                thread.join(1.0)
            if self.error is None:
                self.error = HardwareError(f"{self._name}: the stage is closed; open it again")
            close_port(self._port)

    # Methods of the threads

    def _read(self) -> None:
        while not self._closing:
            began = self.clock.now()
            try:
                data = self._port.read(min(max(1, self._port.in_waiting), _CHUNK))
            except Exception as error:  # as in send
                self._unplugged(error)
                return
            if self._deaf:
                self.clock.sleep(_TICK)  # do not starve other threads during a flood of bytes
            else:
                self._hear(data, began, self.clock.now())

    def _unplugged(self, error: Exception) -> None:
        if self._closing:
            return
        self.gone = True
        self.halt(
            f"the connection is lost ({error}); the stage may still be moving: switch it off, and "
            "check the connector"
        )
        with self.lock:
            self.lock.notify_all()

    def _hear(self, data: bytes, since: float, now: float) -> None:
        with self.lock:
            self._heard = now
            self._times.listened(since, now)
            for line, began in self._splitter.feed(data, now):
                reply, noise = parse(line), 0
                if reply is None:
                    reply, noise = salvage(line)
                if reply is not None:
                    self._handle(reply, began)
                if noise and self.noise.add(noise, now) and self._active:
                    self._deaf = True
                    self.halt(
                        "the controller sends garbled characters; check the cable, its shield and "
                        "the baud rate"
                    )
                    break
            self._check_answers(now)  # here, because no answer can be received but not yet processed
            self.lock.notify_all()

    def _handle(self, reply: Reply, began: float) -> None:
        match reply:
            case Status():
                self._report(reply, began)
            case Ok():
                self._answered(None)
            case Refusal():
                self._answered(reply)
            case Alarm():
                homing = self.patience is not None
                if self._active and (homing or not self.locked):
                    self.halt(f"{reply}")
            case Banner():
                if self._active and not self.stopping.begun:
                    self.halt("the controller was reset and has lost its commands")
                self.banner = reply
            case Setting() | Message():
                self._replies.append(reply)

    def _report(self, status: Status, began: float) -> None:
        homed = not self.locked and self.patience is None
        working = self._active and homed and not self.stopping.begun
        self.seen = TimedStatus(status, self._times.answer(began), working)
        self._on_report(self.seen)
        if status.state != "idle":
            self.rests = 0
        elif self.seen.answer.asked > self._last_line:
            self.rests += 1
        if not self._active:
            return
        if status.state == "alarm" and not self.locked:
            self.halt("the controller is in alarm; check the switches, then reset and home it")
        elif status.state in _INTERRUPTED:
            self.halt(
                f"the controller changed to the state {status.state} by itself or on request of "
                "another program"
            )

    def _answered(self, refusal: Refusal | None) -> None:
        line = self.window.answer()
        if line is None:
            if self._active and not self.stopping.begun:
                self.halt(
                    "the controller answered a line that this program did not send: let no other "
                    "program use the port"
                )
            return
        self._last_line = self.clock.now()
        self.rests = 0
        self._refused = refusal
        if refusal is not None and self._active:
            self.halt(f"the controller refuses {line}: {refusal}")
        self._pump()

    def _pump(self) -> None:
        while self.error is None and (data := self.window.next(self.clock.now())) is not None:
            self._last_line = self.clock.now()
            try:
                self._port.write(data)
            except Exception as error:  # as in send
                self._unplugged(error)

    def _poll(self) -> None:
        while not self._closing:
            self.clock.sleep(_TICK)
            now = self.clock.now()
            with self.lock:
                if now - self._heard > _STUCK:
                    self._check_answers(now)
                if self.stopping.begun:
                    self._advance_stop(now)
                self._pump()
                self._times.period = self._poll_period()
                ask = self._times.due(now) and not self.gone
                if ask:
                    self._times.ask(self.clock.now())
            if ask:
                if self.stopping.begun and not self.stopping.resetting:  # one may have been lost or undone
                    self.send(HOLD)
                self.send(ASK)
                with self.lock:
                    self._times.sent(self.clock.now())
            if not threading.main_thread().is_alive():  # the program ended without closing the stage
                if not self.stopping.begun:
                    self.halt("the program ended")
                self._closing = self.stopping.over

    def _check_answers(self, now: float) -> None:
        """Stop the machine if it has been silent for too long, or if an answer was lost."""
        if not self._active or self.stopping.begun:
            return
        if self._times.silence(now) > self._limit() and not self._has_unread():
            self.halt(
                "the controller no longer answers; the stage may still be moving: switch it off, and "
                "check the connector"
            )
        idle = self.seen is not None and self.seen.status.state == "idle"
        # Use the time of the query: a busy computer may deliver old reports and answers late.
        since = -math.inf if self.seen is None else self.seen.answer.asked - self._last_line
        lost = self.window.unanswered and since > _ANSWER_LOST
        if idle and self.patience is None and lost:
            self.halt("the controller is at rest but has not answered all lines; check the cable")

    def _limit(self) -> float:
        if self.patience is not None:
            return self.patience
        return self.longest_silence if self._moving() else self._timeout

    def _moving(self) -> bool:
        if self.window.busy or self.seen is None:
            return self.window.busy
        # a line was accepted since the report of rest
        taken = self.seen.status.state == "idle" and self.rests == 0
        return taken or not self.seen.status.rests

    def _poll_period(self) -> float:
        """Return the current interval of queries, seconds."""
        if not self._active:
            return min(self._period, _OPENING_PERIOD)
        return min(self._period, _MOVING_PERIOD) if self._moving() or self.stopping.begun else self._period

    def _has_unread(self) -> bool:
        """Return whether received bytes are waiting for the reader."""
        try:
            return self._port.in_waiting > 0
        except Exception:  # as in send
            return False

    def _advance_stop(self, now: float) -> None:
        """Continue a stop: reset once the machine is at rest, and wait for the answer."""
        rested = self.seen.answer.asked if self.seen is not None and self.seen.status.rests else -math.inf
        if self.stopping.reset(now, rested, self.gone):
            self.window.clear()
            self.banner = None
            self.send(RESET)
        elif self.stopping.resetting:
            self.stopping.finish(now, self.gone or self.banner is not None)
        self.lock.notify_all()

    def _check(self) -> None:
        if self.error is not None:
            raise self.error.with_traceback(None)
