"""Findings of a rig check, on a stage and a camera with given faults."""

import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from mirrorskin.hw.base.camera import Counts, Frames
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.rig_file import (
    CameraSettings,
    RigSettings,
    ShiftAxis,
    StageSettings,
    TiltAxis,
    TravelAxis,
    TwistAxis,
)
from mirrorskin.hw.base.stage import Position, Report
from mirrorskin.hw.rig.check import check_camera, check_moves, check_rig, check_stage
from mirrorskin.io import InputError

DEGREE = math.pi / 180
TILT = {"limits": (-5.0, 4.0), "speed": 20.0}
TRAVEL = TravelAxis(letter="Z", direction=-1, zero=-20.0, limits=(-10.0, 3.0), speed=5.0)
STAGE = StageSettings(
    port="nowhere",
    baud=115200,
    home=True,
    timeout=1.0,
    report_rate=20.0,
    travel=TRAVEL,
    pitch=TiltAxis(letter="X", **TILT),
    roll=TiltAxis(letter="Y", **TILT),
    press=2.0,
    pivot=None,
)
CAMERA = CameraSettings(source=0, size=(7, 5))
RIG = RigSettings(Path("r.toml"), "r", STAGE, CAMERA)
# GRBL's settings of a machine that can do all that the file says.
ABLE = {22: 1.0, 112: 300.0, 110: 1200.0, 111: 1200.0, 132: 13.0, 130: 9.0, 131: 9.0}


@pytest.fixture(autouse=True)
def shared(clock, monkeypatch):
    """Let stage and camera have the clock."""
    monkeypatch.setattr(Stage, "clock", clock)
    monkeypatch.setattr(Camera, "clock", clock)


class Stage:
    """A stage that is where it is sent at once, or as far off as it is told."""

    firmware = "Grbl 1.1h"
    round_trip = longest_trip = 0.004
    longest_silence = 0.07
    clock = None

    def __init__(
        self, settings=STAGE, parameters=ABLE, at=(-15.0, 0.0, 0.0), state="idle", off=0.0, every=0.05
    ):
        self.limits, self.parameters = settings.limits, parameters
        self._position, self._state, self._off, self._every = Position(*at), state, off, every
        self.did = []

    def report(self):
        return Report(self.clock.now(), self._position, self._state)

    def history(self, since):
        times = np.arange(since, self.clock.now(), self._every)
        return [Report(float(at), self._position, self._state) for at in times]

    def home(self):
        self.did.append("home")

    def move(self, place, speed=None):
        self.limits.check(place, "stage")
        self.did.append(place)
        self._position = replace(place, travel=place.travel + self._off)

    def wait(self, timeout=None):
        return self.report()

    def close(self):
        self.did.append("close")


class Camera:
    """A camera of a frame each 10 ms of its own clock, whose frames are all one picture."""

    name, clock = "camera", None

    def __init__(self, picture=None, rate=100.0, lost=0, every=0.01, **counts):
        self._every = every
        self._picture = np.arange(35, dtype=np.uint8).reshape(5, 7) if picture is None else picture
        self.shape, self.dtype = self._picture.shape, self._picture.dtype
        self.counts, self._after = Counts(rate=rate), counts
        self._lost, self.closed = lost, False

    def take(self, limit, timeout):
        self.clock.sleep(self._every)
        lost, self._lost = (self._lost, 0) if self.counts.frames else (0, self._lost)
        self.counts = replace(self.counts, frames=self.counts.frames + 1, **self._after)
        return Frames(self._picture[None], np.zeros(1, np.int64), np.array([self.clock.now()]), lost)

    def flush(self):
        pass

    def close(self):
        self.closed = True


def look(stage, settings=STAGE):
    return {result.what: result for result in check_stage(stage, settings, stage.clock)}


def film(camera, **settings):
    return {
        result.what: result
        for result in check_camera(camera, structs.replace(CAMERA, **settings), camera.clock)
    }


