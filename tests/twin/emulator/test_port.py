"""The emulated controller behind a pseudo-terminal; its faults equal those of the line in memory."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

import pytest
import serial

from mirrorskin.twin.emulator.port import GrblMachine, GrblPort

SOON = 60.0  # seconds: a limit for a busy machine


@pytest.fixture
def port() -> Iterator[GrblPort]:
    with GrblPort(GrblMachine()) as port:
        yield port


@pytest.fixture
def line(port: GrblPort) -> Iterator[serial.Serial]:
    with serial.Serial(port.url, timeout=SOON) as line:
        line.write(b"$X\n")  # the greeting may have come before the port was open
        line.read_until(b"ok\r\n")
        yield line


def ask(line: serial.Serial) -> dict[str, str]:
    line.write(b"?")
    state, *fields = line.read_until(b">\r\n").decode().strip("<>\r\n").split("|")
    return {"": state} | dict(field.split(":", 1) for field in fields)


def test_it_answers_moves_and_reports_right_in_time(port: GrblPort, line: serial.Serial) -> None:
    begun = time.monotonic()
    line.write(b"G1X2F600\n")
    assert line.read_until() == b"ok\r\n"
    while port.machine.moving() and time.monotonic() < begun + SOON:
        before, between, after = (
            port.machine.position()["X"],
            float(ask(line)["MPos"].split(",")[0]),
            port.machine.position()["X"],
        )
        assert before - 1e-3 <= between <= after + 1e-3
    assert 0.15 < time.monotonic() - begun < SOON  # 0.22 s, and as late as we looked


def test_a_host_that_comes_again_finds_it_as_it_was(port: GrblPort) -> None:
    for place in (b"1.000,0.000,0.000", b"2.000,0.000,0.000"):
        with serial.Serial(port.url, timeout=SOON) as line:
            line.write(b"G91G0X1\n")
            line.read_until(b"ok\r\n")
            until, report = time.monotonic() + SOON, b""
            while b"<Idle" not in report:
                assert time.monotonic() < until
                line.write(b"?")
                report = line.read_until(b">\r\n")
            assert place in report


@pytest.mark.parametrize("fault", ["silence", "garble", "alarm"])
def test_a_fault_reaches_the_host_and_the_controller_still_hears(port, line, fault) -> None:
    {"silence": port.silence, "garble": lambda: port.garble(5000), "alarm": lambda: port.alarm(9)}[fault]()
    line.write(b"$I\n" if fault == "garble" else b"$X\nG0X1\n")
    if fault == "silence":
        line.timeout = 0.1
        assert line.read(1) == b""
    else:
        message = {"garble": b"[VER:1.1h", "alarm": b"ALARM:9"}[fault]
        assert message in line.read_until(message)
    until = time.monotonic() + SOON
    while port.machine.position()["X"] != (fault != "garble"):
        assert time.monotonic() < until
        time.sleep(0.005)


def test_a_reader_that_waits_learns_that_the_port_is_gone(port: GrblPort, line: serial.Serial) -> None:
    line.write(b"G1X50F600\n")
    line.read_until()
    threading.Timer(0.05, port.unplug).start()
    with pytest.raises((serial.SerialException, OSError)):
        line.read(1)
    assert not port.machine.moving()
    with contextlib.suppress(OSError):
        line.close()


def test_it_can_be_closed_twice_in_the_middle_of_a_move() -> None:
    port = GrblPort(GrblMachine())
    port.machine.receive(b"G1X10F600\n")
    port.close()
    port.close()
