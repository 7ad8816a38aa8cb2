"""`mirrorskin reconstruct` on a rotation: effect of each option, and refusals."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from commands import done, refused, run
from stacks import MadeUp, read_all, record, sphere

from mirrorskin import engine, io
from mirrorskin.evaluation.scenes.rotations import TILT, Setup, between, direction, expose

SHAPE = (9, 11)
X, Y = np.meshgrid(np.linspace(-1, 1, 11), np.linspace(1, -1, 9))
ZENITH, AZIMUTH = np.radians(10 + 40 * np.hypot(X, Y) / np.sqrt(2)), np.arctan2(Y, X)
SETUP = Setup(gain=400.0, noise=10.0, offset=2000.0, dtype="uint16")
TWO_TURNS = np.tile(SETUP.phase, 2)
HEADER = io.Header(
    "axial",
    pixel_size=(0.1, 0.1),
    press=1.0,
    tilt=TILT,
    pivot=(0.0, 0.0, 0.0),
    zenith_gain=np.array(SETUP.slope),
    zenith_offset=np.array(SETUP.offset),
)
TRUTH = io.Truth(
    height=np.full(SHAPE, -1.0, np.float32),
    zenith=ZENITH.astype(np.float32),
    azimuth=AZIMUTH.astype(np.float32),
    contact=np.ones(SHAPE, np.uint8),
)


def turn(name="turn.h5", phase=SETUP.phase, **changes):
    """Record a rotation over a dome; the changes are the header's."""
    frames = expose(direction(ZENITH, AZIMUTH), replace(SETUP, phase=tuple(phase)), seed=3)
    return record(MadeUp(frames, replace(HEADER, **changes), phase=np.array(phase)), Path(name), truth=TRUTH)


def reconstruct(*words, name="turn.h5"):
    """Return the result, and what was said."""
    ended = done("reconstruct", name, "-o", "out.h5", "--overwrite", *words)
    return io.open_result("out.h5"), ended


def without_note(said):
    """Return what was said but for notes of 8 bits, and of what the surface does not show of the light."""
    return re.sub(r"turn\.h5: (heights: slopes contradict each other|not identifiable) [^\n]*\n", "", said)


def errors(result):
    """Return the angles between the normals and the true ones, degrees."""
    return np.degrees(between(result.normals, direction(ZENITH, AZIMUTH)))


def test_a_rotation_becomes_normals_that_are_scored():
    turn()
    ended = run("reconstruct turn.h5")
    assert (ended.code, without_note(ended.said)) == (0, "")
    result = io.open_result("turn-result.h5")
    assert ended.out.startswith("turn-result.h5: normals at 99 of 99 pixels, zenith from ")
    lowest, highest = result.height.min(), result.height.max()
    ending = (
        f"in contact at 99, relative height from {lowest:.3f} to {highest:.3f} mm, absolute height unknown"
    )
    assert ended.out.endswith(f", {ending}\n")
    assert ended.out.count("\n") == 1
    assert np.max(errors(result)) < 2
    assert result.x is not None
    score = json.loads(run("score turn-result.h5 --truth turn.h5 --json").out)
    assert {"normal", "contact", "edges"} <= set(score)
    assert score["normal"]["answered"] == 99
    assert score["normal"]["rms"] < 0.5
    assert "normal RMS error" in run("score turn-result.h5 --truth turn.h5").out
    assert "map normals" in run("info turn-result.h5").out


def rise(radius):
    """Return how far the dome falls from the middle to so many millimetres off it, by fine steps."""
    steps = np.linspace(0, radius, 2001)
    # The picture's 0.1 mm a pixel are 0.2 in X, and 0.25 in Y.
    slope = np.tan(np.radians(10 + 40 * (2 * steps) / np.sqrt(2)))
    return float(np.sum((slope[1:] + slope[:-1]) / 2 * np.diff(steps)))


def test_the_normals_become_heights_in_millimetres():
    turn()
    result, _ = reconstruct()
    assert result.height.dtype == np.float32
    assert np.mean(result.height) == pytest.approx(0, abs=1e-5)
    assert result.height[4, 5] - result.height[4, 10] == pytest.approx(rise(0.5), rel=0.05)
    assert np.all(result.component == 0)
    np.testing.assert_array_equal(result.offset_unknown, [1])
    assert np.all(result.height_sigma > 0)
    assert "map component" in run("info out.h5").out
    assert "height" in json.loads(run("score out.h5 --truth turn.h5 --json").out)


