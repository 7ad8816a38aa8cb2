"""A GRBL controller in memory: simple motion, a log of everything it received, and faults."""

from __future__ import annotations

import math
import re

from scripted_port import ScriptedPort

from mirrorskin.hw.base.rig_file import StageSettings, TiltAxis, TravelAxis

SLOTS = 4
SETTINGS = {13: 0, 20: 1, 21: 0, 22: 0, 25: 3000} | dict.fromkeys((110, 111, 112), 6000)
SETTINGS |= dict.fromkeys((130, 131, 132), 100)


def stage_settings(**changes):
    """Travel down on Z, pitch on X, roll on Y in degrees; nothing is at 0."""
    settings = {
        "port": "in memory",
        "baud": 115200,
        "home": False,
        "timeout": 2.0,
        "report_rate": 100.0,
        "travel": TravelAxis(letter="Z", direction=-1, zero=10.0, limits=(-5.0, 6.0), speed=20.0),
        "pitch": TiltAxis(letter="X", zero=30.0, limits=(-5.0, 5.0), speed=100.0),
        "roll": TiltAxis(letter="Y", zero=40.0, limits=(-5.0, 5.0), speed=100.0),
        "press": 3.0,
        "pivot": None,
    }
    return StageSettings(**(settings | changes))


class ScriptedGrbl(ScriptedPort):
    """An open serial port with the controller behind it."""

    def __init__(self, clock, place=(30.0, 40.0, 10.0), offset=(1.0, 2.0, 3.0), settings=(), **behaviour):
        super().__init__(clock)
        self.place, self.offset = list(place), list(offset)
        self.settings = SETTINGS | dict(settings)
        self.work = behaviour.get("work", False)  # reports work coordinates
        self.version = behaviour.get("version", "1.1h")
        self.size = behaviour.get("size", 128)
        self.answers = dict(behaviour.get("answers", {}))  # a line to what it is answered instead
        self.state = behaviour.get("state", "Idle")
        self.pins = behaviour.get("pins", "")  # switches that are pressed
        self.lines, self.fill = [], 0
        self.on_move = None
        self.plan = []  # moves: where to, and how many seconds are left
        self._rest, self._buffer, self._reports = "", [], 0
        self._last, self._feed = clock.now(), 1.0
        self.held_at = self.reset_at = None

    def take(self, data):
        for byte in data.decode("latin1"):
            {"?": self._tell, "!": self.hold, "\x18": self.reset}.get(byte, lambda b=byte: self._hear(b))()

    def moving(self):
        return self.state == "Run"

    def reset(self):
        self.reset_at = self.reset_at or self.clock.now()
        lost = self.state == "Run"
        self._rest, self._buffer, self.plan, self._reports = "", [], [], 0
        self.say("", f"Grbl {self.version} ['$' for help]", *["ALARM:3"] * lost)
        self.state = "Alarm" if lost else "Idle"

    def alarm(self, code):
        self.plan.clear()
        self.state = "Alarm"
        self.say(f"ALARM:{code}")

    def hold(self):
        self.held_at = self.held_at or self.clock.now()
        if self.state in ("Run", "Idle"):
            self.state = "Hold:0"

    def advance(self):
        now = self.clock.now()
        rest, self._last = now - self._last, now
        while self.plan and rest > 0 and self.state in ("Idle", "Run"):
            self.state = "Run"
            target, duration = self.plan[0]
            part = min(rest, duration)
            rest -= part
            for k in range(3):
                self.place[k] += (target[k] - self.place[k]) * (part / duration if duration else 1)
            self.plan[0] = target, duration - part
            if duration - part <= 1e-9:
                self.plan.pop(0)
        if not self.plan and self.state == "Run":
            self.state = "Idle"
        while self._buffer and len(self.plan) < SLOTS and not self.state.startswith("Hold"):
            line = self._buffer.pop(0)
            self.lines.append(line)
            self.run(line)
        return self.plan[0][1] if self.plan and self.moving() else math.inf

    def run(self, line):
        """Answer a line."""
        if line in self.answers:
            self.say(self.answers[line])
            return
        if line == "$$":
            self.say(*(f"${number}={value}" for number, value in self.settings.items()))
        elif line == "$I":
            self.say(f"[VER:{self.version}.20190825:]", f"[OPT:V,15,{self.size}]")
        elif line in ("$X", "$H"):
            self.state = "Idle"
        elif self.state == "Alarm":
            self.say("error:9")
            return
        elif re.match(r"(G53)?G[123](?!\d)", line):
            self._move(line)
        self.say("ok")

    def _tell(self):
        at = [p - o for p, o in zip(self.place, self.offset, strict=True)] if self.work else self.place
        text = f"<{self.state}|{'WPos' if self.work else 'MPos'}:{_numbers(at)}|FS:0,0"
        text += f"|Pn:{self.pins}" if self.pins else ""
        self._reports += 1
        if self._reports % 5 == 3:
            text += f"|WCO:{_numbers(self.offset)}"
        self.say(text + ">")

    def _hear(self, byte):
        if byte != "\n":
            self._rest += byte
        else:
            self._buffer.append(self._rest)
            self._rest = ""
        self.fill = max(self.fill, sum(len(line) + 1 for line in self._buffer) + len(self._rest))

    def _move(self, line):
        words = {word[0]: float(word[1:]) for word in re.findall(r"[A-Z]-?[\d.]+", line)}
        self._feed = words.get("F", self._feed)
        start = self.plan[-1][0] if self.plan else self.place
        offset = (0.0, 0.0, 0.0) if line.startswith("G53") else self.offset
        target = [words.get(x, start[k] - offset[k]) + offset[k] for k, x in enumerate("XYZ")]
        length = math.dist(start, target)
        if "I" in words:
            length = math.pi * math.hypot(words["I"], words["J"])
        self.plan.append((target, max(length / self._feed * 60, 1e-6)))
        self.state = "Run"
        if self.on_move:
            self.on_move()


def _numbers(values):
    return ",".join(f"{value:.3f}" for value in values)
