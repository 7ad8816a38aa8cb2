"""What a GRBL 1.1 or grblHAL controller says, line by line."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

LONGEST = 512
"""Bytes that a reply can have; longer ones are noise."""

_LETTERS = "XYZABCUV"  # the order in which a report gives its coordinates
_BANNER = re.compile(r"(grblHAL|Grbl) +v?(\d+)\.(\d+)(\w*)", re.IGNORECASE)
_SETTING = re.compile(r"\$(\d+)=(.*)")
_CODE = re.compile(r"(error|ALARM):(\d+)")
_STATE = re.compile(r"([A-Z][a-z]+)(?::(\d+))?")
_LAST = re.compile(rb"(<[^<]*>|ok|(error|ALARM):\d+)\s*$")
_STATES = {"Idle", "Run", "Hold", "Jog", "Alarm", "Home", "Door", "Check", "Sleep", "Tool"}

_ERRORS = {
    1: "a word without a letter",
    2: "a number that cannot be read",
    3: "an unknown $ command",
    5: "homing is switched off ($22)",
    8: "it takes this only at rest",
    9: "it is locked after an alarm or a reset: home it",
    10: "soft limits ($20) need homing ($22)",
    11: "the line is too long",
    15: "the target is beyond the machine's travel ($130 to $135)",
    20: "it does not know this command",
    21: "two commands exclude each other",
    22: "no feed was set",
    24: "two commands want the axis words",
    26: "no axis word was given",
    33: "the arc or the target cannot be",
    34: "the arc's radius does not fit its ends",
    35: "the arc has no centre in its plane",
    # Those of grblHAL alone
    18: "it was reset",
    45: "a limit switch is pressed: home it",
    46: "it must be homed first",
    50: "the emergency stop is pressed",
    51: "a motor driver reports a fault",
    79: "it takes this only after a reset",
}
_ALARMS = {
    1: "a limit switch was hit; home it before anything else",
    2: "the target is beyond the machine's travel ($130 to $135)",
    3: "it was reset in motion, so that it has lost its place; home it",
    6: "homing was interrupted",
    7: "the door opened while homing",
    8: "homing found a switch that stays pressed; look at its wiring and at $27",
    9: "homing did not reach a switch; look at its wiring and at $130 to $135",
    10: "the emergency stop is pressed",
    11: "it must be homed first",
    12: "a limit switch is pressed: home it",
    15: "homing did not reach the second switch of an axis; look at its wiring",
    16: "its self-test failed; switch it off and on",
    17: "a motor driver reports a fault; look at the motor and its supply",
    18: "homing is not set up as it should be; look at $22 and $44 to $49",
    20: "a board that it is extended by failed; look at its cable",
    21: "its settings cannot be read; set them anew",
    22: "its input buffer ran over; look at the cable",
}


@dataclass(frozen=True, slots=True)
class Banner:
    """What a controller says when it starts: its name and version, such as (1, 1)."""

    text: str
    version: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Ok:
    """A line was taken."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """A line was not taken: ``error:N``."""

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
    """The answer to ``?``: coordinates by letter, in the machine's units, of which a report has some."""

    state: str  # lower case: idle, run, hold, jog, alarm, home, door, check, sleep, tool
    detail: int | None = None  # behind the state: Hold:0 has come to rest, Hold:1 has not
    machine: Mapping[str, float] | None = None
    work: Mapping[str, float] | None = None
    offset: Mapping[str, float] | None = None  # how far the machine's are ahead of the work piece's
    pins: str = ""  # switches that are pressed: axis letters, P probe, D door, H hold, R reset, S start

    @property
    def rests(self) -> bool:
        """Whether nothing moves: not in these states, nor while a hold or an open door slows it down."""
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
    """Anything in brackets, without them, and the start-up lines."""

    text: str


Reply = Banner | Ok | Refusal | Alarm | Status | Setting | Message


def parse(line: bytes) -> Reply | None:
    """Read one reply, without the line's end; None if this is nothing that a controller says."""
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
    """Return the reply, if any, that ends a line which began as something else, and the bytes of noise."""
    match = _LAST.search(line)
    reply = parse(match[0]) if match else None
    return reply, match.start() if match and reply else len(line)


