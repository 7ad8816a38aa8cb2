"""The application's rig, on simulated time: it displays, moves, runs, and always stops."""

import re
from types import SimpleNamespace

import numpy as np
import panel as pn
import pytest
from simulated import simulate

from mirrorskin import engine, io
from mirrorskin.hw.rig.plans import HorizontalPlan, RockPlan, TwistPlan
from mirrorskin.hw.stages.grbl import GrblStage
from mirrorskin.twin.emulator.rig import EmulatedRig
from mirrorskin.view.app import App
from mirrorskin.view.app.page import pages
from mirrorskin.view.app.rig import RigPane
from mirrorskin.view.app.rig_control import RigControl, axial_plan, judge, vertical_plan

SHAPE, PIXEL, RATE = (24, 32), 0.3, 50.0
LONG = 120.0  # simulated seconds, after which what should have happened never will


@pytest.fixture(params=[False])
def emulated(request, clock, monkeypatch):
    """An emulated rig, the control of it, and means to wait; the parameter says whether it has switches."""
    with EmulatedRig(
        shape=SHAPE, pixel_size=PIXEL, rate=RATE, delay=0.05, clock=clock, home=request.param
    ) as rig:
        simulate(monkeypatch, clock, rig.open_stage, rig.open_camera)
        control = RigControl(rig.settings, clock=clock)

        def until(condition):
            end = clock.now() + LONG
            while not condition():
                assert clock.now() < end, (control.state, control.problem)
                clock.sleep(0.02)

        yield SimpleNamespace(rig=rig, control=control, until=until, clock=clock)
        control.close()


@pytest.fixture
def ready(emulated):
    """The same, connected, with a picture."""
    emulated.control.connect()
    emulated.until(lambda: emulated.control.state == "ready" and emulated.control.seen.frame is not None)
    return emulated


def travel(emulated):
    return emulated.rig.where(emulated.clock.now()).travel


def ended(emulated):
    """Whether the thread that drives the rig has left it."""
    return emulated.control.state == "disconnected"


def test_nothing_moves_before_it_is_connected(emulated):
    before = travel(emulated)
    emulated.clock.sleep(1)
    emulated.control.jog("travel", 0.5)
    emulated.clock.sleep(1)
    assert travel(emulated) == before
    assert emulated.control.problem == "Connect first."


def test_the_live_picture_goes_on(ready):
    frames = ready.control.seen.frames
    ready.clock.sleep(1)
    assert ready.control.seen.frames > frames + RATE / 2
    assert ready.control.seen.frame.shape == SHAPE


def test_a_jog_moves_by_the_step(ready):
    before = travel(ready)
    ready.control.jog("travel", 0.25)
    ready.until(lambda: ready.control.state == "ready" and not ready.rig.machine.moving())
    ready.until(lambda: abs(travel(ready) - before - 0.25) < 1e-3)


def test_pictures_come_while_the_stage_moves(ready):
    ready.control.jog("travel", 2.0)
    ready.until(lambda: ready.control.state == "moving")
    frames = ready.control.seen.frames
    ready.clock.sleep(0.5)
    assert ready.control.state == "moving"
    assert ready.control.seen.frames > frames


def test_a_jog_beyond_the_limits_is_refused_and_nothing_moves(ready):
    before = travel(ready)
    ready.control.jog("travel", 50.0)
    ready.until(lambda: ready.control.problem != "")
    assert "beyond the axis" in ready.control.problem
    assert ready.control.state == "ready"
    assert travel(ready) == before


def test_a_second_request_waits_for_the_first(ready):
    ready.control.jog("travel", 2.0)
    ready.until(lambda: ready.control.state == "moving")
    ready.control.lift()
    assert ready.control.problem == "Wait until the stage rests."


@pytest.fixture
def lit(clock, monkeypatch):
    """The control of a connected rig whose wall shows slopes."""
    scene = {"shape": (48, 64), "pixel_size": 0.06, "pattern": "linear"}
    with EmulatedRig(rate=20.0, clock=clock, **scene) as rig:
        simulate(monkeypatch, clock, rig.open_stage, rig.open_camera)
        control = RigControl(rig.settings, clock=clock)
        control.connect()
        while control.state != "ready":
            clock.sleep(0.02)
        yield SimpleNamespace(rig=rig, control=control, clock=clock)
        control.close()


