"""`mirrorskin calibrate tilt`: from turns on a flat and a ball to a precession in a file."""

import re
from pathlib import Path

import numpy as np
import pytest
from calibrations import a_precession, a_response
from commands import refused, run
from leaning_turns import EIGHTHS, Ball, Flat, pictures
from stacks import MadeUp, record

from mirrorskin import io
from mirrorskin.cli.commands.calibrate import inputs
from mirrorskin.cli.commands.calibrate.tilt import warnings
from mirrorskin.hw import AxialPlan
from mirrorskin.twin import Axial, Body, Twin

SHAPE = (64, 64)
TALL = Body(height=1e5, scatter=0.0)  # whose wall reaches up to the camera
TRUTH = io.Precession(np.radians(2.53), 0.05, -1, 0.0, 0.0, (0.0, 0.0), (0.3, -0.2, 12.0))


@pytest.fixture(scope="module")
def turns(tmp_path_factory):
    """A folder with recordings that say a counter-clockwise circle about the sheet's centre."""
    folder = tmp_path_factory.mktemp("turns")
    turn(folder / "flat.h5", Flat(), 0.5, seed=3)
    turn(folder / "ball.h5", Ball(2.0, 0.2, -0.1), 0.45, seed=4)
    return folder


@pytest.fixture(autouse=True)
def here(turns, tmp_path):
    for path in turns.iterdir():
        (tmp_path / path.name).symlink_to(path)


def turn(path, thing, press, seed, **options):
    frames = pictures(
        thing, TRUTH.lean(EIGHTHS), press, TRUTH.pivot, shape=SHAPE, body=TALL, pattern="linear", seed=seed
    )
    record(MadeUp(frames, header(press, **options), phase=EIGHTHS), path)


def header(press, **options):
    movement = Axial([0.0], np.radians(2.5), press)
    twin = Twin(object=Ball(1.0), shape=SHAPE, pixel_size=0.1, movement=movement, pattern="linear", body=TALL)
    original = twin.header
    usual = {
        "pixel_size": (0.1, 0.1),
        "press": press,
        "tilt": original.tilt,
        "dark": original.dark,
        "bright": original.bright,
        "zenith_gain": original.zenith_gain,
        "zenith_offset": original.zenith_offset,
        "camera": "left",
    }
    return io.Header("axial", **usual | options)


def tilt(*words):
    return run("calibrate tilt -o cal.h5 --ball 4mm", *words)


def test_a_flat_and_a_ball_become_a_precession_in_a_file():
    ended = tilt("ball.h5", "--flat", "flat.h5")

    assert ended.code == 0, ended.said
    line = re.fullmatch(
        r"cal.h5: half-angle (\S+) ± \S+ deg, clockwise from (\S+) ± \S+ deg, ellipticity \S+ ± \S+,"
        r" pivot at x \S+ ± \S+ mm, y \S+ ± \S+ mm, z (\S+) ± \S+ mm\n",
        ended.out,
    )
    assert line is not None, ended.out
    assert [float(number) for number in line.groups()] == pytest.approx([2.53, 2.865, 12], abs=0.1)
    assert ended.said.startswith("note: the phase offset is assumed to be within 90 deg of 0")
    calibration = io.open_calibration("cal.h5")
    assert calibration.camera.name == "left"
    assert calibration.camera.shape == SHAPE
    precession = calibration.precession
    assert precession.direction == -1
    assert precession.tilt == pytest.approx(TRUTH.tilt, abs=np.radians(0.02))
    assert precession.lean(EIGHTHS) == pytest.approx(TRUTH.lean(EIGHTHS), abs=1e-4)
    assert precession.sigma["tilt"] < np.radians(0.02)
    assert calibration.process["tilt.sources"] == "ball.h5"
    assert calibration.process["tilt.flats"] == "flat.h5"
    assert calibration.process["tilt.ball"] == "4mm"
    assert (calibration.process["tilt.pixel_size_x"], calibration.process["tilt.pixel_size_y"]) == (0.1, 0.1)
    assert calibration.process["tilt.residual_place"] < 0.005
    assert "within 90 deg" in calibration.process["tilt.assumptions"]


