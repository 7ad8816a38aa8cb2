"""Several thresholds: bounds of the sheet's inclination, and refusals."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from bare import bare
from commands import run
from stacks import record

from mirrorskin import engine, io
from mirrorskin.engine.press import Levels
from mirrorskin.twin import Camera, Sphere, Twin, Vertical

HEIGHT, RADIUS = 40.0, 17.5  # of the twin's wall, mm
STEPS = [math.atan2(RADIUS, HEIGHT) / 2, math.radians(20), math.radians(30)]
SHARES = [1 / 6, 1 / 2, 5 / 6]


@pytest.fixture(scope="module")
def press(tmp_path_factory):
    """A ball under a wall whose light has three levels, and the steps between them."""
    wall = tmp_path_factory.mktemp("wall") / "steps.png"
    z = HEIGHT * (1 - (np.arange(400) + 0.5) / 400)
    light = np.array([85, 170, 255], np.uint8)[np.searchsorted(STEPS[1:], np.arctan2(RADIUS, z) / 2)]
    cv2.imwrite(str(wall), np.repeat(light[:, np.newaxis], 8, axis=1))
    return Twin(
        object=Sphere(10.0),
        shape=(56, 56),
        pixel_size=0.15,
        movement=Vertical(np.arange(0.03, 1.0, 0.03)),
        optics="cylinder",
        pattern=wall,
        camera=Camera(noise=1.0, seed=1),
        references="exact",
    )


@pytest.fixture(scope="module")
def result(press):
    return engine.reconstruct(press, thresholds=SHARES, inclinations=STEPS, fill=False)


def test_the_true_inclination_is_within_its_bounds(press, result):
    truth = press.truth
    off = np.min([np.abs(truth.zenith - step) for step in STEPS], axis=0) > math.radians(3.5)
    selected = (truth.contact == 1) & off & (result.slope_min > 0)
    assert np.count_nonzero(selected) > 200
    assert len(np.unique(result.slope_min[selected])) == 3
    assert (truth.zenith[selected] >= result.slope_min[selected]).all()
    assert not (truth.zenith[selected] > result.slope_max[selected]).any()


def test_bounds_are_neighbouring_steps(result):
    lower, upper = [0, *STEPS], [*STEPS, np.nan]
    for low, high in zip(lower, upper, strict=True):
        here = result.slope_min == np.float32(low)
        np.testing.assert_allclose(result.slope_max[here], high, rtol=1e-6)


def test_heights_are_those_of_the_lowest_threshold(press, result):
    single = engine.reconstruct(press, threshold=SHARES[0], fill=False)
    np.testing.assert_array_equal(result.height, single.height)
    assert single.slope_min is None
    assert result.process["threshold"] == SHARES[0]


def test_one_threshold_gives_bounds_too(press, result):
    single = engine.reconstruct(press, thresholds=SHARES[1:2], inclinations=STEPS[1:2], fill=False)
    np.testing.assert_array_equal(single.slope_min > 0, result.slope_min >= np.float32(STEPS[1]))


def test_invalid_pixels_have_no_bounds():
    frames = np.zeros((6, 1, 4), np.float32)
    frames[3:, 0] = [0, 0.3, 0.9, np.nan]
    options = {"thresholds": [0.2, 0.8], "inclinations": [0.25, 0.5], "dark": 0, "bright": 1, "noise": 0.01}
    result = bare(Levels(**options), frames, travel=0.1 * np.arange(6))
    np.testing.assert_array_equal(result.slope_min, np.array([[0, 0.25, 0.5, np.nan]], np.float32))
    np.testing.assert_array_equal(result.slope_max, np.array([[0.25, 0.5, np.nan, np.nan]], np.float32))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"thresholds": [0.2, 0.8]}, "2 thresholds and 0 inclinations"),
        ({"thresholds": [0.8, 0.2], "inclinations": [0.2, 0.4]}, "from the lowest to the highest"),
        ({"thresholds": [], "inclinations": []}, "from the lowest to the highest"),
        ({"thresholds": [0.2, 0.8], "inclinations": [0.4, 0.2]}, "must rise with the thresholds"),
        ({"thresholds": [0.2, 0.8], "inclinations": [0.4, 2.0]}, "between 0 and 90"),
        ({"thresholds": [0.2, 1.8], "inclinations": [0.2, 0.4]}, "thresholds 1.8"),
        ({"thresholds": [0.5], "inclinations": [0.2], "method": "change-point"}, "method 'threshold'"),
    ],
)
def test_impossible_input_is_one_line(press, options, message):
    with pytest.raises(io.InputError, match=message):
        engine.reconstruct(press, **options)


def test_the_command_takes_them_repeated_or_with_commas(press, result, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    press.rewind()
    record(press, tmp_path / "press.h5")
    angles = ",".join(f"{step}rad" for step in STEPS)
    repeated = [word for threshold in SHARES for word in ("--thresholds", threshold)]
    commas = ["--thresholds", ",".join(map(str, SHARES))]
    for words in (repeated, commas):
        words = [*words, "--inclinations", angles, "--no-fill", "-o", "a.h5", "--overwrite"]
        ended = run("reconstruct", "press.h5", *words)
        assert ended.code == 0, ended.said
        np.testing.assert_array_equal(io.open_result("a.h5").slope_max, result.slope_max)
    for words, message in (
        (["--thresholds", "0.2,0.8"], "2 thresholds and 0 inclinations"),
        (["--threshold", "half"], "--threshold half: a number is needed"),
    ):
        ended = run("reconstruct", "press.h5", *words, "-o", "b.h5")
        assert (ended.code, ended.said.count("\n")) == (2, 1)
        assert message in ended.said
