"""Replies of a GRBL 1.1 or grblHAL controller, line by line."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

LONGEST = 512
"""Maximum length of a reply, bytes; longer ones are noise."""

_LETTERS = "XYZABCUV"  # order of the coordinates in a report
_BANNER = re.compile(r"(grblHAL|Grbl) +v?(\d+)\.(\d+)(\w*)", re.IGNORECASE)
_SETTING = re.compile(r"\$(\d+)=(.*)")
_CODE = re.compile(r"(error|ALARM):(\d+)")
_STATE = re.compile(r"([A-Z][a-z]+)(?::(\d+))?")
_LAST = re.compile(rb"(<[^<]*>|ok|(error|ALARM):\d+)\s*$")
_STATES = {"Idle", "Run", "Hold", "Jog", "Alarm", "Home", "Door", "Check", "Sleep", "Tool"}

_ERRORS = {
    1: "a word without a letter",
    2: "an unreadable number",
    3: "an unknown $ command",
    5: "homing is switched off ($22)",
    8: "accepted only at rest",
    9: "locked after an alarm or a reset: home the stage",
    10: "soft limits ($20) need homing ($22)",
    11: "the line is too long",
    15: "the target is beyond the machine's travel ($130 to $135)",
    20: "unknown command",
    21: "two commands exclude each other",
    22: "no feed was set",
    24: "two commands use the same axis words",
    26: "no axis word was given",
    33: "impossible arc or target",
    34: "the arc's radius does not fit its ends",
    35: "the arc has no centre in its plane",
    # grblHAL only
    18: "the controller was reset",
    45: "a limit switch is pressed: home the stage",
    46: "the stage must be homed first",
    50: "the emergency stop is pressed",
    51: "a motor driver reports a fault",
    79: "accepted only after a reset",
}
_ALARMS = {
    1: "a limit switch was hit; home the stage first",
    2: "the target is beyond the machine's travel ($130 to $135)",
    3: "the controller was reset in motion and has lost its position; home the stage",
    6: "homing was interrupted",
    7: "the door opened while homing",
    8: "homing found a switch that stays pressed; check its wiring and $27",
    9: "homing did not reach a switch; check its wiring and $130 to $135",
    10: "the emergency stop is pressed",
    11: "the stage must be homed first",
    12: "a limit switch is pressed: home the stage",
    15: "homing did not reach the second switch of an axis; check its wiring",
    16: "the self-test failed; switch the controller off and on",
    17: "a motor driver reports a fault; check the motor and its power supply",
    18: "homing is not configured correctly; check $22 and $44 to $49",
    20: "an extension board failed; check its cable",
    21: "the settings cannot be read; enter them again",
    22: "the input buffer overflowed; check the cable",
}


@dataclass(frozen=True, slots=True)
class Banner:
    """Start-up message of a controller: its name and version, such as (1, 1)."""

    text: str
    version: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Ok:
    """A line was accepted."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """A line was refused: ``error:N``."""

    code: int

    def __str__(self) -> str:
        return f"error:{self.code} ({_ERRORS.get(self.code, 'see the list of its error codes')})"


@dataclass(frozen=True, slots=True)
class Alarm:
    """The controller locked itself: ``ALARM:N``."""

    code: int

    def __str__(self) -> str:
        return f"ALARM:{self.code} ({_ALARMS.get(self.code, 'see the list of its alarm codes')})"


@dataclass(frozen=True, slots=True)
class Status:
    """The answer to ``?``: coordinates by letter, in machine units; some may be missing."""

    state: str  # lower case: idle, run, hold, jog, alarm, home, door, check, sleep, tool
    detail: int | None = None  # sub-state: Hold:0 is at rest, Hold:1 is not
    machine: Mapping[str, float] | None = None
    work: Mapping[str, float] | None = None
    offset: Mapping[str, float] | None = None  # machine coordinates minus work coordinates
    pins: str = ""  # pressed switches: axis letters, P probe, D door, H hold, R reset, S start

    @property
    def rests(self) -> bool:
        """Whether nothing moves; a hold or an open door may still be decelerating."""
        if self.state == "hold":
            return self.detail != 1
        if self.state == "door":
            return self.detail in (0, 1)
        return self.state not in ("run", "jog", "home", "tool")


@dataclass(frozen=True, slots=True)
class Setting:
    """One of the ``$`` settings."""

    number: int
    value: str


@dataclass(frozen=True, slots=True)
class Message:
    """Any text in brackets, without them, and the start-up lines."""

    text: str


Reply = Banner | Ok | Refusal | Alarm | Status | Setting | Message


def parse(line: bytes) -> Reply | None:
    """Parse one reply without its line end; None if it is not a reply of a controller."""
    try:
        text = line.decode("ascii").strip()
    except UnicodeDecodeError:
        return None
    if text == "ok":
        return Ok()
    if text.startswith("<"):
        return _status(text)
    if match := _CODE.fullmatch(text):
        return (Alarm if match[1] == "ALARM" else Refusal)(int(match[2]))
    if match := _SETTING.fullmatch(text):
        return Setting(int(match[1]), match[2].partition(" (")[0].strip())
    if match := _BANNER.match(text):
        return Banner(text, (int(match[2]), int(match[3])))
    if re.fullmatch(r"\[[ -~]*\]|>[ -~]*", text):
        return Message(text.strip("[]"))
    return None


def salvage(line: bytes) -> tuple[Reply | None, int]:
    """Return the reply at the end of a line that starts with noise, if any, and the number of noise bytes."""
    match = _LAST.search(line)
    reply = parse(match[0]) if match else None
    return reply, match.start() if match and reply else len(line)


def _status(text: str) -> Status | None:
    """Parse ``<Idle|MPos:0.000,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>``."""
    if not text.endswith(">") or "<" in text[1:]:
        return None
    first, *fields = text[1:-1].split("|")
    state = _STATE.fullmatch(first)
    if state is None or state[1] not in _STATES:
        return None
    places: dict[str, Mapping[str, float] | None] = {}
    pins = ""
    for field in fields:
        name, _, value = field.partition(":")
        pins = value if name == "Pn" else pins
        if name in ("MPos", "WPos", "WCO"):
            places[name] = _coordinates(value)
            if places[name] is None:
                return None
    if ("MPos" in places) == ("WPos" in places):
        return None
    detail = int(state[2]) if state[2] else None
    return Status(state[1].lower(), detail, places.get("MPos"), places.get("WPos"), places.get("WCO"), pins)


def _coordinates(text: str) -> Mapping[str, float] | None:
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        return None
    if not 3 <= len(numbers) <= len(_LETTERS) or not all(map(math.isfinite, numbers)):
        return None
    return dict(zip(_LETTERS, numbers, strict=False))


BUFFER = 128
"""Size of the controller's buffer of lines, bytes, unless it reports another one."""

