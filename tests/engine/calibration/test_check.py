import math
from dataclasses import replace

import numpy as np
import pytest
from stacks import ball
from walls import response_of_twin

from mirrorskin import io
from mirrorskin.engine.calibration.check import check_ball
from mirrorskin.evaluation.calibration import scorer
from mirrorskin.evaluation.calibration.scenes import Frames, Thing
from mirrorskin.twin import Axial, Body, Camera, Twin

SHAPE, PIXEL = (71, 80), 0.08
TRAVEL = np.arange(0, 1.3, 0.02)


@pytest.fixture(scope="module")
def press():
    """The paper's idealisation: a ball of 10 mm, whose heights are found as they are."""
    return ball(SHAPE, PIXEL, TRAVEL, dtype="uint8", noise=1.5, seed=3)


def calibration(shape=SHAPE, **parts):
    dark, bright = np.full(shape, 16, np.float32), np.full(shape, 224, np.float32)
    little = np.full(shape, 0.1, np.float32)
    references = io.References(dark, bright, little, little, np.zeros(shape, np.uint8))
    return io.Calibration(io.CameraId("", shape, np.dtype("uint8")), references, **parts)


def test_a_sound_press_leaves_little(press):
    check = check_ball(press, calibration(), 10.0)
    height = check.after["height"]
    assert check.place == pytest.approx((0, 0), abs=0.02)
    assert float(height.whole.bias) == pytest.approx(0, abs=0.005)
    assert float(height.whole.rms) < 0.02
    assert int(height.whole.pixels) > 1000
    assert check.before == {}


def test_a_ball_of_another_size_shows(press):
    right, wrong = (check_ball(press, calibration(), size).after["height"] for size in (10.0, 8.0))
    assert float(wrong.whole.rms) > 3 * float(right.whole.rms)


def test_a_ball_is_found_next_to_the_middle(press):
    press.rewind()
    frames = np.empty(press.shape, press.dtype)
    press.read(frames)
    aside = Frames(np.roll(frames, 5, axis=2), press.header, "aside", travel=press.travel)
    assert check_ball(aside, calibration(), 10.0).place == pytest.approx((5 * PIXEL, 0), abs=0.03)


def test_the_cells_add_up_to_the_whole(press):
    height = check_ball(press, calibration(), 10.0, cells=5).after["height"]
    assert height.cells.rms.shape == (5, 5)
    assert height.cells.pixels.sum() == int(height.whole.pixels) == np.isfinite(height.error).sum()
    finite = np.isfinite(height.cells.rms)
    squares = (height.cells.pixels * height.cells.rms**2)[finite].sum()
    assert math.sqrt(squares / height.cells.pixels[finite].sum()) == pytest.approx(
        float(height.whole.rms), rel=0.1
    )


def test_what_the_table_has_no_number_for_is_explained(press):
    assert check_ball(press, calibration(), 10.0).notes() == []
    fine = check_ball(press, calibration(), 10.0, cells=40)  # of 2 x 2 pixels
    assert fine.table()[0][4] == "-"
    (note,) = fine.notes()
    assert "no cell has 20 pixels of height" in note
    (height,) = fine.after.values()
    bare = replace(height, expected=math.nan)
    maps = {"zenith": bare, "azimuth": bare, "normal": height}
    check = replace(fine, after=maps, before=maps | {"normal": bare})
    assert check.notes()[0] == "expected: results contain no standard deviation of zenith or azimuth alone"
    assert "of zenith and azimuth and normal that" in check.notes()[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [({"rewindable": False}, "cannot be read twice"), ({"motion": "twist"}, "twist motion")],
)
def test_what_cannot_be_checked_is_refused(press, change, message):
    source = Frames(np.zeros((3, *SHAPE), np.uint8), press.header, "press", travel=np.arange(3.0))
    for name, value in change.items():
        setattr(source, name, value)
    with pytest.raises(io.InputError, match=message):
        check_ball(source, calibration(), 10.0)


@pytest.mark.parametrize(
    ("ball_size", "cells", "message"),
    [(-1.0, 8, "diameter is -1 mm"), (math.nan, 8, "diameter is nan mm"), (4.0, 0, "0 cells a side: give 1")],
)
def test_numbers_out_of_range_are_refused(press, ball_size, cells, message):
    with pytest.raises(io.InputError, match=message):
        check_ball(press, calibration(), ball_size, cells=cells)


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_a_press_on_nothing_is_reported(press):
    source = Frames(np.full((len(TRAVEL), *SHAPE), 16, np.uint8), press.header, "nothing", travel=TRAVEL)
    with pytest.raises(io.InputError, match="too little of a ball"):
        check_ball(source, calibration(), 10.0)


def test_a_rotation_needs_a_zenith(press):
    header = replace(press.header, motion="axial")
    source = Frames(np.zeros((8, *SHAPE), np.uint8), header, "turn", phase=np.arange(8.0))
    with pytest.raises(io.InputError, match="calibrate zenith first"):
        check_ball(source, calibration(), 10.0)


def test_a_rotation_about_a_ball_is_judged_with_the_wall_and_as_it_was_designed():
    shape, pixel, body, distance = (64, 64), 0.12, Body(asymmetry=0.05, asymmetry_azimuth=1.0), 150.0
    phase = np.arange(8) * np.pi / 4
    twin = Twin(
        object=Thing(scorer.ball(6.0, (0.5, -0.4))),
        shape=shape,
        pixel_size=pixel,
        movement=Axial(phase, math.radians(2.5), 0.7),
        optics="cylinder",
        pattern="linear",
        body=body,
        camera=Camera(noise=1.0, seed=3, distance=distance),
        references="exact",
    )
    frames = np.empty(twin.shape, twin.dtype)
    twin.read(frames)
    header, little = twin.header, np.full(shape, 0.1, np.float32)
    references = io.References(header.dark, header.bright, little, little, np.zeros(shape, np.uint8))
    zenith = response_of_twin(shape, pixel, body, distance)
    calibrated = io.Calibration(io.CameraId("", shape, np.dtype("uint8")), references, zenith=zenith)
    check = check_ball(Frames(frames, header, "turn", phase=phase), calibrated, 6.0, cells=4)
    assert check.place == pytest.approx((0.5, -0.4), abs=0.03)
    before, after = check.before, check.after
    assert abs(float(after["zenith"].whole.bias)) < 0.2
    assert float(after["normal"].whole.rms) < 1.0
    assert float(before["zenith"].whole.rms) > 2 * float(after["zenith"].whole.rms)
    assert float(after["height"].whole.rms) < float(before["height"].whole.rms)
    assert [row[:2] for row in check.table()][:2] == [["zenith", "before"], ["zenith", "after"]]
