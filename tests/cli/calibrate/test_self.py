"""`mirrorskin calibrate self`: from touches of unknown objects to a response."""

import json
import math
import shutil

import numpy as np
import pytest
from commands import done, refused
from stacks import record

from mirrorskin import io
from mirrorskin.evaluation.calibration import elastic_touches
from mirrorskin.evaluation.calibration.scenes import press_for
from mirrorskin.evaluation.calibration.touches import FURTHER, LAB, camera_of, references_of, touch
from mirrorskin.io.files.touch_file import save_touch
from mirrorskin.twin import Axial, Camera, Twin, Vertical

TILT = math.radians(3.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A press and a turn."""
    folder = tmp_path_factory.mktemp("touch")
    thing = {"object": "sphere", "shape": (48, 48), "pixel_size": 0.1}
    press = Twin(movement=Vertical(0.03 * np.arange(1, 60)), camera=Camera(seed=1), **thing)
    movement = Axial(np.arange(12) * np.pi / 6, tilt=TILT, press=1.5)
    turn = Twin(movement=movement, pattern="linear", camera=Camera(seed=2), **thing)
    record(press, folder / "press.h5")
    record(turn, folder / "turn.h5")
    return folder


@pytest.fixture(scope="module")
def fitted(folder, tmp_path_factory):
    """What a press and a turn tell: the printed numbers, and the calibration."""
    path = tmp_path_factory.mktemp("fitted") / "cal.h5"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return json.loads(done("calibrate self press.h5 turn.h5 --json -o", path).out), path


@pytest.fixture(autouse=True)
def here(folder, tmp_path):
    for path in folder.iterdir():
        (tmp_path / path.name).symlink_to(path)


def test_response_and_movement_are_written(fitted):
    calibration = io.open_calibration(fitted[1])
    assert calibration.response.touches == 1
    assert abs(calibration.precession.tilt - TILT) < 4 * calibration.precession.sigma["tilt"]


def test_recording_of_a_touch_is_a_press_and_its_turn(fitted):
    with io.open_recording("press.h5") as press, io.open_recording("turn.h5") as turn:
        save_touch("touch.h5", press, turn)
    done("calibrate self touch.h5 -o one.h5")
    of_two, of_one = (io.open_calibration(path).response for path in (fitted[1], "one.h5"))
    np.testing.assert_array_equal(of_one.gain, of_two.gain)


def test_turn_without_a_press_is_used_as_far_as_it_goes():
    actual = done("calibrate self turn.h5 -o cal.h5")
    assert io.open_calibration("cal.h5").response.touches == 1
    assert "zenith gain (±" in actual.said
    assert "add a press of the same touch before each turn" in actual.said


def test_turn_without_a_press_is_added_to_touches(fitted):
    shutil.copy(fitted[1], "cal.h5")
    done("calibrate self press.h5 turn.h5 turn.h5 -o cal.h5")
    assert io.open_calibration("cal.h5").response.touches == 3


def test_touches_are_added(fitted):
    shutil.copy(fitted[1], "cal.h5")
    done("calibrate self press.h5 turn.h5 -o cal.h5")
    assert io.open_calibration("cal.h5").response.touches == 2


def test_touches_that_are_added_have_the_response_of_the_file(fitted):
    shutil.copy(fitted[1], "cal.h5")
    refused(
        "added to the response of the calibration. Remove --zenith-gain and --zenith-offset",
        "calibrate self press.h5 turn.h5 -o cal.h5 --zenith-gain 6.3/deg --zenith-offset -60",
    )


def test_numbers_have_standard_errors(fitted):
    printed, _ = fitted
    gain = printed["estimates"]["zenith_gain"]
    assert 0 < gain["sigma"] < 0.1 * gain["value"]
    assert len(printed["frame_gains"]["turn.h5"]) == 12


def test_stated_number_that_touches_contradict_is_reported():
    actual = done("calibrate self press.h5 turn.h5 -o cal.h5 --stated zenith_offset=-20+-1")
    assert "the touches say" in actual.said


def test_compliance_of_a_calibrated_gel_is_written():
    for recording, name in zip(elastic_touches.touch("cone", 0), ("cone.h5", "turned.h5"), strict=True):
        record(recording, name)
    camera = io.CameraId("", elastic_touches.SHAPE, np.dtype("uint8"))
    io.update_calibration("gel.h5", elastic_touches.calibration(0.03).gel, camera, {})
    printed = json.loads(done("calibrate self cone.h5 turned.h5 --json -o gel.h5").out)
    gel = io.open_calibration("gel.h5").gel
    assert gel.compliance == printed["estimates"]["compliance"]["value"]
    assert gel.sigma["compliance"] < elastic_touches.ERROR


def test_show_prints_the_response(fitted):
    assert "zenith gain" in done("calibrate show", fitted[1]).out


def test_show_repeats_each_note_once():
    said = done("calibrate self turn.h5 -o cal.h5").said
    shown = done("calibrate show cal.h5").out
    notes = [line for line in said.splitlines() if line.startswith("note: ")]
    assert [line for line in shown.splitlines() if line.startswith("note: ")] == notes


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("press.h5", "has no turn"),
        ("press.h5 press.h5", "another press"),
        ("press.h5 turn.h5 --stated tilt=2deg", "NAME=VALUE+-SIGMA"),
        ("press.h5 turn.h5 --stated weight=2+-1", "cannot be stated"),
        ("press.h5 turn.h5 --body-radius 17.5mm", "give both"),
        ("turn.h5 --travel-step 0.1mm", "applies to presses"),
        ("turn.h5 --stated pixel_size=0.1mm+-0.001mm", "turns alone do not depend on it"),
        (
            "press.h5 turn.h5 --body-radius 17.5mm --body-height 40mm --zenith-gain 6.3/deg",
            "follows from its geometry and the references. Remove --zenith-gain",
        ),
    ],
)
def test_what_cannot_be_used_is_refused(arguments, message):
    refused(message, f"calibrate self {arguments} -o cal.h5")


def test_wall_is_found_without_a_ball():
    taken = references_of(LAB)
    press, turn = touch(LAB, FURTHER, press_for(FURTHER), 1, taken)
    record(press, "press.h5")
    record(turn, "turn.h5")
    io.update_calibration("cal.h5", taken, camera_of(LAB))
    said = done("calibrate self press.h5 turn.h5 -o cal.h5 --body-radius 17.5mm --body-height 40mm").out
    assert "radius 17." in said
    assert io.open_calibration("cal.h5").zenith.touches == 1
