from __future__ import annotations

import math
import re

import pytest
from msgspec import structs
from scripted_grbl import ScriptedGrbl, stage_settings

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import TiltAxis, TravelAxis
from mirrorskin.hw.base.stage import Position
from mirrorskin.io import InputError

DOWN = TravelAxis(letter="Z", direction=-1, zero=-5.0, limits=(-5.0, 3.0), speed=20.0)
LEAN = math.radians(2.5)


def test_it_reports_its_position_and_identity(opened, clock):
    stage, _ = opened(ScriptedGrbl(clock, place=(31.0, 40.0, 9.0)))
    report = stage.report()
    assert report.state == "idle"
    assert 0 <= clock.now() - report.time < 0.02
    assert report.position.travel == pytest.approx(1)
    assert report.position.pitch == pytest.approx(math.radians(1))
    assert stage.error is None
    assert "1.1h" in stage.firmware
    assert stage.parameters[110] == 6000
    assert stage.round_trip == 0.0


def test_reports_of_work_coordinates_are_turned_into_the_machines(opened, clock):
    stage, _ = opened(ScriptedGrbl(clock, place=(31.0, 40.0, 9.0), work=True))
    assert stage.report().position.travel == pytest.approx(1)
    stage.move(Position(2.0))
    assert stage.wait().position.travel == pytest.approx(2)


def test_it_goes_where_it_is_sent_in_the_machines_coordinates(opened):
    stage, port = opened()
    stage.move(Position(1.0), 20.0)
    assert stage.wait().position.travel == pytest.approx(1, abs=1e-3)
    assert port.place == pytest.approx([30, 40, 9])
    assert port.lines[-1] == "G53G1Z9.00000X30.00000Y40.00000F1200.0000"
    stage.move(Position(1.0), 20.0)
    stage.wait()
    assert port.lines[-1].startswith("G53G1Z9"), "a move to where it stands needs no line"


@pytest.mark.parametrize(
    "size", [128, 1024]
)  # of a large one no more is used: questions wait behind all of it
def test_a_precession_ends_where_it_began_and_streams_within_the_buffer(opened, size, clock):
    stage, port = opened(ScriptedGrbl(clock, size=size))
    stage.move(Position(1.0, LEAN))
    stage.wait()
    stage.precess(LEAN, 6.0, 6.0)
    assert stage.report().state in ("run", "idle")
    report = stage.wait()
    assert report.state == "idle"
    assert report.position.pitch == pytest.approx(LEAN, abs=1e-4)
    assert sum(line.startswith("G3") for line in port.lines) == 12
    assert 0 < port.fill <= 128


def test_a_precession_begins_where_the_body_stands(opened):
    stage, port = opened()
    sent = len(port.lines)
    with pytest.raises(InputError, match="move there first"):
        stage.precess(LEAN, 1.0, 1.0)
    stage.move(Position(0, LEAN * math.cos(1), LEAN * math.sin(1)))
    stage.wait()
    with pytest.raises(InputError, match="move there first"):
        stage.precess(LEAN, 1.0, 1.0, 1.1)
    stage.precess(LEAN, -0.5, 5.0, 1.0)
    assert stage.wait().position.phase == pytest.approx(1 - math.pi, abs=1e-3)
    assert len(port.lines) == sent + 3


def test_what_is_beyond_the_limits_is_refused_before_anything_is_sent(opened, clock):
    stage, port = opened()
    sent = list(port.lines)
    for beyond in (3.1,), (-6,), (0, 0.2), (math.nan,), (0, 0.07, 0.07):
        with pytest.raises(InputError, match="stage in memory"):
            stage.move(Position(*beyond))
    with pytest.raises(InputError, match="stage in memory"):
        stage.precess(0.1, 1.0, 1.0)
    with pytest.raises(InputError, match="too fast"):
        stage.move(Position(1.0), 100.0)
    clock.sleep(1.0)
    assert port.lines == sent
    assert stage.error is None


def test_steps_other_than_the_rig_files_are_refused(opened, clock):
    travel = stage_settings().travel
    opened(ScriptedGrbl(clock, settings={102: 500.0}), travel=structs.replace(travel, steps=500.0))
    with pytest.raises(InputError, match=r"\$102 is 500 steps, but 250 .*: moves would be 2 times as long"):
        opened(ScriptedGrbl(clock, settings={102: 500.0}), travel=structs.replace(travel, steps=250.0))


def test_a_speed_below_the_firmwares_is_refused_before_anything_is_sent(opened, clock):
    stage, port = opened(ScriptedGrbl(clock, settings={102: 250}))
    sent = list(port.lines)
    with pytest.raises(InputError, match=r"minimum is 30\.5.*use 0\.122 or more"):
        stage.move(Position(1.0), 0.02)
    assert port.lines == sent
    stage.move(Position(0.1), 0.2)
    stage.wait()


