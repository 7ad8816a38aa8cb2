"""A controller that speaks as Marlin 2 does, in real time, in the place of a serial port.

Written after the firmware's documentation of its G-codes: lines wait for moves where the firmware's do.
"""

import functools
import operator
import re
import threading
import time

_WORDS = re.compile(r"([A-Z])(-?\d+\.?\d*)?")


class FakeMarlin:
    """Goes evenly to where it is sent; `now` gives the coordinates, `log` the lines that it took."""

    def __init__(self, emergency=True, home=(0.0, 0.0, 0.0), letters="XYZ"):
        self.emergency, self.letters, self.log = emergency, letters, []
        self.silent = self.closed = self.pulled = False
        self.instead = {}  # a code to what is said instead of its answer
        self.ends = 0.0  # soft limit, below which it clips places; 0 for none
        self.homing = 0.0  # seconds that it takes
        self.killed = False
        self.noise = str  # what becomes of the words on their way
        self._number = 0  # of the last line
        self._home = dict(zip(letters, home, strict=True))
        self._legs = [(0.0, 0.0, dict.fromkeys(letters, 20.0), dict.fromkeys(letters, 20.0))]
        self._out, self._lock = bytearray(), threading.Condition()
        self._pending = []  # lines, the first of which may be waiting for the end of a move
        self._free = 0.0  # when that is over
        self.timeout = 0.02

    # As a port

    @property
    def in_waiting(self):
        if self.pulled:
            raise OSError("no such device")
        with self._lock:
            self._work()
            return len(self._out)

    def read(self, size):
        until = time.monotonic() + self.timeout
        while not self.in_waiting and time.monotonic() < until:
            time.sleep(0.001)
        with self._lock:
            data = bytes(self._out[:size])
            del self._out[:size]
        return data

    def write(self, data):
        with self._lock:
            self._work()
            for line in self.noise(data.decode()).split("\n"):
                if line and not self.killed:
                    self._take(line)
            self._work()

    def pull(self):
        self.pulled = True

    def flush(self):
        pass

    def close(self):
        self.closed = True

    def say(self, *lines):
        if not self.silent:
            self.chat(*lines)

    def chat(self, *lines):
        """Say lines that answer nothing, also while it is silent otherwise."""
        with self._lock:
            self._out += "".join(f"{line}\n" for line in lines).encode("latin-1")

    # As a machine

    def now(self):
        """Return where it is, by letter."""
        at = time.monotonic()
        for began, duration, a, b in reversed(self._legs):
            if at >= began:
                part = 1.0 if at >= began + duration else (at - began) / duration
                return {letter: a[letter] + part * (b[letter] - a[letter]) for letter in a}
        raise AssertionError("before the first")

    def put(self, value):
        """Move all axes, as by its display."""
        place = dict.fromkeys(self.letters, value)
        self._legs.append((time.monotonic(), 0.0, place, place))

    @property
    def moving(self):
        began, duration, _, _ = self._legs[-1]
        return time.monotonic() < began + duration

    def _take(self, line):
        if line.startswith("N"):
            text, _, check = line.rpartition("*")
            number, line = text[1:].split(" ", 1)
            right = int(check) == functools.reduce(operator.xor, text.encode())
            if not right or (int(number) != self._number + 1 and not line.startswith("M110")):
                self.say(
                    f"Error:{'Line Number' if right else 'checksum mismatch'}, Last Line: {self._number}"
                )
                self.say(f"Resend: {self._number + 1}", "ok")
                return
            self._number = int(number)
        code = line.partition(" ")[0]
        if self.emergency and code in ("M410", "M112"):
            self._halt()
            self.killed |= code == "M112"
        self._pending.append(line)

    def _halt(self):
        here = self.now()
        self._legs.append((time.monotonic(), 0.0, here, here))
        self._free = 0.0

    def _work(self):
        while self._pending and time.monotonic() >= self._free:
            line = self._pending[0]
            code = re.match(r"[GM]\d+", line)[0]
            began, duration, _, last = self._legs[-1]
            if code in ("M400", "M114") and time.monotonic() < began + duration:
                self._free = began + duration
                return
            self._pending.pop(0)
            self.log.append(line)
            for said in [self.instead[code]] if code in self.instead else self._answer(code, line, last):
                self.say(said)

    def _answer(self, code, line, last):
        words = {letter: float(value) for letter, value in _WORDS.findall(line[len(code) :]) if value}
        match code:
            case "G1":
                place = last | {letter: value for letter, value in words.items() if letter in last}
                if self.ends:
                    place = {letter: max(value, self.ends) for letter, value in place.items()}
                length = sum((place[letter] - last[letter]) ** 2 for letter in last) ** 0.5
                began, duration, _, _ = self._legs[-1]
                begins = max(time.monotonic(), began + duration)
                self._legs.append((begins, 60 * length / words["F"], last, place))
            case "G28":
                self._legs.append((time.monotonic(), self.homing, last, self._home))
                self._free = time.monotonic() + self.homing
                self._pending.insert(0, "M400")  # whose ok ends it
                return ["echo:busy: processing"]
            case "M115":
                return [
                    "FIRMWARE_NAME:Marlin 2.1.2 (Nov 24 2026) SOURCE_CODE_URL:none PROTOCOL_VERSION:1.0",
                    f"Cap:EMERGENCY_PARSER:{int(self.emergency)}",
                    "ok",
                ]
            case "M114":
                here = self.now()
                told = " ".join(f"{letter}:{value:.2f}" for letter, value in here.items())
                return [f"{told} E:0.00 Count X:0 Y:0 Z:0", "ok"]
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
