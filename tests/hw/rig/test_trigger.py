"""A line of the emulated controller triggers the emulated camera, frame by frame."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from commands import run
from rig_fakes import fake_rig
from simulated import simulate

from mirrorskin import io
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.rig import check
from mirrorskin.hw.rig import rig as rigs
from mirrorskin.hw.rig.plans import VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.scan import StepScan
from mirrorskin.hw.rig.sweep import SweepScan
from mirrorskin.io import InputError
from mirrorskin.twin.emulator.rig import EmulatedRig

SCENE = {"shape": (24, 32), "pixel_size": 0.2, "rate": 40.0}
STEPS = ("--stop", "1mm", "--step", "500um", "--settle", "0s", "--frames", "2")


@pytest.fixture
def emulated(clock):
    """A rig whose camera is triggered by the coolant's line, or a freely running one as if it were."""
    with ExitStack() as stack, pytest.MonkeyPatch.context() as patch:

        def make(line="coolant", free=False):
            trigger = None if free else line
            rig = stack.enter_context(
                EmulatedRig("sphere", trigger=trigger, delay=0.02, clock=clock, **SCENE)
            )
            camera = msgspec.structs.replace(rig.settings.camera, trigger=line, dark=16)
            simulate(patch, clock, rig.open_stage, lambda settings: rig.camera)
            return rig, replace(rig.settings, camera=camera)

        yield make


def is_on(rig, line="coolant"):
    return len(rig.machine.switched(line)) % 2 == 1


def drain(scan):
    """Return the travels of all frames."""
    travel = []
    while (block := scan.read()) is not None:
        travel += block.travel.tolist()
    return travel


@pytest.mark.parametrize("line", ["coolant", "spindle"])
def test_each_frame_of_steps_is_triggered_once_at_rest(emulated, line):
    rig, settings = emulated(line)
    plan = VerticalPlan(0.0, 1.0, step=0.5)
    with rigs.open_rig(settings, steps=True) as opened, StepScan(opened, plan, settle=0.0, frames=2) as scan:
        travel = drain(scan)
    switched = rig.machine.switched(line)
    assert travel == [0, 0, 0.5, 0.5, 1, 1]
    assert len(switched) == 12  # on and off, for each
    assert not any(rig.machine.moving(at) for at in switched)
    assert [rig.where(at).travel for at in switched[::2]] == pytest.approx(travel)
    assert rig.camera.counts.frames == 6


def test_a_capture_in_steps_is_triggered_from_the_command_line(emulated, tmp_path):
    rig, _ = emulated()
    file = rig.write(tmp_path / "rig", "genicam:")
    ended = run("capture", "vertical", "--rig", file, "-o", tmp_path / "press.h5", *STEPS)
    assert ended.code == 0, ended.said
    with io.open_recording(tmp_path / "press.h5") as recording:
        assert (recording.shape, recording.state) == ((6, 24, 32), "complete")
        assert recording.header.dark is not None
    assert rig.camera.counts.frames == 16 + 6  # the dark reference, too
    assert not is_on(rig)


def test_a_missing_frame_ends_a_capture_in_one_line_and_the_line_is_off(emulated, tmp_path):
    rig, _ = emulated()
    file = rig.write(tmp_path / "rig", "genicam:")
    rig.camera.stall()
    ended = run("capture", "vertical", "--rig", file, "-o", tmp_path / "press.h5", *STEPS)
    assert ended.code == 1
    assert (
        "delivered no frame within 2.02 s of its trigger: check the controller's output 'coolant'"
        in ended.said
    )
    assert len(rig.machine.switched("coolant")) == 2


def test_a_camera_that_runs_freely_is_a_fault(emulated):
    _, settings = emulated(free=True)
    with (
        rigs.open_rig(settings, steps=True) as opened,
        StepScan(opened, VerticalPlan(0.0, 1.0, step=0.5), settle=0.0) as scan,
        pytest.raises(HardwareError, match=r"delivered frames without a trigger \(\d+\): check that it is"),
    ):
        drain(scan)


def test_a_surplus_frame_after_the_last_trigger_is_a_fault(emulated):
    rig, settings = emulated()
    with (
        rig.open_stage(settings.stage) as stage,
        Rig(stage, rig.camera, settings, rig.clock) as opened,
        StepScan(opened, VerticalPlan(0.0, 1.0, step=1.0), settle=0.0) as scan,
    ):
        for _ in range(2):
            scan.read()
        came = rig.camera.counts.frames
        stage.switch("coolant", True)
        rig.clock.sleep(0.1)
        assert rig.camera.counts.frames == came + 1
        with pytest.raises(HardwareError, match=r"delivered frames without a trigger \(1\)"):
            scan.read()


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_the_line_is_off_whatever_interrupts(emulated, monkeypatch, error):
    rig, settings = emulated()
    calls = []

    def interrupt(limit, timeout):
        calls.append(is_on(rig))
        raise error

    with pytest.raises(error), rigs.open_rig(settings, steps=True) as opened:  # noqa: PT012
        monkeypatch.setattr(opened.camera, "take", interrupt)
        opened.take(1)
    assert calls == [True]
    assert not is_on(rig)


def test_a_stop_of_the_stage_switches_the_line_off(emulated):
    rig, settings = emulated()
    with rig.open_stage(settings.stage) as stage:
        stage.switch("coolant", True)
        assert is_on(rig)
        stage.stop()
        rig.clock.sleep(0.5)
        assert not is_on(rig)


def test_what_needs_frames_all_the_time_is_refused(emulated, tmp_path):
    rig, settings = emulated()
    file = rig.write(tmp_path / "rig", "genicam:")
    words = ("--rig", file, "--stop", "1mm", "--speed", "1mm/s")
    for ended in (
        run("capture", "vertical", "-o", tmp_path / "press.h5", *words),
        run("rig", "probe", file, "--from", "-1mm"),
    ):
        assert ended.code == 2
        assert "camera.trigger works only for captures in steps: give" in ended.said
    with (
        rig.open_stage(settings.stage) as stage,
        Rig(stage, rig.camera, settings, rig.clock) as opened,
        pytest.raises(InputError, match=r"camera\.trigger works only for captures in steps"),
    ):
        SweepScan(opened, VerticalPlan(0.0, 1.0, speed=1.0))


def test_a_stage_that_has_no_line_is_refused():
    with pytest.raises(
        InputError, match=r"^fake stage: camera.trigger needs a GRBL controller; remove it from the rig file$"
    ):
        fake_rig(lambda place: np.zeros((8, 8), np.uint8), stated={"trigger": "coolant"})


def test_a_stage_that_has_no_line_is_not_homed(monkeypatch):
    with fake_rig(lambda place: np.zeros((3, 4), np.uint8)) as rig:
        homed = []
        monkeypatch.setattr(rig.stage, "home", lambda: homed.append(True), raising=False)
        stage = msgspec.structs.replace(rig.settings.stage, firmware="own:Stage", home=True)
        camera = msgspec.structs.replace(rig.settings.camera, trigger="coolant")
        opened = {"open_stage": lambda _: rig.stage, "open_camera": lambda _: rig.camera}
        with pytest.raises(InputError, match="needs a GRBL controller"):
            rigs.open_rig(replace(rig.settings, stage=stage, camera=camera), True, clock=rig.clock, **opened)
        assert homed == []


def test_rig_check_triggers_a_few_frames(emulated):
    rig, settings = emulated()
    actual = {result.what: result for result in check.check_rig(settings)}
    assert actual["trigger"].found.startswith("3 frames, at most ")
    assert actual["brightness"].verdict == "ok"
    assert not is_on(rig)
