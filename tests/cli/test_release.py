"""A press and its release, from the twin to the score, as a user runs them."""

import contextlib
import json

import numpy as np
import pytest
from commands import run

from mirrorskin import io

SMALL = ["--size", "70x60", "--pixel-size", "0.15mm"]


def mirrorskin(*words, cwd):
    with contextlib.chdir(cwd):
        ended = run(*words)
    assert ended.code == 0, ended.said
    return ended.out


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("release")
    text = mirrorskin("simulate", "vertical", *SMALL, "--release", "-o", "both.h5", cwd=place)
    assert text.startswith("both.h5: 59 frames of 70 x 60")
    return place


def scored(folder, recording, *words):
    report = json.loads(
        mirrorskin("reconstruct", recording, "-o", "r.h5", "--overwrite", *words, "--json", cwd=folder)
    )
    score = json.loads(mirrorskin("score", "r.h5", "--truth", recording, "--json", cwd=folder))
    return report["process"], score["height"]


def test_press_and_release_are_scored_alike(folder):
    press, down = scored(folder, "both.h5")
    release, up = scored(folder, "both.h5", "--event", "release")
    assert (press["event"], press["first_frame"], press["frames"]) == ("onset", 0, 30)
    assert (release["event"], release["first_frame"], release["frames"]) == ("release", 29, 30)
    assert io.open_result(folder / "r.h5").process["event"] == "release"
    assert up["answered"] == down["answered"] > 1000
    assert up["coverage"] == down["coverage"]
    assert up["median"] < 0.03
    assert up["p99"] < 1.05 * down["p99"]


def test_a_release_alone_is_made_by_a_step_below_zero(folder):
    words = ["--travel-step=-0.1mm", "--travel-start", "3mm", "-o", "up.h5"]
    mirrorskin("simulate", "vertical", *SMALL, *words, cwd=folder)
    with io.open_recording(folder / "up.h5") as recording:
        np.testing.assert_allclose(recording.travel, 3 - 0.1 * np.arange(30))
    process, score = scored(folder, "up.h5", "--event", "release", "--method", "change-point")
    assert (process["event"], process["method"], process["first_frame"]) == ("release", "change-point", 0)
    assert score["median"] < 0.03


def test_info_prints_how_far_a_recording_goes_and_back(folder):
    assert json.loads(mirrorskin("info", "both.h5", "--json", cwd=folder))["travel"] == "0.1 to 3 to 0.1 mm"