def test_a_stage_that_agrees_with_its_file_is_sound():
    stage = Stage()
    actual = look(stage)
    assert {result.verdict for result in actual.values()} == {"ok"}
    assert actual["firmware"].found == "Grbl 1.1h"
    assert actual["position"].found == ("travel -15.000 mm, pitch 0.000 deg, roll 0.000 deg (before homing)")
    assert actual["travel: limits against $132"].found == "-10 to 3 mm, 13 mm in the controller"
    assert actual["pitch: speed against $110"].found == "20 deg/s, 20 deg/s in the controller"
    assert actual["reports"].found == "20.0 Hz, requested 20 Hz"
    assert actual["round trip of a report"].found == "4.0 ms"
    assert stage.did == []


@pytest.mark.parametrize(
    ("number", "value", "what", "message"),
    [
        (132, 12.9, "travel: limits against $132", "the limits are 13 mm apart, but the axis is shorter"),
        (131, 8.9, "roll: limits against $131", "the limits are 9 deg apart, but the axis is shorter"),
        (112, 240.0, "travel: speed against $112", "set stage.travel.speed = 4"),
        (110, 600.0, "pitch: speed against $110", "set stage.pitch.speed = 10"),
    ],
)
def test_a_file_beyond_the_controller_is_warned_of(number, value, what, message):
    actual = look(Stage(parameters=ABLE | {number: value}))
    assert actual[what].verdict == "warning"
    assert message in actual[what].remedy
    assert [result.what for result in actual.values() if result.verdict != "ok"] == [what]


@pytest.mark.parametrize(
    ("zero", "soft", "verdict"),
    [(-3, 1, "ok"), (3, 1, "ok"), (-3.001, 1, "warning"), (-2.999, 1, "warning"), (-2.999, 0, "ok")],
)
def test_limits_that_the_controller_s_soft_limits_cut_are_warned_of(zero, soft, verdict):
    # -3 to 3 mm from that zero; the machine goes from -6 to 0, or from 0 to 6.
    travel = structs.replace(TRAVEL, zero=zero, direction=1, limits=(-3.0, 3.0))
    settings = structs.replace(STAGE, travel=travel)
    actual = look(Stage(settings, ABLE | {20: soft, 132: 6.0}), settings)["travel: limits against $132"]
    assert actual.verdict == verdict, actual


def test_what_the_controller_does_not_report_is_not_a_fault():
    actual = look(Stage(parameters={22: 1.0}))
    assert {result.verdict for result in actual.values()} == {"ok"}
    assert actual["roll: limits against $131"].found == "-5 to 4 deg, unknown in the controller"


def test_homing_that_the_controller_cannot_do_fails():
    actual = look(Stage(parameters=ABLE | {22: 0.0}))["homing ($22)"]
    assert (actual.verdict, actual.found) == ("failed", "off")
    assert "home = false" in actual.remedy
    by_hand = structs.replace(STAGE, home=False)
    assert look(Stage(by_hand, ABLE | {22: 0.0}, (0.0, 0.0, 0.0)), by_hand)["homing ($22)"].verdict == "ok"


@pytest.mark.parametrize(("at", "verdict"), [((3.0, 0.0, 0.0), "warning"), ((2.0, 0.0, 0.0), "ok")])
def test_a_stage_without_homing_beyond_its_limits_is_reported(at, verdict):
    settings = structs.replace(STAGE, home=False)
    assert look(Stage(settings, at=at), settings)["position"].verdict == verdict


def test_an_alarm_is_a_fault_unless_homing_ends_it():
    assert look(Stage(state="alarm"))["state"].verdict == "ok"
    actual = look(Stage(state="alarm"), structs.replace(STAGE, home=False))["state"]
    assert (actual.verdict, actual.found) == ("failed", "alarm")
    assert look(Stage(state="door"))["state"].verdict == "failed"


def test_slow_and_missing_reports_are_reported():
    actual = look(Stage(every=0.1))["reports"]
    assert (actual.verdict, actual.found) == ("warning", "10.0 Hz, requested 20 Hz")
    assert "set stage.report_rate = 10" in actual.remedy
    assert look(Stage(every=100.0))["reports"].verdict == "failed"
    slow = Stage()
    slow.round_trip = 0.2
    assert look(slow)["round trip of a report"].verdict == "warning"


def test_an_answer_that_came_late_asks_for_more_silence():
    late = Stage()
    late.longest_trip = 0.06
    actual = look(late)["longest round trip"]
    assert (actual.verdict, actual.found) == ("warning", "60.0 ms; the limit in motion is 70 ms")
    assert "set stage.silence = 0.18" in actual.remedy


