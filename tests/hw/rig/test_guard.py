"""After any fault the stage stops; on fake hardware with faults of every kind."""

import numpy as np
import pytest
from rig_fakes import fake_rig

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.stage import Position

SOON = 1.0  # seconds, in which the guard notices everything


def dark(place):
    return np.zeros((2, 2), np.uint8)


@pytest.fixture
def rig(clock):
    with fake_rig(dark, clock, rate=100.0) as opened:
        yield opened


def stopped(rig):
    """Wait until the stage was stopped."""
    end = rig.clock.now() + SOON
    while not rig.stage.stops and rig.clock.now() < end:
        rig.clock.sleep(0.001)
    return bool(rig.stage.stops)


def begin(rig, timed=False):
    return rig.begin(lambda: rig.stage.move(Position(2.0), 0.5), timed)


@pytest.mark.parametrize(("timed", "stall"), [(True, 0.1), (False, 0.3)])
def test_a_camera_that_stalls_stops_the_stage_while_everyone_is_busy(rig, timed, stall):
    begin(rig, timed)
    began = rig.clock.now()
    rig.camera.stall()
    assert stopped(rig)  # nobody asked the rig for anything
    assert stall <= rig.stage.stops[0] - began < stall + 0.05
    with pytest.raises(HardwareError, match=rf"fake camera delivered no frame for {stall}"):
        rig.take(1)


def test_a_camera_that_is_lost_stops_the_stage_and_is_named(rig):
    begin(rig)
    rig.camera.lose()
    assert stopped(rig)
    with pytest.raises(HardwareError, match="fake camera was lost"):
        rig.check()


def test_a_camera_that_came_back_in_a_timed_move_stops_it(rig):
    rig.begin(lambda: rig.stage.move(Position(2.0), 0.5), timed=True)
    rig.camera.reconnects += 1
    assert stopped(rig)
    with pytest.raises(HardwareError, match=r"was lost while the stage moved.* start again"):
        rig.check()


def test_a_stage_that_fails_is_stopped_and_named(rig):
    begin(rig)
    rig.stage.error = HardwareError("fake stage: ALARM:1")
    assert stopped(rig)
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
    rig.clock.sleep(10.0)
    assert rig._guard.is_alive()
    assert rig.stage.stops == []
    rig.check()


def test_no_move_begins_after_a_fault(rig):
    begin(rig)
    rig.camera.lose()
    assert stopped(rig)
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
def test_the_stage_stops_first_whatever_ends_it(clock, kind):
    rig = fake_rig(dark, clock)
    stage, camera = rig.stage, rig.camera
    order = Order()
    order.camera = camera
    for owner, name in ((stage, "stop"), (stage, "close"), (camera, "close")):
        order.watch(owner, name)
    with pytest.raises(kind):
        end_by(kind, rig)
    assert order[0] == "stop"
    assert order[-2:] == ["close", "camera close"]
    assert clock.threads == []


def test_a_rig_that_is_left_while_it_moves_is_stopped(clock):
    rig = fake_rig(dark, clock)
    stage, camera = rig.stage, rig.camera
    with rig:
        begin(rig)
    assert stage.stops
    assert stage.closed
    assert camera.closed


def test_a_rig_that_is_closed_while_it_moves_is_stopped(clock):
    rig = fake_rig(dark, clock)
    begin(rig)
    rig.close()
    assert rig.stage.stops


def test_a_rig_that_rests_is_left_without_a_stop(clock):
    rig = fake_rig(dark, clock)
    stage = rig.stage
    with rig:
        assert rig.go(Position(-0.9)).position == Position(-0.9)
    assert stage.stops == []
    assert stage.closed


def test_all_is_closed_even_if_closing_fails(clock):
    rig = fake_rig(dark, clock)
    stage, camera = rig.stage, rig.camera

    def fail():
        raise OSError("gone")

    stage.close = fail
    with pytest.raises(OSError, match="gone"), rig:
        pass
    assert camera.closed
    assert clock.threads == []


def test_a_defect_while_the_stage_waits_is_not_hidden(rig):
    rig.stage.wait = lambda: 1 / 0
    with pytest.raises(ZeroDivisionError):
        rig.go(Position(0.0))


@pytest.mark.parametrize("timed", [True, False])
def test_a_program_that_stood_still_ends_a_timed_move(rig, monkeypatch, timed):
    waited = rig._closing.wait
    move = rig.begin(lambda: rig.stage.move(Position(2.0), 1.0), timed)
    pauses = iter([0.6])
    monkeypatch.setattr(rig._closing, "wait", lambda seconds: waited(next(pauses, seconds)))
    if not timed:
        rig.end(move)
        assert rig.stage.stops == []
        return
    with pytest.raises(HardwareError, match=r"was paused for 0\.60 s while the stage moved"):
        rig.end(move)
    assert rig.stage.stops