def test_a_touch_shows_its_surface_and_is_recorded(lit, tmp_path):
    pane = RigPane(lit.control, lambda *shown: None)
    pane.motion.value = "touch"
    pane.touch["sigma"].value = 20.0
    pane.touch["region"].value = "52,20,10x8"
    pane.file.value = str(tmp_path / "frames.h5")
    pane._start()
    while lit.control.state != "moving":
        lit.clock.sleep(0.02)
    while lit.control.state == "moving":
        lit.clock.sleep(0.1)
    pane.refresh()
    assert "the request is met" in pane.run.object, lit.control.problem
    assert np.isfinite(lit.control.result.height).any()
    with io.open_recording(tmp_path / "frames.h5", dataset="turn") as turn:
        assert turn.motion == "axial"


@pytest.mark.parametrize(
    ("region", "words"), [("16,12", "Region .*: give the first column"), ("0,0,99x24", "a region of columns")]
)
def test_an_impossible_region_of_a_touch_is_refused(lit, region, words):
    pane = RigPane(lit.control, lambda *shown: None)
    pane.motion.value = "touch"
    pane.touch["region"].value = region
    pane._start()
    while lit.control.state == "moving" or not lit.control.problem:
        lit.clock.sleep(0.02)
    assert re.search(words, lit.control.problem)


def test_stop_ends_a_touch(lit):
    lit.control.touch(0.001, 0.95, 1.0, 0.04)
    while lit.control.state != "moving":
        lit.clock.sleep(0.02)
    lit.clock.sleep(1.0)
    lit.control.stop()
    while lit.control.state != "disconnected":
        lit.clock.sleep(0.02)
    assert "was stopped" in lit.control.problem


def test_stop_ends_a_move_at_once(ready):
    before = travel(ready)
    ready.control.jog("travel", 3.0)
    ready.until(lambda: travel(ready) > before + 0.1)
    ready.control.stop()
    ready.until(lambda: ended(ready) and not ready.rig.machine.moving())
    assert travel(ready) < before + 1.5
    assert "The stage was stopped." in ready.control.problem


@pytest.mark.parametrize("emulated", [True], indirect=True)
def test_stop_ends_the_homing_while_it_connects(emulated):
    emulated.control.connect()
    emulated.until(emulated.rig.machine.moving)
    assert emulated.control.state == "connecting"
    emulated.control.stop()
    emulated.until(lambda: ended(emulated) and not emulated.rig.machine.moving())


def test_stop_ends_a_run(ready):
    ready.control.run(vertical_plan(0.0, 2.0, 0.2))
    ready.until(lambda: ready.control.seen.update is not None and ready.rig.machine.moving())
    ready.control.stop()
    ready.until(lambda: ended(ready) and not ready.rig.machine.moving())
    assert "The stage was stopped." in ready.control.problem


@pytest.fixture
def slow_stop(emulated, monkeypatch):
    """Let each step of stopping take some time before and after it, seconds."""

    def delay(before, after):
        def stop(stage):
            emulated.clock.sleep(before)
            halt(stage)
            emulated.clock.sleep(after)

        halt = GrblStage.stop
        monkeypatch.setattr(GrblStage, "stop", stop)

    return delay


STOPS = [(0.15, 0, 0.3), (0, 0.15, 1.499), (1, 1, 1.499)]


def press_to(ready, path, end):
    """Start a recorded press to a travel of 1.5 mm, and wait until another travel is reached, mm."""
    ready.control.run(vertical_plan(0.0, 1.5, 0.5), path)
    ready.until(lambda: ready.control.seen.update is not None and travel(ready) >= end)


@pytest.mark.parametrize(
    ("before", "after", "end"),
    [
        pytest.param(before, after, end, marks=[] if (before, after, end) in STOPS else [pytest.mark.slow])
        for end in (0.3, 1.2, 1.499)
        for before, after in ((0, 0), (0.15, 0), (0, 0.15), (0.15, 0.15), (1, 1))
    ],
)
def test_a_stopped_recording_is_complete_only_at_its_last_travel(
    ready, slow_stop, tmp_path, before, after, end
):
    path = tmp_path / "run.h5"
    slow_stop(before, after)
    press_to(ready, path, end)
    ready.control.stop()
    ready.until(lambda: ended(ready))
    with io.open_recording(path) as recording:
        reached = recording.travel[-1] == pytest.approx(1.5, abs=0.01)
        assert reached or recording.state.startswith("cut short: "), recording.state