# Moves


def moves(stage, settings=STAGE):
    return list(check_moves(stage, settings))


def test_each_axis_goes_a_little_there_and_back_within_the_limits():
    stage = Stage()
    actual = moves(stage)
    assert {result.verdict for result in actual} == {"ok"}
    assert [result.what for result in actual] == ["homing", "travel (Z)", "pitch (X)", "roll (Y)"]
    start, lean = Position(-10.0), pytest.approx(0.4 * DEGREE)
    assert stage.did == [
        "home",
        start,
        Position(-9.5),
        start,
        Position(-10.0, lean),
        start,
        Position(-10.0, 0.0, lean),
        start,
    ]
    assert actual[1].found == "+0.5 mm and back, off by 0.0000 mm"
    assert actual[2].found == "+0.4 deg and back, off by 0.0000 deg"


def test_travel_goes_up_where_it_can_and_the_body_is_set_upright_first():
    settings = structs.replace(STAGE, home=False)
    stage = Stage(settings, at=(5.0, 0.2, 0.1))
    moves(stage, settings)
    assert stage.did[:3] == [Position(2.0), Position(1.5), Position(2.0)]


def test_x_y_and_twist_are_moved_of_a_lifted_body():
    x = ShiftAxis(letter="A", limits=(-0.1, 0.9), speed=1.0)
    twist = TwistAxis(letter="C", limits=(-1.0, 2.0), speed=1.0)
    settings = structs.replace(STAGE, home=False, x=x, twist=twist)
    stage = Stage(settings, at=(1.0, 0.0, 0.0, 0.05, 0.0, 0.01))
    actual = moves(stage, settings)
    assert {result.verdict for result in actual} == {"ok"}
    assert [result.what for result in actual[-2:]] == ["x (A)", "twist (C)"]
    assert stage.did[0] == Position(1.0, x=0.05, twist=0.01), "it stays where it may touch something"
    lifted = Position(-10.0, x=0.05, twist=0.01)
    assert stage.did[-6:] == [
        lifted,
        replace(lifted, x=pytest.approx(-0.05)),
        lifted,
        lifted,
        replace(lifted, twist=pytest.approx(0.01 - 0.3 * DEGREE)),
        lifted,
    ]


def test_an_axis_that_stops_elsewhere_fails():
    actual = moves(Stage(off=0.03))[1]
    assert (actual.verdict, actual.found) == ("failed", "+0.5 mm and back, off by 0.0300 mm")
    assert "steps per unit" in actual.remedy
    assert moves(Stage(off=0.015))[1].verdict == "ok"


# The camera


def test_a_camera_that_agrees_with_its_file_is_sound():
    actual = film(Camera(), rate=102.0)
    assert {result.verdict for result in actual.values()} == {"ok"}
    assert actual["pictures"].found == "7 x 5 uint8"
    assert actual["rate"].found == "100.00 Hz, requested 102 Hz"
    assert actual["brightness"].found == "0 to 34, median 17; 0.00% saturated, 2.86% black"
    total = int(actual["frames"].found.split()[0])
    assert 90 <= total <= 110


def test_a_frame_that_came_late_asks_for_a_longer_stall():
    actual = film(Camera(every=0.08))["longest wait for a frame"]
    assert (actual.verdict, actual.found) == ("warning", "80.0 ms; the limit in motion is 100 ms")
    assert "set camera.stall = 0.24" in actual.remedy


def test_a_slow_camera_that_is_on_time_asks_for_nothing():
    assert film(Camera(every=0.08, rate=12.5))["longest wait for a frame"].verdict == "ok"


def test_lost_frames_and_reconnections_are_reported():
    assert film(Camera(lost=3))["frames"].verdict == "warning"
    assert " 3 lost" in film(Camera(lost=3))["frames"].found
    assert film(Camera(reconnects=1))["frames"].verdict == "warning"


@pytest.mark.parametrize(
    ("dtype", "top"), [(np.uint8, 255), (np.uint16, 65535), (np.uint16, 4095), (np.uint16, 1023 << 6)]
)
def test_too_much_light_is_reported(dtype, top):
    picture = np.arange(35, dtype=dtype).reshape(5, 7)
    picture[0, 0] = top
    actual = film(Camera(picture))["brightness"]
    assert actual.verdict == "warning"
    assert "2.86% saturated" in actual.found
    assert "shorten the exposure" in actual.remedy