def test_earlier_parts_are_kept_and_the_given_scale_is_used():
    ones = np.ones(SHAPE, np.float32)
    references = io.References(16 * ones, 224 * ones, ones, ones, np.zeros(SHAPE, np.uint8))
    camera = io.CameraId("left", SHAPE, np.dtype(np.uint8))
    io.save_calibration(io.Calibration(camera, references), "cal.h5")
    gain = f"{208 / 45 * 1.02}/deg"  # 2 per cent too much

    ended = tilt("ball.h5", "--flat", "flat.h5", "--zenith-gain", gain, "--zenith-offset", "16")

    assert ended.code == 0, ended.said
    calibration = io.open_calibration("cal.h5")
    assert calibration.references is not None
    assert calibration.precession.tilt == pytest.approx(TRUTH.tilt / 1.02, abs=np.radians(0.02))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "no recordings"),
        (["ball.h5"], "half-angle is not determined"),
        (["--flat", "flat.h5"], "neither phases"),
        (["ball.h5", "--press", "1mm"], "--press applies to presses on a rig"),
        (["--rig", "rig.toml"], "--press is missing"),
        (["ball.h5", "--flat", "other.h5"], "take all with one camera"),
        (["bare.h5"], "bare.h5: the recording has no zenith gain and offset"),
    ],
)
def test_impossible_input_is_one_line_and_writes_nothing(words, message):
    if "other.h5" in words:
        record(
            MadeUp(np.zeros((8, 5, 5), np.uint8), io.Header("axial", camera="right"), phase=EIGHTHS),
            "other.h5",
        )
    if "bare.h5" in words:
        bare = io.Header("axial", pixel_size=(0.1, 0.1), camera="left")
        record(MadeUp(np.zeros((8, 5, 5), np.uint8), bare, phase=EIGHTHS), "bare.h5")
    Path("rig.toml").touch()

    refused(message, *words, run=tilt)
    assert not Path("cal.h5").exists()


def test_a_rig_is_asked_for_balls_at_several_places(monkeypatch):
    asked = []

    def take(rig, calibration, places, settle, overwrite):
        asked.extend(places)
        return [calibration.with_name("ball.h5")]

    monkeypatch.setattr(inputs, "take", take)
    Path("rig.toml").touch()
    words = ("--rig", "rig.toml", "--press", "0.45mm", "--tilt", "2deg", "--places", "3", "--flat", "flat.h5")
    ended = tilt(*words)

    assert ended.code == 0, ended.said
    assert [place.name for place in asked] == ["tilt-1", "tilt-2", "tilt-3"]
    assert asked[1].prompt == "put the ball at place 2 of 3, all over the field"
    assert asked[0].plan == AxialPlan(0.45, np.radians(2), phase_step=np.pi / 4)


def test_a_wall_that_was_measured_with_other_pixels_is_refused():
    camera = io.CameraId("left", SHAPE, np.dtype(np.uint8))
    process = {"zenith.pixel_size_x": 0.098, "zenith.pixel_size_y": 0.098}
    io.save_calibration(io.Calibration(camera, zenith=a_response(SHAPE), process=process), "cal.h5")

    refused(
        "calibrate zenith again: it was made with pixels of 0.098 mm, ball.h5 states 0.1 mm",
        "ball.h5",
        "--flat",
        "flat.h5",
        run=tilt,
    )
    assert io.open_calibration("cal.h5").precession is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ellipticity": 0.002, "sigma": {"ellipticity": 0.0005}}, ["azimuths are off by up to 0.057 deg"]),
        ({"centre": (0.003, 0.004), "sigma": {}}, ["to the mean pose, which leans by 0.29 deg"]),
        ({"centre": (1e-4, 0.0), "sigma": {"centre_x": 1e-4, "centre_y": 1e-4}}, []),
    ],
)
def test_an_oval_and_a_mean_lean_are_named_with_what_they_spoil_where_they_matter(options, message):
    notes = list(warnings(a_precession(**{"ellipticity": 0.0, "centre": (0.0, 0.0)} | options)))
    assert len(notes) == len(message)
    assert all(part in note for part, note in zip(message, notes, strict=True))
