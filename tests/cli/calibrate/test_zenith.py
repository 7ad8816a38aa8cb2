"""``mirrorskin calibrate zenith``: input of the fit, written and printed values, refusals."""

import json
from pathlib import Path

import numpy as np
import pytest
from calibrations import a_lens, a_precession, a_response, some_references
from commands import refused, run
from stacks import MadeUp, record

from mirrorskin import io
from mirrorskin.engine.calibration import wall
from mirrorskin.evaluation.scenes.rotations import TILT
from mirrorskin.io.model.calibrated import size_facts

SHAPE = (5, 7)
PHASE = np.arange(8) * np.pi / 4


@pytest.fixture
def folder(tmp_path):
    """Five recordings, place-1.h5 and so on, of a camera called left."""
    for number in range(1, 6):
        header = io.Header("axial", pixel_size=(0.1, 0.1), press=1.0, tilt=TILT, camera="left")
        frames = np.full((8, *SHAPE), 16 + number, np.uint8)
        record(MadeUp(frames, header, phase=PHASE), tmp_path / f"place-{number}.h5")
    return tmp_path


@pytest.fixture
def fitted(monkeypatch):
    """Take down what the fit is given; it answers with a response that is made up."""
    arguments = {}

    def fit_zenith(presses, ball, **options):
        arguments.update(options, ball=ball, names=[press.name for press in presses])
        arguments.update(tilts=[press.header.tilt for press in presses])
        arguments.update(sizes={press.header.pixel_size for press in presses})
        options["progress"](len(presses))
        return response()

    monkeypatch.setattr(wall, "fit_zenith", fit_zenith)
    return arguments


def response():
    made_up = a_response()
    names = ("radius", "rim", "axis_x", "axis_y", "sight_0", "lamp_x", "lamp_y", "scatter")
    fields = {name: getattr(made_up, name) for name in type(made_up).__slots__}
    return io.WallResponse(**fields | {"parameters": names, "covariance": np.diag(np.arange(1.0, 9) ** 2)})


def calibrate(*words, presses=5):
    names = [f"place-{number}.h5" for number in range(1, presses + 1)]
    return run("calibrate zenith", *names, "-o", "cal.h5", "--ball", "4mm", *words)


def test_a_response_is_added_to_a_calibration(folder, fitted):
    references, precession = some_references(), a_precession(tilt=TILT)
    camera = io.CameraId("left", SHAPE, np.dtype(np.uint8))
    io.save_calibration(io.Calibration(camera, references=references, precession=precession), "cal.h5")
    ended = calibrate("--body-radius", "18mm", "--body-height", "41mm")
    assert ended.code == 0, ended.said
    assert ended.out.startswith("cal.h5: wall 17.50 ± 1 mm from the axis and 40.0 ± 2 mm high")
    assert "standard deviation of zenith" in ended.out
    assert fitted["ball"] == pytest.approx(2.0)
    assert fitted["body"] == (18.0, 41.0)
    assert fitted["pattern"] == "graded"
    assert len(fitted["names"]) == 5
    np.testing.assert_array_equal(fitted["references"].dark, references.dark)
    assert fitted["precession"].pivot == precession.pivot
    calibration = io.open_calibration("cal.h5")
    assert calibration.references is not None
    assert calibration.zenith is not None
    np.testing.assert_array_equal(calibration.zenith.curve, a_response().curve)
    assert any("place-3.h5" in str(value) for value in calibration.process.values())


def test_without_a_calibration_one_is_made_and_printed_as_json(folder, fitted):
    ended = calibrate("--pattern", "uniform", "--tilt", "3deg", "--json")
    assert ended.code == 0, ended.said
    report = json.loads(ended.out)
    assert report["output"] == "cal.h5"
    assert report["found"]["rim"] == {"value": 40.0, "sigma": 2.0}
    assert report["degrees"]["residual_on_balls"] == pytest.approx(np.degrees(0.003))
    assert fitted["references"] is None
    assert fitted["precession"] is None
    assert fitted["pattern"] == "uniform"
    assert fitted["tilts"] == pytest.approx([np.radians(3)] * 5)
    assert io.open_calibration("cal.h5").camera.name == "left"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--press", "1mm"), "--press applies to presses on a rig"),
        (("--rig", "rig.toml", "--press", "1mm"), "both give the presses"),
    ],
)
def test_an_impossible_call_is_refused(folder, fitted, words, message):
    Path("rig.toml").touch()
    refused(message, *words, run=calibrate)
    assert not (folder / "cal.h5").exists()


def test_a_calibration_of_another_camera_is_refused_before_the_fit(folder, fitted):
    other = io.CameraId("right", SHAPE, np.dtype(np.uint8))
    io.save_calibration(io.Calibration(other, references=some_references()), "cal.h5")
    refused("right", run=calibrate)
    assert not fitted


def known(**parts):
    process = parts.pop("process", {})
    return io.Calibration(io.CameraId("left", SHAPE, np.dtype(np.uint8)), **parts, process=process)


def test_the_wall_is_measured_with_the_pixels_of_the_scale(folder, fitted):
    io.save_calibration(known(lens=a_lens()), "cal.h5")
    bare = io.Header("axial", press=1.0, tilt=TILT, camera="left")
    record(MadeUp(np.full((8, *SHAPE), 9, np.uint8), bare, phase=PHASE), folder / "place-1.h5")
    ended = calibrate()
    assert ended.code == 0, ended.said
    assert fitted["sizes"] == {(0.5, 0.6)}
    process = io.open_calibration("cal.h5").process
    assert (process["zenith.pixel_size_x"], process["zenith.pixel_size_y"]) == (0.5, 0.6)


def test_a_pixel_size_that_the_scale_denies_is_refused(folder, fitted):
    io.save_calibration(known(lens=a_lens()), "cal.h5")
    refused(
        "--pixel-size 0.1 mm: the scale of cal.h5 is 0.5 mm; remove the option",
        "--pixel-size",
        "0.1mm",
        run=calibrate,
    )
    assert not fitted


def test_a_pivot_measured_with_other_pixels_is_left_out(folder, fitted):
    process = {f"tilt.{key}": value for key, value in size_facts((0.102, 0.102)).items()}
    io.save_calibration(known(precession=a_precession(tilt=TILT), process=process), "cal.h5")
    ended = calibrate()
    assert ended.code == 0, ended.said
    assert "the calibrated tilt is ignored" in ended.said
    assert fitted["precession"] is None


def test_presses_that_leave_the_zenith_uncertain_are_reported(folder, fitted):
    ended = calibrate()
    assert "depth not determined, standard deviation of zenith 0.27 deg: press less" in ended.said
    assert "press less" in ended.said
    assert "residual on the balls at most 0.17 deg" in ended.out


def test_recordings_of_two_kinds_of_samples_are_refused(folder, fitted):
    header = io.Header("axial", pixel_size=(0.1, 0.1), press=1.0, tilt=TILT, camera="left")
    record(MadeUp(np.zeros((8, *SHAPE), np.uint16), header, phase=PHASE), folder / "place-4.h5")
    refused("place-4.h5 is of 'left', 7 x 5, uint16, place-1.h5 of 'left', 7 x 5, uint8", run=calibrate)
    assert not fitted