def test_a_picture_of_floats_may_have_pixels_that_are_no_numbers():
    picture = np.array([[np.nan, -1.0, 1e9]], np.float32)
    actual = film(Camera(picture))["brightness"]
    assert (actual.verdict, actual.found.split(";")[0]) == ("ok", "-1 to 1e+09, median 5e+08")
    assert film(Camera(np.full((2, 2), np.nan, np.float32)))["brightness"].verdict == "warning"


# Both


def opened(stage, camera, move=False):
    return check_rig(
        RIG,
        move=move,
        open_stage=lambda settings: stage,
        open_camera=lambda settings: camera,
        clock=Stage.clock,
    )


@pytest.mark.parametrize("move", [False, True])
def test_nothing_moves_unless_asked_and_both_are_closed(move):
    stage, camera = Stage(), Camera()
    parts = list(dict.fromkeys(result.part for result in opened(stage, camera, move)))
    assert parts == ["stage", "camera", "move"][: 2 + move]
    assert stage.did[-1] == "close"
    assert (len(stage.did) > 1) == move
    assert camera.closed


def test_the_stage_is_closed_when_the_camera_is_not_there_or_is_lost():
    def refuse(settings):
        raise InputError("camera 0 is not there")

    stage = Stage()
    with pytest.raises(InputError, match="camera 0 is not there"):
        list(check_rig(RIG, open_stage=lambda settings: stage, open_camera=refuse, clock=Stage.clock))
    assert stage.did == ["close"]

    class Lost(Camera):
        def take(self, limit, timeout):
            raise HardwareError("camera: no frame came")

    stage, camera = Stage(), Lost()
    with pytest.raises(HardwareError, match="no frame came"):
        list(opened(stage, camera))
    assert stage.did == ["close"]
    assert camera.closed


def test_the_stage_is_closed_when_no_caller_needs_it():
    stage = Stage()
    findings = opened(stage, Camera())
    next(findings)
    findings.close()
    assert stage.did == ["close"]


def test_a_stage_that_is_lost_while_the_camera_is_looked_at_is_reported():
    class Unplugged(Camera):
        def close(self):
            super().close()
            stage.report = lambda: (_ for _ in ()).throw(HardwareError("stage: the connection is lost"))

    stage = Stage()
    with pytest.raises(HardwareError, match="the connection is lost"):
        list(opened(stage, Unplugged()))
    assert stage.did == ["close"]


def test_warnings_of_hardware_are_findings_and_not_also_printed(caplog):
    log = logging.getLogger("mirrorskin.hw")

    class Talking(Camera):
        def take(self, limit, timeout):
            log.info("a frame")
            return super().take(limit, timeout)

    def open_camera(settings):
        log.warning("camera 0: gain %g was asked for, the camera set %g", 2, 3)
        return Talking()

    findings = list(
        check_rig(RIG, open_stage=lambda settings: Stage(), open_camera=open_camera, clock=Stage.clock)
    )
    assert [finding.found for finding in findings if finding.verdict != "ok"] == [
        "camera 0: gain 2 was asked for, the camera set 3"
    ]
    assert not caplog.records
    log.warning("again")
    assert [record.getMessage() for record in caplog.records] == ["again"]


def test_nothing_is_moved_where_something_failed():
    stage = Stage(parameters=ABLE | {22: 0.0})
    last = list(opened(stage, Camera(), move=True))[-1]
    assert (last.part, last.found, last.verdict) == ("move", "not tried", "failed")
    assert stage.did == ["close"]


@pytest.mark.parametrize(
    ("pitch", "roll", "verdict"), [("Y", "X", "ok"), ("X", "A", "warning"), ("A", "B", "warning")]
)
def test_axes_that_have_no_arcs_are_reported(pitch, roll, verdict):
    settings = structs.replace(
        STAGE, pitch=TiltAxis(letter=pitch, **TILT), roll=TiltAxis(letter=roll, **TILT)
    )
    assert look(Stage(settings, {22: 1.0}), settings)["arcs"].verdict == verdict
