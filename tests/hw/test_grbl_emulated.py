from __future__ import annotations

import math
import time
from contextlib import nullcontext

import numpy as np
import pytest
from firmware import PROGRAM, Firmware
from msgspec import structs
from scripted_grbl import stage_settings
from served_rig import allow_delays

from mirrorskin.hw.emulator.port import GrblMachine, GrblPort
from mirrorskin.hw.emulator.rig import EmulatedRig
from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.grbl.stage import GrblStage
from mirrorskin.hw.stage import Position

LEAN = math.radians(2.5)
QUICK = dict.fromkeys((110, 111, 112), 6000) | dict.fromkeys((120, 121, 122), 2000)


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    allow_delays(monkeypatch, 1.0)


@pytest.fixture(params=["emulator", "firmware"] if PROGRAM else ["emulator"])
def stage(request, tmp_path):
    """A stage on a controller whose axes begin at 0."""
    emulated = request.param == "emulator"
    machine = GrblMachine(QUICK) if emulated else Firmware(PROGRAM, tmp_path, QUICK)
    with nullcontext() if emulated else machine, GrblPort(machine) as port:
        axes = {name: structs.replace(axis, zero=0.0) for name, axis in stage_settings().axes.items()}
        borne = {"silence": 0.3, "timeout": 2.0 if emulated else 10.0}  # beside other tests
        with GrblStage(stage_settings(port=port.url, **borne, **axes)) as opened:
            yield opened, machine, port


def _until(moving, machine, seconds=3.0):
    end = time.monotonic() + seconds
    while machine.moving() != moving:
        assert time.monotonic() < end, "the stage moves on" if machine.moving() else "it does not move"
        time.sleep(0.002)


def test_the_stage_goes_round_on_its_circle_and_ends_where_it_should(stage):
    opened, machine, _ = stage
    opened.move(Position(1.0, LEAN))
    opened.wait()
    opened.precess(LEAN, -1.25, 2.0)
    begun = time.monotonic()
    report = opened.wait()
    assert report.position.travel == pytest.approx(1, abs=2e-3)
    assert report.position.phase == pytest.approx(-math.pi / 2, abs=2e-3)
    truth = machine.position()
    assert (truth["X"], truth["Y"], truth["Z"]) == pytest.approx((0, -2.5, -1), abs=2e-3)
    tilts = [at.position.tilt for at in opened.history(begun)]
    assert len(tilts) > 5
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
    begun = time.monotonic()
    opened.move(Position(2.0), 4.0)
    opened.wait()
    off = sorted(abs(-machine.position(at.time)["Z"] - at.position.travel) for at in opened.history(begun))
    assert len(off) > 5
    assert off[len(off) // 2] < 4.0 * 0.01


@pytest.mark.parametrize("fault", ["silence", "garble"])
def test_whatever_fails_the_machine_is_stopped(stage, fault):
    opened, machine, port = stage
    opened.move(Position(-4.5), 0.5)
    _until(True, machine)
    {"silence": port.silence, "garble": lambda: port.garble(100_000)}[fault]()
    with pytest.raises(HardwareError):
        opened.wait()
    _until(False, machine)
    assert machine.position()["Z"] < 4


def test_a_stop_keeps_the_place(stage):
    opened, machine, _ = stage
    opened.move(Position(-4.5), 5.0)
    time.sleep(0.1)
    opened.stop()
    opened.close()
    assert machine.state == "Idle"
    assert 0.1 < machine.position()["Z"] < 4
