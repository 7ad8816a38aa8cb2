"""Scans with a fake stage and camera, whose frames record where they were exposed."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from rig_fakes import fake_rig, settings, spreading

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.stage import Position, Report
from mirrorskin.hw.rig.plans import AxialPlan, HorizontalPlan, RockPlan, TwistPlan, VerticalPlan
from mirrorskin.hw.rig.scan import StepScan
from mirrorskin.hw.rig.sweep import SweepScan
from mirrorskin.io import InputError, StreamRecorder

TILT = 0.04
SHAPE = (3, 4)
ROOM = np.empty((8, *SHAPE), np.uint8)


def told(place):
    """A picture that tells travel and lean: 100 counts a mm from 100 at 0, 1000 counts a radian."""
    picture = np.zeros(SHAPE, np.uint8)
    picture[0] = np.clip(100 + 100 * place.travel, 0, 255)
    picture[1] = np.clip(100 + 1000 * place.pitch, 0, 255)
    picture[2] = np.clip(100 + 1000 * place.roll, 0, 255)
    return picture


def make_rig(picture=told, rate=250.0, delay=0.03, jitter=0.0, late=1e-3, **camera):
    return fake_rig(picture, rate=rate, delay=delay, jitter=jitter, late=late, stated={"dark": 5.0, **camera})


def drain(scan, buffer=ROOM):
    """Return all blocks, with copies of their frames."""
    blocks = []
    while (block := scan.read(buffer)) is not None:
        blocks.append(replace(block, frames=block.frames.copy()))
    return blocks


def joined(blocks, name):
    return np.concatenate([getattr(block, name) for block in blocks])


@pytest.fixture(scope="module")
def pressed():
    """A press without a halt: the scan, its blocks, and where the body truly was in each frame."""
    plan = VerticalPlan(0.0, 1.0, speed=1.5)
    with make_rig(rate=100.0, jitter=0.003, late=0.002) as rig, SweepScan(rig, plan) as scan:
        blocks = drain(scan)
    return scan, blocks, *_exposed(scan)


def _exposed(scan):
    number = np.concatenate([numbers for numbers, _ in scan._frames])
    camera = scan.rig.camera
    places = [scan.rig.stage.position(camera._start + k / camera._rate) for k in number]
    return (places,)


def test_each_frame_of_steps_shows_its_stated_position():
    with make_rig() as rig, StepScan(rig, VerticalPlan(0.0, 1.0, step=0.25), settle=0.02, frames=2) as scan:
        assert scan.shape == (10, *SHAPE)
        blocks = drain(scan, ROOM[:2])
        assert [place.travel for place in rig.stage.moves[-5:]] == [0, 0.25, 0.5, 0.75, 1]
    travel = joined(blocks, "travel")
    np.testing.assert_allclose(travel, np.repeat([0, 0.25, 0.5, 0.75, 1], 2))
    np.testing.assert_allclose(joined(blocks, "frames")[:, 0, 0], 100 + 100 * travel, atol=1)
    np.testing.assert_array_equal(scan.positions()["travel"], travel)
    assert max(len(block.frames) for block in blocks) <= 2
    assert [block.index for block in blocks] == list(np.cumsum([0, *(len(b.frames) for b in blocks)])[:-1])
    assert all(block.stays_valid and block.dropped == 0 for block in blocks)
    assert scan.count == 10


def test_each_frame_of_a_stepwise_turn_shows_its_phase():
    with make_rig() as rig, StepScan(rig, AxialPlan(0.5, TILT, phase_step=math.tau / 5), settle=0.0) as scan:
        blocks = drain(scan)
    phase, frames = joined(blocks, "phase"), joined(blocks, "frames")
    np.testing.assert_allclose(phase, math.tau / 5 * np.arange(5))
    np.testing.assert_allclose(frames[:, 1, 0], 100 + 1000 * TILT * np.cos(phase), atol=1)
    np.testing.assert_allclose(frames[:, 2, 0], 100 + 1000 * TILT * np.sin(phase), atol=1)
    np.testing.assert_array_equal(frames[:, 0, 0], 150)
    assert scan.header.press == 0.5
    assert scan.header.tilt == TILT
    assert scan.header.pivot == (0, 0, 0)


def slid(place):
    """A picture that tells travel, x, y and twist: 100 counts a mm or radian from 100 at 0."""
    values = place.travel, place.x, place.y, place.twist
    return np.clip(100 + 100 * np.array([values, values]), 0, 255).round().astype(np.uint8)


@pytest.mark.parametrize(
    ("plan", "columns"),
    [
        (HorizontalPlan(0.5, 0.8, math.radians(210), step=0.4), [1, 2]),
        (TwistPlan(0.5, -0.4, step=0.2), [3]),
    ],
)
def test_each_frame_of_a_stepwise_slide_or_twist_shows_its_stated_position(plan, columns):
    with make_rig(slid) as rig:
        with StepScan(rig, plan, settle=0.0, frames=2) as scan:
            blocks = drain(scan, np.empty((8, 2, 4), np.uint8))
        places = rig.stage.moves
    told_values, frames = joined(blocks, plan.series), joined(blocks, "frames")
    np.testing.assert_allclose(told_values, np.repeat(plan.values, 2, axis=0))
    np.testing.assert_allclose(frames[:, 0, columns], 100 + 100 * told_values.reshape(6, -1), atol=1)
    np.testing.assert_array_equal(frames[:, 0, 0], 150)
    np.testing.assert_array_equal(scan.positions()[plan.series], told_values)
    assert scan.header.press == 0.5
    end = plan.places[-1]
    assert places[:3] == [Position(-5.0), Position(0.5), Position(0.5)]
    assert places[-2:] == [replace(end, travel=-5.0), Position(-5.0)], "up first, and back above the object"


def test_a_rocking_body_reports_its_tilts_and_goes_back_upright():
    plan = RockPlan(0.5, TILT, math.pi / 2, step=TILT)
    with make_rig() as rig:
        with StepScan(rig, plan, settle=0.0) as scan:
            blocks = drain(scan)
        assert rig.stage.moves[-2:] == [Position(0.5), Position(-5.0)]
    frames = joined(blocks, "frames")
    np.testing.assert_allclose(joined(blocks, "tilt"), [-TILT, 0, TILT])
    np.testing.assert_allclose(joined(blocks, "phase"), math.pi / 2)
    np.testing.assert_allclose(frames[:, 2, 0], 100 + 1000 * joined(blocks, "tilt"), atol=1)
    np.testing.assert_array_equal(frames[:, :2, 0], [[150, 100]] * 3)
    assert scan.header.tilt is None
    assert (scan.header.press, scan.header.pivot) == (0.5, (0, 0, 0))


def test_a_continuous_slide_waits_pressed_and_has_its_positions():
    plan = HorizontalPlan(0.5, 0.8, math.radians(30), speed=1.5, wait=0.2)
    with make_rig(slid, rate=100.0) as rig:
        scan = SweepScan(rig, plan)
        began = rig.clock.now()
        with scan:
            assert rig.clock.now() > began + plan.wait
            blocks = drain(scan, np.empty((8, 2, 4), np.uint8))
    places = _exposed(scan)[0]
    true = np.array([(place.x, place.y) for place in places])
    np.testing.assert_allclose(joined(blocks, "displacement"), true, atol=0.1)
    np.testing.assert_allclose(scan.positions()["displacement"], true, atol=0.02)
    assert true[0].tolist() == [0, 0]


def test_a_body_that_was_left_displaced_is_lifted_before_it_goes_back():
    with make_rig() as rig:
        rig.go(Position(0.5, x=0.4, twist=0.1))
        StepScan(rig, HorizontalPlan(0.5, 0.5, step=0.5)).lift()
        assert rig.stage.moves[-2:] == [Position(-5.0, x=0.4, twist=0.1), Position(-5.0)]


def test_a_continuous_press_only_moves_down_and_has_its_positions(pressed):
    scan, blocks, places = pressed
    true = np.array([place.travel for place in places])
    live, corrected = joined(blocks, "travel"), scan.positions()["travel"]
    for travel, near in ((live, 0.1), (corrected, 0.02)):
        assert np.all(np.diff(travel) >= 0)
        assert abs(travel - true).max() < near
    assert live[0] == 0
    assert corrected[-1] == pytest.approx(1, abs=1e-3)
    assert true[0] == 0
    assert true[-1] == pytest.approx(1)


def test_continuous_strokes_have_the_right_positions():
    plan = VerticalPlan(0.2, 0.7, speed=1.5, strokes=3)
    with make_rig(rate=100.0, late=0.002) as rig, SweepScan(rig, plan) as scan:
        blocks = drain(scan)
        assert [place.travel for place in rig.stage.moves[-3:]] == pytest.approx([0.7, 0.2, 0.7])
    true = np.array([place.travel for place in _exposed(scan)[0]])
    np.testing.assert_allclose(joined(blocks, "travel"), true, atol=0.2)
    np.testing.assert_allclose(scan.positions()["travel"], true, atol=0.03)
    assert np.count_nonzero(np.diff(np.sign(np.diff(true[np.diff(true, prepend=-1) != 0])))) == 2


def test_a_rotation_without_a_halt_has_no_frames_at_rest():
    plan = AxialPlan(0.5, TILT, turns=1.5, rate=3.0)
    with make_rig(rate=200.0) as rig, SweepScan(rig, plan) as scan:
        blocks = drain(scan)
    (places,) = _exposed(scan)
    phase = scan.positions()["phase"]
    true = np.unwrap([place.phase for place in places])
    assert np.all(np.diff(phase) >= 0)
    assert abs(phase - true).max() < 0.06
    assert abs(joined(blocks, "phase") - true).max() < 0.5
    assert max(np.count_nonzero(ends) for ends in (phase < 1e-3, phase > 3 * math.pi - 1e-3)) < 5
    assert len(phase) == pytest.approx(100, abs=20)


def test_of_many_frames_a_turn_only_some_are_given():
    with make_rig(rate=200.0) as rig, SweepScan(rig, AxialPlan(0.5, TILT, rate=2.0), 60) as scan:
        blocks = drain(scan)
    number = np.concatenate([numbers for numbers, _ in scan._frames])
    np.testing.assert_array_equal(np.diff(number), 3)
    assert len(joined(blocks, "frames")) == len(joined(blocks, "phase")) == len(number)
    assert len(number) <= 60
    assert "1 of 3 frames kept" in scan.remark
    phase = joined(blocks, "phase")
    np.testing.assert_allclose(joined(blocks, "frames")[:, 2, 0], 100 + 1000 * TILT * np.sin(phase), atol=16)


def test_losses_between_frames_that_are_skipped_are_counted(monkeypatch):
    with make_rig(rate=200.0) as rig, SweepScan(rig, AxialPlan(0.5, TILT, rate=2.0), 60) as scan:
        take = rig.camera.take
        monkeypatch.setattr(rig.camera, "take", lambda *words: replace(take(*words), dropped=1))
        blocks = drain(scan)
    assert scan.dropped == sum(block.dropped for block in blocks)
    assert scan.dropped > 2 * scan.count


def test_a_rotation_between_two_frames_has_none():
    with make_rig(rate=1.0) as rig, SweepScan(rig, AxialPlan(0.5, TILT, rate=5.0)) as scan:
        assert drain(scan) == []
        assert scan.positions()["phase"].shape == (0,)
        assert scan.rate == pytest.approx(1)


@pytest.mark.parametrize("rate", [1.0, 300.0, 1000.0])
def test_the_delay_of_a_slow_and_a_fast_camera_is_measured(rate):
    with make_rig(spreading((24, 24)), rate, delay=0.05) as rig:
        rig.settings = settings((24, 24), dark=5.0)
        delay = SweepScan(rig, VerticalPlan(0.0, 1.0, speed=1.0)).delay
    assert delay.seconds == pytest.approx(0.05, abs=1e-3 + 3 * delay.error)
    assert delay.error < 0.01


def test_blocks_state_how_late_their_frames_arrive(pressed):
    assert {block.lateness for block in pressed[1]} == {0.03}


@pytest.mark.parametrize("camera", [{}, {"source": "http://camera/video", "delay": 0.03}])
def test_an_unstated_delay_and_that_of_a_stream_are_measured(camera):
    with make_rig(spreading((24, 24)), 100.0, delay=0.05, jitter=0.003, late=0.002) as rig:
        rig.settings = settings((24, 24), dark=5.0, **camera)
        scan = SweepScan(rig, VerticalPlan(0.0, 1.0, speed=1.0))
        delay = scan.delay
    assert delay.seconds == pytest.approx(0.05, abs=0.003)
    assert 0 < delay.error < 0.002
    assert "measured" in scan.remark


def test_a_calibration_is_not_too_slow_for_grbl_and_without_a_picture_names_the_remedy(monkeypatch):
    speeds = []
    with make_rig(lambda place: np.full(SHAPE, 9, np.uint8), 100.0, delay=0.0) as rig:
        rig.settings = settings(SHAPE, dark=5.0)
        move = rig.stage.move
        monkeypatch.setattr(
            rig.stage, "move", lambda place, speed=None: (speeds.append(speed), move(place, speed))
        )
        with pytest.raises(HardwareError, match="'delay'"):
            _ = SweepScan(rig, VerticalPlan(0.0, 0.01, speed=0.02)).delay
    there_and_back = [speed for speed in speeds if speed is not None]
    assert there_and_back == [pytest.approx(1 / 60, rel=0.2)] * 2
    assert min(there_and_back) > 1 / 60


def test_the_dark_reference_is_of_the_lifted_body():
    with make_rig(lambda place: np.full(SHAPE, 20 if place.travel < -4 else 200, np.uint8)) as rig:
        rig.settings = settings(SHAPE, delay=0.03, bright=220.0)
        header = StepScan(rig, VerticalPlan(0.0, 1.0, step=0.5)).header
    np.testing.assert_array_equal(header.dark, np.full(SHAPE, 20, np.float32))
    np.testing.assert_array_equal(header.bright, np.full(SHAPE, 220, np.float32))
    assert header.dark.dtype == header.bright.dtype == np.float32


def test_references_and_scale_of_the_rig_file_are_the_scans():
    with make_rig(pixel_size=(0.1, 0.2), zenith_gain=math.radians(300.0), zenith_offset=7.0) as rig:
        header = StepScan(rig, VerticalPlan(0.0, 1.0, step=0.5)).header
    np.testing.assert_array_equal(header.dark, np.full(SHAPE, 5, np.float32))
    assert header.bright is None
    assert header.pixel_size == (0.1, 0.2)
    assert (header.zenith_gain, header.zenith_offset) == (300, 7)
    assert header.start_time


@pytest.mark.parametrize(
    "plan",
    [
        VerticalPlan(0.0, 2.5, speed=1.0),
        AxialPlan(1.0, 0.2, rate=1.0),
        VerticalPlan(0.0, 1.0, speed=50.0),
        AxialPlan(1.0, TILT, rate=1e-6),
    ],
)
def test_a_plan_beyond_the_limits_is_refused_before_anything_moves(plan):
    with make_rig() as rig:
        with pytest.raises(InputError):
            SweepScan(rig, plan)
        assert rig.stage.moves == []


def test_a_scan_that_is_done_lifts_the_body():
    with make_rig() as rig:
        with StepScan(rig, VerticalPlan(0.0, 1.0, step=0.5), settle=0.0) as scan:
            drain(scan)
        assert rig.stage.position() == Position(-5.0)
        assert rig.stage.stops == []


def test_a_leaning_body_is_brought_upright_before_it_is_lifted():
    with make_rig() as rig:
        rig.go(Position(0.5, TILT))
        scan = StepScan(rig, AxialPlan(0.5, TILT, phase_step=2.0))
        scan.lift()
        assert rig.stage.moves[-2:] == [Position(0.5), Position(-5.0)]


def test_a_scan_that_is_left_in_the_middle_of_a_move_stops_the_stage():
    with make_rig() as rig:
        with SweepScan(rig, VerticalPlan(0.0, 1.0, speed=1.0)) as scan:
            scan.read(ROOM)
        assert rig.stage.stops
        assert rig.stage.moves[-1] == Position(1.0)


def interrupt(scan, blocks):
    with scan:
        blocks.extend(scan.read(ROOM) for _ in range(20))
        raise KeyboardInterrupt


def test_positions_of_a_scan_that_was_cut_short_are_the_live_ones():
    blocks = []
    with make_rig() as rig:
        scan = SweepScan(rig, VerticalPlan(0.0, 1.0, speed=2.0))
        with pytest.raises(KeyboardInterrupt):
            interrupt(scan, blocks)
    np.testing.assert_array_equal(scan.positions()["travel"], joined(blocks, "travel"))


def test_a_stage_that_rests_elsewhere_is_not_believed(monkeypatch):
    with make_rig() as rig:
        astray = Report(0.0, Position(0.4), "idle")
        scan = StepScan(rig, VerticalPlan(0.0, 1.0, step=0.5), settle=0.0)
        _ = scan.header
        monkeypatch.setattr(rig, "go", lambda place, speed=None: astray)
        with pytest.raises(HardwareError, match="from its target"):
            drain(scan)


def test_a_recording_of_a_sweep_that_rests_elsewhere_is_cut_short(monkeypatch, tmp_path):
    with make_rig() as rig, monkeypatch.context() as patch:
        scan = SweepScan(rig, VerticalPlan(0.0, 1.0, speed=1.0))
        _ = scan.header
        patch.setattr(rig, "end", lambda move: Report(0.0, Position(0.4), "idle"))
        recorder = StreamRecorder(scan, tmp_path / "press.h5")
        with pytest.raises(HardwareError, match="from its target"), recorder:
            drain(recorder)
    assert re.fullmatch("cut short: .* from its target: .*", recorder.state)
