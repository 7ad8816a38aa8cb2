"""A controller with Marlin 2's protocol, in place of a serial port.

Written after the firmware's documentation of its G-codes: lines wait for moves where the firmware's do.
"""

import functools
import math
import operator
import re

from scripted_port import ScriptedPort

_WORDS = re.compile(r"([A-Z])(-?\d+\.?\d*)?")


class FakeMarlin(ScriptedPort):
    """Goes evenly to where it is sent; `place` gives the coordinates, `log` the lines that it took."""

    def __init__(self, clock, emergency=True, home=(0.0, 0.0, 0.0), letters="XYZ"):
        super().__init__(clock)
        self.emergency, self.letters, self.log = emergency, letters, []
        self.instead = {}  # a code to what is said instead of its answer
        self.ends = 0.0  # soft limit, below which it clips places; 0 for none
        self.homing = 0.0  # seconds that it takes
        self.killed = False
        self.noise = str  # what becomes of the words on their way
        self._number = 0  # of the last line
        self._home = dict(zip(letters, home, strict=True))
        start = dict.fromkeys(letters, 20.0)
        self._legs = [(clock.now(), 0.0, start, start)]
        self._pending = []  # lines, the first of which may be waiting for the end of a move
        self._free = 0.0  # when that is over

    def take(self, data):
        for line in self.noise(data.decode()).split("\n"):
            if line and not self.killed:
                self._hear(line)

    def chat(self, *lines):
        """Say lines that answer nothing, also while it is silent otherwise."""
        silent, self.silent = self.silent, False
        self.say(*lines)
        self.silent = silent

    def place(self):
        """Return where it is, by letter."""
        at = self.clock.now()
        began, duration, a, b = next(leg for leg in reversed(self._legs) if leg[0] <= at)
        part = 1.0 if at >= began + duration else (at - began) / duration
        return {letter: a[letter] + part * (b[letter] - a[letter]) for letter in a}

    def put(self, value):
        """Move all axes, as by its display."""
        self._stand(dict.fromkeys(self.letters, value))

    @property
    def moving(self):
        return self.clock.now() < self._end

    @property
    def _end(self):
        return self._legs[-1][0] + self._legs[-1][1]

    def _stand(self, place):
        self._legs.append((self.clock.now(), 0.0, place, place))

    def _hear(self, line):
        if line.startswith("N"):
            text, _, check = line.rpartition("*")
            number, line = text[1:].split(" ", 1)
            right = int(check) == functools.reduce(operator.xor, text.encode())
            if not right or (int(number) != self._number + 1 and not line.startswith("M110")):
                what = "Line Number" if right else "checksum mismatch"
                self.say(f"Error:{what}, Last Line: {self._number}", f"Resend: {self._number + 1}", "ok")
                return
            self._number = int(number)
        code = line.partition(" ")[0]
        if self.emergency and code in ("M410", "M112"):
            self._halt()
            self.killed |= code == "M112"
        self._pending.append(line)

    def _halt(self):
        self._stand(self.place())
        self._free = 0.0

    def advance(self):
        while self._pending and self.clock.now() >= self._free:
            line = self._pending[0]
            code = re.match(r"[GM]\d+", line)[0]
            if code in ("M400", "M114") and self.moving:
                self._free = self._end
                break
            self._pending.pop(0)
            self.log.append(line)
            last = self._legs[-1][3]
            self.say(*([self.instead[code]] if code in self.instead else self._answer(code, line, last)))
        return max(0.0, self._free - self.clock.now()) if self._pending else math.inf

    def _answer(self, code, line, last):
        words = {letter: float(value) for letter, value in _WORDS.findall(line[len(code) :]) if value}
        match code:
            case "G1":
                place = last | {letter: value for letter, value in words.items() if letter in last}
                if self.ends:
                    place = {letter: max(value, self.ends) for letter, value in place.items()}
                length = sum((place[letter] - last[letter]) ** 2 for letter in last) ** 0.5
                begins = max(self.clock.now(), self._end)
                self._legs.append((begins, 60 * length / words["F"], last, place))
            case "G28":
                self._legs.append((self.clock.now(), self.homing, last, self._home))
                self._free = self.clock.now() + self.homing
                self._pending.insert(0, "M400")  # whose ok ends it
                return ["echo:busy: processing"]
            case "M115":
                return [
                    "FIRMWARE_NAME:Marlin 2.1.2 (Nov 24 2026) SOURCE_CODE_URL:none PROTOCOL_VERSION:1.0",
                    f"Cap:EMERGENCY_PARSER:{int(self.emergency)}",
                    "ok",
                ]
            case "M114":
                report = " ".join(f"{letter}:{value:.2f}" for letter, value in self.place().items())
                return [f"{report} E:0.00 Count X:0 Y:0 Z:0", "ok"]
            case "M503":
                return ["echo:  M203 X50.00 Y50.00 Z8.00 E25.00", "echo:  M201 X500 Y500 Z100", "ok"]
            case "M27":
                return ["Not SD printing", "ok"]
            case "M410":
                self._halt()
            case "M112":
                self.killed = True
                return ["Error:Printer halted. kill() called!"]
        return ["ok"]
