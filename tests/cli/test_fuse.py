"""`mirrorskin fuse`: one surface from a press and a rotation; and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from commands import done, refused, run
from stacks import record

from mirrorskin import engine, io
from mirrorskin.twin import Axial, Camera, Twin, Vertical

SHAPE, PIXEL = (44, 48), 0.25
TRAVEL = 0.1 * np.arange(1, 21)
PHASE = np.arange(8) * np.pi / 4
DETECTOR = "entry/instrument/detector"


def twin(movement, pattern="uniform", pixel_size=PIXEL, shape=SHAPE):
    return Twin(
        object="sphere",
        shape=shape,
        pixel_size=pixel_size,
        movement=movement,
        pattern=pattern,
        camera=Camera(noise=0.5),
    )


def press(**changes):
    return twin(Vertical(TRAVEL), **changes)


def turn(**changes):
    return twin(Axial(PHASE, np.radians(2.5), 1.5), "linear", **changes)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """The recordings of a press and a rotation, made once."""
    place = tmp_path_factory.mktemp("kept")
    for name, source in (("press.h5", press()), ("turn.h5", turn())):
        record(source, place / name, truth=lambda source=source: source.truth)
    return place


@pytest.fixture(autouse=True)
def folder(kept, tmp_path):
    for file in kept.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())


def fuse(*words, names=("press.h5", "turn.h5")):
    """Return the result, and how the command ended."""
    ended = done("fuse", *names, "-o", "out.h5", "--overwrite", *words)
    return io.open_result("out.h5"), ended


def foreign(name, stack):
    """Keep a recording's frames alone, in a layout of somebody else's."""
    with io.open_recording(name) as source:
        frames = np.concatenate([source.read().frames for _ in range(source.shape[0])])
    with h5py.File(name, "w") as file:
        file[stack] = frames


def zenith_scale():
    """Return the options that tell what the rotation's file does."""
    with io.open_recording("turn.h5") as recording:
        gain, offset = (np.median(getattr(recording.header, f"zenith_{name}")) for name in ("gain", "offset"))
    return ["--zenith-gain", f"{gain}/rad", "--zenith-offset", f"{offset}"]


def without(name, *lost):
    with h5py.File(name, "a") as file:
        for dataset in lost:
            del file[dataset]


