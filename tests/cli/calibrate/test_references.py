"""``mirrorskin calibrate references``: from recordings to the calibration file."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from commands import done, refused, run
from reference_frames import expose, pixels, rolled, source
from stacks import record

from mirrorskin import io
from mirrorskin.cli.commands.calibrate import inputs

SHAPE = (21, 33)
NOISE = 1.5


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Where the recordings are, of pixels of which one is hot and one dead."""
    folder = tmp_path_factory.mktemp("references")
    dark, light = pixels(SHAPE)
    dark[3, 4] += 70
    light[8, 9] = 0
    record(source(expose(dark, NOISE, 24, seed=1)), folder / "dark.h5")
    record(source(expose(dark + light, NOISE, 24, seed=2)), folder / "bright.h5")
    record(source(rolled(dark, light, 80, 0.4, 0.1)), folder / "ball.h5")
    record(source(expose(np.full(SHAPE, 0.2), 0.5, 24, seed=3)), folder / "black.h5")
    return folder


def references(scene, path, *words, dark="dark.h5", bright="bright.h5"):
    return run("calibrate references --dark", scene / dark, "--bright", scene / bright, "-o", path, *words)


def test_a_dark_and_a_bright_recording_become_references(scene, tmp_path):
    path = tmp_path / "cal.h5"
    ended = references(scene, path)
    assert ended.code == 0, ended.said
    assert ended.said == ""
    assert ended.out.startswith(f"{path}: dark 15.")
    assert "24 frames" in ended.out
    assert ended.out.endswith("; 1 hot, 1 dead, 0 saturated\n")
    calibration = io.open_calibration(path)
    assert calibration.camera.name == "lab"
    assert calibration.camera.shape == SHAPE
    assert calibration.camera.dtype == np.uint8
    assert calibration.references.defects[3, 4] == 1
    assert calibration.references.defects[8, 9] == 2
    assert calibration.process["references.dark_frames"] == 24
    assert calibration.process["references.bright_sources"] == str(scene / "bright.h5")


def test_a_folder_of_pictures_is_accepted(scene, tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number, frame in enumerate(expose(pixels(SHAPE)[0], NOISE, 6)):
        cv2.imwrite(str(folder / f"{number:03}.png"), frame)
    ended = references(scene, tmp_path / "cal.h5", dark=folder)
    assert ended.code == 0, ended.said
    assert "6 frames" in ended.out


@pytest.mark.parametrize("name", ["dark.npy", "dark.tif"])
def test_frames_without_positions_are_accepted(scene, tmp_path, name):
    frames = expose(pixels(SHAPE)[0], NOISE, 6)
    if name.endswith(".npy"):
        np.save(tmp_path / name, frames)
    else:
        tifffile.imwrite(tmp_path / name, frames, photometric="minisblack")
    ended = references(scene, tmp_path / "cal.h5", dark=tmp_path / name)
    assert ended.code == 0, ended.said
    assert io.open_calibration(tmp_path / "cal.h5").process["references.dark_frames"] == 6


def test_too_few_frames_for_a_stated_noise_are_counted(scene, tmp_path):
    path = tmp_path / "cal.h5"
    message = refused("--noise 0.1", scene, path, "--noise", "0.1", run=references)
    needed = int(message.split(" more frames")[0].split()[-1])
    assert needed == pytest.approx((NOISE**2 + 1 / 12) / 0.1**2 - 24, rel=0.1)
    assert not path.exists()
    assert references(scene, path, "--noise", "0.5").code == 0


def test_a_camera_whose_dark_level_is_cut_off_is_reported(scene, tmp_path):
    ended = references(scene, tmp_path / "cal.h5", dark="black.h5")
    assert ended.code == 0, ended.said
    assert "black level" in ended.said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--dark", "dark.h5"), "--bright missing"),
        ((), "--dark and --bright missing"),
        (("--dark", "dark.h5", "--bright", "bright.h5", "--noise", "0"), "give a number above 0"),
        (("--dark", "dark.h5", "--bright", "bright.h5", "--press", "1mm"), "--rolled"),
        (("--dark", "bright.h5", "--bright", "dark.h5"), "exchanged"),
        (("--dark", "dark.h5", "--bright", "ball.h5"), "--rolled"),
        (("--dark", "dark.h5", "--bright", "none.h5"), "none.h5"),
        (("--rig", "rig.toml", "--rolled"), "--press is missing"),
    ],
)
def test_an_impossible_call_is_one_line(scene, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(scene)
    Path("rig.toml").touch()
    refused(message, "calibrate references -o", tmp_path / "cal.h5", *words)
    assert not (tmp_path / "cal.h5").exists()


def test_a_rig_is_asked_for_the_dark_and_for_the_ball_at_each_place(scene, tmp_path, monkeypatch):
    asked = []

    def take(rig, calibration, places, overwrite):
        assert (rig.name, calibration) == ("rig.toml", tmp_path / "cal.h5")
        asked.extend(places)
        return [scene / ("dark.h5" if place.name == "dark" else "ball.h5") for place in places]

    monkeypatch.setattr(inputs, "take", take)
    monkeypatch.setattr(inputs, "still_plan", lambda rig, travel=None: travel)
    Path("rig.toml").touch()
    words = ("--rig", "rig.toml", "--rolled", "--press", "1.5mm", "--places", "3", "--frames", "7")
    done("calibrate references -o", tmp_path / "cal.h5", *words)
    assert [place.name for place in asked] == ["dark", "bright-1", "bright-2", "bright-3"]
    assert [place.plan for place in asked] == [None, 1.5, 1.5, 1.5]
    assert all(place.frames == 4 for place in asked)
    assert asked[2].prompt == "put the ball at place 2 of 3, all over the field"
