"""The emulated controller behind a terminal: right in time, and broken on demand."""

from __future__ import annotations

import random
import re
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import serial

from mirrorskin.hw.emulator.port import GrblMachine, GrblPort

LONG = 10.0  # seconds that a slow computer may take


@pytest.fixture
def port() -> Iterator[GrblPort]:
    with GrblPort(GrblMachine()) as opened:
        yield opened
    assert "emulated controller" not in {thread.name for thread in threading.enumerate()}


@pytest.fixture
def line(port: GrblPort) -> Iterator[serial.Serial]:
    opened = serial.serial_for_url(port.url, 115200, timeout=LONG)
    opened.write(b"\x18$I\n")
    until(opened, "[OPT:")
    assert hear(opened) == "ok"
    yield opened
    opened.close()


def hear(line: serial.Serial) -> str:
    heard = line.read_until(b"\n")
    assert heard.endswith(b"\n")
    return str(heard.decode("latin-1").strip())


def until(line: serial.Serial, begin: str) -> str:
    deadline = time.monotonic() + LONG
    while time.monotonic() < deadline:
        if (heard := hear(line)).startswith(begin):
            return heard
    pytest.fail(f"{begin} was not heard")


def soon(holds: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + LONG
    while time.monotonic() < deadline:
        if holds():
            return True
        time.sleep(0.002)
    return False


def test_it_answers_at_once(line: serial.Serial) -> None:
    times = []
    for _ in range(20):
        began = time.perf_counter()
        line.write(b"?")
        assert re.fullmatch(r"<Idle\|MPos:0\.000,0\.000,0\.000\|FS:0,0(\|.*)?>", hear(line))
        times.append(time.perf_counter() - began)
    assert min(times) < 0.1


def test_it_greets_once_the_port_is_there(port: GrblPort) -> None:
    with serial.Serial(port.url, timeout=LONG) as opened:
        opened.write(b"$I\n")
        assert until(opened, "[VER:1.1h")


def test_it_moves_right_in_time(port: GrblPort, line: serial.Serial) -> None:
    line.write(b"G1X4F1200\n")
    assert hear(line) == "ok"
    assert soon(lambda: not port.machine.moving())
    assert port.machine.position() == {"X": 4.0, "Y": 0.0, "Z": 0.0}
    now = time.monotonic()
    moving = [at for at in (now - 0.002 * n for n in range(5000)) if port.machine.moving(at)]
    assert max(moving) - min(moving) == pytest.approx(4 / 20 + 20 / 500, abs=0.005)


def test_what_it_reports_is_where_it_was(port: GrblPort, line: serial.Serial) -> None:
    line.write(b"G1X4F1200\n")
    hear(line)
    for _ in range(5):
        before = time.monotonic()
        line.write(b"?")
        report = hear(line)
        after = time.monotonic()
        x = float(report.split("MPos:")[1].split(",")[0])
        low, high = (port.machine.position(at)["X"] for at in (before, after))
        assert low - 0.001 <= x <= high + 0.001


def test_a_hold_stops_it_on_its_way(port: GrblPort, line: serial.Serial) -> None:
    line.write(b"G1X400F1200\n")
    hear(line)
    began = time.monotonic()
    line.write(b"!")
    assert soon(lambda: port.machine.state == "Hold:0")
    speeds = [port.machine.speed(began + 0.002 * n) for n in range(5000)]
    assert 0 < max(speeds) < 20.001
    assert speeds[-1] == 0
    assert port.machine.position()["X"] < 399


def test_a_host_that_comes_again_finds_it_as_it_was(port: GrblPort, line: serial.Serial) -> None:
    line.write(b"G0X1\n")
    hear(line)
    line.close()
    assert soon(lambda: not port.machine.moving())
    with serial.Serial(port.url, timeout=LONG) as again:
        again.write(b"?")
        assert "MPos:1.000" in until(again, "<")


def test_a_silent_controller_still_hears(port: GrblPort, line: serial.Serial) -> None:
    line.write(b"G1X100F1200\n")
    hear(line)
    port.silence()
    line.timeout = 0.1
    line.write(b"?")
    assert line.read(1) == b""
    assert port.machine.moving()
    line.write(b"!")
    assert soon(lambda: not port.machine.moving())
    assert port.machine.state == "Hold:0"
    port.mend()
    line.timeout = LONG
    line.write(b"?")
    assert hear(line).startswith("<Hold:0")


def test_noise_comes_with_the_replies_among_it(port: GrblPort, line: serial.Serial) -> None:
    count = 100_000
    port.garble(count, seed=7)
    line.write(b"$I\n")
    heard = bytearray()
    deadline = time.monotonic() + LONG
    while len(heard) < count + 40 and time.monotonic() < deadline:
        heard += line.read(line.in_waiting or 1)
    reply = b"[VER:1.1h.20190825:]\r\n[OPT:VM,15,128]\r\nok\r\n"
    at = heard.find(reply)
    assert 0 <= at < count
    del heard[at : at + len(reply)]
    assert heard == random.Random(7).randbytes(count)


def test_noise_ends_when_it_is_mended(port: GrblPort, line: serial.Serial) -> None:
    port.garble(10_000_000)
    line.read(10)
    port.mend()
    line.write(b"$I\n")
    heard = b""
    deadline = time.monotonic() + LONG
    while not heard.endswith(b"\nok\r\n") and time.monotonic() < deadline:
        heard += line.read(line.in_waiting or 1)
    assert b"[VER:1.1h" in heard
    assert len(heard) < 1_000_000


def test_of_half_a_line_the_rest_never_comes(port: GrblPort, line: serial.Serial) -> None:
    port.half_line()
    line.write(b"$G\n")
    assert re.fullmatch(r"\[GC:[^]]*ok", hear(line))
    line.write(b"$G\n")
    assert re.fullmatch(r"\[GC:.*\]", hear(line))
    assert hear(line) == "ok"


def test_replies_can_be_late_and_keep_their_order(port: GrblPort, line: serial.Serial) -> None:
    port.delay(0.15)
    began = time.monotonic()
    line.write(b"$G\n")
    assert hear(line).startswith("[GC:")
    assert time.monotonic() - began >= 0.15
    assert hear(line) == "ok"
    port.mend()
    line.write(b"\n")
    assert hear(line) == "ok"


def test_an_alarm_from_another_thread_is_told_at_once(port: GrblPort, line: serial.Serial) -> None:
    line.write(b"G1X100F1200\n")
    hear(line)
    thread = threading.Thread(target=port.alarm, args=(1,))
    thread.start()
    assert hear(line) == "ALARM:1"
    thread.join()
    assert not port.machine.moving()


def gone(line: serial.Serial) -> bool:
    try:
        line.write(b"?")
        line.read(1)
    except (serial.SerialException, OSError):
        return True
    return False


@pytest.mark.parametrize("powered", [False, True])
def test_an_unplugged_port_is_gone(powered: bool) -> None:
    machine = GrblMachine()
    with GrblPort(machine) as port, serial.Serial(port.url, timeout=0.2) as line:
        line.write(b"G1X100F1200\n")
        assert soon(machine.moving)
        port.unplug(powered)
        assert soon(lambda: gone(line))
        assert machine.moving() == powered
        with pytest.raises(serial.SerialException):
            serial.Serial(port.url)
        port.silence()
        port.mend()


def test_a_reader_that_waits_learns_that_the_port_is_gone(port: GrblPort, line: serial.Serial) -> None:
    timer = threading.Timer(0.1, port.unplug)
    timer.start()
    with pytest.raises(serial.SerialException):
        line.read(1)
    timer.join()


def test_where_it_was_can_be_asked_from_many_threads(port: GrblPort, line: serial.Serial) -> None:
    line.write(b"G1X40F1800\n")
    hear(line)
    wrong: list[float] = []

    def watch() -> None:
        last, begin = 0.0, time.monotonic()
        while time.monotonic() - begin < 0.2:
            x = port.machine.position()["X"]
            if x < last - 1e-9:
                wrong.append(x)
            last = x

    threads = [threading.Thread(target=watch) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_it_can_be_closed_twice_in_the_middle_of_a_move() -> None:
    port = GrblPort(GrblMachine())
    with serial.Serial(port.url) as line:
        line.write(b"G1X40F1800\n")
        assert soon(port.machine.moving)
    port.close()
    port.close()
    port.alarm(1)
    assert not port.machine.moving()
