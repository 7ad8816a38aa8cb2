"""Whatever goes wrong, the stage stops; on made-up hardware that can go wrong at will."""

import threading
import time

import numpy as np
import pytest
from rig_fakes import FakeCamera, FakeStage, settings
from served_rig import allow_delays

from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.rig import rig as rigs
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.stage import Position

DEADLINE = 30.0  # seconds: a limit for a busy machine, not for the guard


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    allow_delays(monkeypatch)


@pytest.fixture
def rig():
    stage = FakeStage()
    camera = FakeCamera(stage.position, lambda place: np.zeros((2, 2), np.uint8), rate=100.0)
    with Rig(stage, camera, settings((2, 2))) as opened:
        yield opened


def stopped(stage):
    """Wait until the stage was stopped."""
    until = time.monotonic() + DEADLINE
    while not stage.stops and time.monotonic() < until:
        time.sleep(0.005)
    return bool(stage.stops)


def begin(rig, timed=False):
    return rig.begin(lambda: rig.stage.move(Position(2.0), 0.5), timed)


@pytest.mark.parametrize(("timed", "stall"), [(True, 0.1), (False, 0.3)])
def test_a_camera_that_stalls_stops_the_stage_while_everyone_is_busy(rig, timed, stall):
    begin(rig, timed)
    began = time.monotonic()
    rig.camera.stall()
    assert stopped(rig.stage)  # nobody asked the rig for anything
    assert rig.stage.stops[0] - began > stall / 2
    with pytest.raises(HardwareError, match=rf"fake camera gave no frame for {stall}"):
        rig.take(1)


def test_a_camera_that_is_lost_stops_the_stage_and_is_named(rig):
    begin(rig)
    rig.camera.lose()
    assert stopped(rig.stage)
    with pytest.raises(HardwareError, match="fake camera was lost"):
        rig.check()


def test_a_camera_that_came_back_in_a_timed_move_stops_it(rig):
    rig.begin(lambda: rig.stage.move(Position(2.0), 0.5), timed=True)
    rig.camera.reconnects += 1
    assert stopped(rig.stage)
    with pytest.raises(HardwareError, match=r"was lost while the stage moved.* begin anew"):
        rig.check()


def test_a_stage_that_fails_is_stopped_and_named(rig):
    begin(rig)
    rig.stage.error = HardwareError("fake stage: ALARM:1")
    assert stopped(rig.stage)
    with pytest.raises(HardwareError, match="ALARM:1"):
        rig.take(1)


def test_waiting_for_a_move_ends_with_the_fault(rig):
    move = begin(rig)
    rig.camera.stall()
    with pytest.raises(HardwareError, match="no frame"):
        rig.end(move)
    assert rig.stage.stops


def test_a_camera_that_stalls_at_rest_stops_nothing(rig):
    rig.go(Position(-0.9))
    rig.camera.stall()
    looked = time.monotonic() + 0.3
    until = looked + DEADLINE
    while rig._looked < looked:
        assert time.monotonic() < until, "the guard has ended"
        time.sleep(0.005)
    assert rig.stage.stops == []
    rig.check()


def test_no_move_begins_after_a_fault(rig):
    begin(rig)
    rig.camera.lose()
    assert stopped(rig.stage)
    count = len(rig.stage.moves)
    with pytest.raises(HardwareError, match="was lost"):
        rig.go(Position(0.0))
    assert len(rig.stage.moves) == count


class Order(list):
    """Writes down what is called, in order."""

    def watch(self, owner, name):
        call = getattr(owner, name)

        def told(*args):
            self.append(name if owner is not self.camera else f"camera {name}")
            return call(*args)

        setattr(owner, name, told)


def end_by(kind, rig):
    with rig:
        begin(rig)
        raise kind


@pytest.mark.parametrize("kind", [KeyboardInterrupt, SystemExit, ValueError, HardwareError, GeneratorExit])
def test_the_stage_stops_first_whatever_ends_it(kind):
    stage = FakeStage()
    camera = FakeCamera(stage.position, lambda place: np.zeros((2, 2), np.uint8))
    order = Order()
    order.camera = camera
    for owner, name in ((stage, "stop"), (stage, "close"), (camera, "close")):
        order.watch(owner, name)
    threads = threading.active_count()
    with pytest.raises(kind):
        end_by(kind, Rig(stage, camera, settings((2, 2))))
    assert order[0] == "stop"
    assert order[-2:] == ["close", "camera close"]
    assert threading.active_count() == threads


def test_a_rig_that_is_left_while_it_moves_is_stopped():
    stage = FakeStage()
    camera = FakeCamera(stage.position, lambda place: np.zeros((2, 2), np.uint8))
    with Rig(stage, camera, settings((2, 2))) as rig:
        begin(rig)
    assert stage.stops
    assert stage.closed
    assert camera.closed


def test_a_rig_that_rests_is_left_without_a_stop():
    stage = FakeStage()
    camera = FakeCamera(stage.position, lambda place: np.zeros((2, 2), np.uint8))
    with Rig(stage, camera, settings((2, 2))) as rig:
        assert rig.go(Position(-0.9)).position == Position(-0.9)
    assert stage.stops == []
    assert stage.closed


def test_all_is_closed_even_if_closing_fails():
    stage = FakeStage()
    camera = FakeCamera(stage.position, lambda place: np.zeros((2, 2), np.uint8))
    threads = threading.active_count()

    def fail():
        raise OSError("gone")

    stage.close = fail
    with pytest.raises(OSError, match="gone"), Rig(stage, camera, settings((2, 2))):
        pass
    assert camera.closed
    assert threading.active_count() == threads


def test_a_defect_while_the_stage_waits_is_not_hidden(rig):
    rig.stage.wait = lambda: 1 / 0
    with pytest.raises(ZeroDivisionError):
        rig.go(Position(0.0))


def test_a_program_that_stood_still_in_a_timed_move_ends_it(rig, monkeypatch):
    monkeypatch.setattr(rigs, "_PAUSE", 0.5)
    waited = rig._closing.wait

    def paused(seconds):
        monkeypatch.setattr(rig._closing, "wait", waited)
        return waited(0.6)

    move = rig.begin(lambda: rig.stage.move(Position(2.0), 5.0), timed=True)
    monkeypatch.setattr(rig._closing, "wait", paused)
    with pytest.raises(HardwareError, match=r"stood still for \d+\.\d+ s while the stage moved"):
        rig.end(move)
    assert rig.stage.stops


def test_a_program_that_stood_still_in_steps_goes_on(rig, monkeypatch):
    monkeypatch.setattr(rigs, "_PAUSE", 0.5)
    waited = rig._closing.wait
    move = rig.begin(lambda: rig.stage.move(Position(2.0), 5.0))
    monkeypatch.setattr(rig._closing, "wait", lambda seconds: waited(0.6))
    rig.end(move)
    assert rig.stage.stops == []