def _status(text: str) -> Status | None:
    """Read ``<Idle|MPos:0.000,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>``."""
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
"""Bytes of lines that a controller keeps while it works, unless it says otherwise."""

_WINDOW = 1.0  # seconds over which noise is counted
_BEARABLE = 256  # bytes of it


class Splitter:
    """Cuts what arrives into lines; each knows when its first byte came."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self._began = 0.0

    def feed(self, data: bytes, now: float) -> list[tuple[bytes, float]]:
        """Return the lines that `data` completes, and when each began; overlong ones come in pieces."""
        found: list[tuple[bytes, float]] = []
        *whole, rest = data.replace(b"\r", b"\n").split(b"\n")
        for part in whole:
            began = self._began if self._rest else now
            found.append((bytes(self._rest + part), began))
            self._rest.clear()
        if rest and not self._rest:
            self._began = now
        self._rest += rest
        if len(self._rest) > LONGEST:
            found.append((bytes(self._rest), self._began))
            self._rest.clear()
        return [(line, began) for line, began in found if line]


class Noise:
    """Counts the bytes that cannot be understood: a little of it is borne."""

    def __init__(self) -> None:
        self.total: int = 0
        self._heard: deque[tuple[float, int]] = deque()
        self._recent = 0

    def add(self, size: int, now: float) -> bool:
        """Note so many bytes of noise; return whether it is too much within a second."""
        self._heard.append((now, size))
        self.total += size
        self._recent += size
        while self._heard[0][0] < now - _WINDOW:
            self._recent -= self._heard.popleft()[1]
        return self._recent > _BEARABLE


AHEAD = 0.5
"""Seconds of motion that the controller has in store when the next line is sent.

When this program is killed, the stage moves on for this long and for one line more. When this program pauses
for longer, the stage comes to rest; `Rig` then ends a timed move.
"""


class Window:
    """Lines on their way to the controller: no byte more than its buffer holds, and no motion far ahead.

    Bytes are counted until a line is answered. The motion of a line is assumed to begin when that of the line
    before it ends, and to last for its duration.
    """

    def __init__(self, size: int = BUFFER) -> None:
        self.size = size  # bytes of the controller's buffer
        self.done: int = 0  # lines answered
        self._waiting: deque[tuple[bytes, float, float]] = deque()  # with their duration and ramp
        self._sent: deque[bytes] = deque()
        self._filled = 0
        self._ends = -math.inf  # when the motion that was sent ends, seconds of time.monotonic

    @property
    def busy(self) -> bool:
        """Whether any line waits or is unanswered."""
        return bool(self._waiting or self._sent)

    @property
    def unanswered(self) -> bool:
        """Whether a line was sent and not answered yet."""
        return bool(self._sent)

    def add(self, line: str, duration: float = 0.0, ramp: float = 0.0) -> int:
        """Append a line, whose motion takes some seconds, `ramp` of which to reach its speed or to stop.

        Return the value of `done` once it is answered.
        """
        data = line.encode("ascii") + b"\n"
        if len(data) > self.size:
            raise ValueError(f"a line of {len(data)} bytes does not fit a buffer of {self.size}")
        self._waiting.append((data, duration, ramp))
        return self.done + len(self._sent) + len(self._waiting)

    def next(self, now: float) -> bytes | None:
        """Return the next line, to be sent now, if the buffer has room for it and its motion is due."""
        if not self._waiting:
            return None
        data, duration, ramp = self._waiting[0]
        # What the controller has in store must be enough to slow down, or it does not reach its speed.
        early = duration > 0 and self._ends - now > AHEAD + ramp / 2
        if early or self._filled + len(data) > self.size:
            return None
        self._waiting.popleft()
        self._ends = max(self._ends, now) + duration
        self._sent.append(data)
        self._filled += len(data)
        return data

    def answer(self) -> str | None:
        """Note that the oldest line sent was answered, and return it; None if none was sent."""
        if not self._sent:
            return None
        data = self._sent.popleft()
        self._filled -= len(data)
        self.done += 1
        return data.decode("ascii").strip()

    def clear(self) -> None:
        """Forget all lines: the controller was reset."""
        self._waiting.clear()
        self._sent.clear()
        self._filled = 0
        self._ends = -math.inf
