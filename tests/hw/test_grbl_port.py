from __future__ import annotations

import os
import random
import socket
import threading
import time

import pytest
from scripted_grbl import ScriptedGrbl, stage_settings

from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.grbl.link import open_port
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.stage import Position
from mirrorskin.io import InputError


class Carrier:
    """Carries bytes between two ends and a scripted controller."""

    def __init__(self, receive, send, controller):
        self.receive, self.send, self.controller = receive, send, controller
        self.ending = threading.Event()
        self.threads = [threading.Thread(target=work) for work in (self._in, self._out)]
        for thread in self.threads:
            thread.start()

    def _in(self):
        while not self.ending.is_set():
            if data := self.receive():
                self.controller.write(data)

    def _out(self):
        while not self.ending.is_set():
            if data := self.controller.read(4096):
                self.send(data)

    def end(self):
        self.ending.set()
        for thread in self.threads:
            thread.join(5)


@pytest.fixture
def carry():
    """Begin to carry bytes; whatever comes, it ends."""
    carriers = []

    def begin(*ends):
        carriers.append(Carrier(*ends))
        return carriers[-1]

    yield begin
    for carrier in carriers:
        carrier.end()


@pytest.fixture
def terminal():
    """Both ends of a pseudo-terminal: ours, and the path of the other."""
    ours, theirs = os.openpty()
    os.set_blocking(ours, False)
    yield ours, os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


def _received(fd):
    time.sleep(0.002)
    try:
        return os.read(fd, 4096)
    except BlockingIOError:
        return b""


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("/dev/no-such-port", "no such port"),
        ("nonsense://here", "correct the rig file"),
        ("socket://127.0.0.1:1", "correct the rig file"),
        ("/dev/null", "correct the rig file"),
    ],
)
def test_a_port_that_cannot_be_opened_is_refused_in_one_line(url, told):
    with pytest.raises(InputError, match=f"^stage {url}: .*{told}") as caught:
        GrblStage(stage_settings(port=url))
    assert "\n" not in str(caught.value)


def test_a_port_in_use_is_refused(terminal):
    port = open_port(terminal[1], 115200, "it")
    try:
        with pytest.raises(InputError, match=r"another program uses it"):
            open_port(terminal[1], 115200, "it")
    finally:
        port.close()


def test_a_port_where_nothing_answers_is_refused(terminal):
    begun = time.monotonic()
    with pytest.raises(InputError, match=r"nothing answers within 0.25 s"):
        GrblStage(stage_settings(port=terminal[1], timeout=0.25))
    assert time.monotonic() - begun < 60


@pytest.mark.parametrize("what", ["echo", "noise"])
def test_a_port_where_something_else_answers_is_refused(terminal, carry, what):
    noise = random.Random(2)
    answers = {"echo": lambda data: data + b"\n", "noise": lambda data: noise.randbytes(50) + b"\n"}
    ours = terminal[0]
    other = ScriptedGrbl()
    other.write = lambda data: os.write(ours, answers[what](data))
    other.read = lambda size: time.sleep(0.01) or b""
    carry(lambda: _received(ours), None, other)
    with pytest.raises(InputError, match=r"not GRBL 1.1"):
        GrblStage(stage_settings(port=terminal[1], timeout=4.0))


def test_a_stage_works_through_a_serial_port_until_it_is_unplugged(carry):
    ours, theirs = os.openpty()
    path = os.ttyname(theirs)
    os.set_blocking(ours, False)
    carrier = carry(lambda: _received(ours), lambda data: os.write(ours, data), ScriptedGrbl())
    with GrblStage(stage_settings(port=path)) as stage:
        os.close(theirs)
        stage.move(Position(1.0))
        assert stage.wait().position.travel == pytest.approx(1, abs=1e-3)
        stage.move(Position(-4), 0.5)
        carrier.end()
        os.close(ours)
        with pytest.raises(HardwareError, match="line is lost"):
            stage.wait()


def test_a_stage_works_through_a_socket_until_it_is_closed(carry):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = open_port(f"socket://127.0.0.1:{listener.getsockname()[1]}", 115200, "it")
        end = listener.accept()[0]
    with end:
        end.settimeout(0.02)
        carrier = carry(lambda: _heard(end), end.sendall, ScriptedGrbl())
        stage = GrblStage(stage_settings(), port)
        stage.move(Position(1.0))
        assert stage.wait().position.travel == pytest.approx(1, abs=1e-3)
        stage.move(Position(-4), 0.5)
        carrier.end()
    with pytest.raises(HardwareError, match="line is lost"):
        stage.wait()
    stage.close()


def _heard(end):
    try:
        return end.recv(4096)
    except TimeoutError:
        return b""