@pytest.mark.parametrize("seconds", [*[pytest.param(time, marks=pytest.mark.slow) for time in (0, 0.15)], 1])
def test_a_body_that_is_stopped_at_the_end_of_a_press_is_not_lifted(ready, slow_stop, tmp_path, seconds):
    slow_stop(seconds, seconds)
    press_to(ready, tmp_path / "run.h5", 1.4999)
    ready.control.stop()
    ready.until(lambda: ended(ready) and not ready.rig.machine.moving())
    assert travel(ready) == pytest.approx(1.5, abs=1e-3)


def test_a_run_that_was_asked_for_but_not_begun_does_not_move_after_closing(ready):
    before = travel(ready)
    ready.control.run(vertical_plan(0.0, 1.5, 0.5))
    ready.control.close()
    assert ended(ready)
    assert travel(ready) == before


def test_after_a_stop_it_can_be_connected_again(ready):
    ready.control.stop()
    ready.until(lambda: ended(ready))
    ready.control.connect()
    ready.until(lambda: ready.control.state == "ready")


def test_closing_stops_what_moves(ready):
    ready.control.jog("travel", 3.0)
    ready.until(ready.rig.machine.moving)
    ready.control.close()
    ready.until(lambda: not ready.rig.machine.moving())
    assert travel(ready) < -1.5


@pytest.mark.parametrize("fault", ["stall", "silence", "alarm", "bug"])
def test_a_fault_stops_the_stage_and_shows_the_reason(ready, fault):
    before = travel(ready)
    ready.control.jog("travel", 3.0)
    ready.until(lambda: travel(ready) > before + 0.1)
    if fault == "stall":
        ready.rig.camera.stall()
    elif fault == "silence":
        ready.rig.port.silence()
    elif fault == "alarm":
        ready.rig.machine.alarm(1)
    else:  # an error of the program itself
        ready.control._look = lambda rig: 1 / 0
    ready.until(lambda: ended(ready) and not ready.rig.machine.moving())
    assert travel(ready) < before + 2.5
    assert ready.control.problem


def test_a_run_shows_heights_records_and_returns_a_result(ready, tmp_path):
    path = tmp_path / "run.h5"
    ready.control.run(vertical_plan(0.0, 1.5, 0.5), path)
    ready.until(lambda: ready.control.result is not None and ready.control.state == "ready")
    assert ready.control.problem == ""
    assert np.isfinite(ready.control.result.height).sum() > 20
    assert ready.control.seen.update.height is not None
    assert ready.control.recorded == path
    with io.open_recording(path) as recording:
        assert recording.motion == "vertical"


class Light(engine.Operation):
    """Number of frames in which a pixel is bright."""

    light = io.Map("number of bright frames", "frames", dtype="int64", title="Bright frames")
    brightest = io.Map("largest brightness", "counts", axes="none", dtype="float64")

    def start(self, shape, dtype):
        self.light_frames, self.most = np.zeros(shape, np.int64), 0.0

    def push(self, frames):
        self.light_frames += (frames > 100).sum(axis=0)
        self.most = max(self.most, float(frames.max()))

    def result(self):
        return {"light": self.light_frames, "brightest": self.most}


def test_a_run_shows_the_maps_and_numbers_of_an_own_operation(emulated):
    control = RigControl(emulated.rig.settings, emulated.clock, Light)
    emulated.control = control
    pane = RigPane(control, lambda name, source: None)
    control.connect()
    emulated.until(lambda: control.state == "ready")
    control.run(vertical_plan(0.0, 1.5, 0.5))
    emulated.until(lambda: control.result is not None and control.state == "ready")
    pane.refresh()
    control.close()
    assert control.problem == ""
    assert control.seen.update.first == "light"
    np.testing.assert_array_equal(control.seen.update.light, control.result.light)
    assert pane.growing.figure.title.text == "Light (frames), while the stage moves"
    assert "Brightest" in pane.run.object
    assert " counts" in pane.run.object


def test_a_recording_that_exists_is_not_replaced(ready, tmp_path):
    path = tmp_path / "run.h5"
    path.write_text("mine")
    ready.control.run(vertical_plan(0.0, 1.5, 0.5), path)
    assert "exists" in ready.control.problem
    assert path.read_text() == "mine"
    assert ready.control.state == "ready"


