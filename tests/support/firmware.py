"""A real firmware, GRBL 1.1 or grblHAL, compiled as a program, in place of an emulated machine.

It speaks on its standard streams, keeps its settings in the folder that it runs in, and writes its steps to a
file; docs/rig.md says how it is built. It does not write its last steps before a halt: at rest its own report
tells where it is.
"""

from __future__ import annotations

import bisect
import os
import re
import select
import signal
import subprocess
import threading
import time
import tty
from collections.abc import Mapping
from pathlib import Path

from mirrorskin.hw.base.clock import SYSTEM
from mirrorskin.io.base.types import Closing

PROGRAM = os.environ.get("GRBL")
"""The program; `make test-hardware GRBL=PATH` gives it."""

_INVERTED = {5: 1, 6: 1}  # GRBL's switches are all low, which means pressed unless they are inverted
_STEPS = 250.0  # a mm, as GRBL has them unless told otherwise
_PER_AXIS = range(100, 136)
_TICK = 0.002  # seconds between looks at what it said, and between its lines of steps
_START = 60.0
_STILL = 0.05  # seconds without a step, after which it rests
_REPORT = re.compile(rb"<([^|>]*)\|MPos:([-\d.,]+)[^>]*>")


def is_hal(program: str | None) -> bool:
    """Return whether a program is grblHAL."""
    return program is not None and b"GrblHAL" in Path(program).read_bytes()


class Firmware(Closing):
    """A controller that is a process, with the face of `GrblMachine`."""

    clock = SYSTEM

    def __init__(self, program: str, folder: Path, settings: Mapping[int, float]) -> None:
        self._ended, self._lock = threading.Event(), threading.Lock()
        # Files that are terminals are written line by line.
        (self._line, theirs), (self._steps, log) = os.openpty(), os.openpty()
        for end in theirs, log:
            tty.setraw(end)
        self._said = self._heard = b""
        self.process = subprocess.Popen(
            ["stdbuf", "-i0", program, "-n", "-r", str(_TICK), "-s", os.ttyname(log), "-b", os.devnull],
            cwd=folder,
            stdin=theirs,
            stdout=theirs,
        )
        os.close(theirs)
        self._log = log
        hal = is_hal(program)
        self.axes = "XYZABC" if hal else "XYZ"
        self._places: list[tuple[float, tuple[float, ...]]] = [(time.monotonic(), (0.0,) * len(self.axes))]
        self._follower = threading.Thread(target=self._follow, name="steps", daemon=True)
        self._follower.start()
        self._expect(b"help]\r\n")
        values = {} if hal else _INVERTED
        values |= {n: value for n, value in settings.items() if n not in _PER_AXIS or n % 10 < len(self.axes)}
        for number, value in sorted(values.items(), reverse=True):  # $22 before $20
            self.receive(f"${number}={value:g}\n".encode())
            self._expect(b"ok\r\n")

    def close(self) -> None:
        """End the program."""
        self._ended.set()
        self.process.kill()
        self.process.wait()
        self._follower.join()
        for end in self._line, self._steps, self._log:
            os.close(end)

    def receive(self, data: bytes) -> None:
        """Take bytes from the host, now."""
        os.write(self._line, data)

    def take(self) -> bytes:
        """Return what has been replied since the last call."""
        with self._lock:
            self._hear()
            output, self._said = self._said, b""
            return output

    def next_event(self) -> float:
        """Return when to look next."""
        return time.monotonic() + _TICK

    def position(self, at: float | None = None) -> dict[str, float]:
        """Return where the steps had brought it by a time, mm or degrees; now, by its own report."""
        if at is None:
            place = self.report()[2].split(b",")
            return {letter: float(value) for letter, value in zip(self.axes, place, strict=True)}
        places = self._places
        last = max(1, bisect.bisect_right(places, at, key=lambda entry: entry[0]))
        return dict(zip(self.axes, places[last - 1][1], strict=True))

    def moving(self, at: float | None = None) -> bool:
        """Return whether it stepped shortly before a time."""
        at = time.monotonic() if at is None else at
        return self.position(at) != self.position(at - _STILL)

    @property
    def state(self) -> str:
        """The state that it reports when asked now."""
        return self.report()[1].decode()

    def report(self) -> re.Match[bytes]:
        """Return its answer when asked now: the state and the place."""
        with self._lock:
            self._heard = b""
        self.receive(b"?")
        end = time.monotonic() + _START
        while not (report := _REPORT.search(self._heard)):
            assert time.monotonic() < end, "the firmware does not answer"
            time.sleep(_TICK)
            with self._lock:
                self._hear()
        return report

    def cut_power(self) -> None:
        """Kill it."""
        self.process.kill()

    def pause(self, seconds: float) -> None:
        """Let it do nothing for some time, and then go on."""
        self.process.send_signal(signal.SIGSTOP)
        threading.Timer(seconds, self.process.send_signal, [signal.SIGCONT]).start()

    def _hear(self) -> None:
        while select.select([self._line], [], [], 0)[0]:
            try:
                heard = os.read(self._line, 4096)
            except OSError:  # it has ended
                return
            self._said += heard
            self._heard += heard

    def _expect(self, words: bytes) -> None:
        end, output = time.monotonic() + _START, b""
        while words not in output:
            assert time.monotonic() < end, output
            time.sleep(_TICK)
            output += self.take()

    def _follow(self) -> None:
        """Read the steps as they are written."""
        rest = b""
        while not self._ended.is_set():
            if not select.select([self._steps], [], [], _TICK)[0]:
                continue
            *whole, rest = (rest + os.read(self._steps, 4096)).split(b"\n")
            now = time.monotonic()
            for line in whole:
                if line and not line.startswith(b"#"):
                    parts = line.split()[1 : 1 + len(self.axes)]
                    self._places.append((now, tuple(float(part.rstrip(b",\r")) / _STEPS for part in parts)))
