"""The line to the controller: one thread reads, one asks for reports and keeps watch."""

from __future__ import annotations

import errno
import math
import os
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import serial

from mirrorskin.hw.errors import HardwareError
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
from mirrorskin.io import InputError

SLICE = 0.02
"""Longest time that a read waits, seconds: how finely a silence is measured."""

_WRITE = 0.25  # seconds after which a line that takes nothing more is broken
_REMEDIES = {
    errno.ENOENT: "there is no such port; plug the controller in, or correct the rig file's port",
    errno.ENODEV: "there is no such port; plug the controller in, or correct the rig file's port",
    errno.ENXIO: "there is no such port; plug the controller in, or correct the rig file's port",
    errno.EACCES: "no permission to open it; join the group that owns it (dialout, uucp)",
    errno.EBUSY: "another program uses it; close that first",
    errno.EAGAIN: "another program uses it; close that first",
}


class Port(Protocol):
    """What of a serial port is used: pyserial's, or anything alike."""

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""

    def read(self, size: int = 1, /) -> bytes:
        """Wait for so many bytes, `SLICE` seconds at most, and return what came."""

    def write(self, data: bytes, /) -> int | None:
        """Send."""

    def close(self) -> None:
        """Let the port go."""


def open_port(url: str, baud: int, name: str) -> Port:
    """Open a serial port, or what a URL of pyserial names, for us alone.

    Parameters
    ----------
    url : str
        Such as ``/dev/ttyUSB0``, ``socket://host:port`` or ``rfc2217://host:port``.
    baud : int
        Bits per second.
    name : str
        What to call the stage in messages.

    Returns
    -------
    Port
        Its reads wait `SLICE` seconds at most.

    Raises
    ------
    InputError
        There is no such port, it is in use, or it cannot be opened.
    """
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
    opened: Port = port
    return opened


def close_port(port: Port) -> None:
    """Close a port, also one that is gone."""
    socket = getattr(port, "_socket", None)  # pyserial forgets it where the other side has left
    try:
        port.close()
        if socket is not None:
            socket.close()
    except Exception:  # pyserial raises many kinds, and there is nothing left to do
        return


_DELAYED = 2 * SLICE  # of our own sleep: a busy computer may hush others, too
_PART = 0.5  # of a slice that such a sleep counts as silence
_SURELY = 0.4  # seconds after which nobody is that busy
_MEDIAN_OF = 15  # round trips that the usual one is the median of
_TIMES, _LATE = 3.0, 0.004  # of the usual, and seconds more, that a round trip may take to be trusted
_AGAIN = 0.04  # seconds, and at least two usual round trips, after which a question is asked again
_FIRST = 0.2  # the same before any was answered
_WIDER = 2.0  # times what an answer took that several questions were open for: the same until one is trusted


@dataclass(frozen=True, slots=True)
class Answer:
    """When an answer was asked for, when it was so, and whether that can be trusted."""

    asked: float
    time: float
    sure: bool


