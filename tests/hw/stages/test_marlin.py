"""A stage with a Marlin controller moves in steps, and stops on faults."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from commands import run
from fake_marlin import FakeMarlin
from line_faults import CHANGES, outcomes
from rig_fakes import FakeCamera, settings
from simulated import write_film_rig

from mirrorskin import io
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.stage import Position
from mirrorskin.hw.rig.plans import AxialPlan, VerticalPlan
from mirrorskin.hw.rig.rig import Rig, open_stage
from mirrorskin.hw.rig.scan import StepScan
from mirrorskin.hw.rig.sweep import SweepScan
from mirrorskin.hw.stages.marlin import MarlinStage
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

RIG = settings((4, 4), delay=0.0, dark=5.0)
STAGE = msgspec.structs.replace(RIG.stage, firmware="marlin", x=None, y=None, twist=None)
RIG = replace(RIG, stage=STAGE)  # travel is Z, pitch and roll are X and Y
SOON = 1.0  # seconds in which everything that happens in motion is noticed


@pytest.fixture
def line(clock):
    return FakeMarlin(clock)


@pytest.fixture
def stage(line):
    with MarlinStage(STAGE, line, clock=line.clock) as stage:
        stage.home()
        yield stage
    assert line.closed


def test_steps_are_recorded(stage, line, clock, tmp_path):
    camera = FakeCamera(
        clock,
        lambda at: Position(line.place()["Z"]),
        lambda place: np.full((4, 4), 20 + 100 * (place.travel > 0.25), np.uint8),
        rate=50.0,
    )
    rig = Rig(stage, camera, RIG, clock)
    with (
        rig,
        io.StreamRecorder(StepScan(rig, VerticalPlan(0.0, 0.5, step=0.25)), tmp_path / "p.h5") as recorder,
    ):
        while recorder.read() is not None:
            pass
    with io.open_recording(tmp_path / "p.h5") as recording:
        block = recording.read(np.empty((3, 4, 4), np.uint8))
        assert block.travel.tolist() == [0.0, 0.25, 0.5]
        assert block.frames[:, 0, 0].tolist() == [20, 20, 120]


def test_it_goes_no_faster_than_the_controller(stage, line):
    stage.move(Position(-1.0))
    stage.wait()
    assert [message for message in line.log if message.startswith("G1")] == [
        "G1Z-1.00000X0.00000Y0.00000F480.0000"  # 8 mm/s of M203
    ]


@pytest.mark.parametrize("plan", [VerticalPlan(0.0, 0.5, speed=0.5), AxialPlan(1.0, 0.04, turns=1, rate=0.5)])
def test_sweeps_and_turns_are_refused(stage, clock, plan):
    camera = FakeCamera(clock, lambda at: Position(), lambda place: np.zeros((4, 4), np.uint8))
    rig = Rig(stage, camera, RIG, clock)
    with rig, pytest.raises(io.InputError, match=r"does not report its position while it moves; use steps"):
        SweepScan(rig, plan)


def begin_slow(stage):
    """Begin a move of twenty seconds, and let it go on for a while."""
    stage.move(Position(-5.0), speed=0.25)
    stage.clock.sleep(0.3)


def rests_on_its_way(line):
    """Wait until it rests, and return whether that is before the end of the move."""
    line.until(lambda: not line.moving, SOON)
    return -5.0 < line.place()["Z"] <= 0.0


def test_a_refused_speed_stops_nothing(stage):
    with pytest.raises(io.InputError, match="slow"):
        stage.move(Position(1.0), speed=1e-9)
    stage.move(Position(1.0))
    assert stage.wait().position.travel == pytest.approx(1.0)


def test_silence_in_motion_is_noticed_long_before_the_timeout(line, clock):
    with MarlinStage(msgspec.structs.replace(STAGE, timeout=9.0), line, clock=clock) as stage:
        begin_slow(stage)
        line.silent = True
        line.until(lambda: stage.error, SOON)
        assert "no longer answers" in str(stage.error)


@pytest.mark.parametrize("emergency", [True, False])
def test_a_stop_in_motion_comes_at_once(clock, emergency):
    line = FakeMarlin(clock, emergency)
    with MarlinStage(STAGE, line, clock=clock) as stage:
        stage.home()
        begin_slow(stage)
        stage.stop()
        assert rests_on_its_way(line)
        with pytest.raises(HardwareError, match="the stage was stopped; open it again"):
            stage.wait()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (lambda line: setattr(line, "silent", True), "no longer answers"),
        (lambda line: line.unplug(), "the connection is lost"),
        (lambda line: line.say("start"), "was reset and has lost its position"),
        (lambda line: line.say("ok"), "answered a line that this program did not send"),
        (lambda line: line.say(*["\x01\xe9\x7f" * 40] * 5), "sends garbled characters"),
        (
            lambda line: setattr(line, "noise", lambda message: message.replace("M110", "M111")),
            "checksum mismatch",
        ),
        (lambda line: line.say("Error:Heating failed, system stopped!"), "Heating failed"),
    ],
)
def test_faults_in_motion_stop_it(stage, line, fault, message):
    begin_slow(stage)
    fault(line)
    with pytest.raises(HardwareError, match=message):
        stage.wait()
    assert line.gone or rests_on_its_way(line)


@pytest.mark.parametrize("at", [0.0, 0.004, 0.37, 3.0])
def test_ctrl_c_in_motion_stops_it(stage, line, clock, at):
    begin_slow(stage)
    clock.later(at, clock.interrupt)
    with pytest.raises(KeyboardInterrupt):
        stage.wait()
    assert rests_on_its_way(line)


def test_homing_is_stopped_by_killing_the_controller(line, clock):
    line.homing = 100.0
    with MarlinStage(STAGE, line, clock=clock) as stage:
        clock.later(0.2, stage.stop)
        with pytest.raises(HardwareError, match="was stopped"):
            stage.home()
        assert line.killed


def test_a_place_that_the_controller_clips_is_noticed(stage, line):
    line.ends = -0.5
    stage.move(Position(-1.0))
    with pytest.raises(HardwareError, match=r"rests 0\.5 mm or degrees from its target"):
        stage.wait()


@pytest.mark.parametrize(
    ("instead", "message"),
    [
        ({"M115": "FIRMWARE_NAME:Klipper FIRMWARE_VERSION:v0.12"}, "firmware is Klipper, not Marlin"),
        ({"M115": "Grbl 1.1h ['$' for help]"}, "the device is not Marlin"),
        ({"M115": ""}, "no answer within 12 s"),
        ({"M27": "SD printing byte 12/34\nok"}, "printing from its card"),
        ({"M114": "X:0.00 Y:0.00 E:0.00\nok"}, "has no axis Z"),
        ({"M503": "nothing\nok", "G90": "Error:checksum mismatch"}, "answers G90 with 'Error:checksum"),
    ],
)
def test_what_is_not_a_stage_is_refused(line, clock, instead, message):
    line.instead = instead
    with pytest.raises(io.InputError, match=message):
        MarlinStage(STAGE, line, clock=clock)
    assert line.closed


def test_the_rig_file_chooses_it(line, clock, monkeypatch):
    monkeypatch.setattr("mirrorskin.hw.stages.marlin.open_port", lambda *_: line.open())
    stage = open_stage(STAGE, clock=clock)
    stage.close()
    assert stage.firmware == "Marlin 2.1.2 (Nov 24 2026)"
    with pytest.raises(io.InputError, match="only GRBL can be unlocked"):
        open_stage(STAGE, unlock=True)


def test_chatter_without_an_answer_is_silence(stage, line, clock):
    begin_slow(stage)
    line.silent, failed = True, clock.event()

    def chatter():
        while not failed.wait(0.02):
            line.chat("T:20.0 /0.0")

    talk = clock.thread(chatter, "chatter")
    talk.start()
    with pytest.raises(HardwareError, match="no longer answers"):
        stage.wait()
    failed.set()
    talk.join()
    assert rests_on_its_way(line)


def test_a_word_that_noise_changed_does_not_move_it(stage, line):
    line.noise = lambda message: message.replace("Z-1.0", "Z-9.0")
    with pytest.raises(HardwareError, match="checksum mismatch"):
        stage.move(Position(-1.0))
    assert not line.moving
    assert not any(message.startswith("G1") for message in line.log)


def test_a_stop_just_before_a_move_is_sent_stops_it(stage, line):
    def late(message):
        if "G1" in message:
            line.noise = str
            stage.stop()
        return message

    line.noise = late
    with pytest.raises(HardwareError, match="the stage was stopped"):
        stage.move(Position(-5.0), speed=0.5)
    assert rests_on_its_way(line)


def test_a_wait_ends_in_time(stage, line):
    begin_slow(stage)
    with pytest.raises(HardwareError, match=r"did not come to rest within 0\.1 s"):
        stage.wait(timeout=0.1)
    assert rests_on_its_way(line)


def test_who_else_moves_it_is_noticed(stage, line):
    line.put(0.5)
    line.until(lambda: stage.error, SOON)
    with pytest.raises(HardwareError, match=r"rests 0\.5 mm .* check that nothing else moves it"):
        stage.report()


def test_other_steps_than_the_rig_file_s_are_refused(line):
    line.instead = {"M503": "echo:  M92 X80.00 Y80.00 Z200.00\nok"}
    travel = msgspec.structs.replace(STAGE.travel, steps=400.0)
    with pytest.raises(
        io.InputError, match=r"M92 Z is 200 steps, but 400 in the rig file: moves would be 0\.5"
    ):
        MarlinStage(msgspec.structs.replace(STAGE, travel=travel), line, clock=line.clock)


def go(**faults):
    """Move there and back through a line with faults, and return what went wrong."""
    line, error = FakeMarlin(SimulatedClock()), None
    vars(line).update(faults)
    try:
        with MarlinStage(STAGE, line, clock=line.clock) as stage:
            stage.home()
            for travel in (-0.4, -0.1):
                stage.move(Position(travel))
                assert stage.wait().position.travel == pytest.approx(travel, abs=0.021)
                assert line.place()["Z"] == pytest.approx(travel, abs=0.021)
    except (HardwareError, io.InputError) as failed:
        error = failed
        assert "\n" not in str(error)
    assert line.clock.threads == []
    line.clock.sleep(1.0)
    assert not line.moving
    return error


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("method", ["said", "heard"])
def test_each_reply_and_byte_may_fail_once(method, change):
    assert None in outcomes(go, method, change, required=30), "some of it does not matter"


RIG_FILE = """
[stage]
firmware = "marlin"
port = "socket://nowhere:1"
press = 2.0
[stage.travel]
letter = "Z"
limits = [-5.0, 3.0]
speed = 8.0
"""


@pytest.fixture
def capture(line, simulated, tmp_path, monkeypatch):
    """Run commands on a rig file: the controller is the fake one, and the camera a film of 200 s."""
    monkeypatch.setattr("mirrorskin.hw.stages.marlin.open_port", lambda *_: line.open())
    monkeypatch.chdir(tmp_path)
    write_film_rig(tmp_path, RIG_FILE)
    return lambda words: run("capture", "vertical", *words.split(), "--rig", "rig.toml", "-o", "press.h5")


def test_a_rig_file_captures_in_steps(capture, tmp_path):
    ended = capture("--stop 0.4mm --step 0.2mm --settle 0s")
    assert ended.code == 0, ended
    with io.open_recording(tmp_path / "press.h5") as recording:
        np.testing.assert_allclose(recording.travel, [0.0, 0.2, 0.4])
    checked = run("rig", "check", "rig.toml", "--move")
    assert checked.code == 0, checked
    assert "Marlin 2.1.2" in checked.out
    assert "$" not in checked.out


def test_a_sweep_is_refused_before_it_homes(capture, line):
    ended = capture("--stop 0.4mm --speed 0.2mm/s")
    assert (ended.code, line.log) == (2, [])
    assert "Marlin does not report its position while it moves; use steps" in ended.said


@pytest.mark.parametrize("fault", [lambda line: line.unplug(), lambda line: setattr(line, "silent", True)])
def test_a_fault_ends_the_capture_with_a_line(capture, line, fault):

    def noticed(message):
        if "G1Z2.0" in message:
            fault(line)
        return message

    line.noise = noticed
    ended = capture("--start 0mm --stop 2mm --step 2mm --settle 0s")
    assert (ended.code, ended.said.count("\n")) == (1, 1), ended
