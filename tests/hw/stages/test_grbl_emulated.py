"""The driver with the emulated controller on simulated time, and with a real firmware."""

from __future__ import annotations

import math
from contextlib import ExitStack

import numpy as np
import pytest
from firmware import PROGRAM, Firmware
from line_faults import CHANGES, outcomes
from msgspec import structs
from scripted_grbl import stage_settings

from mirrorskin.hw.base.clock import SYSTEM
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.stages.grbl import GrblStage
from mirrorskin.io import InputError
from mirrorskin.twin.emulator.port import GrblLine, GrblMachine, GrblPort
from mirrorskin.twin.emulator.rig import EmulatedRig
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

LEAN = math.radians(2.5)
SOON = 30.0  # seconds
QUICK = dict.fromkeys((110, 111, 112), 6000) | dict.fromkeys((120, 121, 122), 2000)
AXES = {name: structs.replace(axis, zero=0.0) for name, axis in stage_settings().axes.items()}


class Bench:
    """A stage on a controller whose axes begin at 0."""

    def __init__(self, machine, line, clock, **changes):
        self.machine, self.line, self.clock = machine, line, clock
        self.stage = GrblStage(stage_settings(**AXES, **changes), line.open(), clock=clock)

    def until(self, condition):
        end = self.clock.now() + SOON
        while not condition():
            assert self.clock.now() < end
            self.clock.sleep(0.002)


@pytest.fixture(params=["emulator", "firmware"] if PROGRAM else ["emulator"])
def bench(request, tmp_path):
    with ExitStack() as stack:
        if request.param == "emulator":
            clock = SimulatedClock()
            machine = GrblMachine(QUICK, clock=clock)
            line = GrblLine(machine)
        else:
            clock, machine = SYSTEM, stack.enter_context(Firmware(PROGRAM, tmp_path, QUICK))
            line = stack.enter_context(GrblPort(machine))
        bench = Bench(machine, line, clock, silence=0.07 if clock is not SYSTEM else 0.3)
        stack.enter_context(bench.stage)
        yield bench


def test_the_stage_goes_round_on_its_circle_and_ends_where_it_should(bench):
    stage, machine = bench.stage, bench.machine
    stage.move(Position(1.0, LEAN))
    stage.wait()
    begun = bench.clock.now()
    stage.precess(LEAN, -1.25, 2.0)
    report = stage.wait()
    assert report.position.travel == pytest.approx(1, abs=2e-3)
    assert report.position.phase == pytest.approx(-math.pi / 2, abs=2e-3)
    truth = machine.position()
    assert (truth["X"], truth["Y"], truth["Z"]) == pytest.approx((0, -2.5, -1), abs=2e-3)
    bench.until(lambda: len(stage.history(begun)) > 5)
    tilts = [at.position.tilt for at in stage.history(begun)]
    assert tilts == pytest.approx([LEAN] * len(tilts), abs=math.radians(5e-3))
    assert bench.clock.now() - begun > 1.25 / 2


def test_places_are_gone_to_one_after_the_other_without_anyone_waiting(bench):
    begun = bench.clock.now()
    bench.stage.follow([Position(1.0), Position(0.2), Position(0.6)], 4.0)
    assert bench.stage.wait().position.travel == pytest.approx(0.6, abs=2e-3)
    travel = [-bench.machine.position(float(at))["Z"] for at in np.linspace(begun, bench.clock.now(), 400)]
    turns = np.flatnonzero(np.diff(np.sign(np.diff(travel)[np.abs(np.diff(travel)) > 1e-9])))
    assert len(turns) == 2
    assert max(travel) == pytest.approx(1.0, abs=0.05)
    assert min(travel[int(np.argmax(travel)) :]) == pytest.approx(0.2, abs=0.05)


def test_a_homed_stage_has_its_position_at_once_and_continues(clock):
    with (
        EmulatedRig(shape=(4, 6), rate=5, home=True, clock=clock) as rig,
        rig.open_stage(rig.settings.stage) as stage,
    ):
        stage.home()  # in which nothing is answered
        stage.move(Position())
        assert stage.wait().position.travel == pytest.approx(0, abs=0.01)
        assert rig.where(clock.now()).travel == pytest.approx(0, abs=0.01)


def test_reports_state_where_the_machine_was(bench):
    begun, speed = bench.clock.now(), 4.0
    bench.stage.move(Position(2.0), speed)
    bench.stage.wait()
    reports = [at for at in bench.stage.history(begun) if 0.1 < at.position.travel < 1.9]
    assert len(reports) > 5
    off = sorted(abs(-bench.machine.position(at.time)["Z"] - at.position.travel) for at in reports)
    assert off[len(off) // 2] < speed * (6e-4 if bench.clock is not SYSTEM else 0.01)


@pytest.mark.parametrize("fault", ["silence", "garble"])
def test_whatever_fails_the_machine_is_stopped(bench, fault):
    bench.stage.move(Position(-4.5), 0.25)
    bench.until(lambda: bench.machine.position()["Z"] > 0)
    {"silence": bench.line.silence, "garble": lambda: bench.line.garble(100_000)}[fault]()
    with pytest.raises(HardwareError):
        bench.stage.wait()
    bench.until(lambda: not bench.machine.moving())
    assert bench.machine.position()["Z"] < (0.1 if bench.clock is not SYSTEM else 4)


def test_a_stop_keeps_the_place(bench):
    bench.stage.move(Position(-4.5), 0.25)
    bench.until(lambda: bench.machine.position()["Z"] > 0.1)
    bench.stage.stop()
    bench.stage.close()
    assert bench.machine.state == "Idle"
    assert 0.1 < bench.machine.position()["Z"] < (0.15 if bench.clock is not SYSTEM else 4)


# Every reply and every byte can fail, once or again and again. Whatever comes of it is an error in one
# line, or the right place (within 0.01 mm, since GRBL has no checksums); nothing waits for ever, and no axis
# moves on.


def go(**faults):
    """Move there and back through a line with faults, and return what went wrong."""
    clock, error = SimulatedClock(), None
    machine = GrblMachine(QUICK, clock=clock)
    line = GrblLine(machine)
    for name, fault in faults.items():
        setattr(line, name, fault)
    try:
        with Bench(machine, line, clock, timeout=1.0).stage as stage:
            for travel in (0.4, 0.1):
                stage.move(Position(travel), 2.0)
                assert stage.wait().position.travel == pytest.approx(travel, abs=0.011)
                assert -machine.position()["Z"] == pytest.approx(travel, abs=0.011)
    except (HardwareError, InputError) as failed:
        error = failed
        assert "\n" not in str(error)
    assert clock.threads == []
    clock.sleep(1.0)
    assert not machine.moving()
    return error


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("method", ["said", "heard"])
def test_each_reply_and_byte_may_fail_once(method, change):
    assert None in outcomes(go, method, change, required=40), "some of it does not matter"


@pytest.mark.parametrize("every", [2, 3, 7, 20])
@pytest.mark.parametrize("name", ["said", "heard"])
def test_each_nth_reply_or_byte_may_be_lost(name, every):
    go(**{name: lambda number, what: b"" if number % every == 0 else what})
