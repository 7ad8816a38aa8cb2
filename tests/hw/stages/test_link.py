"""Real ports: failures to open, devices that are no stages, and stages that are disconnected."""

from __future__ import annotations

import os
import random
import socket
import threading
from contextlib import suppress

import pytest
from scripted_grbl import stage_settings

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import TravelAxis
from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.stages.grbl import GrblStage
from mirrorskin.hw.stages.link import open_port
from mirrorskin.io import InputError
from mirrorskin.twin.emulator.port import GrblMachine, GrblPort

PATIENT = {"timeout": 60.0, "silence": 5.0}  # seconds, for a busy machine
AXES = {"travel": TravelAxis(letter="Z", limits=(-5.0, 6.0), speed=20.0), "pitch": None, "roll": None}


@pytest.fixture
def terminal():
    """Both ends of a pseudo-terminal: ours, and the path of the other."""
    ours, theirs = os.openpty()
    os.set_blocking(ours, False)
    yield ours, os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


@pytest.fixture
def answering(terminal):
    """Answer all that is written to a terminal, in a thread, until the test ends."""
    ended, threads = threading.Event(), []

    def answer(change):
        def work():
            while not ended.wait(0.01):
                try:
                    os.write(terminal[0], change(os.read(terminal[0], 4096)))
                except BlockingIOError:
                    continue

        threads.append(threading.Thread(target=work))
        threads[-1].start()

    yield answer
    ended.set()
    for thread in threads:
        thread.join()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("/dev/no-such-port", "no such port"),
        ("nonsense://here", "correct the rig file"),
        ("socket://127.0.0.1:1", "correct the rig file"),
        ("/dev/null", "correct the rig file"),
    ],
)
def test_a_port_that_cannot_be_opened_is_refused_in_one_line(url, message):
    with pytest.raises(InputError, match=f"^stage {url}: .*{message}") as caught:
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
    with pytest.raises(InputError, match=r"no answer within 0.25 s"):
        GrblStage(stage_settings(port=terminal[1], timeout=0.25))


@pytest.mark.parametrize("what", ["echo", "noise"])
def test_a_port_where_something_else_answers_is_refused(terminal, answering, what):
    noise = random.Random(2)
    answers = {"echo": lambda data: data + b"\n", "noise": lambda data: noise.randbytes(50) + b"\n"}
    answering(answers[what])
    with pytest.raises(InputError, match=r"not GRBL 1.1"):
        GrblStage(stage_settings(port=terminal[1], timeout=1.0))


def works_until(stage, leave):
    """Move, and begin another move, in which the other side leaves."""
    stage.move(Position(1.0))
    assert stage.wait().position.travel == pytest.approx(1, abs=1e-3)
    stage.move(Position(-4), 0.25)
    leave()
    with pytest.raises(HardwareError, match="connection is lost"):
        stage.wait()
    stage.close()


def test_a_stage_works_through_a_serial_port_until_it_is_unplugged():
    with GrblPort(GrblMachine()) as port:
        works_until(GrblStage(stage_settings(port=port.url, **PATIENT, **AXES)), port.unplug)


def test_a_stage_works_through_a_socket_until_it_is_closed():
    machine, ended = GrblMachine(), threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = open_port(f"socket://127.0.0.1:{listener.getsockname()[1]}", 115200, "it")
        end = listener.accept()[0]
    end.settimeout(0.005)

    def carry():
        while not ended.is_set():
            with suppress(TimeoutError):
                machine.receive(end.recv(4096))
            end.sendall(machine.take())
        end.close()

    carrier = threading.Thread(target=carry)
    carrier.start()

    def leave():
        ended.set()
        carrier.join()

    works_until(GrblStage(stage_settings(**PATIENT, **AXES), port), leave)