def test_the_pane_shows_what_the_rig_shows(ready):
    pane = RigPane(ready.control, lambda name, source: None)
    assert pane.connect.disabled
    assert not pane.start.disabled
    assert "Saturated" in pane.facts.object
    assert "-4.000 mm" in pane._places["travel"].object
    pane.jogs["travel", 1].param.trigger("clicks")
    ready.until(lambda: abs(travel(ready) + 3.95) < 1e-3)


def test_the_stop_button_stops(ready):
    pane = RigPane(ready.control, lambda name, source: None)
    ready.control.jog("travel", 3.0)
    ready.until(ready.rig.machine.moving)
    pane.stop.param.trigger("clicks")
    ready.until(lambda: ended(ready) and not ready.rig.machine.moving())
    pane.refresh()
    assert not pane.connect.disabled
    assert "was stopped" in pane.state.object


def test_stop_is_at_the_head_whatever_the_page_shows(emulated, tmp_path):
    app = App(rig=emulated.control)
    app.add("a result", io.Result(height=np.zeros((8, 9), np.float32)))
    assert app.session is not None
    assert app.rig.stop in app.view[0]


@pytest.mark.parametrize(
    ("motion", "plan"),
    [
        ("slide", HorizontalPlan(1.0, 0.5, 0.0, speed=0.2, wait=0.5)),
        ("twist", TwistPlan(1.0, np.radians(10.0), speed=np.radians(4.0), wait=0.5)),
        ("rocking", RockPlan(1.0, np.radians(2.5), 0.0, speed=np.radians(2.0))),
    ],
)
def test_other_motions_are_run_from_the_page(ready, monkeypatch, motion, plan):
    asked = []
    monkeypatch.setattr(ready.control, "run", lambda plan, record: asked.append(plan))
    pane = RigPane(ready.control, lambda name, source: None)
    pane.motion.value = motion
    pane.start.param.trigger("clicks")
    assert asked == [plan]


def test_a_slide_is_run_and_has_a_result(ready):
    ready.control.run(HorizontalPlan(1.0, 0.3, speed=0.5))
    ready.until(lambda: ready.control.result is not None or ready.control.problem != "")
    assert ready.control.problem == ""
    pane = RigPane(ready.control, lambda name, source: None)
    assert "Frames used" in pane.run.object


def test_an_impossible_plan_is_refused(ready):
    pane = RigPane(ready.control, lambda name, source: None)
    pane.press["stop"].value = -1.0
    pane.start.param.trigger("clicks")
    assert "does not go down" in ready.control.problem


def test_a_run_without_a_possible_result_moves_nothing(ready):
    before = travel(ready)
    ready.control.run(axial_plan(0.5, 0.002, 1.0, 20.0))
    ready.until(lambda: ready.control.problem != "")
    assert "2.5 frames a turn: at least 3 are needed" in ready.control.problem
    assert ready.control.state == "ready"
    assert travel(ready) == before


def test_the_recording_of_a_run_is_opened(ready, tmp_path):
    app = App(rig=ready.control)
    app.rig.file.value = str(tmp_path / "run.h5")
    app.rig.start.param.trigger("clicks")
    ready.until(lambda: ready.control.result is not None and ready.control.state == "ready")
    app.rig.open.param.trigger("clicks")
    assert app.session.whole is not None
    app.close()


def test_closing_the_last_page_stops_the_rig(ready, monkeypatch):
    closed = []
    monkeypatch.setattr(
        type(pn.state), "on_session_destroyed", lambda state, callback: closed.append(callback)
    )
    with pages([], [], ready.control) as page:
        page()
        page()
        ready.control.jog("travel", 3.0)
        ready.until(ready.rig.machine.moving)
        closed[0](None)
        assert ready.rig.machine.moving()
        closed[1](None)
        ready.until(lambda: not ready.rig.machine.moving())
    assert ended(ready)


def test_saturation_and_sharpness_are_judged():
    frame = np.zeros((10, 10), np.uint8)
    frame[:5] = 255
    judged = judge(frame)
    assert judged.saturated == 0.5
    assert judged.counts.sum() == 100
    assert judged.sharpness > judge(np.full((10, 10), 9, np.uint8)).sharpness == 0
