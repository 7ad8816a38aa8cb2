"""``--calibration`` of reconstruct, capture and live: effects, written values, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibrations import a_calibration, assert_same
from commands import done, refused
from rig_fakes import fake_rig, settings, spreading
from stacks import MadeUp, record

from mirrorskin import engine, io
from mirrorskin.evaluation.scenes.rotations import TILT, Setup, between, direction, expose
from mirrorskin.hw.base import rig_file as file
from mirrorskin.hw.rig import rig

SHAPE = (9, 11)
X, Y = np.meshgrid(np.linspace(-1, 1, 11), np.linspace(1, -1, 9))
ZENITH, AZIMUTH = np.radians(10 + 40 * np.hypot(X, Y) / np.sqrt(2)), np.arctan2(Y, X)
SETUP = Setup(gain=400.0, noise=10.0, offset=2000.0, dtype="uint16")
TURN = io.Header(
    "axial",
    pixel_size=(0.1, 0.1),
    press=1.0,
    tilt=TILT,
    zenith_gain=np.array(SETUP.slope),
    zenith_offset=np.array(SETUP.offset),
    camera="left",
)
TRAVEL = np.arange(8) * 0.1


def save(name="cal.h5", camera="left", dtype="uint8", shape=SHAPE, **parts):
    calibration = io.Calibration(io.CameraId(camera, shape, np.dtype(dtype)), **parts)
    io.save_calibration(calibration, name)
    return calibration


def flat_references(dark=20.0, bright=220.0):
    full = np.ones(SHAPE, np.float32)
    return io.References(dark * full, bright * full, full, full, np.zeros(SHAPE, np.uint8))


def press(name="press.h5", **options):
    """Record pixels that turn light one after the other, by a recording whose own references are wrong."""
    steps = np.linspace(0.15, 0.55, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    fraction = np.clip((TRAVEL[:, None, None] - steps) / 0.2 + 0.5, 0, 1)
    frames = np.rint(20 + 200 * fraction).astype(np.uint8)
    wrong = {"dark": np.zeros(SHAPE, np.float32), "bright": np.full(SHAPE, 60, np.float32)}
    header = io.Header("vertical", pixel_size=(0.1, 0.1), camera="left", **wrong)
    source = MadeUp(frames, header, travel=TRAVEL)
    with io.Recorder(source, name, **options) as recorder:
        recorder.drain(lambda count: None)
    return steps


def turn(name="turn.h5", phase=SETUP.phase):
    """Record a rotation over a dome, which says these phases."""
    frames = expose(direction(ZENITH, AZIMUTH), SETUP, seed=3)
    return record(MadeUp(frames, TURN, phase=np.array(phase)), Path(name))


def reconstruct(name, *words):
    done("reconstruct", name, "-o", "out.h5", "--overwrite", *words)
    return io.open_result("out.h5")


def bias(result, steps):
    return float(np.max(np.abs(-result.height - steps)))


def test_a_press_is_reconstructed_with_the_references_of_the_calibration():
    steps, calibration = press(), save(references=flat_references())
    without, result = reconstruct("press.h5"), reconstruct("press.h5", "--calibration", "cal.h5")
    assert bias(result, steps) < 0.005
    assert bias(without, steps) > 0.02
    assert_same(result.calibration, calibration)
    assert (result.process["calibration"], result.process["calibration_parts"]) == ("cal.h5", "references")
    assert result.process["source_region"] == "0,0,11x9"
    assert without.calibration is None
    assert "calibration" not in without.process
    by_hand = reconstruct("press.h5", "--dark", "20", "--bright", "220")
    np.testing.assert_array_equal(result.height, by_hand.height)


def test_a_calibration_that_is_carried_is_used_unless_another_is_given():
    carried = replace(a_calibration(SHAPE, only=[]), references=flat_references())
    steps = press(calibration=carried)
    other = save(references=flat_references(dark=100.0))
    result = reconstruct("press.h5")
    assert bias(result, steps) < 0.005
    assert result.process["calibration"] == "the calibration in press.h5"
    assert_same(result.calibration, carried)
    replaced = reconstruct("press.h5", "--calibration", "cal.h5")
    assert bias(replaced, steps) > 0.02
    assert_same(replaced.calibration, other)
    press("plain.h5")
    from_a_result = reconstruct("plain.h5", "--calibration", "press.h5")
    np.testing.assert_array_equal(from_a_result.height, result.height)


def test_normals_of_a_stage_that_goes_round_otherwise_are_right_with_its_precession():
    turn(phase=[0.4 - phase for phase in SETUP.phase])
    precession = io.Precession(TILT, 0.4, -1, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0, 5.0))
    save(dtype="uint16", precession=precession)
    true = direction(ZENITH, AZIMUTH)
    without, result = reconstruct("turn.h5"), reconstruct("turn.h5", "--calibration", "cal.h5")
    assert np.degrees(np.median(between(without.normals, true))) > 5
    assert np.degrees(np.median(between(result.normals, true))) < 1
    assert result.process["calibration_parts"] == "tilt"


# What is refused, in one line and with exit code 2, before anything is written.


def older(path):
    import h5py

    with h5py.File(path, "r+") as opened:
        opened["entry"].attrs["mirrorskin_calibration"] = 0


REFUSALS = [
    ({"shape": (9, 12)}, None, "cal.h5 is of 12 x 9 pixels, {} of 11 x 9: calibrate again"),
    ({}, older, "cal.h5 contains a calibration of an older layout, 0, where 1 is read: calibrate again"),
    ({}, lambda path: path.unlink(), "cal.h5: no such file"),
]


@pytest.mark.parametrize(("options", "change", "message"), REFUSALS)
def test_a_wrong_calibration_is_refused_by_reconstruct(options, change, message):
    press()
    save(**options)
    if change is not None:
        change(Path("cal.h5"))
    refused(message.format("press.h5"), "reconstruct press.h5 -o out.h5 --calibration cal.h5")
    assert not Path("out.h5").exists()


@pytest.mark.parametrize(("options", "change", "message"), REFUSALS[1:])
@pytest.mark.parametrize("command", ["capture", "live"])
def test_a_wrong_calibration_is_refused_before_the_stage_is_opened(
    monkeypatch, command, options, change, message
):
    monkeypatch.setattr(file, "load_rig", lambda path: settings(SHAPE, name="left"))
    monkeypatch.setattr(rig, "open_rig", None)
    Path("rig.toml").touch()
    save(**options)
    if change is not None:
        change(Path("cal.h5"))
    words = ["vertical", "--rig", "rig.toml", "--stop", "1mm", "--step", "1mm", "--calibration", "cal.h5"]
    refused(message.format("fake"), command, *words, *(["-o", "rec.h5"] if command == "capture" else []))


def test_the_calibration_is_not_overwritten():
    press()
    save()
    before = Path("cal.h5").read_bytes()
    refused("is the input", "reconstruct press.h5 -o cal.h5 --calibration cal.h5")
    assert Path("cal.h5").read_bytes() == before


# Of a rig.


@pytest.fixture
def fake(clock, monkeypatch):
    """A rig whose file is read and which is opened without hardware; its own references are wrong."""
    rig_options = {"pixel_size": (0.2, 0.2), "delay": 0.0, "rate": 60.0, "name": "left", "bright": 255.0}

    monkeypatch.setattr(file, "load_rig", lambda path: settings(SHAPE, **rig_options))
    monkeypatch.setattr(
        rig, "open_rig", lambda *_: fake_rig(spreading(SHAPE), clock, rate=60.0, stated=rig_options)
    )
    Path("rig.toml").touch()


PRESS = ("vertical", "--rig", "rig.toml", "--stop", "0.8mm", "--speed", "2mm/s", "--calibration", "cal.h5")


def test_a_capture_carries_the_calibration_and_keeps_the_rig_s_own_references(fake):
    calibration = save(references=flat_references())
    done("capture", *PRESS, "-o", "rec.h5")
    with io.open_recording("rec.h5") as recording:
        assert_same(recording.carried, calibration)
        assert recording.header.camera == "left"
        assert np.all(recording.header.bright == 255)
        dark = recording.header.dark
        assert io.Calibrated(recording, recording.carried).header.dark[0, 0] == 20
        assert dark[0, 0] != 20


def test_live_uses_the_calibration_and_carries_it_in_what_it_writes(fake):
    calibration = save(references=flat_references())
    done("live", *PRESS, "--latency", "5s", "--record", "rec.h5", "-o", "out.h5")
    result = io.open_result("out.h5")
    assert_same(result.calibration, calibration)
    assert result.process["calibration"] == "cal.h5"
    with io.open_recording("rec.h5", live=True) as recording:
        assert_same(recording.carried, calibration)
        replayed = engine.reconstruct(recording, fill=False)
    measured = result.filled == 0
    np.testing.assert_array_equal(replayed.status, result.status)
    np.testing.assert_array_equal(replayed.height[measured], result.height[measured])