def test_a_press_and_a_rotation_become_one_surface():
    ended = run("fuse press.h5 turn.h5")
    assert ended.code == 0
    assert "warning" not in ended.said
    result = io.open_result("press-fused.h5")
    answered = np.count_nonzero(np.isfinite(result.height))
    lowest, highest = np.nanmin(result.height), np.nanmax(result.height)
    filled = np.count_nonzero(result.filled)
    start = f"press-fused.h5: height at {answered} of {result.height.size} pixels ({filled} filled), "
    assert ended.out.startswith(f"{start}from {lowest:.3f} to {highest:.3f} mm")
    assert ended.out.count("\n") == 1
    with io.open_recording("press.h5") as recording:
        error = result.height - recording.truth.height
    assert np.sqrt(np.nanmean(error**2)) < 0.05
    assert abs(error[SHAPE[0] // 2, SHAPE[1] // 2]) < 0.05  # at the top, which neither saw
    assert result.filled[SHAPE[0] // 2, SHAPE[1] // 2] == 1
    text = run("info press-fused.h5").out
    assert "map height" in text
    assert "map filled" in text
    assert "height RMS error" in run("score press-fused.h5 --truth press.h5").out


def test_json_contains_the_engine_s_surface_and_where_it_came_from():
    result, ended = fuse("--json")
    report = json.loads(ended.out)
    assert report["output"] == "out.h5"
    assert report["summary"]["what"] == "height"
    assert report["summary"]["filled"] == np.count_nonzero(result.filled)
    assert report["summary"]["components"] == result.component.max() + 1
    assert report["summary"]["offset_unknown"] == np.count_nonzero(result.offset_unknown)
    assert report["process"]["vertical_source"].endswith("press.h5")
    assert report["process"]["axial_source"].endswith("turn.h5")
    with io.open_recording("press.h5") as vertical, io.open_recording("turn.h5") as axial:
        expected = engine.fuse(vertical, axial)
    np.testing.assert_array_equal(result.height, expected.height)
    np.testing.assert_array_equal(result.filled, expected.filled)


def test_options_replace_properties_missing_in_files_of_others():
    ours, _ = fuse("--no-register")
    scale = zenith_scale()
    foreign("press.h5", "raw/images")
    foreign("turn.h5", "raw/images")
    with h5py.File("turn.h5", "a") as file:
        file["raw/others"] = file["raw/images"][()]
    words = ["--travel-step", "0.1mm", "--travel-start", "0.1mm", "--phase-step", "45deg"]
    words += ["--tilt", "2.5deg", "--pixel-size", "0.25mm", "--dataset", "/raw/images", "--no-register"]
    theirs, _ = fuse(*words, *scale)
    both = np.isfinite(ours.height) & np.isfinite(theirs.height)
    assert both.sum() > 0.8 * np.isfinite(ours.height).sum()
    assert np.median(np.abs(ours.height - theirs.height)[both]) < 0.05


def test_a_rotation_whose_pivot_is_unknown_is_not_registered():
    without("turn.h5", "entry/instrument/stage/pivot")
    refused("pivot", "fuse press.h5 turn.h5")
    fuse("--no-register")


def test_a_rotation_without_a_gain_is_refused_and_it_can_be_given():
    scale = zenith_scale()
    without("turn.h5", f"{DETECTOR}/zenith_gain", f"{DETECTOR}/zenith_offset")
    line = refused("", "fuse press.h5 turn.h5")
    assert "turn.h5" in line
    assert "gain" in line
    fuse(*scale)


def test_both_are_read_with_a_calibration():
    with io.open_recording("turn.h5") as recording:
        shape, dark, bright = recording.shape[1:], recording.header.dark, recording.header.bright
    little = np.full(shape, 0.1, np.float32)
    references = io.References(dark, bright, little, little, np.zeros(shape, np.uint8))
    io.save_calibration(io.Calibration(io.CameraId("", shape, np.dtype("uint8")), references), "cal.h5")
    plain, calibrated = fuse()[0], fuse("--calibration", "cal.h5")[0]
    assert (
        calibrated.process["vertical_bright"]
        == calibrated.process["axial_bright"]
        == "map of the calibration"
    )
    np.testing.assert_array_equal(calibrated.calibration.references.bright, bright)
    np.testing.assert_allclose(calibrated.height, plain.height, atol=1e-4)
    io.save_calibration(io.Calibration(io.CameraId("other", shape, np.dtype("uint8"))), "cal.h5")
    refused("other", "fuse press.h5 turn.h5", "--calibration", "cal.h5")


GRIDS = {
    "of another size": ({"shape": (40, 48)}, ["40", "44"]),
    "of other pixels": ({"pixel_size": 0.2}, ["0.25", "0.2"]),
}


@pytest.mark.parametrize("kind", GRIDS)
def test_grids_that_differ_are_refused_with_both(kind):
    changes, words = GRIDS[kind]
    record(turn(**changes), Path("other.h5"))
    line = refused("", "fuse press.h5 other.h5")
    for word in ("press.h5", "other.h5", *words):
        assert word in line


@pytest.mark.parametrize(
    "names", [("press.h5", "press.h5"), ("turn.h5", "turn.h5"), ("turn.h5", "press.h5")], ids="-".join
)
def test_a_recording_of_the_other_motion_is_refused(names):
    line = refused("", "fuse", *names)
    assert "a vertical one and an axial one" in line or "give the press first" in line
    assert any(name in line for name in names)


def test_a_result_is_not_a_recording():
    io.save_result(io.Result(height=np.zeros(SHAPE, np.float32)), "out.h5")
    refused("out.h5 is a result", "fuse", *("press.h5", "out.h5"))


@pytest.mark.parametrize("name", ["press.h5", "turn.h5"])
def test_neither_input_is_overwritten(name):
    refused("is the input", "fuse press.h5 turn.h5", "-o", name)


REFUSED = {
    "no such press": ([], ("gone.h5", "turn.h5"), "gone.h5: no such file"),
    "no such rotation": ([], ("press.h5", "gone.h5"), "gone.h5: no such file"),
    "a tilt without a unit": (["--tilt", "2"], None, "--tilt 2: a unit is needed"),
    "a gain of no angle": (["--zenith-gain", "4"], None, "--zenith-gain 4"),
    "no folder for the output": (["-o", "no/such/out.h5"], None, "no folder"),
    "an unknown device": (["--device", "abacus"], None, "abacus"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_is_one_line(case):
    words, names, message = REFUSED[case]
    line = refused("", "fuse", *(names or ("press.h5", "turn.h5")), *words)
    assert message in line


def test_pixels_of_unknown_size_are_refused_and_can_be_given():
    for name in ("press.h5", "turn.h5"):
        without(name, f"{DETECTOR}/x_pixel_size", f"{DETECTOR}/y_pixel_size")
    refused("pixel size", "fuse press.h5 turn.h5")
    fuse("--pixel-size", "0.25mm")


def test_a_surface_that_was_not_found_is_one_line_and_no_file(monkeypatch):
    def fails(*sources, **options):
        raise engine.NotConverged("the residual is 0.3 after 100 iterations: allow more")

    monkeypatch.setattr("mirrorskin.engine.fuse", fails)
    line = "the residual is 0.3 after 100 iterations: allow more"
    assert refused(line, "fuse press.h5 turn.h5", code=1) == line
