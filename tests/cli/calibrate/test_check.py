import json

import numpy as np
import pytest
from commands import refused, run
from stacks import ball, record

from mirrorskin import io

SHAPE, PIXEL = (48, 50), 0.12


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A press on the paper's ball, and a calibration of references."""
    folder = tmp_path_factory.mktemp("check")
    press = ball(SHAPE, PIXEL, np.arange(0, 1.2, 0.04), noise=1.5, seed=3)
    record(press, folder / "press.h5")
    save(folder / "cal.h5")
    save(folder / "other.h5", (47, 50))
    return folder


def save(path, shape=SHAPE):
    dark, bright = np.full(shape, 16, np.float32), np.full(shape, 224, np.float32)
    little = np.full(shape, 0.1, np.float32)
    references = io.References(dark, bright, little, little, np.zeros(shape, np.uint8))
    camera = io.CameraId("", shape, np.dtype("uint8"))
    io.save_calibration(io.Calibration(camera, references), path)


def check(folder, *words):
    return run("calibrate check", folder / "press.h5", "--calibration", folder / "cal.h5", *words)


def test_the_errors_left_are_printed_in_a_table(folder):
    ended = check(folder, "--ball", "10mm")
    assert ended.code == 0, ended.said
    head, height, place = ended.out.splitlines()
    assert head.split()[:4] == ["what", "when", "rms", "bias"]
    assert height.split()[:2] == ["height", "after"]
    assert place.startswith("ball of 10 mm found at")


def test_json_contains_the_cells_too(folder):
    report = json.loads(check(folder, "--ball", "10mm", "--cells", "4", "--json").out)
    assert np.shape(report["after"]["height"]["cells"]["rms"]) == (4, 4)
    assert abs(report["after"]["height"]["bias"]) < 0.02
    assert report["before"] == {}


def test_a_picture_is_drawn(folder, tmp_path):
    ended = check(folder, "--ball", "10mm", "-o", tmp_path / "check.png")
    assert ended.code == 0, ended.said
    assert (tmp_path / "check.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--ball", "0mm"), "diameter is 0 mm: give a length above 0"),
        (("--ball", "10mm", "--cells", "0"), "cells"),
    ],
)
def test_impossible_input_is_refused_in_a_line(folder, words, message):
    refused(message, folder, *words, run=check)
