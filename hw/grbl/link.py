"""The line to the controller: one thread reads, one asks for reports and keeps watch."""

from __future__ import annotations

import errno
import math
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import serial

from mirrorskin.hw.clock import Clock
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.grbl.moves import Command
from mirrorskin.hw.grbl.replies import (
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
from mirrorskin.hw.grbl.report_times import SLICE, Answer, ReportTimes
from mirrorskin.hw.rig_file import StageSettings
from mirrorskin.io import InputError

_WRITE = 0.25  # seconds after which a line that takes nothing more is broken
_NO_PORT = "there is no such port; plug the controller in, or correct the rig file's port"
_BUSY = "another program uses it; close that first"
_REMEDIES = {
    **dict.fromkeys((errno.ENOENT, errno.ENODEV, errno.ENXIO), _NO_PORT),
    **dict.fromkeys((errno.EBUSY, errno.EAGAIN), _BUSY),
    errno.EACCES: "no permission to open it; join the group that owns it (dialout, uucp)",
}


def open_port(url: str, baud: int, name: str) -> serial.Serial:
    """Open a serial port, or what a URL of pyserial names, for us alone; reads wait `SLICE` at most."""
    try:
        port = serial.serial_for_url(url, baud, timeout=SLICE, do_not_open=True)
        if os.name == "posix":
            port.exclusive = True
        if not url.lower().startswith("rfc2217:"):  # which knows no such limit
            port.write_timeout = _WRITE
        port.open()
    except (OSError, ValueError) as error:
        known = _REMEDIES.get(getattr(error, "errno", None) or 0)
        raise InputError(f"{name}: {known or f'cannot be opened ({error}); correct the rig file'}") from error
    return port


def close_port(port: serial.Serial) -> None:
    """Close a port, also one that is gone."""
    socket = getattr(port, "_socket", None)  # pyserial forgets it where the other side has left
    try:
        port.close()
        if socket is not None:
            socket.close()
    except Exception:  # pyserial raises many kinds, and there is nothing left to do
        return


HOLDING = 0.3
"""Seconds that a stop waits for rest before it resets, unless the axes take longer to slow down."""

_RESETTING = 0.3  # seconds that a reset may take to be answered


class Stopping:
    """Where a stop has got to; it needs no lock, so that anyone can begin it at any moment."""

    def __init__(self) -> None:
        self.holding = HOLDING  # seconds that it waits for rest before it resets
        self.over: bool = False
        self._began = self._reset = math.inf

    @property
    def longest(self) -> float:
        """Seconds that a stop takes at most."""
        return self.holding + _RESETTING

    @property
    def begun(self) -> bool:
        """Whether the machine was commanded to hold."""
        return self._began < math.inf

    @property
    def resetting(self) -> bool:
        """Whether it was commanded to reset."""
        return self._reset < math.inf

    def begin(self, now: float) -> None:
        """Note that the machine was commanded to hold."""
        self._began = min(self._began, now)

    def reset(self, now: float, rested: float, gone: bool) -> bool:
        """Return whether to reset now: the machine rests, the line is gone, or the time is up.

        `rested` is when the newest report was asked for, if that was of rest.
        """
        if self.resetting or not (gone or rested > self._began or now - self._began > self.holding):
            return False
        self._reset = now
        return True

    def finish(self, now: float, answered: bool) -> None:
        """Note whether the reset was answered: then the stop is over, and after a while in any case."""
        self.over = self.over or answered or now - self._reset > _RESETTING


ASK, HOLD, RESET = b"?", b"!", b"\x18"

_TICK = 0.01  # seconds between two looks at the clock
_TRIPS = 4  # usual round trips at least, that a question may be open in motion
_OPENING_PERIOD = 0.05  # seconds between questions at most, until `begin`
_MOVING_PERIOD = 0.025  # the same in motion and during a stop: how soon a silence shows
_ANSWER_LOST = 0.5  # seconds at rest after which an answer that is out will not come
_STUCK = 1.0  # seconds after which a read that has not returned counts as hung
_SLICE = 0.05  # seconds of one wait
_CHUNK = 1024  # bytes that are heard at a time, before others have their turn
_INTERRUPTED = ("hold", "door", "sleep", "check")  # states that we did not ask for

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class TimedStatus:
    """A report: what it says, when it was asked for, and when it was so."""

    status: Status
    answer: Answer
    working: bool  # it goes where it was sent: not before `begin`, while it is locked or homes, nor in a stop


class Link:
    """Sends lines and realtime bytes, hears replies, and notices what is wrong.

    At first it only listens: noise, silence and alarms are no errors until `begin`.

    Each report is handed to `on_report`, with `lock` held; `lock` is notified whenever something was heard.
    """

    def __init__(
        self,
        port: serial.Serial,
        name: str,
        settings: StageSettings,
        on_report: Callable[[TimedStatus], None],
        clock: Clock,
    ) -> None:
        self.error: HardwareError | None = None  # what went wrong, first of all
        self.clock = clock
        self.lock: threading.Condition = clock.condition()
        self.window: Window = Window()
        self.noise: Noise = Noise()
        self.seen: TimedStatus | None = None  # the newest report
        self.rests: int = 0  # reports of rest in a row, all asked for after the last line was taken
        self.banner: Banner | None = None  # what it said when it started, since the last reset
        self.gone: bool = False  # whether the port is lost
        self.locked = False  # whether an alarm is no error, because the stage is to be homed first
        self.patience: float | None = None  # seconds that it may be silent while it homes
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
        self._heard = self.clock.now()  # when it was last listened to
        self._last_line = -math.inf  # when a line was last sent or answered
        self.stopping: Stopping = Stopping()
        self._deaf = False  # what comes is noise, and was reported as such
        self._closing = False
        self._threads = [
            clock.thread(work, f"{name} {work.__name__.strip('_')}") for work in (self._read, self._poll)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def round_trip(self) -> float:
        """Seconds from a question to its answer, of late; NaN before the first."""
        with self.lock:
            return self._times.usual

    @property
    def longest_trip(self) -> float:
        """The longest of late; NaN before the first."""
        with self.lock:
            return self._times.longest

    @property
    def longest_silence(self) -> float:
        """Seconds without an answer that a move bears."""
        with self.lock:
            return max(self._silence, _TRIPS * self._times.usual)

    # What others call

    def begin(self) -> None:
        """From now on, take noise, silence, alarms and resets for errors."""
        with self.lock:
            self._active = True
            self.noise = Noise()

    def enqueue(self, *commands: Command) -> int:
        """Send lines, each as soon as the controller has room and its motion is due.

        Return the value of `window.done` once the first is answered.
        """
        with self.lock:
            self._check()
            numbers = [self.window.add(one.line, one.duration, one.ramp) for one in commands]
            self.rests = 0
            self._pump()
        return numbers[0]

    def ask(self, line: str, timeout: float) -> list[Reply]:
        """Send a line, wait until it is answered, and return what was said in between."""
        with self.lock:
            self._replies = []
            number = self.enqueue(Command(line))
        self.until(lambda: self.window.done >= number or None, timeout, f"take {line}")
        with self.lock:
            if self._refused is not None:
                raise HardwareError(f"{self._name}: it refuses {line}: {self._refused}")
            return self._replies

    def until(self, ready: Callable[[], T | None], timeout: float, what: str) -> T:
        """Wait until `ready` gives something; HardwareError if something goes wrong, or it takes too long."""
        end = self.clock.now() + timeout
        with self.lock:
            while True:
                self._check()
                result = ready()
                if result is not None:
                    return result
                left = end - self.clock.now()
                if left <= 0:
                    raise HardwareError(f"{self._name}: did not {what} within {timeout:.3g} s")
                self.lock.wait(min(left, _SLICE))

    def restart(self, timeout: float) -> None:
        """Hold the machine, reset it, and forget what it said before."""
        self.send(HOLD)
        self.clock.sleep(self.stopping.holding)
        self.banner = None
        self.send(RESET)
        self.until(lambda: self.banner, timeout, "start anew")
        self.seen = None

    def halt(self, why: str) -> None:
        """Stop the machine at once, from any thread, without waiting for any; the reset follows."""
        if not self.stopping.resetting:  # a hold after the reset would stay
            self.send(HOLD)
        if self.error is None:
            self.error = HardwareError(f"{self._name}: {why}")
        self.stopping.begin(self.clock.now())
        if self.patience is not None:  # homing heeds nothing but a reset
            self.send(RESET)

    def send(self, byte: bytes) -> None:
        """Send a realtime byte past all lines; whether it gets there shows in the reports."""
        try:
            self._port.write(byte)
        except Exception:  # pyserial raises many kinds on a port that is gone; the reader reports it
            return

    def close(self) -> None:
        """Stop the machine if it moves, end the threads, and let the port go, in a second or two at most."""
        if self._closing:
            return
        if self._active and self._moving():
            self.halt("the stage was closed in motion")
        end = self.clock.now() + 2 * self.stopping.longest
        try:
            while self.stopping.begun and not self.stopping.over and self.clock.now() < end:
                self.clock.sleep(_TICK)
        finally:  # also after another Ctrl-C
            self._closing = True
            for thread in self._threads:
                thread.join(1.0)
            if self.error is None:
                self.error = HardwareError(f"{self._name}: the stage is closed; open it again")
            close_port(self._port)

    # What the threads do

    def _read(self) -> None:
        while not self._closing:
            began = self.clock.now()
            try:
                data = self._port.read(min(max(1, self._port.in_waiting), _CHUNK))
            except Exception as error:  # as in send
                self._unplugged(error)
                return
            if self._deaf:
                self.clock.sleep(_TICK)  # a flood must not take the others' time
            else:
                self._hear(data, began, self.clock.now())

    def _unplugged(self, error: Exception) -> None:
        if self._closing:
            return
        self.gone = True
        self.halt(f"the line is lost ({error}); the stage may move on: switch it off, and look at the plug")
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
                    self.halt("what it says is garbled; look at the cable, its shield and the baud rate")
                    break
            self._check_answers(now)  # here, where no answer can be read and not yet taken
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
                    self.halt("the controller was reset; it has lost its commands")
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
            self.halt("it is in alarm; look at its switches, then reset and home it")
        elif status.state in _INTERRUPTED:
            self.halt(f"it went into the state {status.state} unasked")

    def _answered(self, refusal: Refusal | None) -> None:
        line = self.window.answer()
        if line is None:
            if self._active and not self.stopping.begun:
                self.halt("it answered a line that nobody here sent: let no other program speak to it")
            return
        self._last_line = self.clock.now()
        self.rests = 0
        self._refused = refusal
        if refusal is not None and self._active:
            self.halt(f"it refuses {line}: {refusal}")
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
                if self.stopping.begun and not self.stopping.resetting:  # lest one was lost, or undone
                    self.send(HOLD)
                self.send(ASK)
                with self.lock:
                    self._times.sent(self.clock.now())
            if not threading.main_thread().is_alive():  # the program ended and left us
                if not self.stopping.begun:
                    self.halt("the program ended")
                self._closing = self.stopping.over

    def _check_answers(self, now: float) -> None:
        """Stop it when it has been silent for too long, or lost an answer."""
        if not self._active or self.stopping.begun:
            return
        if self._times.silence(now) > self._limit() and not self._has_unread():
            self.halt("it no longer answers; the stage may move on: look at the plug, and switch it off")
        idle = self.seen is not None and self.seen.status.state == "idle"
        # By the time of the question: a busy computer may hand over old reports and answers late.
        since = -math.inf if self.seen is None else self.seen.answer.asked - self._last_line
        lost = self.window.unanswered and since > _ANSWER_LOST
        if idle and self.patience is None and lost:
            self.halt("it rests without having answered all lines; look at the cable")

    def _limit(self) -> float:
        if self.patience is not None:
            return self.patience
        return self.longest_silence if self._moving() else self._timeout

    def _moving(self) -> bool:
        if self.window.busy or self.seen is None:
            return self.window.busy
        taken = self.seen.status.state == "idle" and self.rests == 0  # a line, since the report of rest
        return taken or not self.seen.status.rests

    def _poll_period(self) -> float:
        """Return the seconds between two questions, as things stand."""
        if not self._active:
            return min(self._period, _OPENING_PERIOD)
        return min(self._period, _MOVING_PERIOD) if self._moving() or self.stopping.begun else self._period

    def _has_unread(self) -> bool:
        """Return whether there is something to be read that the reader did not get to."""
        try:
            return self._port.in_waiting > 0
        except Exception:  # as in send
            return False

    def _advance_stop(self, now: float) -> None:
        """Go on with a stop: reset once the machine is held, and wait until that is answered."""
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