def test_without_a_pixel_size_there_are_no_heights_and_a_line_states_the_reason():
    turn(pixel_size=None)
    result, ended = reconstruct()
    said = "turn.h5: no height: the recording has no pixel size; give --pixel-size\n"
    assert without_note(ended.said) == said
    assert ended.out.startswith("out.h5: normals at 99 of 99 pixels, zenith from ")
    assert not {"height", "height_sigma", "component"} & set(result.maps())
    without_file, ended = reconstruct("--pixel-size", "0.1mm")
    assert without_note(ended.said) == ""
    assert np.isfinite(without_file.height).all()


def test_a_surface_that_was_not_found_is_one_line_and_no_file(monkeypatch):
    def fails(*maps, **options):
        raise engine.NotConverged("the residual is 0.3 after 100 iterations: allow more")

    turn()
    monkeypatch.setattr("mirrorskin.engine.integration.normals_to_height.integrate_arrays", fails)
    before = set(Path().iterdir())
    ended = run("reconstruct turn.h5")
    line = "mirrorskin: turn.h5: the residual is 0.3 after 100 iterations: allow more\n"
    assert (ended.code, ended.out, ended.said) == (1, "", line)
    assert set(Path().iterdir()) == before


def test_each_turn_has_maps_of_its_own():
    turn(phase=TWO_TURNS)
    together, _ = reconstruct()
    assert together.zenith.shape == SHAPE
    each, ended = reconstruct("--per-turn")
    assert each.normals.shape == (2, *SHAPE, 3)
    assert {values.shape for name, values in each.maps().items() if name != "normals"} == {(2, *SHAPE)}
    assert "198 of 198 pixels in 2 turns" in ended.out
    assert np.max(errors(each)) < 2


def test_phases_from_a_file_replace_the_recording_s():
    turn("right.h5", phase=np.array(SETUP.phase) ** 1.1)
    with io.open_recording("right.h5") as recording:
        recorded = read_all(recording, 8)
    record(MadeUp(recorded.frames, HEADER, phase=np.zeros(8)), Path("wrong.h5"))
    Path("phases.txt").write_text(" ".join(f"{phase!r}rad" for phase in recorded.phase.tolist()))
    replaced, _ = reconstruct("--phases", "phases.txt", name="wrong.h5")
    expected, _ = reconstruct(name="right.h5")
    np.testing.assert_array_equal(replaced.normals, expected.normals)


def test_gain_offset_and_tilt_on_the_command_line_replace_the_recording_s():
    turn("right.h5")
    turn("wrong.h5", zenith_gain=np.array(7.0), zenith_offset=np.array(700.0), tilt=0.2)
    words = ["--zenith-gain", "400/deg", "--zenith-offset", "2000", "--tilt", "2.5deg"]
    replaced, _ = reconstruct(*words, name="wrong.h5")
    expected, _ = reconstruct(name="right.h5")
    np.testing.assert_allclose(replaced.normals, expected.normals, atol=1e-5)


def test_an_unknown_tilt_is_estimated():
    turn("unknown.h5", tilt=None)
    result, _ = reconstruct("--tilt", "estimate", name="unknown.h5")
    assert np.mean(errors(result)) < 2
    turn("wrong.h5", tilt=0.2)
    again, _ = reconstruct("--tilt", "estimate", name="wrong.h5")
    np.testing.assert_array_equal(again.normals, result.normals)


def test_heights_come_from_a_simulation_or_a_result():
    turn()
    io.save_result(io.Result(height=TRUTH.height), "heights.h5")
    plain, _ = reconstruct()
    by_truth, _ = reconstruct("--heights", "turn.h5")
    by_result, _ = reconstruct("--heights", "heights.h5")
    np.testing.assert_array_equal(by_truth.normals, by_result.normals)
    assert by_truth.process["heights"] != plain.process["heights"]