class Watch:
    """Keeps the times of questions and answers.

    A question that stays open is asked again. From then on nobody knows which one an answer is meant for,
    until a period has passed without any; and it is waited longer before the next is asked again.

    Parameters
    ----------
    period : float
        Seconds from one question to the next; may be changed at any time.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self._quiet = -math.inf  # since when nothing was asked, nor answered that cannot be trusted
        self._wider = 0.0
        self._resume = 0.0  # when no answers to earlier questions are to be expected any more
        self._open: list[float] = []
        self._unsure = False
        self._silence = 0.0
        self._trips: deque[float] = deque(maxlen=_MEDIAN_OF)

    @property
    def usual(self) -> float:
        """Seconds of the usual round trip; NaN before the first."""
        return statistics.median(self._trips) if self._trips else math.nan

    def listened(self, began: float, now: float) -> None:
        """Note that somebody listened for `SLICE` seconds at most; an answer that came is told afterwards."""
        if self._open:
            delayed = now - began > _DELAYED
            self._silence += _PART * SLICE if delayed else max(0.0, now - max(began, self._open[0]))

    def silence(self, now: float) -> float:
        """Return for how long a question has been open, as far as somebody listened for an answer."""
        if self._open and now - self._open[0] > _SURELY:
            return now - self._open[0]
        return self._silence

    def due(self, now: float) -> bool:
        """Return whether to ask now."""
        if not self._open:
            return now - self._quiet >= self.period and now >= self._resume
        wait = max(_AGAIN, 2 * self.usual) if self._trips else _FIRST
        return now - self._open[-1] >= max(wait, self._wider)

    def ask(self, now: float) -> None:
        """Note that the question was sent."""
        self._unsure = bool(self._open)
        self._open.append(now)
        self._quiet = now

    def answer(self, now: float) -> Answer:
        """Note that an answer came: it was so in the middle between question and answer.

        It cannot be trusted if no question was open or several were, which makes it as if asked for never,
        or if it came late.
        """
        asked, self._open = self._open, []
        self._silence = 0.0
        if self._unsure or not asked:
            self._quiet = now
            if asked:
                self._wider = min(_WIDER * (now - asked[0]), _SURELY)  # homing answers nothing for long
                self._resume = asked[-1] + self._wider
            return Answer(-math.inf, now, False)
        trip = now - asked[0]
        late = bool(self._trips) and trip > _LATE + _TIMES * self.usual
        self._trips.append(trip)
        self._wider = self._wider if late else 0.0
        return Answer(asked[0], now - trip / 2, not late)


HOLDING = 0.3
"""Seconds that a stop waits for rest before it resets."""

_RESETTING = 0.3  # seconds that a reset may take to be answered

LONGEST = HOLDING + _RESETTING
"""Seconds that a stop takes at most."""


class Stopping:
    """Where a stop has got to; it needs no lock, so that anyone can begin it at any moment.

    Attributes
    ----------
    over : bool
        Whether it is done.
    """

    def __init__(self) -> None:
        self.over = False
        self._began = math.inf
        self._reset = math.inf

    @property
    def begun(self) -> bool:
        """Whether the machine was told to hold."""
        return self._began < math.inf

    @property
    def resetting(self) -> bool:
        """Whether it was told to reset."""
        return self._reset < math.inf

    def begin(self, now: float) -> None:
        """Note that the machine was told to hold."""
        self._began = min(self._began, now)

    def reset(self, now: float, rested: float, gone: bool) -> bool:
        """Return whether to reset now: the machine rests, the line is gone, or the time is up.

        Parameters
        ----------
        now : float
            Seconds.
        rested : float
            When the newest report was asked for, if it tells of rest.
        gone : bool
            Whether there is nobody to wait for.
        """
        if self.resetting or not (gone or rested > self._began or now - self._began > HOLDING):
            return False
        self._reset = now
        return True

    def finish(self, now: float, answered: bool) -> None:
        """Note whether the reset was answered: then the stop is over, and after a while in any case."""
        self.over = self.over or answered or now - self._reset > _RESETTING


ASK, HOLD, RESET = b"?", b"!", b"\x18"

_TICK = 0.01  # seconds between two looks at the clock
_SILENCE, _TRIPS = 0.07, 4  # seconds, and usual round trips at least, that a question may be open in motion
_EAGER = 0.05  # seconds between questions at most, until `begin`
_FAST = 0.025  # the same in motion and during a stop: how soon a silence shows
_LOST = 0.5  # seconds at rest after which an answer that is out will not come
_SLICE = 0.05  # seconds of one wait
_CHUNK = 1024  # bytes that are heard at a time, before others have their turn
_INTERRUPTED = ("hold", "door", "sleep", "check")  # states that we did not ask for

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Seen:
    """A report: what it says, when it was asked for, and when it was so.

    ``working`` tells whether it goes where it was sent: not before `Link.begin`, while it is locked or homes,
    nor in a stop.
    """

    status: Status
    answer: Answer
    working: bool


class Link:
    """Sends lines and realtime bytes, hears replies, and tells what is wrong.

    At first it only listens: noise, silence and alarms are no errors until `begin`.

    Parameters
    ----------
    port : Port
        Open; the link closes it.
    name : str
        What to call the stage in messages.
    timeout : float
        Seconds that a stage at rest may be silent.
    period : float
        Seconds between two questions for a report, at rest; there are more in motion.
    on_report : callable
        Told each report.

    Attributes
    ----------
    error : HardwareError or None
        What went wrong, first of all.
    lock : Condition
        Notified whenever something was heard.
    window : Window
        The lines on their way.
    seen : Seen or None
        The newest report.
    rests : int
        Reports of rest in a row, all asked for after the last line was taken.
    banner : Banner or None
        What the controller said when it started, since it was last told to.
    gone : bool
        Whether the port is lost.
    locked : bool
        Whether an alarm is no error, because the stage is to be homed first.
    patience : float or None
        Seconds that it may be silent, where it was told to do what keeps it from answering.
    """

    def __init__(
        self,
        port: Port,
        name: str,
        timeout: float,
        period: float,
        on_report: Callable[[Seen], None],
    ) -> None:
        self.error: HardwareError | None = None
        self.lock = threading.Condition()
        self.window = Window()
        self.noise = Noise()
        self.seen: Seen | None = None
        self.rests = 0
        self.banner: Banner | None = None
        self.gone = False
        self.locked = False
        self.patience: float | None = None
        self._port = port
        self._name = name
        self._timeout = timeout
        self._period = period
        self._tell = on_report
        self._watch = Watch(period)
        self._splitter = Splitter()
        self._said: list[Reply] = []
        self._refused: Refusal | None = None
        self._active = False
        self._moved = -math.inf  # when a line was last sent or answered
        self._stopping = Stopping()
        self._deaf = False  # what comes is noise, and was told as such
        self._closing = False
        self._threads = [
            threading.Thread(target=work, name=f"{name} {work.__name__.strip('_')}")
            for work in (self._read, self._keep)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def round_trip(self) -> float:
        """Seconds from a question to its answer, of late; NaN before the first."""
        with self.lock:
            return self._watch.usual

    # What others call

    def begin(self) -> None:
        """From now on, take noise, silence, alarms and resets for errors."""
        with self.lock:
            self._active = True
            self.noise = Noise()

    def enqueue(self, *lines: str) -> int:
        """Send lines as soon as the controller has room; return `window.done` once the first is answered."""
        with self.lock:
            self._check()
            numbers = [self.window.add(line) for line in lines]
            self.rests = 0
            self._pump()
        return numbers[0]

    def ask(self, line: str, timeout: float) -> list[Reply]:
        """Send a line, wait until it is answered, and return what was said in between.

        Raises
        ------
        HardwareError
            It was refused, or not answered within `timeout` seconds.
        """
        with self.lock:
            self._said = []
            number = self.enqueue(line)
        self.until(lambda: self.window.done >= number or None, timeout, f"take {line}")
        with self.lock:
            if self._refused is not None:
                raise HardwareError(f"{self._name}: it refuses {line}: {self._refused}")
            return self._said

    def until(self, ready: Callable[[], T | None], timeout: float, what: str) -> T:
        """Wait until `ready` gives something.

        Raises
        ------
        HardwareError
            When something goes wrong, or did not happen within `timeout` seconds.
        """
        end = time.monotonic() + timeout
        with self.lock:
            while True:
                self._check()
                result = ready()
                if result is not None:
                    return result
                left = end - time.monotonic()
                if left <= 0:
                    raise HardwareError(f"{self._name}: did not {what} within {timeout:.3g} s")
                self.lock.wait(min(left, _SLICE))

    def restart(self, timeout: float) -> None:
        """Hold the machine, reset it, and forget what it said before."""
        self.send(HOLD)
        time.sleep(HOLDING)
        self.banner = None
        self.send(RESET)
        self.until(lambda: self.banner, timeout, "start anew")
        self.seen = None

    def halt(self, why: str) -> None:
        """Stop the machine at once, from any thread, without waiting for any; the reset follows."""
        if not self._stopping.resetting:  # a hold after the reset would stay
            self.send(HOLD)
        if self.error is None:
            self.error = HardwareError(f"{self._name}: {why}")
        self._stopping.begin(time.monotonic())
        if self.patience is not None:  # homing heeds nothing but a reset
            self.send(RESET)

    def send(self, byte: bytes) -> None:
        """Send a realtime byte past all lines; whether it gets there shows in the reports."""
        try:
            self._port.write(byte)
        except Exception:  # pyserial raises many kinds on a port that is gone; the reader tells of it
            return

    def close(self) -> None:
        """Stop the machine if it moves, end the threads, and let the port go, in a second or two at most."""
        if self._closing:
            return
        if self._moving():
            self.halt("the stage was closed in motion")
        end = time.monotonic() + 2 * LONGEST
        try:
            while self._stopping.begun and not self._stopping.over and time.monotonic() < end:
                time.sleep(_TICK)
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
            began = time.monotonic()
            try:
                data = self._port.read(min(max(1, self._port.in_waiting), _CHUNK))
            except Exception as error:  # as in send
                self._unplugged(error)
                return
            if self._deaf:
                time.sleep(_TICK)  # a flood must not take the others' time
            else:
                self._hear(data, began, time.monotonic())

    def _unplugged(self, error: Exception) -> None:
        if self._closing:
            return
        self.gone = True
        self.halt(f"the line is lost ({error}); the stage may move on: switch it off, and look at the plug")
        with self.lock:
            self.lock.notify_all()

    def _hear(self, data: bytes, since: float, now: float) -> None:
        with self.lock:
            self._watch.listened(since, now)
            for line, began in self._splitter.feed(data, now):
                reply, noise = parse(line), 0
                if reply is None:
                    reply, noise = salvage(line)
                if reply is not None:
                    self._take(reply, began)
                if noise and self.noise.add(noise, now) and self._active:
                    self._deaf = True
                    self.halt("what it says is garbled; look at the cable, its shield and the baud rate")
                    break
            self.lock.notify_all()

    def _take(self, reply: Reply, began: float) -> None:
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
                if self._active and not self._stopping.begun:
                    self.halt("the controller was reset; it has lost what it was told")
                self.banner = reply
            case Setting() | Message():
                self._said.append(reply)

    def _report(self, status: Status, began: float) -> None:
        homed = not self.locked and self.patience is None
        working = self._active and homed and not self._stopping.begun
        self.seen = Seen(status, self._watch.answer(began), working)
        self._tell(self.seen)
        if status.state != "idle":
            self.rests = 0
        elif self.seen.answer.asked > self._moved:
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
            return
        self._moved = time.monotonic()
        self.rests = 0
        self._refused = refusal
        if refusal is not None and self._active:
            self.halt(f"it refuses {line}: {refusal}")
        self._pump()

    def _pump(self) -> None:
        while self.error is None and (data := self.window.next()) is not None:
            self._moved = time.monotonic()
            try:
                self._port.write(data)
            except Exception as error:  # as in send
                self._unplugged(error)

    def _keep(self) -> None:
        while not self._closing:
            time.sleep(_TICK)
            now = time.monotonic()
            with self.lock:
                self._look(now)
                if self._stopping.begun:
                    self._end(now)
                self._watch.period = self._pace()
                ask = self._watch.due(now) and not self.gone
                if ask:
                    self._watch.ask(time.monotonic())
            if ask:
                if self._stopping.begun and not self._stopping.resetting:  # lest one was lost, or undone
                    self.send(HOLD)
                self.send(ASK)
            if not threading.main_thread().is_alive():  # the program ended and left us
                if not self._stopping.begun:
                    self.halt("the program ended")
                self._closing = self._stopping.over

    def _look(self, now: float) -> None:
        """Tell when it has been silent for too long, or lost an answer."""
        if not self._active or self._stopping.begun:
            return
        if self._watch.silence(now) > self._limit() and not self._waiting():
            self.halt("it no longer answers; the stage may move on: look at the plug, and switch it off")
        idle = self.seen is not None and self.seen.status.state == "idle"
        if idle and self.patience is None and self.window.busy and now - self._moved > _LOST:
            self.halt("it rests without having answered all lines; look at the cable")

    def _limit(self) -> float:
        if self.patience is not None:
            return self.patience
        return max(_SILENCE, _TRIPS * self._watch.usual) if self._moving() else self._timeout

    def _moving(self) -> bool:
        if self.window.busy or self.seen is None:
            return self.window.busy
        taken = self.seen.status.state == "idle" and self.rests == 0  # a line, since the report of rest
        return taken or not self.seen.status.rests

    def _pace(self) -> float:
        """Return the seconds between two questions, as things stand."""
        if not self._active:
            return min(self._period, _EAGER)
        return min(self._period, _FAST) if self._moving() or self._stopping.begun else self._period

    def _waiting(self) -> bool:
        """Return whether there is something to be read that the reader did not get to."""
        try:
            return self._port.in_waiting > 0
        except Exception:  # as in send
            return False

    def _end(self, now: float) -> None:
        """Go on with a stop: reset once the machine is held, and wait until that is answered."""
        rested = self.seen.answer.asked if self.seen is not None and self.seen.status.rests else -math.inf
        if self._stopping.reset(now, rested, self.gone):
            self.window.clear()
            self.banner = None
            self.send(RESET)
        elif self._stopping.resetting:
            self._stopping.finish(now, self.gone or self.banner is not None)
        self.lock.notify_all()

    def _check(self) -> None:
        if self.error is not None:
            raise self.error.with_traceback(None)
