"""Transcripts of real firmwares, with which emulated controller and driver are compared.

``python tests/support/transcript.py PROGRAM > tests/hw/stages/grbl-1.1h.txt`` makes it anew; docs/rig.md
tells how the program is built.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from firmware import Firmware

from mirrorskin.hw.base.clock import SYSTEM, Clock
from mirrorskin.twin.emulator.port import GrblMachine

SETTINGS = {20: 0, 22: 0} | {
    base + axis: value for base, value in ((100, 250.0), (110, 1200.0), (120, 200.0)) for axis in range(3)
}
REST = "(rest)"
"""In place of a line: ask until it rests."""

RESET, HOLD, RESUME, WAIT = "(reset)", "(hold)", "(resume)", "(wait)"
_BYTES = {RESET: b"\x18", HOLD: b"!", RESUME: b"~"}
REQUESTS = (
    *("?", "$I", "$$", "G21G90G94", "g53 g1 x2 y1 z-1 f300", REST, "G91", "G1X-0.5F600", REST, "G90"),
    *("G1X0Y0Z0F240", WAIT, HOLD, REST, RESUME, REST, "G17", "G2X2Y0I1J0F300", REST, "G3X0Y0I-1F300", REST),
    *("$FOO", "G5", "G1XF1", "1G", "$H", "G1X1X2", "G0G1X1", "G2X1Y1", "G2X1Y0I0.1", "G2I1", "Q1"),
    *("G1X3F60", "$$", "G1X4", RESET, "?", "G1X1F100", "$X", "?", "G1X1", RESET, "?"),
)
_QUIET = 0.3  # seconds without a word, after what no line answers
_LONGEST = 20.0
_POLL = 0.05


class Exchange(NamedTuple):
    """What was sent, what was said until it was done with, and how many seconds that took."""

    sent: str
    said: list[str]
    seconds: float


def play(machine: Firmware | GrblMachine, clock: Clock = SYSTEM) -> Iterator[Exchange]:
    """Send the requests, each when the one before is done with."""
    listen(machine, clock, lambda lines, quiet: quiet > _QUIET)
    for request in REQUESTS:
        began = clock.now()
        if request == REST:
            output: list[str] = []
            while not output or not re.match("<(Idle|Hold:0)", output[-1]):
                clock.sleep(_POLL)
                machine.receive(b"?")
                output = listen(machine, clock, lambda lines, _: bool(lines))
            yield Exchange(request, output[-1:], clock.now() - began)
            continue
        if request == WAIT:
            clock.sleep(_QUIET)
            yield Exchange(request, [], _QUIET)
            continue
        machine.receive(_BYTES.get(request) or (b"?" if request == "?" else f"{request}\n".encode()))
        if request in _BYTES:
            last = "Grbl" if request == RESET else ""
            output = listen(
                machine,
                clock,
                lambda lines, quiet, last=last: quiet > _QUIET and last in " ".join(lines),
            )
        elif request == "?":
            output = listen(machine, clock, lambda lines, _: bool(lines))
        else:
            output = listen(machine, clock, lambda lines, _: re.match("ok|error", (lines or [""])[-1]))
        yield Exchange(request, output, clock.now() - began)


def listen(
    machine: Firmware | GrblMachine,
    clock: Clock,
    done: Callable[[list[str], float], object],
) -> list[str]:
    """Return the lines that it says until that is all."""
    heard, since, end = "", clock.now(), clock.now() + _LONGEST
    while not done([line for line in heard.split("\r\n")[:-1] if line], clock.now() - since):
        assert clock.now() < end, heard
        clock.sleep(0.002)
        if more := machine.take().decode():
            heard, since = heard + more, clock.now()
    return [line for line in heard.split("\r\n")[:-1] if line]


def write(exchanges: Iterable[Exchange]) -> Iterator[str]:
    """Yield the lines of a transcript."""
    for sent, output, seconds in exchanges:
        yield f"> {sent}"
        yield from (f"< {line}" for line in output)
        yield f"= {seconds:.2f}"


def read(path: Path) -> list[Exchange]:
    """Read a transcript."""
    exchanges: list[Exchange] = []
    for line in path.read_text().splitlines():
        kind, text = line[:1], line[2:]
        if kind == ">":
            exchanges.append(Exchange(text, [], 0.0))
        elif kind == "<":
            exchanges[-1].said.append(text)
        elif kind == "=":
            exchanges[-1] = exchanges[-1]._replace(seconds=float(text))
    return exchanges


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder, Firmware(sys.argv[1], Path(folder), SETTINGS) as firmware:
        print("# What the firmware answers: > sent, < said, = seconds until it was done with.")
        for line in write(play(firmware)):
            print(line, flush=True)