def test_soft_limits_bound_the_axes(opened, clock):
    stage, _ = opened(ScriptedGrbl(clock, settings={132: 6}, place=(30.0, 40.0, -1.0)), travel=DOWN)
    assert stage.limits.travel == (-5.0, 1.0)


def test_a_slow_axis_has_longer_for_its_hold(opened, clock):
    stage, _ = opened(ScriptedGrbl(clock, settings={122: 10, 112: 600}))
    assert stage._link.stopping.holding == pytest.approx(1.25)


def test_reports_are_valid_for_their_time(opened, clock):
    stage, _ = opened()
    begun = clock.now()
    stage.move(Position(2.0), 5.0)
    stage.wait()
    under_way = [report for report in stage.history(begun) if 0.1 < report.position.travel < 1.9]
    assert len(under_way) > 10
    late = [report.time - begun - report.position.travel / 5 for report in under_way]
    assert late == pytest.approx([0.0] * len(late), abs=2e-4)  # a report is rounded to a micrometre


def test_a_locked_stage_without_switches_is_refused_until_it_is_unlocked(opened, clock):
    port = ScriptedGrbl(clock, state="Alarm")
    with pytest.raises(InputError, match="rig unlock"):
        opened(port)
    assert "$X" not in port.lines
    stage, port = opened(ScriptedGrbl(clock, state="Alarm"), unlock=True)
    assert "$X" in port.lines
    stage.move(Position(0.1))
    stage.wait()


def test_a_locked_stage_with_switches_waits_to_be_homed(opened, clock):
    stage, port = opened(ScriptedGrbl(clock, state="Alarm", settings={22: 1}), home=True)
    assert "$X" not in port.lines
    assert stage.report().state == "alarm"
    for ask in (lambda: stage.move(Position(0.1)), stage.wait):
        with pytest.raises(HardwareError, match="home it first"):
            ask()
    stage.home()
    assert port.lines[-2:] == ["$H", "G21G90G94"]
    stage.move(Position(0.1))
    stage.wait()


def test_homing_that_fails_is_an_alarm(opened, clock):
    stage, _ = opened(
        ScriptedGrbl(clock, state="Alarm", settings={22: 1}, answers={"$H": "ALARM:9"}), home=True
    )
    with pytest.raises(HardwareError, match="did not reach a switch"):
        stage.home()


def test_homing_that_is_switched_off_is_refused(opened):
    stage, _ = opened()
    with pytest.raises(InputError, match=re.escape("$22=1")):
        stage.home()


def test_a_pressed_switch_is_refused_where_nothing_is_homed(opened, clock):
    with pytest.raises(InputError, match="limit switch of Z is pressed"):
        opened(ScriptedGrbl(clock, pins="ZP"))


def test_what_moves_by_others_is_left_alone_unless_it_is_unlocked(opened, clock):
    port = ScriptedGrbl(clock)
    port.plan.append(([30.0, 40.0, 0.0], 60.0))
    port.state = "Run"
    with pytest.raises(InputError, match="in the state run"):
        opened(port)
    assert not set(b"!\x18") & set(port.bytes)
    port.closed = False
    stage, _ = opened(port, unlock=True)
    assert stage.report().state == "idle"
    assert port.bytes.index(b"!") < port.bytes.index(b"\x18")


@pytest.mark.parametrize(
    ("behaviour", "message"),
    [
        ({"version": "0.9j"}, "version 0.9j"),
        ({"settings": {13: 1}}, re.escape("$13=0")),
        ({"answers": {"$$": "error:8"}}, "error:8"),
    ],
)
def test_a_controller_that_cannot_be_worked_with_is_refused(opened, clock, behaviour, message):
    port = ScriptedGrbl(clock, **behaviour)
    with pytest.raises(InputError, match=f"^stage in memory: .*{message}"):
        opened(port)
    assert port.closed


def test_an_axis_that_the_controller_has_not_is_refused(opened, clock):
    port = ScriptedGrbl(clock)
    with pytest.raises(InputError, match="no axis A"):
        opened(port, pitch=TiltAxis(letter="A", limits=(-57, 57), speed=57))
    assert port.closed


def test_closing_twice_and_stopping_after_is_not_an_error(opened):
    stage, _ = opened()
    stage.close()
    stage.close()
    stage.stop()
    with pytest.raises(HardwareError, match="closed"):
        stage.move(Position(1))
    with pytest.raises(HardwareError, match="closed"):
        stage.report()


def test_leaving_it_in_motion_stops_it(opened):
    stage, port = opened()
    with stage:
        stage.move(Position(-4), 1.0)
    assert port.held_at is not None
    assert port.reset_at is not None
    assert port.closed
