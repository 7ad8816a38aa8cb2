from __future__ import annotations

import math
import time
from contextlib import nullcontext

import numpy as np
import pytest
from firmware import PROGRAM, Firmware
from msgspec import structs
from scripted_grbl import stage_settings
from served_rig import LATE, allow_delays

from mirrorskin.hw.emulator.port import GrblMachine, GrblPort
from mirrorskin.hw.emulator.rig import EmulatedRig
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.stage import Position

LEAN = math.radians(2.5)
SOON = 30.0  # seconds: a limit for a busy machine
QUICK = dict.fromkeys((110, 111, 112), 6000) | dict.fromkeys((120, 121, 122), 2000)


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    allow_delays(monkeypatch)


@pytest.fixture(params=["emulator", "firmware"] if PROGRAM else ["emulator"])
def stage(request, tmp_path):
    """A stage on a controller whose axes begin at 0."""
    emulated = request.param == "emulator"
    machine = GrblMachine(QUICK) if emulated else Firmware(PROGRAM, tmp_path, QUICK)
    with nullcontext() if emulated else machine, GrblPort(machine) as port:
        axes = {name: structs.replace(axis, zero=0.0) for name, axis in stage_settings().axes.items()}
        silence = getattr(request.function, "silence", LATE)
        with GrblStage(stage_settings(port=port.url, silence=silence, **axes)) as opened:
            yield opened, machine, port


def _until(condition):
    end = time.monotonic() + SOON
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


def test_the_stage_goes_round_on_its_circle_and_ends_where_it_should(stage):
    opened, machine, _ = stage
    opened.move(Position(1.0, LEAN))
    opened.wait()
    begun = time.monotonic()
    opened.precess(LEAN, -1.25, 2.0)
    report = opened.wait()
    assert report.position.travel == pytest.approx(1, abs=2e-3)
    assert report.position.phase == pytest.approx(-math.pi / 2, abs=2e-3)
    truth = machine.position()
    assert (truth["X"], truth["Y"], truth["Z"]) == pytest.approx((0, -2.5, -1), abs=2e-3)
    _until(lambda: len(opened.history(begun)) > 5)
    tilts = [at.position.tilt for at in opened.history(begun)]
    assert tilts == pytest.approx([LEAN] * len(tilts), abs=math.radians(5e-3))
    assert time.monotonic() - begun > 1.25 / 2


def test_places_are_gone_to_one_after_the_other_without_anyone_waiting(stage):
    opened, machine, _ = stage
    begun = time.monotonic()
    opened.follow([Position(1.0), Position(0.2), Position(0.6)], 4.0)
    assert opened.wait().position.travel == pytest.approx(0.6, abs=2e-3)
    travel = [-machine.position(float(at))["Z"] for at in np.linspace(begun, time.monotonic(), 400)]
    turns = np.flatnonzero(np.diff(np.sign(np.diff(travel)[np.abs(np.diff(travel)) > 1e-9])))
    assert len(turns) == 2
    assert max(travel) == pytest.approx(1.0, abs=0.05)
    assert min(travel[int(np.argmax(travel)) :]) == pytest.approx(0.2, abs=0.05)


def test_a_stage_that_was_homed_knows_its_place_at_once_and_goes_on():
    with EmulatedRig(shape=(4, 6), rate=5, home=True) as rig, GrblStage(rig.settings.stage) as opened:
        opened.home()  # in which nothing is answered
        opened.move(Position())
        assert opened.wait().position.travel == pytest.approx(0, abs=0.01)
        assert rig.where(time.monotonic()).travel == pytest.approx(0, abs=0.01)


def test_reports_tell_where_the_machine_was(stage):
    opened, machine, _ = stage
    begun, reports, speed = time.monotonic(), [], 4.0
    while len(reports) <= 5:  # a busy machine may give few in each move
        assert time.monotonic() < begun + SOON
        opened.move(Position(2.0 if opened.report().position.travel < 1 else 0.0), speed)
        opened.wait()
        reports = [at for at in opened.history(begun) if 0.1 < at.position.travel < 1.9]
    off = sorted(abs(-machine.position(at.time)["Z"] - at.position.travel) for at in reports)
    assert off[len(off) // 2] < speed * max(0.01, opened.longest_trip)


@pytest.mark.parametrize("fault", ["silence", "garble"])
def test_whatever_fails_the_machine_is_stopped(stage, fault):
    opened, machine, port = stage
    opened.move(Position(-4.5), 0.25)
    _until(lambda: machine.position()["Z"] > 0)
    {"silence": port.silence, "garble": lambda: port.garble(100_000)}[fault]()
    with pytest.raises(HardwareError):
        opened.wait()
    _until(lambda: not machine.moving())
    assert machine.position()["Z"] < 4


test_whatever_fails_the_machine_is_stopped.silence = 0.3


def test_a_stop_keeps_the_place(stage):
    opened, machine, _ = stage
    opened.move(Position(-4.5), 0.25)
    _until(lambda: machine.position()["Z"] > 0.1)
    opened.stop()
    opened.close()
    assert machine.state == "Idle"
    assert 0.1 < machine.position()["Z"] < 4