_WINDOW = 1.0  # seconds over which noise is counted
_BEARABLE = 256  # bytes of noise that are tolerated in it


class Splitter:
    """Divides received bytes into lines, with the time of the first byte of each."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self._began = 0.0

    def feed(self, data: bytes, now: float) -> list[tuple[bytes, float]]:
        """Return the lines that `data` completes, and the times of their first bytes."""
        lines: list[tuple[bytes, float]] = []
        *whole, rest = data.replace(b"\r", b"\n").split(b"\n")
        for part in whole:
            began = self._began if self._rest else now
            lines.append((bytes(self._rest + part), began))
            self._rest.clear()
        if rest and not self._rest:
            self._began = now
        self._rest += rest
        if len(self._rest) > LONGEST:
            lines.append((bytes(self._rest), self._began))
            self._rest.clear()
        return [(line, began) for line, began in lines if line]


class Noise:
    """Counts bytes that are not understood; a small number is tolerated."""

    def __init__(self) -> None:
        self.total: int = 0
        self._heard: deque[tuple[float, int]] = deque()
        self._recent = 0

    def add(self, size: int, now: float) -> bool:
        """Add a number of noise bytes; return whether there are too many within a second."""
        self._heard.append((now, size))
        self.total += size
        self._recent += size
        while self._heard[0][0] < now - _WINDOW:
            self._recent -= self._heard.popleft()[1]
        return self._recent > _BEARABLE


AHEAD = 0.5
"""Seconds of motion that the controller has queued when the next line is sent.

When this program is killed, the stage moves on for this time and for one more line. When this program pauses
for longer, the stage comes to rest; `Rig` then ends a timed move.
"""


class Window:
    """Lines sent to the controller: never more bytes than its buffer holds, nor motion far ahead.

    Bytes are counted until a line is answered. The motion of a line is assumed to start when that of the
    previous line ends, and to last for its duration.
    """

    def __init__(self, size: int = BUFFER) -> None:
        self.size = size  # size of the controller's buffer, bytes
        self.done: int = 0  # number of lines answered
        self._waiting: deque[tuple[bytes, float, float]] = deque()  # with duration and ramp of each
        self._sent: deque[bytes] = deque()
        self._filled = 0
        self._ends = -math.inf  # end of the motion sent so far, seconds of time.monotonic

    @property
    def busy(self) -> bool:
        """Whether any line is waiting or unanswered."""
        return bool(self._waiting or self._sent)

    @property
    def unanswered(self) -> bool:
        """Whether a sent line is unanswered."""
        return bool(self._sent)

    def add(self, line: str, duration: float = 0.0, ramp: float = 0.0) -> int:
        """Append a line whose motion takes `duration` seconds; accelerating or decelerating takes `ramp`.

        Return the value of `done` once it is answered.
        """
        data = line.encode("ascii") + b"\n"
        if len(data) > self.size:
            raise ValueError(f"a line of {len(data)} bytes does not fit a buffer of {self.size}")
        self._waiting.append((data, duration, ramp))
        return self.done + len(self._sent) + len(self._waiting)

    def next(self, now: float) -> bytes | None:
        """Return the next line to send now, if the buffer has room for it and its motion is due."""
        if not self._waiting:
            return None
        data, duration, ramp = self._waiting[0]
        # The queued motion must be long enough to decelerate in, or the speed is not reached.
        early = duration > 0 and self._ends - now > AHEAD + ramp / 2
        if early or self._filled + len(data) > self.size:
            return None
        self._waiting.popleft()
        self._ends = max(self._ends, now) + duration
        self._sent.append(data)
        self._filled += len(data)
        return data

    def answer(self) -> str | None:
        """Record the answer to the oldest line, and return that line; None if none was sent."""
        if not self._sent:
            return None
        data = self._sent.popleft()
        self._filled -= len(data)
        self.done += 1
        return data.decode("ascii").strip()

    def clear(self) -> None:
        """Discard all lines: the controller was reset."""
        self._waiting.clear()
        self._sent.clear()
        self._filled = 0
        self._ends = -math.inf