def test_without_a_gain_there_is_no_zenith_and_a_line_states_the_reason():
    turn(zenith_gain=None)
    result, ended = reconstruct()
    assert ended.said == "turn.h5: no zenith: the recording has no zenith gain; give --zenith-gain\n"
    assert ended.out.startswith("out.h5: modulation at 99 of 99 pixels, from ")
    assert {"azimuth", "modulation"} <= set(result.maps())
    assert not {"zenith", "normals", "normals_sigma"} & set(result.maps())
    np.testing.assert_allclose(np.cos(result.azimuth - AZIMUTH), 1, atol=0.01)
    json.loads(reconstruct("--json")[1].out)
    score = json.loads(run("score out.h5 --truth turn.h5 --json").out)
    assert "normal" not in score
    assert score["azimuth"]["rms"] < 5


def test_options_of_another_motion_are_refused():
    turn()
    record(sphere(), Path("press.h5"))
    message = refused("", "reconstruct turn.h5 --no-fill")  # of a pair of opposites the first is named
    assert message == "--fill applies to presses only; turn.h5 is a rotation. Remove it"
    message = refused("", "reconstruct press.h5 --zenith-gain 4/deg")
    assert message == "--zenith-gain applies to rotations only; press.h5 is a press. Remove it"


@pytest.mark.parametrize("motion", ["horizontal", "twist"])
def test_a_motion_without_a_method_is_refused_whatever_the_options(motion):
    record(sphere(), Path("press.h5"))
    refused(motion, "reconstruct press.h5 --motion", motion, "--threshold", "0.3")


CASES = {
    "a method of the other motion": ({}, ["--method", "threshold"], "threshold"),
    "no tilt": ({"tilt": None}, [], "tilt"),
    "a tilt of 0": ({}, ["--tilt", "0deg"], "tilt"),
    "a gain of 0": ({"zenith_gain": np.array(0.0)}, [], "gain"),
    "a gain of NaN": ({"zenith_gain": np.array(np.nan)}, [], "gain"),
    "gains of NaN": ({"zenith_gain": np.full(SHAPE, np.nan)}, [], "gain"),
    "a given gain of 0": ({}, ["--zenith-gain", "0/deg"], "gain"),
    "an offset of NaN": ({}, ["--zenith-offset", "nan"], "offset"),
    "a noise of 0": ({}, ["--noise", "0"], "noise"),
    "two phases": ({}, ["--phases", "two.txt"], "2 different phases"),
    "one phase": ({}, ["--phase-step", "360deg"], "at 1 phase do not determine"),
    "phases side by side": ({}, ["--phase-step", "0.001deg"], "too close together"),
    "seven phases": ({}, ["--phases", "seven.txt"], "seven.txt lists 7 phases for 8 frames"),
    "phases twice": ({}, ["--phases", "seven.txt", "--phase-step", "45deg"], "Remove one of them"),
    "heights from nowhere": ({}, ["--heights", "gone.h5"], "gone.h5: no such file"),
    "no heights": ({}, ["--heights", "flat.h5"], "flat.h5 contains no heights"),
    "heights of another size": ({}, ["--heights", "small.h5"], "small.h5 contains the heights of"),
    "heights without a pivot": ({"pivot": None}, ["--heights", "turn.h5"], "pivot"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_line(case):
    changes, words, message = CASES[case]
    turn(**changes)
    Path("two.txt").write_text("0deg 90deg " * 4)
    Path("seven.txt").write_text("0deg 45deg 90deg 135deg 180deg 225deg 270deg")
    io.save_result(io.Result(zenith=np.zeros(SHAPE, np.float32)), "flat.h5")
    io.save_result(io.Result(height=np.zeros((2, 3), np.float32)), "small.h5")
    refused(message, "reconstruct turn.h5", *words)


def test_two_phases_half_a_turn_apart_are_a_body_that_rocks():
    turn()
    ended = done("reconstruct turn.h5 --phase-step 180deg -o rocked.h5")
    assert "slope at" in ended.out
    assert io.open_result("rocked.h5").normals is None


def test_two_frames_are_no_rotation():
    with h5py.File("two.h5", "w") as file:
        file["frames"] = np.zeros((2, *SHAPE), np.uint8)
    words = ["--motion", "axial", "--phase-step", "45deg", "--tilt", "2.5deg", "--zenith-gain", "4/deg"]
    refused("2 different phases", "reconstruct two.h5", *words)
